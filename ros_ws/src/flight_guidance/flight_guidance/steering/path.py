# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define paths of lines and arcs in the local tangent plane, and routes of waypoints.

The corners of a route are fillets.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from enum import IntEnum
from itertools import pairwise
from types import MappingProxyType
from typing import Any, NamedTuple

from flight_core.parameters import ParameterError, require
from flight_core.vectors import Scalar, array_namespace
from flight_guidance.steering.lateral import PathError

Point = tuple[Scalar, Scalar]  # north, east, m

SHARPEST = math.radians(150.0)
"""Largest turn of a fillet, which cuts the corner by 2.8 radii. At a sharper corner the aircraft
passes the waypoint, and then joins the next leg."""

JOINED = math.radians(30.0)
"""Largest difference between the course flown and the course of the leg at which an aircraft may
leave the joining circle for the leg."""

OPPOSITE = math.radians(120.0)
"""An aircraft near the start of a leg needs a joining circle, too, if the course flown differs from
that of the leg by more than this."""

SLACK = 0.1
"""If a tangent touches the joining circle by less than this angle beyond the point of the leg, no
further turn of 360 deg is counted, rad."""

SHORTEST = 1e-3
"""A fillet whose ends are nearer to the waypoint than this is left out, m: between legs on a
straight line it would come only from rounding."""


class Line(NamedTuple):
    """A straight leg."""

    start: Point
    end: Point


class Loiter(NamedTuple):
    """Circles that an aircraft flies round a waypoint.

    It flies on when the circles are flown and it has the altitude of the leg.
    """

    turns: float = 0.0  # number of turns
    wait: float = 0.0  # time on the circle, s


class Arc(NamedTuple):
    """A leg on a circle that is less than a full turn, or an orbit.

    An arc without an end is an endless orbit. An arc with a loiter is an orbit until the loiter is
    over.
    """

    centre: Point
    radius: float  # m, positive to the right (clockwise from above), negative to the left
    end: Point | None = None
    loiter: Loiter | None = None


Leg = Line | Arc


class Route(NamedTuple):
    """The legs of a route, each with the altitude and airspeed of the waypoint at its end."""

    legs: tuple[Leg, ...]
    altitude: tuple[float, ...]  # m, altitude of each leg
    V: tuple[float, ...]  # m/s, airspeed of each leg
    from_altitude: tuple[float, ...] = ()  # m, altitude at the waypoint where the leg begins
    from_V: tuple[float, ...] = ()  # m/s, airspeed at this waypoint
    # whether the altitude changes linearly along a line instead of at its start
    slopes: bool = False
    notes: tuple[str, ...] = ()  # sentences on what is flown differently from the waypoints

    @property
    def radius(self) -> float:
        """Radius of the last orbit and of the fillets, m."""
        return abs(self.legs[-1].radius) if isinstance(self.legs[-1], Arc) else 0.0

    def near(self, leg: int) -> float:
        """Return the distance from the end of a leg within which the leg is taken as flown, m.

        The distance is the radius, but at least 1 s of flight.
        """
        return max(self.radius, self.V[leg])

    def start(self, leg: int, along: float = 0.0) -> tuple[Point, float]:
        """Return the start of a leg, and the course at the start, rad.

        For a line the start is the point at the distance `along`, m. For an orbit the start is the
        centre, and the course is 0.
        """
        path = self.legs[leg]
        if isinstance(path, Line):
            course = course_of(path.start, path.end)
            return _along(path.start, course, along), course
        if is_orbit(path):
            return path.centre, 0.0
        before = self.legs[leg - 1]  # the leg before an arc is a line
        return before.end or path.centre, end_course(before)

    def profile(self, leg: int, along: float) -> tuple[float, float]:
        """Return the altitude at a distance along a leg, m, and the leg's slope, climb / distance.

        With `slopes` the altitude changes linearly from waypoint to waypoint, otherwise in a step.
        """
        altitude = self.altitude[leg]
        distance = length(self.legs[leg])
        if not self.slopes or not distance:
            return altitude, 0.0
        slope = (altitude - self.from_altitude[leg]) / distance
        return altitude - slope * (distance - along), slope

    def joining_altitude(self, leg: int, along: float) -> float:
        """Return the altitude, m, at which to join a leg `along` m after its start."""
        if along or not self.from_altitude:
            return self.profile(leg, along)[0]
        return self.from_altitude[leg]


def is_orbit(leg: Leg) -> bool:
    """Return whether a leg is a full circle, flown for a loiter or for ever."""
    return isinstance(leg, Arc) and (leg.end is None or leg.loiter is not None)


def length(leg: Leg) -> float:
    """Return the length of a line, m, or 0 for an arc."""
    return math.dist(leg.start, leg.end) if isinstance(leg, Line) else 0.0


def along(start: Point, end: Point, share: float) -> Point:
    """Return the point at a fraction of the way from a start to an end."""
    return start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1])


def nearest(leg: Leg, position: Point) -> float:
    """Return how far along a line the point nearest to a position is, m from the start.

    The result lies between 0 and the length. For an arc it is 0.
    """
    if isinstance(leg, Line):
        return min(max(length(leg) - to_go(leg, position), 0.0), length(leg))
    return 0.0


def course_of(start: Point, end: Point) -> float:
    """Return the course from a start to an end, rad from north."""
    return math.atan2(end[1] - start[1], end[0] - start[0])


def error(leg: Leg, position: Point) -> PathError:
    """Compute the cross-track error of a position from a leg.

    The result also has the course and the curvature of the leg at the nearest point.
    """
    if isinstance(leg, Line):
        return line_error(leg.start, course_of(leg.start, leg.end), position)
    return circle_error(leg.centre, leg.radius, position)


def line_error(start: Point, track: Scalar, position: Point) -> PathError:
    """Compute the `error` from a line through the point `start` with the course `track`, rad."""
    xp = array_namespace(track)
    north = position[0] - start[0]
    east = position[1] - start[1]
    return PathError(east * xp.cos(track) - north * xp.sin(track), track, 0.0)


def circle_error(centre: Point, radius: Scalar, position: Point) -> PathError:
    """Compute the `error` from a circle; the radius, m, is positive to the right."""
    xp = array_namespace(radius)
    north = position[0] - centre[0]
    east = position[1] - centre[1]
    side = xp.copysign(1.0, radius)
    # bearing of the position from the centre
    bearing = xp.atan2(east, north)
    return PathError(
        side * (abs(radius) - xp.hypot(north, east)), bearing + side * math.pi / 2.0, 1.0 / radius
    )


def end_course(leg: Leg) -> float:
    """Return the course at the end of a leg, rad. Raises ValueError for an orbit."""
    if isinstance(leg, Line):
        return course_of(leg.start, leg.end)
    if leg.end is None:
        raise ValueError("an orbit has no end")
    return float(error(leg, leg.end).track)


def is_passed(leg: Leg, position: Point) -> bool:
    """Return whether a position is past the end of a leg.

    It is if it lies beyond the line through the end, perpendicular to the course. An orbit is never
    passed.
    """
    return (
        leg.end is not None
        and not is_orbit(leg)
        and bool(is_beyond(leg.end, end_course(leg), position))
    )


def is_beyond(end: Point, course: Scalar, position: Point) -> Any:
    """Return whether a position lies beyond the line that crosses a course, rad, at a point."""
    xp = array_namespace(course)
    north = position[0] - end[0]
    east = position[1] - end[1]
    return north * xp.cos(course) + east * xp.sin(course) >= 0.0


def is_entered(leg: Leg, following: Leg | None, position: Point) -> bool:
    """Return whether a position lies beyond the end of a leg, but not beyond a `following` arc."""
    return is_passed(leg, position) and not (
        isinstance(following, Arc) and is_passed(following, position)
    )


def to_go(leg: Leg, position: Point) -> float:
    """Return the distance along a leg to its end, m, from the point nearest to a position."""
    if leg.end is None or is_orbit(leg):
        return 0.0
    if isinstance(leg, Line):
        course = end_course(leg)
        return float(
            (leg.end[0] - position[0]) * math.cos(course)
            + (leg.end[1] - position[1]) * math.sin(course)
        )
    turn = course_of(leg.centre, leg.end) - course_of(leg.centre, position)
    return leg.radius * math.remainder(turn, 2.0 * math.pi)


# Joining a leg: the joining circle touches the leg at a point. The aircraft flies along a tangent
# to this circle, and then round the circle onto the leg.


class Side(IntEnum):
    """On which side the joining circle lies, as the sign of its radius."""

    NONE = 0  # no circle, because the aircraft is on the leg or near its point
    RIGHT = 1
    LEFT = -1


def joining_centre(point: Point, course: Scalar, radius: Scalar) -> Point:
    """Return the centre of the circle that touches a line at a point.

    `course` is the course of the line, rad. The radius, m, is positive to the right.
    """
    xp = array_namespace(course)
    return point[0] - radius * xp.sin(course), point[1] + radius * xp.cos(course)


def joining_length(
    point: Point, course: Scalar, radius: Scalar, position: Point, course_flown: Scalar
) -> Scalar:
    """Compute the length of the way by a joining circle onto a course at a point, m.

        R abs(turn) + sqrt(d^2 - R^2) + R sweep

    turn is the angle from the course flown to the tangent, and d is the distance from the centre of
    the joining circle. sweep is the angle on the circle from the point where the tangent touches it
    to the point of the leg. `course_flown` and `course` are in rad.
    """
    xp = array_namespace(radius)
    centre = joining_centre(point, course, radius)
    north = position[0] - centre[0]
    east = position[1] - centre[1]
    side = xp.copysign(1.0, radius)
    R = abs(radius)
    d = xp.hypot(north, east)
    touch = xp.atan2(east, north) + side * xp.acos(R / xp.maximum(d, R))  # bearing from the centre
    turn = touch + side * math.pi / 2.0 - course_flown
    sweep = (side * (course - touch) - math.pi / 2.0 + SLACK) % (2.0 * math.pi) - SLACK
    angle = xp.atan2(xp.sin(turn), xp.cos(turn))
    return R * abs(angle) + xp.sqrt(xp.maximum(d * d - R * R, 0.0)) + R * xp.maximum(sweep, 0.0)


def joining(
    point: Point,
    course: Scalar,
    radius: Scalar,
    near: Scalar,
    position: Point,
    course_flown: Scalar,
) -> Scalar:
    """Choose on which side the joining circle gives the shorter way onto a course at a point.

    Returns a value of `Side` for each position. No circle is needed if the position is within
    `near`, m, of the point, and the course flown is within OPPOSITE of the course.
    """
    right_way, left_way = (
        joining_length(point, course, side * radius, position, course_flown)
        for side in (Side.RIGHT, Side.LEFT)
    )
    xp = array_namespace(right_way)
    far = (xp.hypot(position[0] - point[0], position[1] - point[1]) > near) | (
        xp.cos(course_flown - course) < math.cos(OPPOSITE)
    )
    return xp.where(far, xp.where(right_way <= left_way, Side.RIGHT, Side.LEFT), Side.NONE)


def is_joined(
    point: Point, course: Scalar, near: Scalar, position: Point, course_flown: Scalar
) -> Any:
    """Return whether an aircraft is beyond a point of a leg, and flies near the leg.

    It flies near the leg if it is within `near`, m, of the leg, and if its course differs from the
    leg's course by at most JOINED.
    """
    xp = array_namespace(course)
    is_near = xp.hypot(position[0] - point[0], position[1] - point[1]) <= near
    return (
        is_near
        & is_beyond(point, course, position)
        & (xp.cos(course_flown - course) >= math.cos(JOINED))
    )


def outline(leg: Leg, start: Point) -> list[Point]:
    """Draw points along a leg from its start.

    On an arc the points are at most 10 deg apart. An orbit is drawn as at least one full turn.
    """
    if isinstance(leg, Line):
        return [leg.start, leg.end]
    side = math.copysign(1.0, leg.radius)
    first = course_of(leg.centre, start)
    turn = 2.0 * math.pi if is_orbit(leg) else 0.0
    if leg.end is not None:
        turn += side * (course_of(leg.centre, leg.end) - first) % (2.0 * math.pi)
    count = math.ceil(turn / math.radians(10.0)) + 1
    return [
        _along(leg.centre, first + side * turn * k / (count - 1), abs(leg.radius))
        for k in range(count)
    ]


def route_outline(route: Route) -> list[tuple[float, float, float]]:
    """Draw points along a route: north, east and altitude, m."""
    points: list[tuple[float, float, float]] = []
    for number, leg in enumerate(route.legs):
        if isinstance(leg, Line):
            start = leg.start
        elif points:
            start = points[-1][:2]
        else:
            start = _along(leg.centre, 0.0, abs(leg.radius))
        points += [
            (*point, route.profile(number, nearest(leg, point))[0]) for point in outline(leg, start)
        ]
    return points


def lengths_after(route: Route) -> list[float]:
    """Return the total length of the legs that follow each leg, m; the last orbit counts as 0."""
    lengths = []
    point = route.start(0)[0]
    for leg in route.legs[:-1]:
        points = outline(leg, leg.start if isinstance(leg, Line) else point)
        lengths.append(sum(map(math.dist, points, points[1:])))
        point = points[-1]
    return [sum(lengths[number + 1 :]) for number in range(len(route.legs))]


def leg_places(route: Route) -> list[Point]:
    """Return where the number of each leg is drawn: the middle of a line or of an arc."""
    places = []
    point = route.start(0)[0]
    for leg in route.legs:
        if isinstance(leg, Line):
            places.append(along(leg.start, leg.end, 0.5))
            point = leg.end
        else:
            points = outline(leg, point)
            places.append(points[len(points) // 2])
            point = points[-1]
    return places


def distance_from(legs: Sequence[Leg], point: Point) -> float:
    """Return the distance of a point from the lines, fillets and endless orbit of a route, m."""
    distances = []
    for leg in legs:
        if isinstance(leg, Line):
            distances.append(
                math.dist(point, along(leg.start, leg.end, nearest(leg, point) / length(leg)))
            )
        elif leg.loiter is None:
            distances.append(abs(math.dist(point, leg.centre) - abs(leg.radius)))
            if leg.end is not None:
                distances.append(math.dist(point, leg.end))
    return min(distances)


def is_too_sharp(leg: Leg, following: Leg | None) -> bool:
    """Return whether the corner between two lines is too sharp for a fillet, beyond SHARPEST."""
    if not isinstance(leg, Line) or not isinstance(following, Line):
        return False
    return abs(math.remainder(end_course(following) - end_course(leg), 2.0 * math.pi)) > SHARPEST


def leads(legs: Sequence[Leg]) -> list[int]:
    """Return to which waypoint each leg of a route leads, by its number.

    A fillet leads to the waypoint after the corner.
    """
    numbers = []
    number = 0
    for leg in legs:
        number += isinstance(leg, Line)
        numbers.append(number + 1 if isinstance(leg, Arc) and not is_orbit(leg) else number)
    return numbers


class ShortLegError(ParameterError):
    """Raised if a leg is too short for its fillets."""

    def __init__(self, sentence: str, number: int) -> None:
        super().__init__(sentence)
        self.number = number  # number of the waypoint at the end of the leg


def route(
    waypoints: Sequence[Point],
    radius: float,
    least: float,
    loiters: Mapping[int, Loiter] = MappingProxyType({}),
    left: Collection[int] = frozenset(),
) -> tuple[Leg, ...]:
    """Plan legs through waypoints, then an orbit round the last waypoint.

    The corners have fillets of `radius`, m. The fillet of a turn tau begins and ends at radius
    tan(tau / 2) from the waypoint. A corner sharper than SHARPEST has no fillet. `loiters` has
    waypoints by number, at which a circle round the waypoint replaces the fillet. Circles and the
    orbit are clockwise, but at the waypoints of `left` they are counter-clockwise. Lines are
    tangents to the circles, but a line that is too short for a tangent leads to the waypoint.
    Raises ParameterError for fewer than two waypoints, for a radius below `least`
    (`lateral.least_radius`), for a waypoint inside the circle of a loiter, and for circles of
    opposite sides that overlap. Raises ShortLegError for a leg that is too short for the fillets.
    Source: R. W. Beard, T. W. McLain, Small Unmanned Aircraft (2012), algorithm 8.
    """
    require(len(waypoints) >= 2, "route", f"{len(waypoints)} waypoints", "two or more")
    require(
        radius >= least,
        "guidance.radius",
        f"{radius:g} m",
        f"at least {math.ceil(least)} m at this speed, wind and bank",
    )
    legs: list[Leg] = []
    first = 0
    last = len(waypoints) - 1
    before = 0  # side of the previous circle: 1 right, -1 left, 0 without a circle
    for k in [*sorted(number for number in loiters if number < last), last]:
        side = -1 if k in left else 1
        if k > 0:
            lines = _between_circles(waypoints[first : k + 1], radius, first, (before, side))
            if legs and isinstance(circle := legs[-1], Arc):
                legs[-1] = circle._replace(
                    end=lines[0].start if isinstance(lines[0], Line) else None
                )
            legs += lines
        legs.append(Arc(waypoints[k], side * radius, None, None if k == last else loiters[k]))
        first = k
        before = side
    return tuple(legs)


def tangent(centres: tuple[Point, Point], radius: float, sides: tuple[int, int]) -> Line:
    """Compute the line that is tangent to two circles of a radius in m.

    Sides are 1 for a clockwise circle, -1 for a counter-clockwise one, 0 for a point. With the
    bearing and the distance from the first centre to the second,

        course = bearing - asin((side_2 - side_1) radius / distance),

    and the line begins at side_1 radius to the left of the first centre. The distance is more than
    abs(side_2 - side_1) radius.
    """
    distance = math.dist(*centres)
    offset = (sides[1] - sides[0]) * radius
    course = course_of(*centres) - math.asin(offset / distance)
    start = _along(centres[0], course - math.pi / 2.0, sides[0] * radius)
    return Line(start, _along(start, course, math.sqrt(distance**2 - offset**2)))


def _between_circles(
    waypoints: Sequence[Point], radius: float, first: int, sides: tuple[int, int]
) -> list[Leg]:
    """Plan lines and fillets between a circle round the first waypoint and one round the last.

    `sides` are as for `tangent`; the first side is 0 without a circle at the first waypoint.
    `first` is the number of the first waypoint.
    """
    points = list(waypoints)
    if sides[0]:
        distance = math.dist(*points[:2])
        crosses = len(points) == 2 and sides[0] != sides[1]
        require(
            distance > (2.0 if crosses else 1.0) * radius,
            f"route[{first + 1}]",
            f"{distance:g} m from the loiter before",
            f"more than {2.0 * radius:g} m, of circles in opposite directions"
            if crosses
            else f"more than {radius:g} m, the radius of the circle",
        )
        if len(points) == 2:
            return [tangent((points[0], points[1]), radius, sides)]
        points[0] = tangent((points[0], points[1]), radius, (sides[0], 0)).start
    before, last = points[-2:]
    if math.dist(before, last) > radius:
        touch = tangent((before, last), radius, (0, sides[1])).end
        with suppress(ParameterError):
            return filleted([*points[:-1], touch], radius, first)
    return filleted(points, radius, first)


def filleted(waypoints: Sequence[Point], radius: float, first: int = 0) -> list[Leg]:
    """Plan lines through waypoints, with fillets in the corners.

    `first` is the number of the first waypoint. Raises as `route` does.
    """
    turns = [0.0]
    for before, corner, after in zip(waypoints, waypoints[1:], waypoints[2:], strict=False):
        turn = math.remainder(course_of(corner, after) - course_of(before, corner), 2.0 * math.pi)
        turns.append(turn if abs(turn) <= SHARPEST else 0.0)
    turns.append(0.0)
    fillets = [radius * math.tan(abs(turn) / 2.0) for turn in turns]
    legs: list[Leg] = []
    start = waypoints[0]
    for k, (start_point, end_point) in enumerate(pairwise(waypoints)):
        length = math.dist(start_point, end_point)
        both_fillets = fillets[k] + fillets[k + 1]
        if length <= both_fillets:
            expected = (
                f"expected more than {math.ceil(both_fillets)} m, for fillets of {radius:g} m"
            )
            number = first + k + 1
            raise ShortLegError(
                f"route[{number}]: found {length:g} m from the waypoint before, {expected}", number
            )
        course = course_of(start_point, end_point)
        turn = turns[k + 1]
        end = _along(end_point, course, -fillets[k + 1])
        legs.append(Line(start, end))
        if fillets[k + 1] > SHORTEST:
            side = math.copysign(1.0, turn)
            start = _along(end_point, course + turn, fillets[k + 1])
            legs.append(
                Arc(_along(end, course + side * math.pi / 2.0, radius), side * radius, start)
            )
        else:
            start = end_point
    return legs


def _along(point: Point, course: float, distance: float) -> Point:
    return point[0] + distance * math.cos(course), point[1] + distance * math.sin(course)
