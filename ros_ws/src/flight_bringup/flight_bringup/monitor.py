# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Observe a flight from outside, for `rise-di fly`."""

import time

from flight_core.modes import Mode
from flight_core.outcome import Outcome, ended_early
from flight_core.rates import nanoseconds, seconds
from flight_core.text import bounded
from flight_core.vectors import FloatArray
from flight_ros import reports
from flight_ros.client import Client
from flight_ros.endpoints import require_no_publishers
from flight_ros.messages import Decoder, instant, stamp_of
from flight_ros.simulated_time import ClockRestarted, SimulatedTime
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import HostTime
from flight_ros.topics import (
    ENGAGEMENT,
    INTERNALS,
    LEARNING,
    LOCKSTEP,
    NEWEST_SAMPLES,
    NODE_STATE,
    PUBLISH,
    RECORDED,
    START,
    STATES,
    Y_M,
    NodeState,
    Y,
    offered,
)

# s, time to discover the publishers of another flight on this host: twice the measured 0.25 s.
DISCOVERY_TIME = 0.5
LOOP_INPUTS = (Y.name, Y_M.name)  # topics from which a controller computes u
FREE_DOMAIN = (
    "a domain of its own for each flight: set ROS_DOMAIN_ID, or a namespace of its own: --namespace"
)

MODES = {float(mode): mode.name for mode in Mode}


class FlightMonitor(Client):
    """Follows a flight by the states of its nodes and the progress of its log.

    If the flight is in real time, the monitor also follows the topic `internals` of the controller
    and a bridge's engagement.
    """

    def __init__(
        self,
        outputs: tuple[str, ...],
        *,
        lockstep: bool,
        use_sim_time: bool = False,
        learns: bool = False,
        namespace: str = "",
    ) -> None:
        super().__init__("monitor", namespace)
        self._created = time.monotonic()
        self.by_clock = use_sim_time
        self._simulated = SimulatedTime(self._node, self._refused) if use_sim_time else None
        self.clock: HostTime = self._simulated or time  # clock of the flight
        self._namespace = self._node.get_namespace().rstrip("/")
        # Each subscription slows a lockstep flight down.
        if lockstep:
            self._internals = None
        else:
            self._internals = PolledSubscription(self._node, INTERNALS, NEWEST_SAMPLES, raw=True)
        self._recorded = PolledSubscription(self._node, RECORDED, LOCKSTEP, raw=True)
        self._node_state = PolledSubscription(self._node, NODE_STATE, STATES)
        self._states: dict[str, str] = {}  # last state of each process
        self._publish_start = self._node.create_publisher(
            START.type, START.name, offered(START)
        ).publish
        self._engagement = None if lockstep else PolledSubscription(self._node, ENGAGEMENT, PUBLISH)
        self._learning = (
            PolledSubscription(self._node, LEARNING, PUBLISH, raw=True) if learns else None
        )
        self._decoder = Decoder(("mode", *(f"e.{output}" for output in outputs)))

    def has_time(self) -> bool:
        """Return whether the time of the flight is known.

        If the time is simulated, it is known once the first /clock has arrived.
        """
        return self._simulated is None or self._simulated.is_known()

    def ahead(self, lead: float) -> float:
        """Return the flight time, s, that may pass while `lead` s pass on the host.

        It is longer than `lead` if a simulator runs faster than real time.
        """
        return lead if self._simulated is None else lead * max(self._simulated.speed(), 1.0)

    def end_of_clock(self) -> Outcome | None:
        """Return the outcome if the simulator behind /clock has ended or restarted, else None."""
        if self._simulated is None or not self._simulated.is_known():
            return None
        try:
            self._simulated.require_one_simulation()
        except ClockRestarted as restart:
            return ended_early(f"ended early: {restart}")
        count = self._simulated.subscription.entity.get_publisher_count
        if not self._simulated.is_silent() or count():
            return None
        return ended_early("ended early: /clock has no publisher: its simulator ended")

    def is_ready(self, node: str, pid: int) -> bool:
        """Return whether the event loop of a node runs.

        The process id distinguishes the node from a node of the same name in another flight.
        """
        return self._state(node, pid) in {*NodeState}

    def is_matched(self, node: str, pid: int) -> bool:
        """Return whether each input of a node has a publisher."""
        return self._state(node, pid) in {*NodeState} - {NodeState.READY}

    def start(self, start_time: float) -> None:
        """Publish t = 0, as a system time in s, for the nodes."""
        self._publish_start(instant(nanoseconds(start_time)))

    def is_flying(self, node: str, pid: int) -> bool:
        """Return whether the aircraft has taken a u."""
        return self._state(node, pid) == NodeState.FLYING

    def is_completed(self, node: str, pid: int) -> bool:
        """Return whether the aircraft has completed a lockstep flight."""
        return self._state(node, pid) == NodeState.COMPLETED

    def _state(self, node: str, pid: int) -> str:
        for arrival in self._node_state.take():
            self._states[arrival.message.key] = arrival.message.value
        return self._states.get(f"{self._namespace}/{node}#{pid}", "")

    def newest(self) -> tuple[str, FloatArray] | None:
        """Return mode and e in the newest tick of the controller, or None without a new tick."""
        status = None
        for sample in self._decoded(self._internals, self._decoder.decode):
            if sample is not None:
                status = MODES.get(sample.value[0], "?"), sample.value[1:]
        return status

    def engagement(self) -> list[tuple[str, str]]:
        """Return the phases of a bridge since the last call, in order, each with its reason."""
        messages = () if self._engagement is None else self._engagement.take()
        return [
            (bounded(arrival.message.key), bounded(arrival.message.value)) for arrival in messages
        ]

    def learned(self) -> list[tuple[float, str]]:
        """Return what became of a learner's proposals since the last call.

        Each element has an instant by the clock of the stamps, s, and a sentence.
        """
        return [
            (seconds(report.stamp_ns), bounded(report.sentence))
            for report in self._decoded(self._learning, reports.decode)
        ]

    def recorded(self) -> float | None:
        """Return the instant up to which the log is complete, s.

        If the flight is in lockstep, this is a flight time. If it is in real time, it is a time by
        the clock of the stamps. Returns None if nothing has changed since the last call.
        """
        stamps = self._decoded(self._recorded, stamp_of)
        return seconds(stamps[-1]) if stamps else None

    def require_free_domain(self) -> None:
        """Check that the namespace has no aircraft and no reference model yet.

        Raises ParameterError if it has one of them. Only this ROS domain is checked. The check
        waits until DISCOVERY_TIME after the monitor was made, because publishers are not known
        earlier.
        """
        remaining = self._created + DISCOVERY_TIME - time.monotonic()
        require_no_publishers(self._node, LOOP_INPUTS, FREE_DOMAIN, remaining)
