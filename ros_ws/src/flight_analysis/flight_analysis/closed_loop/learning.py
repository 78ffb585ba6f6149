# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A learner beside a controller in a loop of one process, and what a learner is."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from flight_core.modes import Mode
from flight_core.vectors import FloatArray
from rise_di_controller.controller import Controller, ControlOutput
from rise_di_controller.learning import Event, Learning, designed
from rise_di_controller.learning import Proposal as ReceivedProposal
from rise_di_controller.rise_di import RiseDiConfig


class Proposal(NamedTuple):
    """Result of an identification in flight: parameters to fly with, or the reason why there are none."""

    controller: RiseDiConfig | None
    sentence: str


class Learner(Protocol):
    """What learns from a flight. Channels in the law's order."""

    def take(self, stamp_ns: int, y: FloatArray, u: FloatArray) -> None:
        """Take y and u, after its limits, of a tick of the engaged law, (m,)."""

    def propose(self) -> Proposal:
        """Parameters from the record so far."""


Learn = Callable[[RiseDiConfig], Learner]


def as_received(proposal: Proposal, start: RiseDiConfig, end_ns: int, flown: int) -> ReceivedProposal:
    """A proposal as the controller receives it: with the end of its window, and the digest of what flew then."""
    change = {} if proposal.controller is None else designed(start, proposal.controller)
    return ReceivedProposal(end_ns, start.digest(), flown, change, proposal.sentence)


class LearningLoop:
    """Steps a learner with the ticks of a controller, in simulated time."""

    def __init__(self, parameters: RiseDiConfig, learn: Learn, announce: Callable[[Event], None]) -> None:
        self._parameters, self._learner = parameters, learn(parameters)
        self._learning = Learning(parameters, announce, simulated=True)

    def before_tick(self, controller: Controller, now_ns: int) -> None:
        """Let the proposals act that are due, and fall back where the law diverges."""
        self._learning.step(controller, now_ns)

    def after_tick(self, controller: Controller, output: ControlOutput | None, now_ns: int) -> None:
        """Record a tick, and propose where an identification is due."""
        if output is None or not controller.has_internals:
            return
        if controller.mode is Mode.ENGAGED:
            self._learner.take(output.stamp_ns, output.inputs.y, output.u)
        if self._learning.ticked(now_ns):
            proposal = as_received(self._learner.propose(), self._parameters, now_ns, controller.digest)
            self._learning.receive(proposal, controller, now_ns)
