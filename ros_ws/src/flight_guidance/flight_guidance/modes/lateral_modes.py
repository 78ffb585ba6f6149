# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the bank for a lateral mode.

The mode is a heading or a course, an orbit, a leg of a route, or the action of the fence.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from flight_core.units import GRAVITY
from flight_core.vectors import Scalar, array_namespace
from flight_guidance.fence.fence import Escape, FenceAction
from flight_guidance.guidance_state import GuidanceMode, GuidanceParams, GuidanceState, Lateral
from flight_guidance.modes.legs import EXIT, course_and_speed, has_loitered, is_at_exit
from flight_guidance.steering import path
from flight_guidance.steering.lateral import (
    PathError,
    bank_for,
    course_acceleration,
    path_acceleration,
    turn_towards,
)
from flight_guidance.steering.path import Arc, Point, Route, Side
from flight_guidance.steering.vertical import path_angle

STEEPEST = math.radians(89.0)
"""Largest bank that a mode may ask for, before protection."""

NOWHERE = PathError(0.0, 0.0, 0.0)
"""The error of a mode without a path."""


def lateral_bank(
    state: GuidanceState,
    pose: Mapping[str, float],
    speed: float,
    route: Route | None,
    params: GuidanceParams,
) -> tuple[float, PathError, float]:
    """Compute the bank of the lateral mode, rad, and the error from its path.

    Also returns the distance to the end of the leg, m.
    """
    if state.mode is not GuidanceMode.ENGAGED:
        return 0.0, NOWHERE, 0.0
    if state.lateral is Lateral.PHI:
        return state.target.phi, NOWHERE, 0.0
    if state.lateral in {Lateral.HEADING, Lateral.COURSE}:
        motion = (state.target.course, *course_and_speed(pose))
        if state.lateral is Lateral.HEADING:
            motion = (state.target.heading, state.psi, speed)
        angle = path_angle(pose["climb"], speed)
        return bank_for(course_acceleration(*motion, params.k_chi), angle, STEEPEST), NOWHERE, 0.0
    if state.lateral is Lateral.ROUTE and route is not None:
        if state.joining is not Side.NONE:
            return _onto_leg(state, pose, speed, route, params)
        return _along_leg(state, pose, speed, route, params)
    target = state.target
    orbit = _wide_enough(Arc((target.north, target.east), target.radius), params)
    position = (pose["north"], pose["east"])
    error = path.error(orbit, position)
    is_entered: Callable[[Point], Any] = partial(path.is_entered, orbit, None)
    bank = follow(error, error.curvature, is_entered, state.slip, pose, speed, params)
    return bank, error, path.to_go(orbit, position)


def _wide_enough(orbit: Arc, params: GuidanceParams) -> Arc:
    """Widen an orbit to the least radius at which the aircraft can fly it now.

    The least radius grows if the largest bank falls in flight.
    """
    return orbit._replace(
        radius=math.copysign(max(abs(orbit.radius), params.limits.radius), orbit.radius)
    )


def _onto_leg(
    state: GuidanceState,
    pose: Mapping[str, float],
    speed: float,
    route: Route,
    params: GuidanceParams,
) -> tuple[float, PathError, float]:
    """Compute the results of `lateral_bank` on the joining circle, which leads onto a leg."""
    position = (pose["north"], pose["east"])
    course_over_ground, _ = course_and_speed(pose)
    start, course = route.start(state.leg, state.target.along)
    radius = state.joining * route.radius
    error = path.circle_error(path.joining_centre(start, course, radius), radius, position)

    def joined(place: Point) -> Any:
        return path.is_joined(start, course, route.near(state.leg), place, course_over_ground)

    entry = path.error(route.legs[state.leg], start).curvature
    bank = follow(error, entry, joined, state.slip, pose, speed, params)
    return bank, error, path.joining_length(start, course, radius, position, course_over_ground)


def _along_leg(
    state: GuidanceState,
    pose: Mapping[str, float],
    speed: float,
    route: Route,
    params: GuidanceParams,
) -> tuple[float, PathError, float]:
    """Compute the results of `lateral_bank` on a leg of the route."""
    position = (pose["north"], pose["east"])
    leg = route.legs[state.leg]
    if isinstance(leg, Arc) and leg.end is None:
        leg = _wide_enough(leg, params)
    error = path.error(leg, position)
    following = None if leg.end is None else route.legs[state.leg + 1]
    entry = error.curvature
    if following is not None and leg.end is not None:
        entry = path.error(following, leg.end).curvature
    is_entered: Callable[[Point], Any] = partial(path.is_entered, leg, following)
    if following is not None and path.is_orbit(leg) and has_loitered(state, pose, route):
        near = route.near(state.leg)
        late = is_at_exit(leg, near, pose, position) and not is_at_exit(
            leg, EXIT * course_and_speed(pose)[1], pose, position
        )
        if not late:
            is_entered = partial(is_at_exit, leg, near, pose)
    bank = follow(error, entry, is_entered, state.slip, pose, speed, params)
    return bank, error, path.to_go(leg, position)


def follow(
    error: PathError,
    entry: Scalar,
    is_entered: Callable[[Point], Any],
    slip: Scalar,
    pose: Mapping[str, Scalar],
    speed: Scalar,
    params: GuidanceParams,
) -> Scalar:
    """Compute the bank that follows a path, rad, before protection.

    `entry` is the curvature of the next leg at its start, 1/m. Because the bank lags its command,
    this curvature must replace the curvature of the present leg before the aircraft reaches the
    next leg. It does so as soon as `is_entered` is true for the position that the aircraft will
    have after the mean lag. For a change d of the bank, the mean lag is the sum of three times:
    abs(d) / (2 p_max) for the ramp of the bank, 1 / (2 k_phi) for the loop of the bank, and
    `turn_lag` for the turn behind the bank.
    """
    course, ground_speed = course_and_speed(pose)
    xp = array_namespace(ground_speed)
    change = xp.atan(ground_speed**2 * entry / GRAVITY) + xp.atan(
        ground_speed**2 * -error.curvature / GRAVITY
    )
    attitude = params.attitude
    lag = abs(change) / (2.0 * attitude.roll_rate) + 0.5 / attitude.k_phi + params.turn_lag
    position_ahead = (pose["north"] + lag * pose["v_north"], pose["east"] + lag * pose["v_east"])
    error = error._replace(curvature=xp.where(is_entered(position_ahead), entry, error.curvature))
    acceleration = path_acceleration(error, course, ground_speed, params.path) + slip
    return bank_for(acceleration, path_angle(pose["climb"], speed), STEEPEST)


def escaping_bank(
    escape: Escape,
    bank: Scalar,
    pose: Mapping[str, Scalar],
    speed: Scalar,
    params: GuidanceParams,
) -> Scalar:
    """Compute the bank that the action of the fence needs, rad.

    In a turn it is the bank of the turn, and on the way home the bank that holds the course. If the
    fence does not act, the result is `bank`, the bank of the lateral mode.
    """
    course, ground_speed = course_and_speed(pose)
    xp = array_namespace(ground_speed)
    acceleration = params.k_chi * ground_speed * turn_towards(escape.course - course)
    towards = bank_for(acceleration, path_angle(pose["climb"], speed), STEEPEST)
    bank = xp.where(escape.action >= FenceAction.BACK, towards, bank)
    turns = abs(escape.action) == FenceAction.RIGHT
    return xp.where(turns, escape.action * params.limits.bank, bank)
