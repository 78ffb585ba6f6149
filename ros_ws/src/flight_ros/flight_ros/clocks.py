# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compare the clocks of the nodes of an aircraft on several hosts.

The result is the offset of each clock, and the mean delay of a message.

The delay is measured in both directions. Once a second, a node i publishes on `clocks` the least
difference D_ij = (clock of i at the reception) - (clock of j when it was sent) of the messages from
a node j. With the delay d_ji of a message from j to i, and theta_j = (clock of j) - (clock of i),

    D_ij = d_ji - theta_j,   D_ji = d_ij + theta_j,   so theta_j = (D_ji - D_ij) / 2
        where d_ij = d_ji.

If the two delays differ, the error is half of their difference. Source: D. L. Mills et al., RFC
5905 (2010), section 8.

Nodes of a host share the monotonic clock. So a node also sends the identity of its host, and the
lead of its clock over the monotonic clock. For nodes of one host, theta_j is then exact, and a busy
host that delays messages shifts no clock.
"""

import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rclpy.node import Node

from flight_core.rates import NANOSECONDS
from flight_core.text import bounded
from flight_ros.messages import Encoder, NamedDecoder
from flight_ros.receiver import Refusals
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import CLOCKS, offered

# number of differences that are kept for each node; the least of them has the least delay
WINDOW = 8
PEERS = 100  # largest number of nodes that are kept, because names can be forged
FORGET_NS = 5 * NANOSECONDS  # a node that is silent for this time is forgotten
DIFFERS = 0.005
"""Offset of a clock above which a warning is logged, s. It is half a period of a controller at
100 Hz, and several times the error of the estimate on a local network. An offset falsifies every
age, and stamps of a clock that is ahead delay u."""
# Channels of `clocks` beside the names of nodes. Those names begin with a slash.
HOST = "host"  # a number for the boot of the host; 0 is unknown
AHEAD = "ahead"  # clock of the node minus the monotonic clock, s
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
SYNCHRONISE = "synchronise the hosts, as by chrony or PTP"
RESTART = "the system clock of this host was set between the starts of the two: restart all nodes"


def number_of_host() -> float:
    """Return a number for this host's boot that float64 can hold, or 0 if the system has none."""
    return float(int(BOOT_ID.read_text(encoding="ascii")[:8], 16)) if BOOT_ID.exists() else 0.0


class ClockOfPeer(NamedTuple):
    """By how much the clock of another node is ahead, and the mean delay of a message, s."""

    offset: float
    delay: float
    advice: str = SYNCHRONISE  # advice for a clock that differs

    def __str__(self) -> str:
        return f"{abs(self.offset):.3f} s {'ahead of' if self.offset > 0.0 else 'behind'} this one"


class Peers:
    """The differences of clocks that a node measures, and the differences that its peers report.

    Times whose names end in _ns are in ns, and all others in s.
    """

    def __init__(self, own_name: str, host: float = 0.0) -> None:
        self.ahead = 0.0  # s, lead of this node's clock over the monotonic clock
        self._own = own_name
        self._host = host
        self._seen: dict[str, deque[float]] = {}
        self._reported: dict[str, float] = {}
        self._on_host: dict[str, float] = {}  # offsets of the nodes on this host
        self._heard_ns: dict[str, int] = {}

    def receive(
        self, sender: str, sent_ns: int, received_ns: int, reported: Mapping[str, float]
    ) -> None:
        """Take a message of another node.

        It was sent at `sent_ns` by the clock of the sender, and received at `received_ns` by the
        clock of this node. `reported` has the differences that the sender has measured, s, by node.
        """
        for name, heard_ns in list(self._heard_ns.items()):
            if received_ns - heard_ns > FORGET_NS:
                self.forget(name)
        if sender == self._own or (sender not in self._seen and len(self._seen) >= PEERS):
            return
        self._heard_ns[sender] = received_ns
        self._seen.setdefault(sender, deque(maxlen=WINDOW)).append(
            (received_ns - sent_ns) / NANOSECONDS
        )
        if self._own in reported:
            self._reported[sender] = reported[self._own]
            if self._host and reported.get(HOST) == self._host:
                self._on_host[sender] = reported.get(AHEAD, self.ahead) - self.ahead

    def forget(self, name: str) -> None:
        """Forget a node that has left, by its name."""
        for table in (self._seen, self._reported, self._heard_ns, self._on_host):
            table.pop(name, None)

    def differences(self) -> dict[str, float]:
        """Return the report of this node, which has the least difference for every peer.

        The report also has HOST and AHEAD, from which nodes of the same host compute exact offsets.
        """
        return {HOST: self._host, AHEAD: self.ahead} | {
            name: min(seen) for name, seen in self._seen.items()
        }

    def clocks(self) -> dict[str, ClockOfPeer]:
        """Return the clocks of the nodes that have reported."""
        seen = self.differences()
        clocks = {
            name: ClockOfPeer((reported - seen[name]) / 2.0, (reported + seen[name]) / 2.0)
            for name, reported in self._reported.items()
        }
        return clocks | {
            name: ClockOfPeer(offset, seen[name] + offset, RESTART)
            for name, offset in self._on_host.items()
        }


class PeerClocks:
    """Measures the clocks of the other nodes by messages on the topic `clocks`."""

    def __init__(self, node: Node, instance: str, refusals: Refusals) -> None:
        self._refusals = refusals
        self._peers = Peers(instance, number_of_host())
        self._instance = instance
        self._logged: dict[str, float] = {}
        self._publish = node.create_publisher(CLOCKS.type, CLOCKS.name, offered(CLOCKS)).publish
        self._subscription = PolledSubscription(node, CLOCKS, offered(CLOCKS), raw=True)
        self._decoder = NamedDecoder()

    def exchange(self, ahead_ns: int) -> None:
        """Once a second, take the reports of other nodes, and send one.

        `ahead_ns` is the system clock minus the time of the node.
        """
        self._peers.ahead = (time.time_ns() - ahead_ns - time.monotonic_ns()) / NANOSECONDS
        for sample, received in self._refusals.decoded(
            self._subscription, self._subscription.take(), self._decoder.decode
        ):
            self._peers.receive(
                sample.sender, sample.stamp_ns, received.received_ns - ahead_ns, sample.channels
            )
        differences = self._peers.differences()
        encoder = Encoder([*differences], self._instance)
        self._publish(encoder.encode(time.time_ns() - ahead_ns, np.array([*differences.values()])))

    def received(self) -> list[str]:
        """Return the names of the peers from which messages were received."""
        return [name for name in self._peers.differences() if name.startswith("/")]

    def clocks(self) -> dict[str, ClockOfPeer]:
        """Return the clocks of the peers."""
        return self._peers.clocks()

    def sentence_on(self, sender: str) -> str | None:
        """Say how far a sender's clock differs, as the end of a sentence about its time stamp.

        Returns None if the clock does not differ, or if this is unknown.
        """
        clock = self.clocks().get(sender)
        if clock is None or abs(clock.offset) <= DIFFERS:
            return None
        return bounded(f": the clock of {sender} is {clock}")

    def report(self) -> dict[str, object]:
        """Return the clocks for the diagnostics."""
        report: dict[str, object] = {}
        for name, clock in sorted(self.clocks().items()):
            report |= {
                f"clock of {name} (s)": f"{clock.offset:+.4f}",
                f"delay of {name} (s)": f"{clock.delay:.4f}",
            }
        return report

    def news(self) -> list[str]:
        """Write a sentence for every clock whose offset has changed by more than DIFFERS.

        An offset of at most DIFFERS is taken as 0: the clock agrees.
        """
        sentences = []
        for name, clock in self.clocks().items():
            offset = clock.offset if abs(clock.offset) > DIFFERS else 0.0
            if abs(offset - self._logged.get(name, 0.0)) > DIFFERS:
                self._logged[name] = offset
                agrees = "agrees with this one" if offset == 0.0 else f"is {clock}: {clock.advice}"
                sentences.append(bounded(f"the clock of {name} {agrees}"))
        return sentences
