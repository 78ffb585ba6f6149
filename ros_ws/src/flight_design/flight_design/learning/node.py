# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run a learner as a node, which proposes feedforward and observer from the controller's ticks.

The search runs in a thread of low priority. If the flight is in real time, the loop does not wait
for the search.
"""

import os
import threading
import traceback
from collections.abc import Callable
from functools import partial

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from flight_analysis.closed_loop.learning_loop import (
    Identifications,
    Learned,
    LearnerResult,
    as_received,
)
from flight_analysis.closed_loop.scenario import load_scenario
from flight_core.modes import Mode
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_core.vectors import StampedVector
from flight_design.learning.params import LearnerConfig
from flight_design.learning.scenario_learner import learner
from flight_ros import reports
from flight_ros.flight_node import FlightNode
from flight_ros.messages import Decoder
from flight_ros.reports import Report
from flight_ros.ticker import Tick
from flight_ros.topics import INTERNALS, LEARNED, LOCKSTEP, PROPOSAL, RECORD_FOREIGN
from rise_di_controller.internals import GIVEN_UP
from rise_di_controller.learning.proposals import Updates

PERIOD_NS = NANOSECONDS // 10
NICE = 10  # nice value of a search in real time, which must not delay the loop


class LearnerNode(FlightNode[LearnerConfig]):
    """Takes y and u of each tick from `internals`, and publishes the proposals that are due.

    After a search, the guarantee of its proposal is proved. The proposal does not wait for this
    proof. While a search or a proof runs, the samples wait in the queue of the subscription, so the
    record of a search does not change. If the flight is in lockstep, the proposals therefore equal
    the proposals of a simulation in one process. If it is in real time, a search begins with the
    newest sample. If several identifications became due during a search, only the last of them is
    made.
    """

    def __init__(self) -> None:
        super().__init__("learner", LearnerConfig)
        scenario = load_scenario(self.parameters.scenario_file)
        lockstep = self.parameters.lockstep
        make = learner(scenario, real_time=not lockstep)
        if make is None:
            raise ParameterError(
                "learner.scenario_file: found a scenario without controller.learn, expected one "
                "that learns"
            )
        self._start = scenario.rise_di()
        assert self._start.learn is not None  # noqa: S101 - for the type checker
        self._settings, self._new_learner = self._start.learn, partial(make, self._start)
        names = ("mode", "age", "parameters", *(f"y.{name}" for name in self._start.outputs))
        names += tuple(f"u.{name}" for name in self._start.inputs)
        names += tuple(f"{GIVEN_UP}.{name}" for name in self._start.outputs)
        self._internals = self.receive(
            INTERNALS,
            Decoder(names).decode,
            self._take,
            max_age_ns=None,  # samples wait while a search runs
            lock=self.publisher_lock(self._timeouts_ns),
            qos=LOCKSTEP if lockstep else RECORD_FOREIGN,
        )
        self._publish, self._publish_learned = self.advertise(PROPOSAL), self.advertise(LEARNED)
        # the search of a proposal, or after it the proof of its guarantee
        self._search: threading.Thread | None = None
        self._is_sent = True  # whether the proposal of the last search has been published
        self._proposal = LearnerResult(None, None)
        self._found: Learned | None = None
        self._end_ns = 0
        self._flown = 0
        self._given_up: tuple[str, ...] = ()
        self._begin_record()

    def _begin_record(self) -> None:
        """Start over with an empty record."""
        self._learner, self._updates = self._new_learner(), Updates(self._settings)
        self._identifications = Identifications(self._learner, self._start.outputs)
        self._has_record = self._is_due = False
        self._said = "no model yet"

    def period_ns(self) -> int:
        return PERIOD_NS

    def tick(self, tick: Tick, now_ns: int) -> None:
        self._advance(now_ns)

    def advance(self) -> bool:
        return self._advance(0)

    def awaited_topic(self) -> str | None:
        return None if self._search is not None else self._internals.name

    def _timeouts_ns(self) -> tuple[int, int]:
        max_age_ns = nanoseconds(self._start.max_age)
        return max_age_ns, max_age_ns + nanoseconds(self._start.hold + self._start.ramp)

    def _advance(self, now_ns: int) -> bool:
        """Publish what a finished search or proof found, and take samples until the next search.

        Returns whether there was a sample, a proposal or a proof.
        """
        advanced = False
        if self._search is not None and not self._search.is_alive():
            self._search = None
            if self._is_sent:
                self._publish_found()
            else:
                self._send_proposal()
                self._begin(self._prove)
            advanced = True
        while self._search is None and self._internals.poll(now_ns, 1):
            advanced = True
            if self.parameters.lockstep:
                self._begin_search()
        self._begin_search()
        return advanced

    def _send_proposal(self) -> None:
        """Publish the proposal of a finished search."""
        self._is_sent = True
        proposal = as_received(self._proposal, self._start, self._end_ns, self._flown)
        values = {"start": proposal.start, "flown": proposal.flown, **proposal.change}
        report = Report(
            self._end_ns,
            self.instance,
            proposal.sentence or "",
            values,
            is_warning=not proposal.change,
        )
        self._publish(reports.encode(report, "proposal"))
        if proposal.sentence is not None:
            self._said = f"{'proposes' if proposal.change else 'no model:'} {proposal.sentence}"
            self.get_logger().info(self._said)

    def _publish_found(self) -> None:
        """Publish what was identified, with the guarantee of its proposal if there is one."""
        if self._found is not None:
            encoder = self.encoder(self._found.names)
            self._publish_learned(encoder.encode(self._end_ns, self._found.values))

    def _begin_search(self) -> None:
        """Begin a search on the record so far, if one is due."""
        if self._is_due and self._search is None:
            self._is_due = self._is_sent = False
            self._begin(self._propose)

    def _begin(self, work: Callable[[], None]) -> None:
        """Begin a search or a proof in a thread of its own."""
        # A daemon thread does not delay the end of the node.
        self._search = threading.Thread(target=work, daemon=True)
        self._search.start()

    def _take(self, sample: StampedVector, now_ns: int) -> None:
        mode, age, flown = sample.value[:3].tolist()
        y, u, given_up = np.split(sample.value[3:], 3)
        if mode == Mode.INACTIVE:  # the next engagement begins with the initial law
            if self._has_record:
                self._begin_record()
            return
        self._end_ns = sample.stamp_ns + round(age * NANOSECONDS)
        if mode == Mode.ENGAGED:
            self._learner.take(sample.stamp_ns, y, u, int(flown))
        self._has_record = True
        self._flown = int(flown)
        self._given_up = tuple(
            name for name, is_left in zip(self._start.outputs, given_up, strict=True) if is_left
        )
        self._is_due = self._updates.is_due(self._end_ns) or self._is_due

    def _propose(self) -> None:
        if not self.parameters.lockstep:
            os.nice(NICE)  # on Linux for this thread alone
        try:
            self._proposal = self._learner.propose(self._flown, self._given_up)
        except Exception as error:  # the flight continues; in lockstep it waits for a proposal
            self.get_logger().error(f"unexpected exception: {traceback.format_exc()}")
            self._proposal = LearnerResult(
                None, f"the identification failed: {' '.join(str(error).split())}"
            )

    def _prove(self) -> None:
        """Prove the guarantee of the proposal, and note it with what was identified."""
        if not self.parameters.lockstep:
            os.nice(NICE)
        self._found = None
        try:
            self._found = self._identifications.next(self._proposal)
        except Exception:  # the flight continues without the guarantee
            self.get_logger().error(f"unexpected exception: {traceback.format_exc()}")

    def close(self) -> None:
        """Complete the searches that are due, if the flight is in lockstep.

        The log then has the results of these searches, as the log of a simulation in one process
        has.
        """
        if self.parameters.lockstep:
            self._advance(0)
            while self._search is not None:
                self._search.join()
                self._advance(0)

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        return DiagnosticStatus.OK, "identifies" if self._search is not None else self._said, {}
