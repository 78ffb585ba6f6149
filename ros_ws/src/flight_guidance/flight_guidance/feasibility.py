# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Refuse a route that is beyond the performance of the aircraft before it is flown.

The refusal names the nearest feasible value.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from flight_core.parameters import ParameterError, require
from flight_guidance.fence.zones import Fence, clearance, clearance_text
from flight_guidance.guidance_state import LARGEST
from flight_guidance.routes.route_file import Waypoint
from flight_guidance.steering import path, protection
from flight_guidance.steering.lateral import least_period, least_radius
from flight_guidance.steering.path import Leg, Line, Loiter, Point, Route

HEADWIND = 1.2
"""Least ratio of the airspeed to the wind: against the wind the aircraft still moves ahead by a
sixth of the airspeed."""


class Performance(NamedTuple):
    """What the aircraft can fly, and the largest wind in which it must fly the route."""

    speed: float  # m/s, airspeed for waypoints that name none
    stall_speed: float  # m/s
    bank: float  # largest bank, rad
    roll_rate: float  # largest phi_dot, rad/s
    climb: float  # largest climb rate, m/s
    sink: float  # largest sink rate, m/s
    wind: float  # m/s, largest wind from any direction
    largest_speed: float = math.inf  # m/s
    lowest: float = -math.inf  # m, least altitude
    highest: float = math.inf  # m, largest altitude


def speeds(waypoints: Sequence[Waypoint], first: float) -> tuple[float, ...]:
    """Return the airspeed on the leg to each waypoint, m/s.

    If a waypoint names no airspeed, its leg has the airspeed of the leg before. The first leg then
    has the airspeed `first`.
    """
    leg_speeds = []
    for waypoint in waypoints:
        first = waypoint.speed or first
        leg_speeds.append(first)
    return tuple(leg_speeds)


@dataclass(frozen=True, kw_only=True)
class FlyableRoute:
    """The legs of a route, and the waypoints through which they lead.

    Waypoints that were left out because their legs were too short are not among them. Legs that
    were too steep have circles on which the aircraft climbs or descends.
    """

    legs: tuple[Leg, ...]
    waypoints: tuple[Waypoint, ...]
    notes: tuple[str, ...]  # sentences on what differs from the given waypoints


@lru_cache(maxsize=8)  # checks, nodes, replay and report all ask for the same route
def flyable(
    waypoints: tuple[Waypoint, ...], radius: float, period: float, can: Performance
) -> FlyableRoute:
    """Plan the legs of a route with fillets of `radius`, m, and path following with `period`, s.

    If a leg is too short for the fillets, one of its waypoints is left out. The route must still
    pass this waypoint within `radius` or within 1 s of flight. A change of altitude may be too
    large for the straight part of its leg in a tailwind. The aircraft then makes the change on a
    circle: a climb at the start of the leg, and a descent at the end of the leg.

    Raises ParameterError for a waypoint that is not finite or beyond LARGEST, for an altitude or a
    speed out of bounds, and for a speed of at most HEADWIND times the wind. It is also raised for a
    `period` below `lateral.least_period`, for a `radius` below `lateral.least_radius`, and for a
    leg that is too short for the fillets. Both limits depend on the largest bank at the speed of
    the leg, which keeps a margin to the stall (`protection.bank_limit`).
    """
    require_bounds(waypoints, can)
    leg_speeds = speeds(waypoints, can.speed)
    least = 0.0
    slowest = 0.0
    for speed in leg_speeds:
        bank = protection.bank_limit(can.bank, can.stall_speed, speed)
        least = max(least, least_radius(speed, can.wind, bank))
        slowest = max(slowest, least_period(speed, bank, can.roll_rate))
    expected = f"at least {_up(slowest, 0.1):g} s at this speed, bank and roll rate"
    require(period >= slowest, "guidance.period", f"{period:g} s", expected)
    waypoints_by_number = [
        waypoint._replace(speed=speed)
        for waypoint, speed in zip(waypoints, leg_speeds, strict=True)
    ]
    remaining, notes = _without_short_legs(waypoints_by_number, radius, least)
    return _with_circles(dict(remaining), notes, radius, least, can)


def as_route(
    legs: tuple[Leg, ...],
    waypoints: Sequence[Waypoint],
    speed: float,
    *,
    slopes: bool,
    notes: tuple[str, ...] = (),
) -> Route:
    """Make a Route from legs through waypoints.

    `speed` is the airspeed, m/s, up to the first waypoint that names one. If `slopes`, the altitude
    changes linearly along each line. Otherwise it changes in a step at the start of a leg.

    A fillet belongs to the way to the next waypoint. A leg starts at the altitude and the airspeed
    of the previous waypoint. An orbit round a waypoint starts at the altitude of this waypoint, and
    ends at the altitude at which the aircraft flies on.
    """
    leg_speeds = speeds(waypoints, speed)
    numbers = path.leads(legs)
    before = [max(k - 1, 0) for k in numbers]
    altitude = []
    departures = []
    for leg, to, start in zip(legs, numbers, before, strict=True):
        orbit = path.is_orbit(leg)
        departures.append(waypoints[to].altitude if orbit else waypoints[start].departure)
        end = waypoints[to].departure if orbit else waypoints[to].altitude
        is_fillet = not isinstance(leg, Line) and not orbit
        altitude.append(departures[-1] if is_fillet and slopes else end)
    return Route(
        legs=legs,
        altitude=tuple(altitude),
        V=tuple(leg_speeds[k] for k in numbers),
        from_altitude=tuple(departures),
        from_V=tuple(leg_speeds[k] for k in before),
        slopes=slopes,
        notes=notes,
    )


def _legs(waypoints: Sequence[Waypoint], radius: float, least: float) -> tuple[Leg, ...]:
    loiters = {
        k: Loiter(waypoint.turns, waypoint.wait)
        for k, waypoint in enumerate(waypoints)
        if waypoint.is_loiter
    }
    left = [k for k, waypoint in enumerate(waypoints) if waypoint.left]
    return path.route([waypoint.point for waypoint in waypoints], radius, least, loiters, left)


def _without_short_legs(
    waypoints: Sequence[Waypoint], radius: float, least: float
) -> tuple[list[tuple[int, Waypoint]], tuple[str, ...]]:
    """Return the waypoints with their numbers, without those that make legs too short.

    `least` is the least radius of a circle, m. A note names each waypoint that is left out. Raises
    ShortLegError if a leg is too short and none of its waypoints can be left out.
    """
    remaining = list(enumerate(waypoints))
    refusal = None
    while True:
        try:
            legs = _legs([waypoint for _, waypoint in remaining], radius, least)
            break
        except path.ShortLegError as short:
            refusal = refusal or short
            inner = [
                k
                for k in (short.number - 1, short.number)
                if 0 < k < len(remaining) - 1 and not remaining[k][1].is_loiter
            ]
            if not inner:
                raise refusal from None
            del remaining[
                min(
                    inner,
                    key=lambda k: _offset(
                        *(waypoint.point for _, waypoint in remaining[k - 1 : k + 2])
                    ),
                )
            ]
        except ParameterError as error:
            # Without this waypoint the corners are different, and their legs may be too short.
            raise refusal or error from None
    numbers = {number for number, _ in remaining}
    notes = []
    for number, waypoint in enumerate(waypoints):
        if number in numbers:
            continue
        distance = path.distance_from(legs, waypoint.point)
        if distance > max(radius, waypoint.speed or 0.0):
            raise refusal or ParameterError("route")
        notes.append(
            f"route[{number}]: corner cut, {distance:.0f} m from the waypoint: a leg is too "
            "short for the fillets"
        )
    return remaining, tuple(notes)


def _offset(before: Point, point: Point, after: Point) -> float:
    """Return the distance of a point from the line between two other points, m."""
    line = Line(before, after)
    share = path.nearest(line, point) / max(path.length(line), 1e-9)
    return math.dist(point, path.along(before, after, share))


def _with_circles(
    by_number: Mapping[int, Waypoint],
    notes: tuple[str, ...],
    radius: float,
    least: float,
    can: Performance,
) -> FlyableRoute:
    """Add a circle to a route for each change of altitude that is too large for its leg.

    A change is too large if it needs a faster climb or sink along the leg than the aircraft can
    fly. `by_number` has the waypoints by their numbers.
    """
    numbers = list(by_number)
    waypoints = list(by_number.values())
    sentences = list(notes)
    while True:
        legs = _legs(waypoints, radius, least)
        lines: dict[int, float] = {}
        for number, leg in zip(path.leads(legs), legs, strict=True):
            if isinstance(leg, Line):
                lines[number] = path.length(leg)
        for k, length in lines.items():
            before = waypoints[k - 1]
            waypoint = waypoints[k]
            change = waypoint.altitude - before.departure
            rate = can.climb if change > 0.0 else can.sink
            reach = rate * length / ((waypoint.speed or can.speed) + can.wind)
            if abs(change) <= reach:
                continue
            rises = change > 0.0
            difference = f"{abs(change):g} m {'above' if rises else 'below'} the waypoint before"
            expected = f"at most {math.floor(reach)} m at {rate:g} m/s over {length:.0f} m"
            require(
                rate > 0.0 and (rises or waypoint.departure == waypoint.altitude),
                f"route[{numbers[k]}].altitude",
                difference,
                expected,
            )
            if rises:
                waypoints[k - 1] = before._replace(leave=waypoint.altitude)
            else:
                waypoints[k] = waypoint._replace(altitude=before.departure, leave=waypoint.altitude)
            where = (
                f"round the waypoint {'before' if rises else 'itself'}, where the leg takes "
                f"{math.floor(reach)} m"
            )
            sentences.append(f"route[{numbers[k]}]: {difference}, flown on circles {where}")
            break
        else:
            return FlyableRoute(legs=legs, waypoints=tuple(waypoints), notes=tuple(sentences))


def require_bounds(waypoints: Sequence[Waypoint], can: Performance) -> None:
    """Check that all waypoints, altitudes and airspeeds are inside their bounds.

    Raises ParameterError if not.
    """
    for k, waypoint in enumerate(waypoints):
        north, east, altitude = waypoint[:3]
        is_plausible = all(
            abs(value) <= LARGEST for value in (north, east, altitude, waypoint.departure)
        )
        position = f"north {north:g}, east {east:g}, altitude {altitude:g} m"
        require(
            is_plausible,
            f"route[{k}]",
            position,
            f"finite values, at most {LARGEST:g} m either way",
        )
        for value in (altitude, waypoint.departure):
            is_permitted = can.lowest <= value <= can.highest
            require(
                is_permitted,
                f"route[{k}].altitude",
                f"{value:g} m",
                f"{can.lowest:g} to {can.highest:g} m",
            )
    floor = protection.speed_floor(can.stall_speed)
    for k, speed in enumerate(speeds(waypoints, can.speed)):
        require(
            speed >= floor,
            f"route[{k}].V",
            f"{speed:g} m/s",
            f"at least {_up(floor, 0.1):g} m/s, the speed floor",
        )
        require(
            speed <= can.largest_speed,
            f"route[{k}].V",
            f"{speed:g} m/s",
            f"at most {can.largest_speed:g} m/s",
        )
        expected = (
            f"more than {HEADWIND * can.wind:.3g} m/s, or a guidance.wind below "
            f"{speed / HEADWIND:.3g} m/s"
        )
        speed_in_wind = f"{speed:g} m/s in a wind of {can.wind:g} m/s"
        require(speed > HEADWIND * can.wind, f"route[{k}].V", speed_in_wind, expected)


def require_inside(route: Route, fence: Fence, margin: float) -> None:
    """Check that no leg comes nearer to the fence than `margin`, m.

    Raises ParameterError, which names the place where the clearance is least.
    """
    start: Point = (0.0, 0.0)
    for number, leg in enumerate(route.legs):
        points = path.outline(leg, start)
        start = points[-1]
        if isinstance(leg, Line):
            count = math.ceil(path.length(leg) / (POINT_DISTANCE * route.radius)) + 1
            points = [path.along(leg.start, leg.end, k / count) for k in range(count + 1)]
        north, east = np.array(points).T
        inside = clearance(fence.zones, north, east)
        if path.is_too_sharp(leg, next(iter(route.legs[number + 1 :]), None)):
            inside[-1] -= TURN_BACK * route.radius
        worst = int(np.argmin(inside))
        outermost = (
            f"leg {number}, {clearance_text(inside[worst])} at north {north[worst]:.0f} m, "
            f"east {east[worst]:.0f} m"
        )
        require(
            bool(inside[worst] >= margin), "route", outermost, f"at least {margin:.0f} m inside"
        )


TURN_BACK = 3.0
"""Distance within which an aircraft joins the next leg after a corner without a fillet, in radii of
the fillets. The osprey needed 2.0."""

POINT_DISTANCE = 0.05
"""Distance of the points of a line at which the fence is checked, in radii of the fillets."""


def _up(value: float, step: float) -> float:
    """Round a lower bound up to a multiple of a step, so that the result is still feasible."""
    return math.ceil(value / step) * step
