# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A learner beside a controller in a loop of one process: when its proposals act, and when the law falls back."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from flight_core.parameters import ParameterError, flatten
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import FloatArray
from rise_di_controller.controller import Controller, ControlOutput
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di import RiseDiConfig


class Proposal(NamedTuple):
    """Result of an identification in flight: parameters to fly with, or the reason why there are none."""

    controller: RiseDiConfig | None
    sentence: str


class Learner(Protocol):
    """What learns from a flight. Channels in the law's order."""

    def take(self, stamp_ns: int, y: FloatArray, u: FloatArray) -> None:
        """Take y and u, after its limits, of a tick, (m,)."""

    def propose(self) -> Proposal:
        """Parameters from the record so far."""


class Event(NamedTuple):
    """What a learner did at an instant: a change of the controller's parameters by dotted name, or none, and why."""

    stamp_ns: int
    change: Mapping[str, Any]
    sentence: str


Learn = Callable[[RiseDiConfig], Learner]


class LearningLoop:
    """Steps a learner with the ticks of a controller. A proposal acts `latency` after the end of its window."""

    def __init__(self, parameters: RiseDiConfig, learn: Learn, announce: Callable[[Event], None]) -> None:
        assert parameters.learn is not None  # noqa: S101 - the caller makes no loop without it
        self._settings, self._announce = parameters.learn, announce
        self._learner, self._waiting = learn(parameters), list[tuple[int, Proposal]]()
        self._flown: ControllerConfig = parameters

    def before_tick(self, controller: Controller, now_ns: int) -> None:
        """Take the proposals that are due, and fall back where the law diverges."""
        while self._waiting and self._waiting[0][0] <= now_ns:
            proposal = self._waiting.pop(0)[1]
            if proposal.controller is not None:
                self._take(controller, now_ns, proposal.controller, proposal.sentence)
        if (fallback := controller.fallback()) is not None:
            self._take(controller, now_ns, fallback, "diverges: falls back to the law of the start")

    def after_tick(self, output: ControlOutput | None, now_ns: int) -> None:
        """Record a tick, and propose where an identification is due. `now_ns` is the flight time."""
        if output is not None:
            self._learner.take(output.stamp_ns, output.inputs.y, output.u)
        if self._settings.is_due(seconds(now_ns)):
            proposal = self._learner.propose()
            if proposal.controller is None:
                self._announce(Event(now_ns, {}, proposal.sentence))
            self._waiting.append((now_ns + nanoseconds(self._settings.latency), proposal))

    def _take(self, controller: Controller, now_ns: int, new: ControllerConfig, sentence: str) -> None:
        try:
            controller.retune(new)
        except ParameterError as error:
            self._announce(Event(now_ns, {}, f"refused: {error}"))
            return
        self._announce(Event(now_ns, changes(self._flown, new), sentence))
        self._flown = new


def changes(old: ControllerConfig, new: ControllerConfig) -> dict[str, Any]:
    """What differs between two parameter sets, by dotted name; None for a parameter that is gone."""
    before, after = dict(flatten(old.model_dump())), dict(flatten(new.model_dump()))
    return {name: after.get(name) for name in before | after if before.get(name) != after.get(name)}
