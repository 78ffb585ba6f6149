# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Enforce a fence, which has zones to stay in and zones to keep out of, by the last safe turn.

Each step predicts the turns at the largest bank to the right and to the left. A turn lasts until
the course points along the way home. The better turn is the one that stays farther from the fence.
As soon as even this turn would come nearer to the fence than the distance flown in the time MARGIN,
the aircraft flies it, and then home. An aircraft outside first flies the shortest way back inside,
and then home. Functions take Python floats, or arrays with an element for each aircraft of a fleet.
"""

import math
from enum import IntEnum
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from flight_core.units import GRAVITY
from flight_core.vectors import Array, Scalar, array_namespace
from flight_guidance.fence.ways import POINTS, Ways, line_clearance, ways
from flight_guidance.fence.zones import Fence, Zone, clearance
from flight_guidance.steering.lateral import LARGEST_SLIP
from flight_guidance.steering.protection import forward

__all__ = ["Fence", "Zone", "clearance"]

MARGIN = 0.5
"""Least distance to the fence, in s of flight over ground. It is the largest cross-track error that
guidance promises in wind and turbulence."""

HOMEWARD = math.radians(20.0)
"""A turn ends when the course is this angle short of the bearing of the way home."""

AHEAD = math.radians(60.0)
"""Largest angle between the course and the bearing of the way home at which an aircraft flies along
the way."""

LEAST_TURN = math.radians(5.0)
"""Bank of the longest turn that is predicted, which takes 2 min at 20 m/s.

If the bank is smaller, the prediction still ends after this time. At 1.1 V_s and below the largest
bank is 0, and the prediction is a straight line.
"""

SHARES = (1.0, 1.0 - LARGEST_SLIP)
"""Fractions of the coordinated turn for which turns are predicted. The nearer turn counts.

r follows psi' = g tan(phi) / V, but the aircraft flies along chi = psi + beta. A growing sideslip,
and k_beta beta in r_m, reduce the turn. The sideslip takes a fraction of 0.19 on the osprey if
every entry of A and B is off by up to 30 %, and of 0.09 on JSBSim's f16.
"""


class Motion(NamedTuple):
    """The motion of an aircraft from which a turn is predicted, and the limits of the turn."""

    north: Scalar  # m
    east: Scalar  # m
    phi: Scalar  # rad, bank at the end of a roll that is under way
    heading: Scalar  # rad, psi + beta
    speed: Scalar  # airspeed, m/s
    wind: tuple[Scalar, Scalar]  # velocity of the air: north, east, m/s
    bank: Scalar  # largest bank, rad
    roll_rate: float  # rad/s
    # s, lag of the turn behind the commanded bank, which is 1 / (2 k_phi) plus `turn_lag`.
    lag: float


def _remaining(side: Array, bearing: Array, course: Array) -> Array:
    """Return the angle of a turn to the given side from the course to a bearing, rad, 0 to 2 pi."""
    return side * (bearing - course) % (2.0 * math.pi)


def _bearing(chart: Ways, fence: Fence, north: Array, east: Array) -> Array:
    """Return the bearing of the way home, rad."""
    aim_north, aim_east, _ = chart.aim(fence, north, east)
    return array_namespace(north).atan2(aim_east - east, aim_north - north)


def turn_clearance(fence: Fence, motion: Motion) -> tuple[Array, Array]:
    """Compute the least clearance from the fence in a turn to the right and to the left, m.

        phi' = p_max after the lag, to the largest bank;  chi' = share g tan(phi) / V;
            [n, e]' = V [cos, sin](chi) + W

    A turn begins with the `lag`. The bank then changes at p_max to the largest bank. The turn is
    computed for each `share` in SHARES, the fraction of the turn of this bank that the aircraft
    really flies, and the result is the least clearance of all. A turn ends when the course is only
    HOMEWARD away from the bearing of the way home. It also ends after the time of nearly a full
    turn at the largest bank, where a bank below LEAST_TURN is taken as LEAST_TURN. The path is
    integrated by the trapezoidal rule at POINTS instants.
    """
    xp = array_namespace(motion.phi)
    axes = (1,) * np.ndim(motion.phi)
    turns = np.array([*product((1.0, -1.0), SHARES)])
    side, share = (column.reshape(-1, 1, *axes) for column in turns.T)
    aim = side * motion.bank
    turn = share * GRAVITY / forward(motion.speed)
    rolled = motion.lag + abs(aim - motion.phi) / motion.roll_rate
    longest = (
        motion.lag
        + 2.0 * motion.bank / motion.roll_rate
        + 1.95 * math.pi / (turn * xp.tan(xp.maximum(motion.bank, LEAST_TURN)))
    )
    t = np.linspace(0.0, 1.0, POINTS).reshape(-1, *axes) * longest
    reach = motion.roll_rate * xp.maximum(t - motion.lag, 0.0)
    phi = motion.phi + xp.minimum(xp.maximum(aim - motion.phi, -reach), reach)
    chi = motion.heading + _integral(turn * xp.tan(phi), longest)
    v_north = motion.speed * xp.cos(chi) + motion.wind[0]
    v_east = motion.speed * xp.sin(chi) + motion.wind[1]
    north = motion.north + _integral(v_north, longest)
    east = motion.east + _integral(v_east, longest)
    remaining = _remaining(
        side, _bearing(ways(fence), fence, north, east), xp.atan2(v_east, v_north)
    )
    homeward = (remaining < HOMEWARD) & (t > rolled)
    after = xp.cumsum(homeward, axis=1) - homeward > 0
    nearest = xp.min(xp.where(after, math.inf, clearance(fence.zones, north, east)), axis=1)
    right_turn, left_turn = (xp.min(nearest[k : k + len(SHARES)], axis=0) for k in (0, len(SHARES)))
    return right_turn, left_turn


COURSES = 24
"""Number of courses, and of directions of the wind, for `room_at_home`."""


def room_at_home(fence: Fence, motion: Motion, wind: float) -> float:
    """Compute how near to the fence the turn from home onto the orbit may come, m.

    An aircraft may come over home on any course, and its turn onto the orbit may lead outside of
    the orbit by up to twice the radius of the turn. The aircraft flies the better of the turns to
    the right and to the left. The result is the least clearance over COURSES courses, and over
    COURSES directions of the wind. `wind` is the speed of the wind, m/s, and `motion` is the motion
    of the aircraft over home.
    """
    angles = np.linspace(0.0, 2.0 * math.pi, COURSES, endpoint=False)
    from_sides = angles if wind else angles[:1]
    heading, side = (grid.ravel() for grid in np.meshgrid(angles, from_sides))
    turning = motion._replace(
        north=np.full(heading.shape, motion.north),
        east=np.full(heading.shape, motion.east),
        phi=np.zeros(heading.shape),
        heading=heading,
        wind=(wind * np.cos(side), wind * np.sin(side)),
    )
    return float(np.min(np.maximum(*turn_clearance(fence, turning))))


def _integral(rate: Array, longest: Array) -> Array:
    """Integrate a rate over axis 1 by the trapezoidal rule, from 0 on.

    The rate is given at POINTS equally spaced times up to `longest`.
    """
    xp = array_namespace(rate)
    steps = 0.5 * (rate[:, 1:] + rate[:, :-1]) * (longest / (POINTS - 1))
    return xp.concat([xp.zeros_like(rate[:, :1]), xp.cumsum(steps, axis=1)], axis=1)


class FenceAction(IntEnum):
    """The action of the fence on an aircraft. A turn has the sign of its bank."""

    NONE = 0
    RIGHT = 1
    LEFT = -1
    HOME = 2  # the straight way home
    BACK = 3  # the shortest way back inside
    AROUND = 4  # the way home around a zone or a corner


class Escape(NamedTuple):
    """The action that `last_safe_turn` chooses, with the clearances on which it depends."""

    action: Any  # FenceAction, or an array of its values
    begins: Any  # whether the action begins at this step
    clearance: Any  # m, present clearance
    predicted: Any  # m, least predicted clearance on the best way
    course: Any  # rad, course of the way home over ground


def last_safe_turn(fence: Fence, action: Scalar, motion: Motion) -> Escape:
    """Choose the action of the fence after a step; `action` is the action in the previous step.

    Let margin be the distance flown in the time MARGIN. A turn begins when even the better of the
    two turns would come nearer to the fence than margin. The turn ends when the course is only
    HOMEWARD away from the bearing of the way home, or later if the way home is not free yet.

    On the way home the aircraft turns only if the better turn keeps a larger clearance than the way
    does. Besides, the clearance of this turn must be below margin and below the present clearance.
    Outside the fence no turn begins, and the aircraft flies back until it is inside by margin.
    """
    if isinstance(motion.phi, float):
        north, east, phi = map(np.float64, (motion.north, motion.east, motion.phi))
        motion = motion._replace(north=north, east=east, phi=phi)
    xp = array_namespace(motion.phi)
    place = (motion.north, motion.east)
    v_north = motion.speed * xp.cos(motion.heading) + motion.wind[0]
    v_east = motion.speed * xp.sin(motion.heading) + motion.wind[1]
    course = xp.atan2(v_east, v_north)
    margin = MARGIN * xp.hypot(v_north, v_east)
    *aim, straight = ways(fence).aim(fence, *place)
    bearing = xp.atan2(aim[1] - place[1], aim[0] - place[0])
    now = clearance(fence.zones, *place)
    is_outside = (now < 0.0) | ((action == FenceAction.BACK) & (now < margin))
    homeward = xp.where(straight, FenceAction.HOME, FenceAction.AROUND)

    right_turn, left_turn = turn_clearance(fence, motion)
    turn = xp.maximum(right_turn, left_turn)
    flies_home = action != FenceAction.NONE
    along = flies_home & (xp.cos(bearing - course) > math.cos(AHEAD))
    way = xp.where(along, line_clearance(fence, *place, *aim), -math.inf)
    clearances = xp.maximum(turn, way)
    least = xp.where(flies_home, xp.minimum(margin, now), margin)
    must_turn = (clearances < least) & (turn > way)
    remaining = _remaining(action, bearing, course)
    ends = (remaining > math.pi) & (way >= least)
    turns = (abs(action) == FenceAction.RIGHT) & (remaining >= HOMEWARD) & ~ends

    after = xp.where(
        must_turn,
        xp.where(right_turn >= left_turn, FenceAction.RIGHT, FenceAction.LEFT),
        xp.where(flies_home, homeward, FenceAction.NONE),
    )
    after = xp.where(turns, action, xp.where(is_outside, FenceAction.BACK, after))
    return Escape(
        action=after,
        begins=(action == FenceAction.NONE) & (after != FenceAction.NONE),
        clearance=now,
        predicted=clearances,
        course=bearing,
    )
