# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Flights of a campaign with a learner: side by side in the compiled loop, or one by one as those
of `rise-di fly --in-process`.
"""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from flight_analysis.closed_loop.learning_loop import Learn
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import error_metrics, inputs_by_part, true_error
from flight_campaign.campaign_course import build_course
from flight_campaign.definition import Definition
from flight_campaign.engines import Job
from flight_campaign.rows import Chunk
from flight_core.outcome import COMPLETED
from flight_core.parameters import require
from flight_core.rates import period_ns
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from rise_di_controller.proposals import UNVERIFIED, Event, EventKind

if TYPE_CHECKING:
    from flight_campaign.learning_fleet import LearningFleet

MakeLearner = Callable[[Scenario], Learn | None]
"""Makes the learner of a scenario, as `flight_design.learning.scenario_learner.learner`. Raises
ParameterError."""


class LearningOutcome(NamedTuple):
    """Outcomes of the identifications of a flight."""

    first_model: float  # s, when the first model flew; NaN without one
    models: int  # proposals that flew, without the rough model
    refused: int  # identifications refused by the learner, and proposals refused by the controller
    fallbacks: int  # to the law of the start, in all channels or in some


def learned(tape: Tape, events: Sequence[Event]) -> LearningOutcome:
    """Outcomes of the identifications of a flight, from its tape and its events."""
    proposed = tape["learned"]["proposed"] if "learned" in tape else np.ones(0)
    return _outcome(events, int(np.sum(proposed == 0.0)))


def _outcome(events: Sequence[Event], unproposed: int) -> LearningOutcome:
    """Outcomes from the events of a flight, and the number of identifications without a
    proposal.
    """
    flown = [
        event.stamp_ns
        for event in events
        if event.kind is EventKind.FLIES and UNVERIFIED not in event.sentence
    ]
    fallbacks = sum(event.kind in {EventKind.FALLBACK, EventKind.RESTART} for event in events)
    refused = unproposed + sum(event.kind is EventKind.REFUSED for event in events)
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


def _by_channel(flights: Sequence[Flight], kind: str) -> dict[str, FloatArray]:
    """A figure of the flights by channel, (N,) each."""
    values = [getattr(flight, kind) for flight in flights]
    by_channel = {}
    for name in values[0]:
        by_channel[name] = np.array([by_name[name] for by_name in values])
    return by_channel


MOST_KEPT = 8  # courses and learners
_KEPT: dict[tuple[object, str], Any] = {}


def _kept(make: Callable[..., Any], scenario: Scenario, **options: bool) -> Any:
    """What a function makes of a scenario, once in a process for those that differ in A and B of
    the aircraft alone, which neither a learner nor a course knows.
    """
    aircraft = scenario.aircraft.model_dump(exclude={"uncertainty"})
    known = vars(scenario) | {"aircraft": aircraft, "name": "", "path": ""}
    key = make, repr(known)
    if key not in _KEPT:
        if len(_KEPT) >= MOST_KEPT:
            _KEPT.clear()
        _KEPT[key] = make(scenario, **options)
    return _KEPT[key]


def side_by_side(
    definition: Definition,
    case: int,
    first: int,
    learn: Sequence[Learn],
    windows: tuple[int, ...] = (),
) -> "LearningFleet | None":
    """The aircraft from number `first` with their learners; None for a scenario beyond the compiled
    loop. `windows` as for `batch.fly`.
    """
    from flight_campaign import batch  # noqa: PLC0415 - JAX, which the command needs only for flights
    from flight_campaign.drawn_fleet import drawn_fleet  # noqa: PLC0415 - as above
    from flight_campaign.learning_fleet import LearningFleet, flies_side_by_side  # noqa: PLC0415 - as above

    scenario = definition.scenario(case)
    controller = scenario.rise_di()
    course = _kept(build_course, scenario, learns=True)
    if not flies_side_by_side(controller, course):
        return None
    vehicle = batch.vehicle(scenario)
    drawn = drawn_fleet(definition, scenario, first, len(learn))
    fleet, equipped = drawn.on_device(course, vehicle)
    return LearningFleet(fleet, equipped, course, controller, learn, windows)


def _fly_side_by_side(
    definition: Definition, case: int, first: int, count: int, learner: MakeLearner
) -> list[Flight]:
    """The flights of the `count` aircraft from number `first`.

    A flight that leaves the compiled loop, as one that falls back, flies again by itself.
    """
    scenarios = [definition.aircraft_scenario(first + k, case) for k in range(count)]
    controller = definition.scenario(case).rise_di()
    fleet = side_by_side(definition, case, first, [_kept(learner, each) for each in scenarios])
    if fleet is None:
        return [fly(each, learner) for each in scenarios]
    result, outcomes = fleet.fly()
    flights = []
    for k, outcome in enumerate(outcomes):
        if outcome.left_loop:
            flights.append(fly(scenarios[k], learner))
            continue
        rms, largest = (
            dict(zip(controller.outputs, values[:, k].tolist(), strict=True))
            for values in (result.rms, result.max)
        )
        slew = dict(zip(controller.effectors, result.slew[:, k].tolist(), strict=True))
        came_to = _outcome(outcome.events, outcome.unproposed)
        flights.append(Flight(False, rms, largest, slew, came_to))
    return flights


def fly_chunk(definition: Definition, job: Job, learner: MakeLearner) -> Chunk:
    """Fly a chunk of a campaign with learners."""
    from flight_campaign.drawn_fleet import drawn_fleet  # noqa: PLC0415 - JAX, as above

    case, chunk = job
    first = chunk * definition.chunk
    count = definition.size(job)
    scenario = definition.scenario(case)
    entries = drawn_fleet(definition, scenario, first, count).entries()
    flown = _fly_side_by_side(definition, case, first, count, learner)
    by_kind = {kind: _by_channel(flown, kind) for kind in ("rms", "max", "slew")}
    rms = np.array([by_kind["rms"][name] for name in scenario.controller.outputs])
    figures = {"score": definition.score(rms)}
    for kind, by_channel in by_kind.items():
        figures |= {f"{kind}.{name}": values for name, values in by_channel.items()}
    for name in LearningOutcome._fields:
        figures[name] = np.array([float(getattr(flight.learned, name)) for flight in flown])
    return Chunk(first, np.array([flight.diverged for flight in flown]), figures, entries)
