# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Missions: uncertain aircraft fly the route of a guided scenario, one at a time in one process."""

from typing import NamedTuple

import numpy as np

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import CAPTURE_TIME, best_error, error_metrics
from flight_analysis.report.guided import control_errors
from flight_core.outcome import COMPLETED
from flight_core.parameters import require
from flight_core.tape import Tape
from guidance.modes import Lateral

MISSION_CHUNK = 10
"""Aircraft in a chunk of a campaign of missions: three minutes of flight take about 20 s each."""


class Mission(NamedTuple):
    """Result of one flight. The figures of one that diverged are not valid."""

    diverged: bool
    figures: dict[str, float]


def require_mission(scenario: Scenario) -> None:
    """Raise ParameterError for a guided scenario that a campaign cannot judge: without a route, or of an aircraft of JSBSim."""
    route = scenario.guidance is not None and scenario.guidance.route is not None
    require(route, "guidance.route", "none", "a route, whose cross-track error is the score of a campaign of missions")
    aircraft = scenario.aircraft
    require(not aircraft.is_jsbsim, "airframe", aircraft.airframe, "an airframe with matrices, which a campaign varies")


def fly_mission(scenario: Scenario) -> Mission:
    """Fly a guided scenario. The score is the largest cross-track error on the route, in half seconds of flight at V0."""
    tape = simulate(scenario)
    return Mission(tape.outcome != COMPLETED, figures_of(tape, scenario))


def figures_of(tape: Tape, scenario: Scenario) -> dict[str, float]:
    """Score, cross-track error and altitude error on the route, largest bank, errors of the law. SI.

    The orbit round the last waypoint is left out: it begins at its centre.
    """
    log, errors = tape["guidance"], control_errors(tape)
    guidance = scenario.guidance
    legs = () if guidance is None else guidance.plan(guidance.waypoints()).legs
    orbit = len(legs) - 1
    on_route = (log["mode.lateral"] == Lateral.ROUTE) & (log["leg"] < orbit)
    xtrack, true = error_metrics(errors["xtrack"][on_route]), best_error(tape)[1]
    law = {name: error_metrics(true[name]) for name in scenario.controller.outputs}
    return {
        "score": xtrack.max / (CAPTURE_TIME * scenario.aircraft.channels().speed),
        "max.xtrack": xtrack.max,
        "rms.xtrack": xtrack.rms,
        "rms.altitude": error_metrics(errors["altitude"][on_route]).rms,
        "max.phi": float(np.max(np.abs(log["pose.phi"]), initial=0.0)),
        **{f"rms.{name}": one.rms for name, one in law.items()},
        **{f"max.{name}": one.max for name, one in law.items()},
    }
