# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Feasibility: refusal of a route beyond the aircraft's performance before the flight, with the nearest feasible value."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flight_core.parameters import require
from flight_guidance import path, protection
from flight_guidance.fence import Fence, clearance
from flight_guidance.lateral import least_period, least_radius
from flight_guidance.modes import LARGEST
from flight_guidance.path import Leg, Line, Point, Route
from flight_guidance.route_file import Waypoint

HEADWIND = 1.2
"""Least ratio of the airspeed to the wind: against the wind the aircraft still goes ahead by a sixth of the airspeed."""


class Performance(NamedTuple):
    """Performance of the aircraft, and the largest wind."""

    speed: float  # airspeed where the route names none, m/s
    stall_speed: float  # m/s
    bank: float  # largest bank, rad
    roll_rate: float  # largest phi_dot, rad/s
    climb: float  # largest climb rate, m/s
    sink: float  # largest sink rate, m/s
    wind: float  # largest wind from any side, m/s
    largest_speed: float = math.inf  # m/s
    lowest: float = -math.inf  # m, least altitude
    highest: float = math.inf  # m


def speeds(waypoints: Sequence[Waypoint], first: float) -> tuple[float, ...]:
    """Airspeeds on the legs to the waypoints, m/s: of the waypoint, or of the leg before; `first` where none is named yet."""
    named = []
    for waypoint in waypoints:
        first = waypoint.speed or first
        named.append(first)
    return tuple(named)


def flyable_legs(waypoints: Sequence[Waypoint], radius: float, period: float, can: Performance) -> tuple[Leg, ...]:
    """The legs of a route with fillets of `radius`, m, and path following with `period`, s.

    Raises ParameterError for a waypoint not finite or beyond LARGEST, an altitude or a speed beyond the bounds, a speed of at
    most HEADWIND times the wind, a period below the rule, a radius below (V + W)^2 / (g tan(0.8 phi_max)), a leg too short for
    the fillets, and an altitude out of reach of the climb or sink along the straight part of the leg, the wind from behind.
    phi_max is the largest bank at V for the stall speed.
    """
    for k, (north, east, altitude, _) in enumerate(waypoints):
        known = all(abs(value) <= LARGEST for value in (north, east, altitude))
        found = f"north {north:g}, east {east:g}, altitude {altitude:g} m"
        require(known, f"route[{k}]", found, f"finite values, at most {LARGEST:g} m either way")
        permitted = can.lowest <= altitude <= can.highest
        require(permitted, f"route[{k}].altitude", f"{altitude:g} m", f"{can.lowest:g} to {can.highest:g} m")
    floor, flown = protection.speed_floor(can.stall_speed), speeds(waypoints, can.speed)
    for k, speed in enumerate(flown):
        require(speed >= floor, f"route[{k}].V", f"{speed:g} m/s", f"at least {_up(floor, 0.1):g} m/s, the speed floor")
        require(speed <= can.largest_speed, f"route[{k}].V", f"{speed:g} m/s", f"at most {can.largest_speed:g} m/s")
        expected = f"more than {HEADWIND * can.wind:.3g} m/s, or a guidance.wind below {speed / HEADWIND:.3g} m/s"
        found = f"{speed:g} m/s in a wind of {can.wind:g} m/s"
        require(speed > HEADWIND * can.wind, f"route[{k}].V", found, expected)
    least, slowest = 0.0, 0.0
    for speed in flown:
        bank = protection.bank_limit(can.bank, can.stall_speed, speed)
        least = max(least, least_radius(speed, can.wind, bank))
        slowest = max(slowest, least_period(speed, bank, can.roll_rate))
    expected = f"at least {_up(slowest, 0.1):g} s at this speed, bank and roll rate"
    require(period >= slowest, "guidance.period", f"{period:g} s", expected)
    legs = path.route([waypoint.point for waypoint in waypoints], radius, least)
    lines = [leg for leg in legs if isinstance(leg, Line)]
    for k, (line, speed) in enumerate(zip(lines, flown[1:], strict=True), 1):
        change = waypoints[k].altitude - waypoints[k - 1].altitude
        length, rate = math.dist(*line), can.climb if change > 0.0 else can.sink
        reach = rate * length / (speed + can.wind)
        found = f"{abs(change):g} m {'above' if change > 0.0 else 'below'} the waypoint before"
        expected = f"at most {math.floor(reach)} m at {rate:g} m/s over {length:.0f} m"
        require(abs(change) <= reach, f"route[{k}].altitude", found, expected)
    return legs


def require_inside(route: Route, fence: Fence, margin: float) -> None:
    """Raise ParameterError for a leg nearer to the fence than `margin`, m, with the place that is the farthest outside."""
    start: Point = (0.0, 0.0)
    for number, leg in enumerate(route.legs):
        points = path.outline(leg, start)
        start = points[-1]
        if isinstance(leg, Line):
            count = math.ceil(path.length(leg) / (POINT_DISTANCE * route.radius)) + 1
            points = [path.along(leg.start, leg.end, k / count) for k in range(count + 1)]
        north, east = np.array(points).T
        inside = clearance(fence.zones, north, east)
        worst = int(np.argmin(inside))
        where = f"{abs(inside[worst]):.0f} m {'inside' if inside[worst] >= 0.0 else 'outside'} of the fence"
        found = f"leg {number}, {where} at north {north[worst]:.0f} m, east {east[worst]:.0f} m"
        require(bool(inside[worst] >= margin), "route", found, f"at least {margin:.0f} m inside")


POINT_DISTANCE = 0.05
"""Distance of the points of a line at which the fence is checked, in radii of the fillets."""


def _up(value: float, step: float) -> float:
    """A value rounded up to a multiple of a step: still feasible."""
    return math.ceil(value / step) * step
