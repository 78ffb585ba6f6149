# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly the aircraft of a campaign one by one, as `rise-di fly --in-process` does.

Aircraft that learn, and aircraft on a route, fly in this way.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from flight_analysis.closed_loop.learning_loop import Learn
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics.by_part import inputs_by_part
from flight_analysis.metrics.errors import error_metrics, true_error
from flight_analysis.metrics.transients import CAPTURE_TIME
from flight_analysis.report.guided import control_errors, time_outside
from flight_campaign.definition import Definition
from flight_campaign.engines import Job
from flight_campaign.rows import Chunk
from flight_core.outcome import End
from flight_core.parameters import require
from flight_core.rates import period_ns
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from flight_guidance.guidance_state import Lateral
from flight_guidance.params import GuidanceConfig
from rise_di_controller.learning.proposals import UNVERIFIED, Event, EventKind

MakeLearner = Callable[[Scenario], Learn | None]
"""Makes the learner of a scenario, as `flight_design.learning.scenario_learner.learner` does.
Raises ParameterError if the scenario cannot learn."""

CHUNK = 4
"""Aircraft in a chunk. With so few, the progress moves every minute and no core idles at the end.
"""


class LearningOutcome(NamedTuple):
    """What became of the identifications in a flight."""

    first_model: float  # s, instant from which the first learned model was used; NaN if none was
    models: int  # number of proposals that were used, without the rough model
    # number of identifications that the learner refused, and of proposals that the controller
    # refused
    refused: int
    # number of times that the initial law took over, in all or in some channels
    fallbacks: int


def learned(tape: Tape, events: Sequence[Event]) -> LearningOutcome:
    """Return what became of the identifications in a flight, from its tape and its events."""
    proposed = tape["learned"]["proposed"] if "learned" in tape else np.ones(0)
    models = [
        event.stamp_ns
        for event in events
        if event.kind is EventKind.FLIES and UNVERIFIED not in event.sentence
    ]
    fallbacks = sum(event.kind in {EventKind.FALLBACK, EventKind.RESTART} for event in events)
    refusals = sum(event.kind is EventKind.REFUSED for event in events)
    refusals += int(np.sum(proposed == 0.0))
    return LearningOutcome(
        models[0] / 1e9 if models else math.nan, len(models), refusals, fallbacks
    )


def is_flown_alone(scenario: Scenario) -> bool:
    """Return whether the aircraft fly one by one, because they learn or are guided."""
    return scenario.has_learner() or scenario.guidance is not None


def require_single_flights(scenario: Scenario) -> None:
    """Check that a scenario can be flown in a campaign of single flights.

    Raises ParameterError if not.
    """
    aircraft = scenario.aircraft
    require(
        not aircraft.is_jsbsim,
        "airframe",
        aircraft.airframe,
        "an airframe with matrices: a campaign draws their entries",
    )
    require(
        scenario.guidance is None or scenario.guidance.route is not None,
        "guidance.route",
        "none",
        "a route, whose cross-track error is the score of a campaign of missions",
    )


class SingleFlight(NamedTuple):
    """The result of a flight of a campaign."""

    has_diverged: bool
    figures: dict[str, float]  # figures by name, SI


def fly_single(scenario: Scenario, learner: MakeLearner | None = None) -> SingleFlight:
    """Fly a scenario; its errors are the true errors at the ticks of the controller.

    Raises ParameterError if the scenario cannot be flown in one process.
    """
    events: list[Event] = []
    learn = None if learner is None else learner(scenario)
    tape = simulate(scenario, learn=learn, announce=events.append)
    has_diverged = tape.outcome.end not in {End.COMPLETED, End.LANDED}
    figures: dict[str, float] = {}
    if scenario.guidance is not None:
        figures |= mission_figures(tape, scenario.guidance)
    figures |= _tracking_figures(tape, scenario)
    if scenario.has_learner():
        outcome = learned(tape, events)
        figures |= {name: float(value) for name, value in outcome._asdict().items()}
    return SingleFlight(has_diverged, figures)


def _tracking_figures(tape: Tape, scenario: Scenario) -> dict[str, float]:
    """Return rms and largest true error of each output, and mean abs(u_dot) of each effector."""
    true = true_error(tape)
    assert true is not None  # noqa: S101 - simulated flights have the truth
    is_tick = true.stamp_ns % period_ns(scenario.controller.rate, "controller.rate") == 0
    errors = {name: error_metrics(true[name][is_tick]) for name in scenario.controller.outputs}
    slew = {name: parts["whole"].rate for name, parts in inputs_by_part(tape, ()).items()}
    return {
        **{f"rms.{name}": metrics.rms for name, metrics in errors.items()},
        **{f"max.{name}": metrics.max for name, metrics in errors.items()},
        **{f"slew.{name}": value for name, value in slew.items()},
    }


def mission_figures(tape: Tape, guidance: GuidanceConfig) -> dict[str, float]:
    """Return the metrics of a mission, by name, SI.

    They are the score, the cross-track and altitude errors on the route, the largest bank and the
    missed legs. With a fence there are also the distance flown outside of the fence and the
    distance from home at the end. The score is the largest cross-track error divided by the
    distance that the aircraft flies in half a second at V0. Errors on the orbit round the last
    waypoint, on the way onto a leg and while the fence acts are left out. If no leg was flown, the
    score and these errors are NaN.
    """
    log = tape["guidance"]
    last_leg = len(guidance.plan(guidance.waypoints()).legs) - 1
    on_route = (log["mode.lateral"] == Lateral.ROUTE) & (log["joining"] == 0.0)
    on_route &= (log["leg"] < last_leg) & (log["fence.action"] == 0.0)
    errors = control_errors(tape)
    xtrack = errors["xtrack"][on_route]
    altitude = errors["altitude"][on_route]
    largest = float(np.max(np.abs(xtrack))) if len(xtrack) else math.nan
    figures = {
        "score": largest / (CAPTURE_TIME * guidance.speed),
        "max.xtrack": largest,
        "rms.xtrack": _rms(xtrack),
        "rms.altitude": _rms(altitude),
        "max.phi": float(np.max(np.abs(log["pose.phi"]))),
        "missed": float(np.count_nonzero(log["missed"])),
    }
    outside = time_outside(tape, guidance)
    if outside is not None:
        figures["max.breach"] = outside.farthest_m
        figures["home"] = math.hypot(
            log["pose.north"][-1] - guidance.home.north, log["pose.east"][-1] - guidance.home.east
        )
    return figures


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def fly_chunk_singly(definition: Definition, job: Job, learner: MakeLearner | None = None) -> Chunk:
    """Fly the aircraft in a chunk of a campaign one by one."""
    from flight_campaign.drawn_fleet import drawn_fleet  # noqa: PLC0415 - imports JAX

    case, chunk = job
    first = chunk * definition.chunk
    count = definition.size(job)
    scenario = definition.scenario(case)
    entries = drawn_fleet(definition, scenario, first, count).entries()
    flights = [
        fly_single(definition.aircraft_scenario(first + k, case), learner) for k in range(count)
    ]
    figures = {
        name: np.array([flight.figures[name] for flight in flights]) for name in flights[0].figures
    }
    if "score" not in figures:
        rms = np.array([figures[f"rms.{name}"] for name in scenario.controller.outputs])
        figures = {"score": definition.score(rms)} | figures
    return Chunk(first, np.array([flight.has_diverged for flight in flights]), figures, entries)
