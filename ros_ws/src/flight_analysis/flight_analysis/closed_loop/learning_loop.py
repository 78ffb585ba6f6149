# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A learner beside a controller in a loop of one process, and what a learner is."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from flight_core.modes import Mode
from flight_core.vectors import FloatArray
from rise_di_controller.controller import Controller, ControlOutput
from rise_di_controller.proposals import Event, Learning, Proposal, designed, outputs_without
from rise_di_controller.rise_di_config import RiseDiConfig


class LearnerResult(NamedTuple):
    """Result of an identification in flight: parameters to fly with, or the reason why there are none."""

    controller: RiseDiConfig | None
    sentence: str


class Learner(Protocol):
    """What learns from a flight. Channels in the law's order."""

    def take(self, stamp_ns: int, y: FloatArray, u: FloatArray, flown: int) -> None:
        """Take y and u, after its limits, of a tick of the engaged law, (m,), and the digest of its parameters."""

    def propose(self, flown: int, given_up: Sequence[str]) -> LearnerResult:
        """Parameters from the record so far.

        `flown` is the digest of the parameters at its end, `given_up` the outputs that have no model to the end of the
        engagement.
        """


Learn = Callable[[RiseDiConfig], Learner]


class Entry(NamedTuple):
    """An entry of A or B: its nominal value in SI, its relative error, and the standard deviation of that after the flight.

    Where the nominal value is 0 both are in parts of another `unit`.
    """

    matrix: str
    row: str
    column: str
    nominal: float
    error: float
    deviation: float
    unit: float  # of error and deviation, SI: the nominal value where it is not 0

    @property
    def name(self) -> str:
        """Such as B[q, elevator]."""
        return f"{self.matrix}[{self.row}, {self.column}]"

    @property
    def value(self) -> float:
        """After the flight, SI."""
        return self.nominal + self.unit * self.error


class Learned(NamedTuple):
    """Channels of the topic `learned`: `proposed`, and value and deviation of entries of A and B in the rows of the outputs."""

    names: tuple[str, ...]
    values: FloatArray


def learned(entries: Iterable[Entry], outputs: tuple[str, ...], *, proposed: bool) -> Learned:
    """What an identification found, and whether it became a proposal."""
    output_entries = [entry for entry in entries if entry.row in outputs]
    channels = {f"value.{entry.name}": entry.value for entry in output_entries}
    channels |= {f"deviation.{entry.name}": abs(entry.unit) * entry.deviation for entry in output_entries}
    return Learned(("proposed", *channels), np.array([float(proposed), *channels.values()]))


class Identifications:
    """The identifications of a learner that has them, each once."""

    def __init__(self, learner: Learner, outputs: tuple[str, ...]) -> None:
        self._learner = learner
        self._outputs = outputs
        self._last = None
        self._names: tuple[str, ...] = ()

    def next(self, proposal: LearnerResult) -> Learned | None:
        """That of a proposal; None where nothing was identified."""
        identification = getattr(self._learner, "identification", None)
        if identification is None or identification is self._last:
            return None
        self._last = identification
        entries = {entry.name: entry for entry in identification.entries if entry.nominal}
        self._names = self._names or tuple(entries)  # a topic keeps its channels: those of the rough airframe
        return learned((entries[name] for name in self._names), self._outputs, proposed=proposal.controller is not None)


def as_received(proposal: LearnerResult, start: RiseDiConfig, end_ns: int, flown: int) -> Proposal:
    """A proposal as the controller receives it: with the end of its window, and the digest of what flew then."""
    change = {} if proposal.controller is None else designed(start, proposal.controller)
    return Proposal(end_ns, start.digest(), flown, change, proposal.sentence)


class LearningLoop:
    """Steps a learner with the ticks of a controller, in simulated time."""

    def __init__(self, parameters: RiseDiConfig, learn: Learn, announce: Callable[[Event], None]) -> None:
        self._parameters = parameters
        self._learner = learn(parameters)
        self._identifications = Identifications(self._learner, parameters.outputs)
        self._learning = Learning(parameters, announce, simulated=True)

    def before_tick(self, controller: Controller, now_ns: int) -> None:
        """Let the proposals act that are due, and fall back where the law diverges."""
        self._learning.step(controller, now_ns)

    def authority(self, controller: Controller) -> FloatArray:
        """What the inputs can do at least, by the model that flies."""
        return self._learning.authority(controller)

    def after_tick(self, controller: Controller, output: ControlOutput | None, now_ns: int) -> Learned | None:
        """Record a tick, and propose where an identification is due. Returns what it found."""
        if output is None or not controller.has_internals:
            return None
        if controller.mode is Mode.ENGAGED:
            self._learner.take(output.stamp_ns, output.inputs.y, output.u, controller.digest)
        if not self._learning.ticked(controller, now_ns):
            return None
        proposal = self._learner.propose(controller.digest, outputs_without(controller.parameters))
        self._learning.receive(as_received(proposal, self._parameters, now_ns, controller.digest), controller, now_ns)
        return self._identifications.next(proposal)
