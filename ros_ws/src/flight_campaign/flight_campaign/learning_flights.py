# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Flights of a campaign with a learner, by the loop of `rise-di fly --in-process`."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from flight_analysis.closed_loop.learning_loop import Learn
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import error_metrics, inputs_by_part, true_error
from flight_core.outcome import COMPLETED
from flight_core.parameters import require
from flight_core.rates import period_ns
from flight_core.tape import Tape
from rise_di_controller.proposals import Event, EventKind

MakeLearner = Callable[[Scenario], Learn | None]
"""Makes the learner of a scenario, as `flight_design.learning.scenario_learner.learner`. Raises
ParameterError."""


class LearningOutcome(NamedTuple):
    """Outcomes of the identifications of a flight."""

    first_model: float  # s, when the first model flew; NaN without one
    models: int  # proposals that flew
    refused: int  # identifications refused by the learner, and proposals refused by the controller
    fallbacks: int  # to the law of the start, in all channels or in some


def learned(tape: Tape, events: Sequence[Event]) -> LearningOutcome:
    """Outcomes of the identifications of a flight, from its tape and its events."""
    flown = [event.stamp_ns for event in events if event.kind is EventKind.FLIES]
    fallbacks = sum(event.kind in {EventKind.FALLBACK, EventKind.RESTART} for event in events)
    refused = sum(event.kind is EventKind.REFUSED for event in events)
    if "learned" in tape:
        refused += int(np.sum(tape["learned"]["proposed"] == 0.0))
    return LearningOutcome(flown[0] / 1e9 if flown else math.nan, len(flown), refused, fallbacks)


class Flight(NamedTuple):
    """Figures of a flight, SI, by name: true errors at the ticks of the controller."""

    diverged: bool
    rms: dict[str, float]  # by output
    max: dict[str, float]
    slew: dict[str, float]  # mean abs(u_dot) by effector
    learned: LearningOutcome


def fly(scenario: Scenario, learner: MakeLearner) -> Flight:
    """Fly a scenario that learns. Raises ParameterError."""
    events: list[Event] = []
    tape = simulate(scenario, learn=learner(scenario), announce=events.append)
    true = true_error(tape)
    outputs = scenario.controller.outputs
    assert true is not None  # noqa: S101 - simulated flights have the truth
    at_ticks = true.stamp_ns % period_ns(scenario.controller.rate, "controller.rate") == 0
    errors = {name: error_metrics(true[name][at_ticks]) for name in outputs}
    slew = {name: parts["whole"].rate for name, parts in inputs_by_part(tape, ()).items()}
    rms = {name: metrics.rms for name, metrics in errors.items()}
    largest = {name: metrics.max for name, metrics in errors.items()}
    return Flight(tape.outcome != COMPLETED, rms, largest, slew, learned(tape, events))


def require_flyable(scenario: Scenario) -> None:
    """Raise ParameterError for a scenario with a learner that a campaign cannot fly."""
    aircraft = scenario.aircraft
    route = scenario.guidance
    require(
        not aircraft.is_jsbsim,
        "airframe",
        aircraft.airframe,
        "an airframe with matrices: a campaign draws their entries",
    )
    require(
        route is None,
        "guidance",
        "a section beside controller.learn",
        "none: the aircraft of a mission do not learn",
    )
