# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fence: zones to stay in and zones to keep out of, kept by the last safe turn.

Each step predicts the turn at the largest bank to either side, until the course points home. Once the better of the two turns
comes nearer to the fence than MARGIN of flight, the aircraft flies the better turn, then home. Functions take Python floats, or
arrays with an element per aircraft of a fleet.
"""

import math
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from flight_core.units import GRAVITY
from flight_core.vectors import Array, Scalar, array_namespace
from flight_guidance.lateral import LARGEST_SLIP

MARGIN = 0.5
"""s of flight over ground: the largest cross-track error that guidance claims in wind and turbulence."""

HOMEWARD = math.radians(20.0)
"""Angle before the bearing of home at which the turn ends."""

SHARES = (1.0, 1.0 - LARGEST_SLIP)
"""Shares of the coordinated turn that the predicted turns have; the nearer turn counts.

r follows psi' = g tan(phi) / V, but the aircraft flies along chi = psi + beta: a growing sideslip, and k_beta beta in r_m, take
from the turn. Of the osprey with every entry of A and B off by up to 30 % the sideslip takes 0.19, of JSBSim's f16 0.09.
"""

POINTS = 64
"""Points of a predicted turn: a chord of the turn of 5 deg departs from the arc by a thousandth of the radius."""


class Zone(NamedTuple):
    """A polygon, or a circle: a single point and a radius."""

    north: tuple[float, ...]  # m
    east: tuple[float, ...]  # m
    radius: float = 0.0  # m, 0 of a polygon
    exclude: bool = False  # whether the aircraft keeps out


class Fence(NamedTuple):
    """The zones, and home. The aircraft stays in one of the zones without `exclude`, and out of each zone with it."""

    zones: tuple[Zone, ...]
    home: tuple[float, float] = (0.0, 0.0)  # north, east, m


class Motion(NamedTuple):
    """What the prediction takes of an aircraft, and the limits of the turn."""

    north: Scalar  # m
    east: Scalar  # m
    phi: Scalar  # rad, once a roll that has begun ends
    heading: Scalar  # rad, psi + beta
    speed: Scalar  # airspeed, m/s
    wind: tuple[Scalar, Scalar]  # where the air moves to: north, east, m/s
    bank: Scalar  # largest bank, rad
    roll_rate: float  # rad/s
    lag: float  # s, of the turn behind the commanded bank: half of 1 / k_phi, and 2 / w_r of the reference model of r


def inside(zone: Zone, north: Array, east: Array) -> Array:
    """Distance from the border of a zone, m, positive inside of the polygon or circle. Arrays of any shape."""
    xp = array_namespace(north)
    if zone.radius:
        return zone.radius - xp.hypot(north - zone.north[0], east - zone.east[0])
    first, second = np.array(zone.north), np.array(zone.east)
    edge_north, edge_east = np.roll(first, -1) - first, np.roll(second, -1) - second
    x, y = north[..., None] - first, east[..., None] - second
    share = xp.clip((x * edge_north + y * edge_east) / (edge_north**2 + edge_east**2), 0.0, 1.0)
    distance = xp.min(xp.hypot(x - share * edge_north, y - share * edge_east), axis=-1)
    level = np.where(edge_north == 0.0, 1.0, edge_north)  # an edge to the east crosses no line to the east
    crossed = ((x < 0.0) != (x < edge_north)) & (y < x * edge_east / level)  # by a ray to the east: even-odd rule
    return xp.where(xp.sum(crossed, axis=-1) % 2 == 1, distance, -distance)


def clearance(zones: tuple[Zone, ...], north: Array, east: Array) -> Array:
    """Distance from the fence, m, negative outside of the fence. Arrays of any shape."""
    xp = array_namespace(north)
    stay = [inside(zone, north, east) for zone in zones if not zone.exclude]
    out = [-inside(zone, north, east) for zone in zones if zone.exclude]
    return reduce(xp.minimum, [*([reduce(xp.maximum, stay)] if stay else []), *out])


def described(distance: float) -> str:
    """A distance of `clearance` in words: "9 m inside of the fence"."""
    return f"{abs(distance):.0f} m {'inside' if distance >= 0.0 else 'outside'} of the fence"


def _remaining(side: Array, home: tuple[float, float], place: tuple[Array, Array], course: Array) -> Array:
    """Angle of a turn to a side from the course to the bearing of home, rad, 0 to 2 pi."""
    xp = array_namespace(course)
    return side * (xp.atan2(home[1] - place[1], home[0] - place[0]) - course) % (2.0 * math.pi)


def turn_clearance(fence: Fence, motion: Motion) -> tuple[Array, Array]:
    """Least clearance of the turn to the right and to the left, m.

        phi' = p_max after the lag, to the largest bank;  chi' = share g tan(phi) / V;  [n, e]' = V [cos, sin](chi) + W

    until the course is HOMEWARD before home, at the latest after nearly a full turn. Trapezoidal rule over POINTS.
    """
    xp = array_namespace(motion.phi)
    axes = (1,) * np.ndim(motion.phi)
    turns = [(side, share) for side in (1.0, -1.0) for share in SHARES]
    side, share = (column.reshape(-1, 1, *axes) for column in np.array(turns).T)
    aim, turn = side * motion.bank, share * GRAVITY / motion.speed
    rolled = motion.lag + abs(aim - motion.phi) / motion.roll_rate
    longest = motion.lag + 2.0 * motion.bank / motion.roll_rate + 1.95 * math.pi / (turn * xp.tan(motion.bank))
    t = np.linspace(0.0, 1.0, POINTS).reshape(-1, *axes) * longest
    reach = motion.roll_rate * xp.maximum(t - motion.lag, 0.0)
    phi = motion.phi + xp.minimum(xp.maximum(aim - motion.phi, -reach), reach)
    chi = motion.heading + _integral(turn * xp.tan(phi), longest)
    v_north = motion.speed * xp.cos(chi) + motion.wind[0]
    v_east = motion.speed * xp.sin(chi) + motion.wind[1]
    north, east = motion.north + _integral(v_north, longest), motion.east + _integral(v_east, longest)
    remaining = _remaining(side, fence.home, (north, east), xp.atan2(v_east, v_north))
    homeward = (remaining < HOMEWARD) & (t > rolled)
    after = xp.cumsum(homeward, axis=1) - homeward > 0
    nearest = xp.min(xp.where(after, math.inf, clearance(fence.zones, north, east)), axis=1)
    right, left = (xp.min(nearest[k : k + len(SHARES)], axis=0) for k in (0, len(SHARES)))
    return right, left


def _integral(rate: Array, longest: Array) -> Array:
    """Integral from 0 over the axis 1 of a rate at POINTS equal times up to `longest`, by the trapezoidal rule."""
    xp = array_namespace(rate)
    steps = 0.5 * (rate[:, 1:] + rate[:, :-1]) * (longest / (POINTS - 1))
    return xp.concat([xp.zeros_like(rate[:, :1]), xp.cumsum(steps, axis=1)], axis=1)


def way_home_clearance(fence: Fence, north: Array, east: Array) -> Array:
    """Least clearance of the straight line home, m."""
    share = np.linspace(0.0, 1.0, POINTS).reshape(-1, *(1,) * np.ndim(north))
    to_north, to_east = north + share * (fence.home[0] - north), east + share * (fence.home[1] - east)
    return array_namespace(north).min(clearance(fence.zones, to_north, to_east), axis=0)


class Escape(NamedTuple):
    """Result of `last_safe_turn`."""

    action: Any  # RIGHT, LEFT, HOME or 0
    begins: Any  # whether a turn begins now
    clearance: Any  # m, now
    predicted: Any  # m, least clearance of the better way


RIGHT, LEFT, HOME = 1.0, -1.0, 2.0
"""Actions of the fence: a turn to the right, to the left, and the way home after the turn; 0 is none."""


def last_safe_turn(fence: Fence, action: Scalar, motion: Motion) -> Escape:
    """The action of the fence after a step, from the action before.

    A turn ends towards home. A turn begins where the better turn comes nearer to the fence than MARGIN of flight. On the way
    home the straight line home is a third choice.
    """
    if isinstance(motion.phi, float):
        north, east, phi = map(np.float64, (motion.north, motion.east, motion.phi))
        motion = motion._replace(north=north, east=east, phi=phi)
    xp, place = array_namespace(motion.phi), (motion.north, motion.east)
    v_north = motion.speed * xp.cos(motion.heading) + motion.wind[0]
    v_east = motion.speed * xp.sin(motion.heading) + motion.wind[1]
    course = xp.atan2(v_east, v_north)
    turns = abs(action) == RIGHT
    ends = turns & (_remaining(action, fence.home, place, course) < HOMEWARD)
    after = xp.where(ends, HOME, action)
    right, left = turn_clearance(fence, motion)
    ahead = xp.cos(_remaining(1.0, fence.home, place, course)) > 0.5
    straight = xp.where((after == HOME) & ahead, way_home_clearance(fence, *place), -math.inf)
    predicted = xp.maximum(xp.maximum(right, left), straight)
    begins = (abs(after) != RIGHT) & (predicted < MARGIN * xp.hypot(v_north, v_east))
    turned = xp.where(begins, xp.where(right >= left, RIGHT, LEFT), after)
    return Escape(turned, begins, clearance(fence.zones, *place), predicted)
