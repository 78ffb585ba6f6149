# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly routes by rule that are hard to begin, windy, steep, or cross themselves.

Each route is flown, missed or refused.

    .venv/bin/python -m benchmarks.routes [--only osprey_servo c172p 737 f16] [--cases behind helix]

The figures go to docs/evidence/guidance-routes-*.csv, if all cases are flown. Each flight is
simulated in one process. Its row has the result, the largest cross-track error on the legs in
seconds of flight at V0, the limit of this error, and the largest error of the altitude. The errors
leave out the first radius of the leg of the start, and of each leg or circle that the aircraft
joins, because within a radius its start counts as reached. A refusal is a result, with its
sentence. `guidance.wind` states the wind. No number is tuned to an aircraft. Exit status 1: an
error beyond its limit, a missed leg, or a lost aircraft.
"""

import csv
import math
import sys
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from benchmarks import evidence
from benchmarks.guidance import AIRCRAFT, OTHERS, aircraft_of, turbulence
from benchmarks.tables import parser_of

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import with_route
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.guided import LegResult, flown_legs
from flight_core.outcome import COMPLETED
from flight_core.parameters import ParameterError
from flight_core.tape import Tape
from flight_guidance.guidance_state import Lateral
from flight_guidance.params import GuidanceConfig
from flight_guidance.routes.route_file import Waypoint
from flight_guidance.steering import path
from flight_guidance.steering.path import Arc, Line, Route

CALM_LIMIT, LIMIT = 0.35, 0.5
"""Cross-track error that guidance claims in calm air, and in wind or turbulence, s of flight at
V0."""

SETTLE = 20.0
"""Time that each flight has in addition, s: for the last orbit, and because the way that joins the
route can be longer than the straight one."""


class Case(NamedTuple):
    """A route and the air. The aircraft starts at the origin and heads north."""

    waypoints: Callable[[float], list[Waypoint]]  # returns the route for a least radius, m
    wind: float = 0.0  # to the east, as a share of V0
    turbulent: bool = False


class Result(StrEnum):
    """How the flight of a case ended."""

    FLOWN = "flown"
    MISSED = "missed"
    LOST = "lost"
    REFUSED = "refused"


class Row(NamedTuple):
    """The result of a flight."""

    aircraft: str
    case: str
    result: Result
    about: str  # what follows the word of the result: leg, outcome or refusal
    xtrack: float  # largest cross-track error on the legs, s of flight at V0
    limit: float  # largest permitted cross-track error, s of flight at V0
    altitude: float  # largest error of the altitude on the legs, m

    @property
    def figure(self) -> evidence.Row:
        """The row of evidence: the error of a flown route, or the words of the result.

        A refusal has no goal. The words of a missed or a lost flight do not meet the goal.
        """
        is_flown = self.result is Result.FLOWN
        goal = None if self.result is Result.REFUSED else self.limit
        value = self.xtrack if is_flown else f"{self.result}{self.about}"
        return evidence.row(
            f"{self.case}: cross-track", value, "s" if is_flown else "", at_most=goal
        )


def of_radii(
    *places: tuple[float, float], altitudes: tuple[float, ...] = ()
) -> Callable[[float], list[Waypoint]]:
    """Return a function that makes a route from a least radius, m.

    `places` are north and east of its waypoints in radii, and `altitudes` are those above the
    start, m.
    """

    def waypoints(radius: float) -> list[Waypoint]:
        heights = altitudes or (0.0,) * len(places)
        return [
            Waypoint(north * radius, east * radius, up)
            for (north, east), up in zip(places, heights, strict=True)
        ]

    return waypoints


def far(radius: float) -> list[Waypoint]:
    """Return a route of one line to the north, 20 km to the east of the start."""
    return [Waypoint(0.0, 20e3, 0.0), Waypoint(6.0 * radius, 20e3, 0.0)]


def steep(_: float) -> list[Waypoint]:
    """Return a route with a leg of 500 m that climbs by 1000 m."""
    return [Waypoint(1000.0, 0.0, 0.0), Waypoint(1500.0, 0.0, 1000.0)]


EIGHT = of_radii((0, 0), (3, 0), (6, 3), (9, 3), (9, 0), (6, 0), (3, 3), (0, 3))
# on a longer route the f16 would run out of fuel against the wind
BOX = of_radii((0, 0), (3, 0), (3, 3), (0, 3))
CASES: Mapping[str, Case] = {
    "behind": Case(of_radii((-4, 0), (-9, 0), (-9, 5))),
    "across": Case(of_radii((3, 7), (3, 13))),
    "20 km away": Case(far),
    "eight": Case(EIGHT),
    "eight, turbulence, wind 0.3 V": Case(EIGHT, 0.3, turbulent=True),
    "back and forth": Case(of_radii((0, 0), (6, 0), (0, 1), (-4, -3))),
    "helix": Case(of_radii((3, 0), (8, 0), (14, 0), altitudes=(0, 120, 120))),
    "1000 m in 500 m": Case(steep),
    "wind 0.6 V": Case(BOX, 0.6),
    "wind 1.2 V": Case(BOX, 1.2),
}


def duration(route: Route, section: GuidanceConfig) -> float:
    """Return a time that suffices to fly a route from the origin against the wind, s."""
    climb, sink = section.climb_limits()
    slowest, (start, course), at = section.speed - section.wind, route.start(0), (0.0, 0.0)
    side = float(path.joining(start, course, route.radius, route.near(0), at, 0.0))
    length = 0.0
    time = SETTLE
    if side:
        length = (
            float(path.joining_length(start, course, side * route.radius, at, 0.0))
            + math.pi * route.radius
        )
    for k, leg in enumerate(route.legs):
        if isinstance(leg, Line):
            length += path.length(leg)
            if path.is_too_sharp(leg, next(iter(route.legs[k + 1 :]), None)):
                length += 4.0 * math.pi * route.radius  # at most two turns to join the next leg
        elif path.is_orbit(leg):
            if leg.end is not None:
                length += 2.0 * math.pi * route.radius
            change = route.altitude[k] - route.from_altitude[k]
            time += 1.2 * abs(change) / (climb if change > 0.0 else sink)
        else:
            length += math.pi * route.radius
    return time + length / slowest


def fly(name: str, title: str, case: Case) -> Row:
    """Fly a case with an aircraft, and return its row."""
    scenario = aircraft_of(name)
    limit = LIMIT if case.wind or case.turbulent else CALM_LIMIT
    try:
        varied = planned(scenario, name, case)
    except ParameterError as refusal:
        return Row(name, title, Result.REFUSED, f": {refusal}", 0.0, limit, 0.0)
    tape = simulate(varied)
    if tape.outcome != COMPLETED:
        return Row(name, title, Result.LOST, f": {tape.outcome}", math.inf, limit, math.inf)
    if varied.guidance is None:
        raise ValueError(f"{name} has no guidance")
    route = varied.guidance.plan(varied.guidance.waypoints())
    result, about = Result.FLOWN, ""
    legs = flown_legs(tape)
    misses = [leg for leg in legs if leg.result is LegResult.MISSED]
    if misses:
        result, about = Result.MISSED, f" leg {misses[0].leg} by {misses[0].missed:.0f} m"
    elif legs[-1].leg < len(route.legs) - 1:
        about = f": on leg {legs[-1].leg} of {len(route.legs) - 1} at the end"
        result = Result.MISSED
    xtrack, altitude = errors(tape, route)
    return Row(
        name,
        title,
        result,
        about,
        round(xtrack / varied.guidance.speed, 3),
        limit,
        round(altitude, 2),
    )


def planned(scenario: Scenario, name: str, case: Case) -> Scenario:
    """Return the scenario of a case. Raises ParameterError if the route is refused."""
    if scenario.guidance is None:
        raise ValueError(f"{name} has no guidance")
    wind = case.wind * scenario.guidance.speed
    ground = scenario.aircraft.altitude or 0.0
    section = scenario.guidance.model_copy(update={"wind": wind})
    waypoints = [
        point._replace(altitude=point.altitude + ground)
        for point in case.waypoints(math.ceil(section.least_radius()))
    ]
    aircraft: dict[str, Any] = {"wind": [0.0, wind]}
    if case.turbulent:
        aircraft["turbulence"] = turbulence(scenario, 1)
    varied = with_route(scenario.vary(aircraft=aircraft, guidance={"wind": wind}), waypoints)
    return varied.vary(
        flight={"duration": float(math.ceil(duration(section.plan(waypoints), section)))}
    )


def errors(tape: Tape, route: Route) -> tuple[float, float]:
    """Return the largest cross-track error and the largest error of the altitude, m.

    Both are those on the legs before the last orbit; the altitude is not judged on a circle.
    """
    log = tape["guidance"]
    circles = [k for k, leg in enumerate(route.legs) if isinstance(leg, Arc) and leg.loiter]
    on_leg = (
        (log["mode.lateral"] == Lateral.ROUTE)
        & (log["joining"] == 0.0)
        & (log["leg"] < len(route.legs) - 1)
    )
    on_circle = np.isin(log["leg"], circles)
    on_leg &= ~on_circle | (log["loitered"] > 0.0)
    begins = (log["joining"] != 0.0) | (on_circle & (log["loitered"] == 0.0))
    for k in [0, *(np.flatnonzero(begins[:-1] & ~begins[1:]) + 1)]:
        from_start = np.hypot(
            log["pose.north"] - log["pose.north"][k], log["pose.east"] - log["pose.east"][k]
        )
        on_leg[k:] &= (log["leg"][k:] != log["leg"][k]) | (from_start[k:] > route.radius)
    off = np.abs(log["pose.altitude"] - log["target.altitude"])
    return float(np.abs(log["xtrack"][on_leg]).max(initial=0.0)), float(
        off[on_leg & ~on_circle].max(initial=0.0)
    )


def main() -> int:
    """Fly, print the rows and store them."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "--only", nargs="*", choices=[*AIRCRAFT, *OTHERS], default=[*AIRCRAFT], help="aircraft"
    )
    parser.add_argument(
        "--cases", nargs="*", choices=[*CASES], default=[*CASES], help="routes; not stored"
    )
    options = parser.parse_args()
    writer = csv.writer(sys.stdout)
    failed = False
    writer.writerow(Row._fields)
    for name in options.only:
        start = evidence.origin(f"python -m benchmarks.routes --only {name}")
        rows_flown = list[Row]()
        for title in options.cases:
            rows_flown.append(row := fly(name, title, CASES[title]))
            writer.writerow(row)
            sys.stdout.flush()
            failed |= row.xtrack > row.limit or row.result in {Result.MISSED, Result.LOST}
        if len(rows_flown) == len(CASES):
            evidence.write(f"guidance-routes-{name}", (row.figure for row in rows_flown), start)
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
