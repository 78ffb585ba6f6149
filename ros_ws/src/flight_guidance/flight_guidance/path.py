# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Paths: lines and arcs in the local tangent plane, and routes of waypoints whose corners are fillets."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from flight_core.parameters import require
from flight_core.vectors import Scalar, array_namespace
from flight_guidance.lateral import PathError

Point = tuple[Scalar, Scalar]  # north, east, m

SHARPEST = math.radians(150.0)
"""Largest change of course at a waypoint: beyond it the fillet cuts the corner by more than 2.8 radii."""

SHORTEST = 1e-3
"""m. A fillet with ends nearer to the waypoint is left out: waypoints on a straight line have a fillet by rounding alone."""


class Line(NamedTuple):
    """A straight leg."""

    start: Point
    end: Point


class Arc(NamedTuple):
    """A leg on a circle, less than a full turn; without an end an orbit."""

    centre: Point
    radius: float  # m, positive to the right (clockwise from above), negative to the left
    end: Point | None = None


Leg = Line | Arc


class Route(NamedTuple):
    """Legs, with altitudes and airspeeds per leg, taken from the waypoint at the end of the leg."""

    legs: tuple[Leg, ...]
    altitude: tuple[float, ...]  # m
    V: tuple[float, ...]  # m/s


def course_of(start: Point, end: Point) -> float:
    """Course from a start to an end, rad from north."""
    return math.atan2(end[1] - start[1], end[0] - start[0])


def error(leg: Leg, position: Point) -> PathError:
    """The cross-track error of a position, and course and curvature of the leg at the nearest point."""
    if isinstance(leg, Line):
        return line_error(leg.start, course_of(leg.start, leg.end), position)
    return circle_error(leg.centre, leg.radius, position)


def line_error(start: Point, track: Scalar, position: Point) -> PathError:
    """`error` beside a line from a point on a course, rad."""
    xp, north, east = array_namespace(track), position[0] - start[0], position[1] - start[1]
    return PathError(east * xp.cos(track) - north * xp.sin(track), track, 0.0)


def circle_error(centre: Point, radius: Scalar, position: Point) -> PathError:
    """`error` beside a circle, radius in m, positive to the right."""
    xp, north, east = array_namespace(radius), position[0] - centre[0], position[1] - centre[1]
    side = xp.copysign(1.0, radius)
    bearing = xp.atan2(east, north)  # from the centre
    return PathError(side * (abs(radius) - xp.hypot(north, east)), bearing + side * math.pi / 2.0, 1.0 / radius)


def end_course(leg: Leg) -> float:
    """Course at the end of a leg, rad. An orbit has none: raises ValueError."""
    if isinstance(leg, Line):
        return course_of(leg.start, leg.end)
    if leg.end is None:
        raise ValueError("an orbit has no end")
    return float(error(leg, leg.end).track)


def passed(leg: Leg, position: Point) -> bool:
    """Whether a position lies beyond the half plane at the end of a leg, across the course there. Never for an orbit."""
    return leg.end is not None and bool(beyond(leg.end, end_course(leg), position))


def beyond(end: Point, course: Scalar, position: Point) -> Any:
    """Whether a position lies beyond the half plane through a point across a course, rad."""
    xp, north, east = array_namespace(course), position[0] - end[0], position[1] - end[1]
    return north * xp.cos(course) + east * xp.sin(course) >= 0.0


def entered(leg: Leg, following: Leg | None, position: Point) -> bool:
    """Whether a position lies beyond the end of a leg, but not beyond a following arc."""
    return passed(leg, position) and not (isinstance(following, Arc) and passed(following, position))


def to_go(leg: Leg, position: Point) -> float:
    """Distance along a leg from the point nearest to a position to the end, m; 0 for an orbit."""
    if leg.end is None:
        return 0.0
    if isinstance(leg, Line):
        course = end_course(leg)
        return float((leg.end[0] - position[0]) * math.cos(course) + (leg.end[1] - position[1]) * math.sin(course))
    turn = course_of(leg.centre, leg.end) - course_of(leg.centre, position)
    return leg.radius * math.remainder(turn, 2.0 * math.pi)


def outline(leg: Leg, start: Point) -> list[Point]:
    """Points along a leg from the start, for drawing: at most 10 deg apart on an arc; an orbit is a full turn."""
    if isinstance(leg, Line):
        return [leg.start, leg.end]
    side, first = math.copysign(1.0, leg.radius), course_of(leg.centre, start)
    turn = 2.0 * math.pi if leg.end is None else side * (course_of(leg.centre, leg.end) - first) % (2.0 * math.pi)
    count = math.ceil(turn / math.radians(10.0)) + 1
    return [_along(leg.centre, first + side * turn * k / (count - 1), abs(leg.radius)) for k in range(count)]


def route_outline(route: Route) -> list[tuple[float, float, float]]:
    """Points along a route, for drawing: north, east and altitude, m. The altitude is constant along a leg."""
    points: list[tuple[float, float, float]] = []
    for leg, altitude in zip(route.legs, route.altitude, strict=True):
        start = leg.start if isinstance(leg, Line) else points[-1][:2] if points else _along(leg.centre, 0.0, abs(leg.radius))
        points += [(*point, altitude) for point in outline(leg, start)]
    return points


def leads(legs: Sequence[Leg]) -> list[int]:
    """Numbers of the waypoints at the ends of the legs of a route; an arc at a waypoint leads to the next waypoint."""
    numbers, at = [], 0
    for leg in legs:
        at += isinstance(leg, Line)
        numbers.append(at + 1 if isinstance(leg, Arc) and leg.end is not None else at)
    return numbers


def route(waypoints: Sequence[Point], radius: float, least: float) -> tuple[Leg, ...]:
    """Legs through waypoints with fillets of a radius in the corners, m, then an orbit round the last waypoint.

    A corner of the turn tau begins and ends radius tan(tau / 2) from the waypoint. Raises ParameterError for fewer than two
    waypoints, a radius below `least` (`lateral.least_radius`), a corner beyond SHARPEST, and a leg too short for the fillets.
    Source: R. W. Beard, T. W. McLain, Small Unmanned Aircraft (2012), algorithm 8.
    """
    require(len(waypoints) >= 2, "route", f"{len(waypoints)} waypoints", "two or more")
    require(radius >= least, "guidance.radius", f"{radius:g} m", f"at least {math.ceil(least)} m at this speed, wind and bank")
    turns = [0.0]
    for k, (before, at, after) in enumerate(zip(waypoints, waypoints[1:], waypoints[2:], strict=False), 1):
        turn = math.remainder(course_of(at, after) - course_of(before, at), 2.0 * math.pi)
        actual, expected = f"a turn of {math.degrees(turn):.0f} deg", f"at most {math.degrees(SHARPEST):.0f} deg either way"
        require(abs(turn) <= SHARPEST, f"route[{k}]", actual, expected)
        turns.append(turn)
    turns.append(0.0)
    cut = [radius * math.tan(abs(turn) / 2.0) for turn in turns]
    legs: list[Leg] = []
    start = waypoints[0]
    for k, (here, there) in enumerate(pairwise(waypoints)):
        length, needed = math.dist(here, there), cut[k] + cut[k + 1]
        found = f"{length:g} m from the waypoint before"
        require(length > needed, f"route[{k + 1}]", found, f"more than {math.ceil(needed)} m, for fillets of {radius:g} m")
        course, turn = course_of(here, there), turns[k + 1]
        end = _along(there, course, -cut[k + 1])
        legs.append(Line(start, end))
        if cut[k + 1] > SHORTEST:
            side = math.copysign(1.0, turn)
            start = _along(there, course + turn, cut[k + 1])
            legs.append(Arc(_along(end, course + side * math.pi / 2.0, radius), side * radius, start))
        else:
            start = there
    return (*legs, Arc(waypoints[-1], radius))


def _along(point: Point, course: float, distance: float) -> Point:
    return point[0] + distance * math.cos(course), point[1] + distance * math.sin(course)
