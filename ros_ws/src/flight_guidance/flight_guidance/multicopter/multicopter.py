# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Step the guidance of a multicopter from a place to body rates.

From the place follows a velocity, from the velocity an acceleration, from the acceleration a
direction of the thrust, and from this direction the body rates. The heading is separate, because no
lateral mode needs the nose to point anywhere. As in `modes.step`, a step has no clock and no hidden
state.
"""

import cmath
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from flight_core.channels import POSE, VERTICAL, vertical
from flight_core.kinematics import clip, euler_rates, heading_rate, thrust_axis, tilt
from flight_core.rates import seconds
from flight_core.units import GRAVITY
from flight_guidance.fence.fence import (
    MARGIN,
    Escape,
    Fence,
    FenceAction,
    clearance,
)
from flight_guidance.fence.ways import line_clearance, ways
from flight_guidance.guidance_state import (
    LARGEST,
    Begin,
    GuidanceMode,
    GuidanceParams,
    GuidanceState,
    Inputs,
    Lateral,
    MulticopterParams,
    StepCommands,
    Target,
    Vertical,
    begun_again,
)
from flight_guidance.modes.legs import has_loitered, on_leg, with_commands
from flight_guidance.modes.targets import home
from flight_guidance.steering import path
from flight_guidance.steering.lateral import PathError
from flight_guidance.steering.path import Arc, Point, Route, Side
from flight_guidance.steering.vertical import VerticalParams, climb_for, slewed

NEAR = 0.5
"""A place counts as reached within this many seconds of flight; at low speed within 0.5 m."""

ACROSS = math.sin(math.radians(60.0))
"""Largest fraction of the speed towards a path, as in the guidance of airplanes."""

WIND_TIME = 3.0
"""T, time constant of the estimated wind, s: longer than the end of a leg, shorter than a leg."""

LONGEST_LEAD = 0.5
"""Longest time over which the attitude of a pose is brought forward to the present, s."""


class MotionCommand(NamedTuple):
    """The motion that a lateral mode commands. Complex numbers are vectors, north + i east."""

    velocity: complex = 0.0  # m/s, over ground
    ahead: complex = 0.0  # m/s, velocity at the time when the tilt will have followed
    acceleration: complex = 0.0  # m/s^2, acceleration of the path itself
    error: PathError = PathError(0.0, 0.0, 0.0)
    to_go: float = 0.0  # m, distance to the place or to the end of the leg


def _gains(params: GuidanceParams) -> MulticopterParams:
    assert params.multicopter is not None  # noqa: S101 - `guidance.step` has checked it
    return params.multicopter


def hold(
    pose: Mapping[str, float], _y: tuple[float, ...], params: GuidanceParams
) -> dict[str, float]:
    """Return commands to hover at the place where the aircraft can stop.

    Heading and altitude stay at their present values.
    """
    stop = _stop(pose, _gains(params))
    place = {"north": stop.real, "east": stop.imag}
    return place | {"heading": pose["psi"], "altitude": pose["altitude"]}


def _velocity(pose: Mapping[str, float]) -> complex:
    return complex(pose["v_north"], pose["v_east"])


def _place(pose: Mapping[str, float]) -> complex:
    return complex(pose["north"], pose["east"])


def _parts(vector: complex) -> tuple[float, float]:
    return vector.real, vector.imag


def _stop(pose: Mapping[str, float], gains: MulticopterParams) -> complex:
    """Return the place where the aircraft can stop, north + i east, m.

    This place lies ahead by lead v + v abs(v) / (2 braking), where v is the velocity.
    """
    v = _velocity(pose)
    return _place(pose) + (gains.lead + abs(v) / (2.0 * gains.braking)) * v


def step(
    state: GuidanceState | None, inputs: Inputs, route: Route | None, params: GuidanceParams
) -> tuple[GuidanceState, StepCommands]:
    """Take a step: attitude, commands, u_m.

        v_c = towards the place or the path, within V
        a_c = a_ff + k_v (v_c - v) + d (v_ff - W),  within l tan(bank),  l = g + d climb
        [p, q] = k_tilt (angle from the thrust to [a_c, l]),  r = k_psi (heading - psi)

    The attitude comes from the pose, and p, q, r of y carry it forward to the present. While the
    pose is stale, the thrust is vertical. After `hold` the rates are 0 until the pose returns. When
    a leg ends, the next leg's commands apply, and then the given commands. The fence acts on the
    place where the aircraft can stop. If this place is not inside, the aircraft flies home. The
    wind W follows by `_with_wind`, since an unexplained deceleration is drag in a wind. The climb
    rate follows from the altitude, as for an airplane. a_ff and v_ff are the acceleration and the
    velocity of the path at the time `lead` from now, because the tilt follows its command with this
    delay.
    """
    gains = _gains(params)
    pose = dict(zip(POSE, inputs.pose, strict=True))
    state = _begin(state, inputs, pose, params)
    dt = seconds(inputs.t_ns - state.t_ns)
    state = _with_attitude(state, inputs, pose, dt, params)
    state, miss = with_commands(
        state,
        inputs.commands,
        pose,
        route,
        params.channels,
        lambda state, route: _along_route(state, pose, dt, route),
        # The aircraft flies straight to the leg. A side, whichever it is, shows that it is on the
        # way.
        lambda state, leg, _, route: on_leg(state, leg, route)._replace(joining=Side.RIGHT),
    )
    state = _with_wind(state, pose, dt, params)
    state, escape = _within_fence(state, pose, params)
    # Speed, tilt and climb follow from the motion that the mode commands.
    flies = state.mode is GuidanceMode.ENGAGED
    speed = min(max(state.target.V, 0.0), params.limits.largest_speed)
    state = state._replace(V_c=slewed(state.V_c, speed, gains.braking, dt))
    motion = _wanted(state, pose, route, escape, params)
    if flies and state.lateral is not Lateral.PHI:
        state = state._replace(V_c=min(state.V_c, abs(motion.velocity)))
    phi_c, theta_c, limited = _attitude_for(state, pose, motion, params)
    state, is_climb_limited = _with_climb(state, pose, dt, params)
    # u_m has the body rates and the climb, within the rates of the reference model.
    rates = _rates(state, phi_c, theta_c, gains)
    name = vertical(params.outputs)
    values = rates | {name: VERTICAL[name] * state.climb_c}
    u_m = tuple(
        slewed(before, values[channel], rate, dt)
        for channel, before, rate in zip(params.outputs, state.u_m, params.slew, strict=True)
    )
    commands = StepCommands(
        phi_c=phi_c,
        theta_c=theta_c,
        xtrack=motion.error.e,
        to_go=motion.to_go,
        track=motion.error.track,
        missed=miss,
        clearance=escape.clearance,
        predicted=escape.predicted,
        is_bank_limited=limited,
        is_theta_limited=limited,
        is_climb_limited=is_climb_limited,
        is_V_limited=flies and speed != state.target.V,
        is_slew_limited=any(
            values[channel] != value for channel, value in zip(params.outputs, u_m, strict=True)
        ),
    )
    return state._replace(t_ns=inputs.t_ns, u_m=u_m), commands


def _begin(
    state: GuidanceState | None,
    inputs: Inputs,
    pose: Mapping[str, float],
    params: GuidanceParams,
) -> GuidanceState:
    """Return the state before a step.

    If the filters start again, the aircraft hovers at the place where it can stop.
    """
    if state is not None and inputs.begin is Begin.NO:
        return state
    gains = _gains(params)
    hover = GuidanceState(
        t_ns=inputs.t_ns - params.period_ns,
        mode=GuidanceMode.ENGAGED,
        lateral=Lateral.PLACE,
        vertical=Vertical.ALTITUDE,
        target=Target(V=params.speed)._replace(**hold(pose, inputs.y, params)),
        leg=0,
        phi=pose["phi"],
        theta=pose["theta"],
        alpha=0.0,
        alpha_trim=0.0,
        slip=0.0,
        climb_c=pose["climb"],
        V_c=abs(_velocity(pose)),
        u_m=(0.0,) * len(params.outputs),
        psi=pose["psi"],
        wind=_parts(_velocity(pose) - _by_tilt(pose, pose, gains) / gains.drag),
        velocity=_parts(_velocity(pose)),
    )
    return begun_again(hover, state, inputs, params, "wind")


def _with_attitude(
    state: GuidanceState,
    inputs: Inputs,
    pose: Mapping[str, float],
    dt: float,
    params: GuidanceParams,
) -> GuidanceState:
    """Return the state with its mode and attitude from the pose, or by dead reckoning.

    When the pose returns after a loss, the aircraft hovers or flies home.
    """
    age_ns = inputs.pose_age_ns
    since = dt
    if age_ns <= params.max_age_ns:
        if state.mode is GuidanceMode.POSE_LOST:
            state = _begin(None, inputs, pose, params)
            if params.home.after_loss:
                state = state._replace(target=state.target._replace(**home(pose, params)))
        state = state._replace(
            mode=GuidanceMode.ENGAGED, phi=pose["phi"], theta=pose["theta"], psi=pose["psi"]
        )
        since = min(seconds(age_ns), LONGEST_LEAD)
    else:
        is_lost = age_ns > params.max_age_ns + params.hold_ns
        state = state._replace(
            mode=GuidanceMode.POSE_LOST if is_lost else GuidanceMode.DEAD_RECKONING
        )
    p, q, r = (inputs.y[params.outputs.index(name)] for name in ("p", "q", "r"))
    phi_dot, theta_dot = euler_rates(state.phi, state.theta, p, q, r)
    psi = state.psi + since * heading_rate(state.phi, state.theta, q, r)
    return state._replace(
        phi=math.remainder(state.phi + since * phi_dot, 2.0 * math.pi),
        theta=state.theta + since * theta_dot,
        psi=math.remainder(psi, 2.0 * math.pi),
    )


def _is_near(state: GuidanceState, pose: Mapping[str, float], place: Point) -> bool:
    return abs(complex(*place) - _place(pose)) <= NEAR * max(float(state.target.V), 1.0)


def _is_stop(route: Route, number: int) -> bool:
    """Return whether an aircraft stops at the end of a leg.

    It stops if the next leg is a hover, or if the corner has no fillet.
    """
    following = next(iter(route.legs[number + 1 :]), None)
    hovers = following is not None and path.is_orbit(following)
    return hovers or bool(path.is_too_sharp(route.legs[number], following))


def _along_route(
    state: GuidanceState, pose: Mapping[str, float], dt: float, route: Route
) -> tuple[GuidanceState, float]:
    """Put the state on the leg once its start is reached, and on the next leg at its end.

    A leg is over when the aircraft has passed its end. If the aircraft waits at the end, the leg is
    over after the wait. Also returns the distance by which the end of the leg was missed, m, or 0.
    """
    position = (pose["north"], pose["east"])
    leg = route.legs[state.leg]
    if state.joining is not Side.NONE:
        start, _ = route.start(state.leg, state.target.along)
        joins = path.is_orbit(leg) or _is_near(state, pose, start)
        return (on_leg(state, state.leg, route) if joins else state), 0.0
    if leg.end is None:
        return state, 0.0
    if isinstance(leg, Arc) and leg.loiter is not None:
        if state.loitered > 0.0 or _is_near(state, pose, leg.centre):
            share = dt / leg.loiter.wait
            state = state._replace(loitered=min(state.loitered + share, 1.0))
        ends = has_loitered(state, pose, route)
        return on_leg(state, state.leg + 1, route) if ends else state, 0.0
    stopped = _is_stop(route, state.leg) and _is_near(state, pose, leg.end)
    if not stopped and not path.is_passed(leg, position):
        return state, 0.0
    distance = math.dist(leg.end, position)
    miss = distance if distance > route.near(state.leg) else 0.0
    return on_leg(state, state.leg + 1, route), miss


def _within_fence(
    state: GuidanceState, pose: Mapping[str, float], params: GuidanceParams
) -> tuple[GuidanceState, Escape]:
    """Return the state under the action of the fence; when the action begins, home is the target.

    The action begins when the way to the place where the aircraft can stop comes too near to the
    fence. Too near is the distance flown in the time MARGIN at the present speed, or at 1 m/s if
    the aircraft is slower.
    """
    fence = params.fence
    if fence is None or state.mode is not GuidanceMode.ENGAGED:
        return state, Escape(
            action=state.fence, begins=False, clearance=LARGEST, predicted=LARGEST, course=0.0
        )
    position = (np.float64(pose["north"]), np.float64(pose["east"]))
    margin = MARGIN * max(abs(_velocity(pose)), 1.0)
    now = float(clearance(fence.zones, *position))
    stop_clearance = float(line_clearance(fence, *position, *_parts(_stop(pose, _gains(params)))))
    action = _action(fence, position, now)
    begins = state.fence is FenceAction.NONE and stop_clearance < margin
    if begins:
        target = state.target._replace(**home(pose, params))
        state = state._replace(
            lateral=Lateral.PLACE, vertical=Vertical.ALTITUDE, target=target, joining=Side.NONE
        )
    is_acting = begins or state.fence is not FenceAction.NONE
    action_in_force = action if is_acting else FenceAction.NONE
    return state._replace(fence=action_in_force), Escape(
        action=action_in_force, begins=begins, clearance=now, predicted=stop_clearance, course=0.0
    )


def _action(fence: Fence, position: tuple[Any, Any], now: float) -> FenceAction:
    """Choose the action of the fence: home straight, home around a zone, or back inside."""
    if now < 0.0:
        return FenceAction.BACK
    is_straight = bool(ways(fence).aim(fence, *position)[2])
    return FenceAction.HOME if is_straight else FenceAction.AROUND


def _wanted(
    state: GuidanceState,
    pose: Mapping[str, float],
    route: Route | None,
    escape: Escape,
    params: GuidanceParams,
) -> MotionCommand:
    """Return the motion that the lateral mode commands, or the motion that keeps off a fence."""
    gains = _gains(params)
    target = state.target
    place = (target.north, target.east)
    if state.mode is not GuidanceMode.ENGAGED or state.lateral is Lateral.PHI:
        return MotionCommand()
    if escape.action in {FenceAction.AROUND, FenceAction.BACK} and params.fence is not None:
        position = (np.float64(pose["north"]), np.float64(pose["east"]))
        north, east, _ = ways(params.fence).aim(params.fence, *position)
        place = (float(north), float(east))
    elif state.lateral is Lateral.COURSE:
        velocity = cmath.rect(state.V_c, target.course)
        return MotionCommand(velocity, velocity, error=PathError(0.0, target.course, 0.0))
    elif state.lateral is Lateral.ROUTE and route is not None:
        leg = route.legs[state.leg]
        if state.joining is Side.NONE and not path.is_orbit(leg):
            return _on_path(state, pose, route, gains)
        place = route.start(state.leg, target.along)[0]
    return _to_place(complex(*place), state, pose, gains)


def _approach(distance: float, speed: float, gains: MulticopterParams) -> tuple[float, float]:
    """Return the speed towards a place at a distance, m/s, and its slope over distance, 1/s.

    `climb_for` gives the speed, with the gain `k_p` and the deceleration `braking`.
    """
    params = VerticalParams(
        k_h=gains.k_p, acceleration=2.0 * gains.braking, climb=speed, sink=speed, alpha_time=0.0
    )
    allowed = float(climb_for(distance, params))
    slope = min(gains.k_p, gains.braking / max(allowed, 1e-6))
    return allowed, 0.0 if allowed >= speed else slope


def _to_place(
    place: complex, state: GuidanceState, pose: Mapping[str, float], gains: MulticopterParams
) -> MotionCommand:
    """Return the motion towards a place, with the deceleration on the way."""
    distance, course = cmath.polar(place - _place(pose))
    speed, slope = _approach(distance, state.V_c, gains)
    velocity = cmath.rect(speed, course)
    closing = (_velocity(pose) * cmath.rect(1.0, -course)).real
    brake = cmath.rect(-slope * closing, course)
    return MotionCommand(
        velocity=velocity,
        ahead=velocity,
        acceleration=brake,
        error=PathError(distance, course, 0.0),
        to_go=distance,
    )


def _on_path(
    state: GuidanceState, pose: Mapping[str, float], route: Route, gains: MulticopterParams
) -> MotionCommand:
    """Return the motion along a line or a fillet of the route."""
    leg = route.legs[state.leg]
    position = (pose["north"], pose["east"])
    error = path.error(leg, position)
    to_go = path.to_go(leg, position)
    speed = state.V_c
    slope = 0.0
    if _is_stop(route, state.leg):
        speed, slope = _approach(max(to_go, 0.0), speed, gains)
    across = -clip(gains.k_p * error.e, ACROSS * speed)
    # complex numbers have the direction along the path + i to the right
    velocity = complex(math.sqrt(speed**2 - across**2), across)
    later = _parts(_place(pose) + gains.lead * _velocity(pose))
    entered_leg = leg
    if path.is_passed(leg, later) and not _is_stop(route, state.leg):
        entered_leg = route.legs[state.leg + 1]
    error_later = path.error(entered_leg, later)
    track = cmath.rect(1.0, error_later.track)
    bend = complex(-slope * speed, speed**2 * error_later.curvature)
    now = velocity * cmath.rect(1.0, error.track)
    return MotionCommand(
        velocity=now, ahead=velocity * track, acceleration=bend * track, error=error, to_go=to_go
    )


def _by_tilt(
    attitude: Mapping[str, float], pose: Mapping[str, float], gains: MulticopterParams
) -> complex:
    """Compute the horizontal acceleration that the tilt in a pose causes, m/s^2, north + i east.

    Its magnitude is (g + drag climb) tan(tilt).
    """
    angles = (tilt(attitude["phi"]), tilt(attitude["theta"]), attitude["psi"])
    north, east, up = thrust_axis(*angles)
    return _lift(pose, gains) / up * complex(north, east)


def _with_wind(
    state: GuidanceState, pose: Mapping[str, float], dt: float, params: GuidanceParams
) -> GuidanceState:
    """Return the state with the estimate of the wind a step later, m/s.

        W' = (v' - (g + d climb) tan(tilt) + d (v - W)) / (d T)

    d is the drag, and T the time constant of the estimate. This is a low-pass of the wind that
    explains the acceleration of the pose. The tilt is taken from the pose, so commands that are not
    flown have no effect on the estimate. W stays within the wind in which the largest tilt can
    still hover.
    """
    gains = _gains(params)
    v = _velocity(pose)
    if state.mode is not GuidanceMode.ENGAGED:
        return state._replace(velocity=_parts(v))
    wind = complex(*state.wind)
    attitude = {"phi": state.phi, "theta": state.theta, "psi": state.psi}
    unexplained = gains.drag * (v - wind) - _by_tilt(attitude, pose, gains)
    wind += (v - complex(*state.velocity) + dt * unexplained) / (gains.drag * WIND_TIME)
    limit = GRAVITY * math.tan(params.limits.bank) / gains.drag
    return state._replace(wind=_parts(_within(wind, limit)), velocity=_parts(v))


def _within(vector: complex, largest: float) -> complex:
    return vector * min(1.0, largest / max(abs(vector), 1e-6))


def _lift(pose: Mapping[str, float], gains: MulticopterParams) -> float:
    """Return the vertical thrust in steady flight, g + drag climb, m/s^2, at least half of g."""
    return max(GRAVITY + gains.drag * pose["climb"], GRAVITY / 2.0)


def _attitude_for(
    state: GuidanceState, pose: Mapping[str, float], motion: MotionCommand, params: GuidanceParams
) -> tuple[float, float, bool]:
    """Return bank and pitch for the commanded acceleration, rad, and whether a limit applies."""
    gains = _gains(params)
    largest = params.limits.bank
    if state.mode is not GuidanceMode.ENGAGED:
        return 0.0, 0.0, False
    if state.lateral is Lateral.PHI:
        commanded_tilt = complex(state.target.phi, state.target.theta)
        angles = _within(commanded_tilt, largest)
        return angles.real, angles.imag, angles != commanded_tilt
    acceleration = (
        motion.acceleration
        + gains.k_v * (motion.velocity - _velocity(pose))
        + gains.drag * (motion.ahead - complex(*state.wind))
    )
    lift = _lift(pose, gains)
    level = _within(acceleration, lift * math.tan(largest))
    forward, right = _parts(level * cmath.rect(1.0, -state.psi))
    return (
        math.atan2(right, math.hypot(forward, lift)),
        math.atan2(-forward, lift),
        level != acceleration,
    )


def _with_climb(
    state: GuidanceState, pose: Mapping[str, float], dt: float, params: GuidanceParams
) -> tuple[GuidanceState, bool]:
    """Set the commanded climb rate.

    The second result says whether the altitude limits reduce it.
    """
    vertical_params = params.vertical
    climb = 0.0
    bounded_climb = 0.0
    if state.mode is GuidanceMode.ENGAGED:
        climb = state.target.climb
        if state.vertical is not Vertical.CLIMB:
            profile = climb if state.vertical is Vertical.PROFILE else 0.0
            climb = profile + climb_for(state.target.altitude - pose["altitude"], vertical_params)
        least = climb_for(params.limits.lowest - pose["altitude"], vertical_params)
        most = climb_for(params.limits.highest - pose["altitude"], vertical_params)
        bounded_climb = float(min(max(climb, least), most))
    climb_c = slewed(state.climb_c, bounded_climb, vertical_params.acceleration, dt)
    return state._replace(climb_c=float(climb_c)), bool(bounded_climb != climb)


def _rates(
    state: GuidanceState, phi_c: float, theta_c: float, gains: MulticopterParams
) -> dict[str, float]:
    """Compute the body rates that turn the thrust to its direction by the shortest way, rad/s.

    r turns the heading at the commanded rate, by the inverse of `kinematics.heading_rate`.

        [p, q] = k_tilt angle [d_y, -d_x] / sqrt(d_x^2 + d_y^2),  angle = atan2(sqrt(..), -d_z)

    Here d is the direction [phi_c, theta_c] in body axes. This is the reduced quaternion error,
    which has no singularity short of a thrust downwards. Source: D. Brescianini, R. D'Andrea,
    Tilt-prioritized quadrocopter attitude control, IEEE Trans. Control Systems Technology 28
    (2020).
    """
    if state.mode is GuidanceMode.POSE_LOST:
        return dict.fromkeys("pqr", 0.0)
    x = -math.cos(phi_c) * math.sin(theta_c)
    z = -math.cos(phi_c) * math.cos(theta_c)
    forward = math.cos(state.theta) * x - math.sin(state.theta) * z
    down = math.sin(state.theta) * x + math.cos(state.theta) * z
    right = math.cos(state.phi) * math.sin(phi_c) + math.sin(state.phi) * down
    down = math.cos(state.phi) * down - math.sin(state.phi) * math.sin(phi_c)
    sine = math.hypot(forward, right)
    rate = min(gains.k_tilt * math.atan2(sine, -down), gains.tilt_rate) / max(sine, 1e-9)
    q = -rate * forward
    turn = 0.0
    if state.mode is GuidanceMode.ENGAGED:
        turn = gains.k_psi * math.remainder(state.target.heading - state.psi, 2.0 * math.pi)
    phi = tilt(state.phi)
    r = (clip(turn, gains.yaw_rate) * math.cos(state.theta) - q * math.sin(phi)) / math.cos(phi)
    return {"p": rate * right, "q": q, "r": float(r)}
