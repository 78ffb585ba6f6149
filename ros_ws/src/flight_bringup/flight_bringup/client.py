# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Clients of a flight: the check of the network between hosts, with its profile, and the pose for
FlightGear.
"""

import os
import socket
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path

import psutil

from flight_bringup.flightgear import packet
from flight_core.environment import PROFILE_VARIABLE
from flight_core.files import write_file, writing
from flight_guidance.route_file import Origin
from flight_ros.client import Client
from flight_ros.clocks import ClockOfPeer, PeerClocks
from flight_ros.messages import NamedDecoder
from flight_ros.network import addresses, network_profile, own_address, ports
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import NEWEST_SAMPLES, POSE
from flight_ros.transport import DISCOVERY_VARIABLE

POSE_TIMEOUT = 5.0  # s
EXCHANGE_PERIOD = 0.1  # s
# s, of exchanges after every host has been received: the least delay of many counts
SETTLE_TIME = 1.0


def write_profile(peers: str, file: Path) -> tuple[str, tuple[str, ...], Mapping[str, str]]:
    """Write the profile of this host to a file. Raises ParameterError.

    Returns the address of this host, those of all hosts, and the environment that selects the
    profile.
    """
    hosts = addresses(peers)
    local = {entry.address for entry in chain.from_iterable(psutil.net_if_addrs().values())}
    own_host = own_address(
        hosts, {address for address in local if address.count(".") == 3 and address != "127.0.0.1"}
    )
    with writing("--write", file, "the path of a file"):
        write_file(file, network_profile(own_host, hosts))
    return (
        own_host,
        hosts,
        {PROFILE_VARIABLE: str(file.absolute()), DISCOVERY_VARIABLE: "SYSTEM_DEFAULT"},
    )


class FlightGearClient(Client):
    """Sends the pose of an aircraft to FlightGear."""

    def __init__(self, namespace: str) -> None:
        super().__init__("flightgear", namespace, rosout=False)
        self._pose = PolledSubscription(self._node, POSE, NEWEST_SAMPLES, raw=True)
        self._decoder = NamedDecoder()
        self._newest: dict[str, float] = {}

    def wait(self) -> None:
        """Wait for a pose. Raises ParameterError without one."""
        self._spin_until(
            lambda: bool(self._take()),
            f"{self._pose.name}: not received, expected a flight in this domain",
        )

    def send(self, address: tuple[str, int], origin: Origin, ground: float, rate: float) -> None:
        """Send the newest pose at a rate, Hz, until no pose has come for POSE_TIMEOUT. `ground`:
        altitude of the origin, m.
        """
        heard = time.monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while (now := time.monotonic()) - heard < POSE_TIMEOUT:
                if self._take():
                    heard = now
                # FlightGear is not started yet, or the network is down for a while
                with suppress(OSError):
                    sender.sendto(packet(self._newest, origin, ground, int(time.time())), address)
                time.sleep(1.0 / rate)

    def _take(self) -> bool:
        """Take the newest pose. Returns whether one has come."""
        poses = [sample.channels for sample in self._decoded(self._pose, self._decoder.decode)]
        self._newest = next(filter(None, reversed(poses)), self._newest)
        return any(poses)


def domain_ports() -> tuple[int, int]:
    """The first and the last UDP port of the domain of this shell."""
    return ports(int(os.environ.get("ROS_DOMAIN_ID") or 0))


class NetworkClient(Client):
    """Exchanges clocks with the same command on the other hosts."""

    def __init__(self, own_host: str, peers: Sequence[str]) -> None:
        super().__init__("network", rosout=False)
        self._instances = {_instance(address): address for address in peers if address != own_host}
        self._clocks = PeerClocks(self._node, _instance(own_host), self._refused)

    def exchange(self, timeout: float) -> tuple[set[str], dict[str, ClockOfPeer]]:
        """Exchange until every host is received and receives, at most `timeout` s.

        Returns the hosts that are received, and of those that also receive this host the clocks.
        """
        received: set[str] = set()
        clocks: dict[str, ClockOfPeer] = {}
        end = time.monotonic() + timeout
        while (now := time.monotonic()) < end:
            self._clocks.exchange(0)
            received |= {
                self._instances[name] for name in self._clocks.received() if name in self._instances
            }
            known = self._clocks.clocks().items()
            new = {self._instances[name]: clock for name, clock in known if name in self._instances}
            if len(clocks) < len(new) == len(self._instances):
                end = min(end, now + SETTLE_TIME)
            clocks |= new
            time.sleep(EXCHANGE_PERIOD)
        return received, clocks


def _instance(address: str) -> str:
    return f"/network#{address}"
