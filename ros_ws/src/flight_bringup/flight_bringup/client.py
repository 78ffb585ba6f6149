# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check the network between hosts, and write the middleware profile that a host needs for it."""

import os
import time
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path

import psutil

from flight_core.environment import PROFILE_VARIABLE
from flight_core.files import write_file, writing
from flight_ros.client import Client
from flight_ros.clocks import ClockOfPeer, PeerClocks
from flight_ros.network import addresses, network_profile, own_address, ports
from flight_ros.transport import DISCOVERY_VARIABLE

EXCHANGE_PERIOD = 0.1  # s, time between two exchanges of clocks
# s for which the exchange continues after every host was received. The offset of a clock comes from
# the exchange with the least delay, so it takes many of them.
SETTLE_TIME = 1.0


def write_profile(peers: str, file: Path) -> tuple[str, tuple[str, ...], Mapping[str, str]]:
    """Write the middleware profile of this host to a file.

    Raises ParameterError if the addresses are not usable, if none of them belongs to this host, or
    if the file cannot be written. Returns the address of this host, the addresses of all hosts, and
    the environment that selects the profile.
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


def domain_ports() -> tuple[int, int]:
    """Return the first and the last UDP port of the ROS domain that this shell uses."""
    return ports(int(os.environ.get("ROS_DOMAIN_ID") or 0))


class NetworkClient(Client):
    """Exchanges clock readings with the same command that runs on the other hosts."""

    def __init__(self, own_host: str, peers: Sequence[str]) -> None:
        super().__init__("network", rosout=False)
        self._instances = {_instance(address): address for address in peers if address != own_host}
        self._clocks = PeerClocks(self._node, _instance(own_host), self._refused)

    def exchange(self, timeout: float) -> tuple[set[str], dict[str, ClockOfPeer]]:
        """Exchange clock readings until this host has one of every other host.

        This takes at most `timeout` s. Returns the hosts whose messages arrive at this host. Also
        returns, for each of these hosts that receives the messages of this host, the reading of its
        clock.
        """
        heard_hosts: set[str] = set()
        clocks: dict[str, ClockOfPeer] = {}
        end = time.monotonic() + timeout
        while (now := time.monotonic()) < end:
            self._clocks.exchange(0)
            heard_hosts |= {
                self._instances[name] for name in self._clocks.received() if name in self._instances
            }
            known_clocks = self._clocks.clocks().items()
            new_clocks = {
                self._instances[name]: clock
                for name, clock in known_clocks
                if name in self._instances
            }
            if len(clocks) < len(new_clocks) == len(self._instances):
                end = min(end, now + SETTLE_TIME)
            clocks |= new_clocks
            time.sleep(EXCHANGE_PERIOD)
        return heard_hosts, clocks


def _instance(address: str) -> str:
    return f"/network#{address}"
