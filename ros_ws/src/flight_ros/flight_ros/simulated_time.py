# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Take the time from the topic /clock, as a simulator sends it, in place of the host's clocks.

Ticks, stamps and ages are in this time. So a flight takes the same ticks at any speed of the
simulator, and a pause of /clock is a pause of the flight. What the process does for itself stays in
the time of the host: diagnostics, services and log lines.
"""

import time
from bisect import bisect_right

from rclpy.node import Node

from flight_core.rates import NANOSECONDS, seconds
from flight_ros.messages import stamp_of
from flight_ros.rclpy_private import WaitSet
from flight_ros.receiver import Refusals
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import NEWEST_SAMPLES, SIMULATED_CLOCK

# longest loss of /clock after which a node catches up with its missed ticks
LARGEST_JUMP_NS = 60 * NANOSECONDS
LONGEST_WAIT_NS = NANOSECONDS // 50  # so that signals and service calls are handled in a pause
SILENT_NS = NANOSECONDS  # silence of /clock after which a node says that it waits
HISTORY = 4096  # number of messages of /clock that are kept to date other messages


class ClockRestarted(Exception):  # noqa: N818 - an event of the simulator
    """Raised if /clock went back or far ahead, because another simulation begins."""


class SimulatedTime:
    """The newest instant of /clock, as a `HostTime`."""

    def __init__(self, node: Node, refusals: Refusals) -> None:
        self._refusals = refusals
        self.subscription = PolledSubscription(node, SIMULATED_CLOCK, NEWEST_SAMPLES, raw=True)
        self._context = node.context
        self._wait_set: WaitSet | None = None
        self._received_ns: list[int] = []  # receptions of the messages, by the system clock
        self._instants_ns: list[int] = []  # the instants in these messages
        self._first = 0, 0  # first instant, and its reception, ns
        self._jump_ns = 0

    def is_known(self) -> bool:
        """Return whether a message has come."""
        self._take()
        return bool(self._instants_ns)

    def is_silent(self) -> bool:
        """Return whether no message has come for SILENT_NS by the host's clock."""
        return not self.is_known() or time.time_ns() - self._received_ns[-1] > SILENT_NS

    def time_ns(self) -> int:
        """Return the newest instant; 0 before the first message."""
        return self._instants_ns[-1] if self.is_known() else 0

    monotonic_ns = time_ns

    def sleep(self, duration: float, /) -> None:
        """Wait for the next message, at most LONGEST_WAIT_NS by the host's clock.

        A duration of simulated time has no fixed length on the host, so `duration` is ignored.
        """
        self._wait_set = self._wait_set or WaitSet([self.subscription.entity], self._context)
        self._wait_set.wait(LONGEST_WAIT_NS)

    def at(self, system_ns: int) -> int:
        """Return the simulated time at an instant of the system clock.

        The time is interpolated between two messages.
        """
        received_ns = self._received_ns
        instants_ns = self._instants_ns
        place = min(max(bisect_right(received_ns, system_ns), 1), len(received_ns) - 1)
        if place == 0 or system_ns >= received_ns[place]:
            return instants_ns[-1]
        step_ns = instants_ns[place] - instants_ns[place - 1]
        share = max(system_ns - received_ns[place - 1], 0) / max(
            received_ns[place] - received_ns[place - 1], 1
        )
        return instants_ns[place - 1] + round(share * step_ns)

    def speed(self) -> float:
        """Return the ratio of simulated time to the host's time since the first message."""
        instant_ns, received_ns = self._first
        return (
            (self.time_ns() - instant_ns) / max(self._received_ns[-1] - received_ns, 1)
            if self.is_known()
            else 0.0
        )

    @property
    def has_restarted(self) -> bool:
        """Whether /clock went back or far ahead; the time has stood still since then."""
        return self._jump_ns != 0

    def require_one_simulation(self) -> None:
        """Raise ClockRestarted after a jump of /clock."""
        if self.has_restarted:
            publishers = self.subscription.entity.get_publisher_count()
            which = f" ({publishers} nodes publish it, expected one)" if publishers > 1 else ""
            raise ClockRestarted(
                f"/clock jumped by {seconds(self._jump_ns):+.3f} s{which}: another simulation "
                "begins"
            )

    def _take(self) -> None:
        messages = self.subscription.take()
        for instant_ns, received in self._refusals.decoded(self.subscription, messages, stamp_of):
            if self._jump_ns:
                return
            received_ns = received.received_ns or time.time_ns()
            if not self._instants_ns:
                self._first = instant_ns, received_ns
            elif not 0 <= (jump_ns := instant_ns - self._instants_ns[-1]) <= LARGEST_JUMP_NS:
                self._jump_ns = jump_ns
                return
            self._instants_ns.append(instant_ns)
            self._received_ns.append(received_ns)
        if len(self._instants_ns) > 2 * HISTORY:
            del self._instants_ns[:HISTORY], self._received_ns[:HISTORY]
