# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Step the guidance of an airplane from pose, y and target to u_m.

Laterally, the modes hold a bank, a heading or a course, or follow an orbit or a route. Vertically,
they hold a pitch, a climb rate or an altitude. The law holds the airspeed, and guidance limits its
command. A step has no clock and no hidden state. Its state is in the log, so you can compute a row
of the log again from the previous row.
"""

import math
from collections.abc import Mapping
from functools import reduce
from operator import or_
from typing import Any

from flight_core.channels import POSE
from flight_core.kinematics import clip, euler_rates, heading_rate, tilt, turn_rate
from flight_core.rates import seconds
from flight_core.units import GRAVITY
from flight_core.vectors import Scalar, array_namespace
from flight_guidance.fence.fence import Escape, FenceAction, Motion, last_safe_turn
from flight_guidance.guidance_state import (
    LARGEST,
    Begin,
    GuidanceMode,
    GuidanceParams,
    GuidanceState,
    Inputs,
    Lateral,
    StepCommands,
    Target,
    Vertical,
    begun_again,
)
from flight_guidance.modes.lateral_modes import escaping_bank, lateral_bank
from flight_guidance.modes.legs import along_route, joining_state, with_commands
from flight_guidance.modes.targets import hold, home, permitted_speed, within_reach
from flight_guidance.steering import protection
from flight_guidance.steering.attitude import BodyRates, body_rates, load_slope, yaw_for_bank
from flight_guidance.steering.lateral import heading_estimate, slip_estimate
from flight_guidance.steering.path import Route, Side
from flight_guidance.steering.vertical import (
    airspeed_increase_for,
    alpha_estimate,
    climb_for,
    path_angle,
    pitch_for,
    slewed,
)
from flight_guidance.steering.wind import Wind, wind_estimate, wind_of

LONGEST_LEAD = 0.5
"""Longest time over which the attitude of a pose is brought forward to the present, s: the rates
change within a second."""


def holding(
    t_ns: int, pose: Mapping[str, Scalar], speed: Scalar, params: GuidanceParams
) -> GuidanceState:
    """Return the state before the first step, at the instant t_ns.

    It holds the present heading, altitude and airspeed.
    """
    alpha = pose["theta"] - path_angle(pose["climb"], speed)
    return GuidanceState(
        t_ns=t_ns - params.period_ns,
        mode=GuidanceMode.ENGAGED,
        lateral=Lateral.HEADING,
        vertical=Vertical.ALTITUDE,
        target=Target()._replace(**hold(pose, speed, params)),
        leg=0,
        phi=pose["phi"],
        theta=pose["theta"],
        alpha=alpha,
        alpha_trim=array_namespace(alpha).maximum(alpha, 0.0),
        slip=0.0 * speed,
        climb_c=pose["climb"],
        V_c=speed,
        u_m=(0.0,) * len(params.outputs),
        wind=_measured_wind(pose, speed),
        psi=pose["psi"],
    )


def begin(state: GuidanceState | None, inputs: Inputs, params: GuidanceParams) -> GuidanceState:
    """Return the state before a step, at the measured values if the filters start again."""
    if state is not None and inputs.begin is Begin.NO:
        return state
    holding_state = holding(
        inputs.t_ns, dict(zip(POSE, inputs.pose, strict=True)), airspeed(inputs.y, params), params
    )
    return begun_again(holding_state, state, inputs, params)


def hold_now(
    pose: Mapping[str, float], y: tuple[float, ...], params: GuidanceParams
) -> dict[str, float]:
    """Return the commands to hold the heading, altitude and airspeed of a pose and a y."""
    return hold(pose, airspeed(y, params), params)


def airspeed(y: tuple[float, ...], params: GuidanceParams) -> float:
    """Return the true airspeed V0 + V, m/s, at least half of V0."""
    return float(true_airspeed(y[params.outputs.index("V")], params))


def true_airspeed(V: Scalar, params: GuidanceParams) -> Scalar:
    """Compute the `airspeed` from the channel V of y, m/s."""
    return array_namespace(V).maximum(params.speed + V, params.speed / 2.0)


def yaw_rate(y: Mapping[str, Scalar], phi: Scalar, theta: Scalar, speed: Scalar) -> Scalar:
    """Return the measured r, rad/s, or without a rudder the yaw rate of a coordinated turn."""
    return y["r"] if "r" in y else turn_rate(phi, theta, 0.0, speed)


def step(
    state: GuidanceState | None, inputs: Inputs, route: Route | None, params: GuidanceParams
) -> tuple[GuidanceState, StepCommands]:
    """Take a step: attitude, commands, u_m.

    1. Euler's kinematics with p, q, r of y carry phi and theta of the pose forward over its age.
    psi follows by `heading_estimate`. While the pose is stale, only Euler's kinematics act
    (`GuidanceMode.DEAD_RECKONING`). If the pose stays stale for longer than `hold_ns`, the attitude
    is unknown (`GuidanceMode.POSE_LOST`) until the pose returns. Then the wings are levelled at the
    present altitude, or the aircraft flies home if `home.after_loss` is set. 2. When a leg ends,
    the commands of the next leg apply, and then the given commands. Unless it is near, the aircraft
    joins a leg by a circle that touches the leg at its start. If the aircraft passes the end of a
    leg far away, the leg is noted as missed. 3. The fence replaces the lateral mode by the last
    safe turn, and then by the way home. 4. Protection limits bank, airspeed, climb and pitch, in
    this order; `attitude.body_rates` limits roll rate and load; the slew of u_m is limited last. 5.
    u_m is p, q, r by `attitude.body_rates`, and V_m = V_c - V0. In POSE_LOST p, q, r are 0.
    """
    params = within_reach(params, inputs.authority)
    state = begin(state, inputs, params)
    dt = seconds(inputs.t_ns - state.t_ns)
    speed = airspeed(inputs.y, params)
    state = _with_attitude(state, inputs, dt, params)
    pose = dict(zip(POSE, inputs.pose, strict=True))
    y = dict(zip(params.outputs, inputs.y, strict=True))
    if params.channels.lateral.keys() & inputs.commands.keys():
        state = state._replace(target=state.target._replace(r=0.0))
    state, miss = with_commands(
        state,
        inputs.commands,
        pose,
        route,
        params.channels,
        lambda state, route: along_route(state, pose, dt, route),
        lambda state, leg, along, route: joining_state(state, leg, along, pose, route),
    )
    state, escape = _within_fence(state, pose, y, speed, params)
    bank, error, to_go = lateral_bank(state, pose, speed, route, params)
    if state.mode is GuidanceMode.ENGAGED:
        bank = escaping_bank(escape, bank, pose, speed, params)
    state, commands = command(state, pose, y, bank, dt, params)
    commands = commands._replace(xtrack=error.e, track=error.track, to_go=to_go, missed=miss)
    commands = commands._replace(clearance=escape.clearance, predicted=escape.predicted)
    velocity = (pose["v_north"], pose["v_east"])
    return state._replace(t_ns=inputs.t_ns, velocity=velocity), commands


def _wanted_rates(
    state: GuidanceState,
    pose: Mapping[str, Scalar],
    r: Scalar,
    phi_c: Scalar,
    theta_c: Scalar,
    speed: Scalar,
    params: GuidanceParams,
) -> BodyRates:
    """Compute the body rates that lead to the commanded attitude, rad/s.

    All are 0 after the loss of the pose. If the input of an output has no effect, the rate of this
    output is 0.
    """
    flies = state.mode is GuidanceMode.ENGAGED
    attitude = params.attitude._replace(n_alpha=load_slope(state.alpha_trim))
    beta = pose["beta"] if flies else 0.0
    flat = flies and state.lateral is Lateral.PHI and state.target.r != 0.0
    rates = body_rates(
        phi_c, theta_c, state.phi, state.theta, r, 0.0 if flat else beta, speed, attitude
    )
    # A commanded yaw rate without a bank is meant to cause sideslip, so beta is not fed back above.
    if flat:
        rates = rates._replace(r=rates.r + state.target.r)
    if state.mode is GuidanceMode.POSE_LOST:
        rates = BodyRates(0.0, 0.0, 0.0)
    rates = rates._replace(**dict.fromkeys(params.dead, 0.0))
    if not params.rolls:
        rates = rates._replace(r=yaw_for_bank(phi_c, state.phi, speed))
    return rates


def command(
    state: GuidanceState,
    pose: Mapping[str, Scalar],
    y: Mapping[str, Scalar],
    phi: Scalar,
    dt: float,
    params: GuidanceParams,
) -> tuple[GuidanceState, StepCommands]:
    """Apply protection, and compute u_m of `step`.

    `phi` is the bank of the lateral mode, rad. `t_ns` of the state stays as it is. The values may
    be arrays with an element for each aircraft of a fleet; then all aircraft have the same modes.
    """
    speed = true_airspeed(y["V"], params)
    limits = params.limits
    flies = state.mode is GuidanceMode.ENGAGED
    if flies:
        state = _with_estimates(state, pose, y, speed, dt, params)

    xp = array_namespace(speed)
    bank = protection.bank_limit(limits.bank, limits.stall_speed, speed)
    phi_c = clip(phi, bank)
    climb_c, is_climb_limited = _climb(state, pose, speed, dt, params) if flies else (0.0, False)
    theta_wanted = pitch_for(climb_c, speed, state.alpha)
    if flies and state.vertical is Vertical.THETA:
        theta_wanted = _pitch_within(state, pose["altitude"], speed, params)
        is_climb_limited = theta_wanted != state.target.theta
    theta_c = xp.minimum(xp.maximum(theta_wanted, limits.least_pitch), limits.largest_pitch)

    V_asked = state.target.V
    if flies and "q" in params.dead:
        V_asked = V_asked + airspeed_increase_for(climb_c - pose["climb"], speed)
    V_wanted = permitted_speed(V_asked, params)
    V_c = slewed(state.V_c, V_wanted, params.slew[params.outputs.index("V")], dt)

    r = yaw_rate(y, state.phi, state.theta, speed)
    rates = _wanted_rates(state, pose, r, phi_c, theta_c, speed, params)
    reference = {"V": V_c - params.speed, **rates._asdict()}
    u_m = tuple(
        reference[name] if name == "V" else slewed(before, reference[name], rate, dt)
        for name, before, rate in zip(params.outputs, state.u_m, params.slew, strict=True)
    )
    commands = StepCommands(
        phi_c,
        theta_c,
        is_bank_limited=(phi_c != phi) | (abs(phi_c) == bank),
        is_theta_limited=theta_c != theta_wanted,
        is_climb_limited=is_climb_limited,
        is_V_limited=V_wanted != state.target.V,
        is_slew_limited=reduce(
            or_, (value != reference[name] for name, value in zip(params.outputs, u_m, strict=True))
        ),
    )
    return state._replace(climb_c=climb_c, V_c=V_c, u_m=u_m), commands


def _with_estimates(
    state: GuidanceState,
    pose: Mapping[str, Scalar],
    y: Mapping[str, Scalar],
    speed: Scalar,
    dt: float,
    params: GuidanceParams,
) -> GuidanceState:
    """Return the state with new estimates of the angle of attack, the slip and the wind."""
    alpha = alpha_estimate(state.alpha, state.theta, pose["climb"], speed, dt, params.vertical)
    turn = GRAVITY * array_namespace(speed).tan(tilt(state.phi))
    r = yaw_rate(y, state.phi, state.theta, speed)
    turn_acceleration = speed * heading_rate(state.phi, state.theta, y["q"], r)
    rolling = abs(y["p"]) / params.attitude.roll_rate
    slip = slip_estimate(
        state.slip, turn, turn_acceleration, rolling, dt, params.vertical.alpha_time
    )
    return state._replace(
        alpha=alpha, slip=slip, wind=wind_estimate(state.wind, _measured_wind(pose, speed), dt)
    )


def _with_attitude(
    state: GuidanceState, inputs: Inputs, dt: float, params: GuidanceParams
) -> GuidanceState:
    """Return the state with its mode and attitude from the pose, or by dead reckoning."""
    pose = dict(zip(POSE, inputs.pose, strict=True))
    if inputs.pose_age_ns <= params.max_age_ns:
        # The aircraft may have flown anywhere while the pose was lost.
        if state.mode is GuidanceMode.POSE_LOST:
            if params.home.after_loss:
                after_loss = home(pose, params)
            else:
                after_loss = {"phi": 0.0, "altitude": pose["altitude"]}
            lateral = Lateral.ORBIT if params.home.after_loss else Lateral.PHI
            level = state._replace(
                lateral=lateral,
                vertical=Vertical.ALTITUDE,
                target=state.target._replace(**after_loss),
                fence=FenceAction.NONE,
            )
            state = begin(level, inputs._replace(begin=Begin.AGAIN), params)
        state = state._replace(mode=GuidanceMode.ENGAGED, phi=pose["phi"], theta=pose["theta"])
        since = min(seconds(inputs.pose_age_ns), LONGEST_LEAD)
    else:
        is_lost = inputs.pose_age_ns > params.max_age_ns + params.hold_ns
        state = state._replace(
            mode=GuidanceMode.POSE_LOST if is_lost else GuidanceMode.DEAD_RECKONING
        )
        since = dt
    y = dict(zip(params.outputs, inputs.y, strict=True))
    r = yaw_rate(y, state.phi, state.theta, airspeed(inputs.y, params))
    phi_dot, theta_dot = euler_rates(state.phi, state.theta, y["p"], y["q"], r)
    phi = state.phi + since * phi_dot
    theta = state.theta + since * theta_dot
    psi_dot = heading_rate(state.phi, state.theta, y["q"], r)
    heading = pose["psi"] + since * psi_dot if state.mode is GuidanceMode.ENGAGED else None
    psi = heading_estimate(state.psi, heading, psi_dot, dt)
    return state._replace(phi=math.remainder(phi, 2.0 * math.pi), theta=theta, psi=psi)


def motion_of(
    state: GuidanceState,
    pose: Mapping[str, Scalar],
    y: Mapping[str, Scalar],
    speed: Scalar,
    params: GuidanceParams,
) -> Motion:
    """Return the motion from which the fence predicts a turn.

    A roll that is under way continues for the lag of the bank, 1 / (2 k_phi).
    """
    bank = protection.bank_limit(params.limits.bank, params.limits.stall_speed, speed)
    lag = 0.5 / params.attitude.k_phi
    r = yaw_rate(y, state.phi, state.theta, speed)
    phi_dot, _ = euler_rates(state.phi, state.theta, y["p"], y["q"], r)
    return Motion(
        north=pose["north"],
        east=pose["east"],
        phi=clip(state.phi + lag * phi_dot, bank),
        heading=pose["psi"] + pose["beta"],
        speed=speed,
        wind=state.wind,
        bank=bank,
        roll_rate=params.attitude.roll_rate,
        lag=lag + params.turn_lag,
    )


def _within_fence(
    state: GuidanceState,
    pose: Mapping[str, float],
    y: Mapping[str, float],
    speed: float,
    params: GuidanceParams,
) -> tuple[GuidanceState, Escape]:
    """Return the state under the action of the fence; when the action begins, home is the target.

    A lateral command that comes during a turn is flown after the turn, unless the aircraft is
    outside.
    """
    if params.fence is None or state.mode is not GuidanceMode.ENGAGED:
        return state, Escape(
            action=state.fence, begins=False, clearance=LARGEST, predicted=LARGEST, course=0.0
        )
    found = last_safe_turn(params.fence, state.fence, motion_of(state, pose, y, speed, params))
    escape = Escape(
        action=FenceAction(int(found.action)),
        begins=bool(found.begins),
        clearance=float(found.clearance),
        predicted=float(found.predicted),
        course=float(found.course),
    )
    # A lateral command came after the turn began if home is not the target any more.
    has_other_target = (
        state.lateral is not Lateral.ORBIT
        or (state.target.north, state.target.east) != params.home[:2]
    )
    if has_other_target and escape.action in {FenceAction.HOME, FenceAction.AROUND}:
        escape = escape._replace(action=FenceAction.NONE)
    elif escape.begins or (has_other_target and escape.action is FenceAction.BACK):
        target = state.target._replace(**home(pose, params))
        state = state._replace(
            lateral=Lateral.ORBIT, vertical=Vertical.ALTITUDE, target=target, joining=Side.NONE
        )
    return state._replace(fence=escape.action), escape


def _measured_wind(pose: Mapping[str, Scalar], speed: Scalar) -> Wind:
    return wind_of(
        pose["v_north"], pose["v_east"], pose["climb"], pose["psi"] + pose["beta"], speed
    )


def _climb(
    state: GuidanceState,
    pose: Mapping[str, Scalar],
    speed: Scalar,
    dt: float,
    params: GuidanceParams,
) -> tuple[Scalar, Any]:
    """Return the commanded climb rate, m/s, and whether protection limits it."""
    if state.vertical is Vertical.THETA:
        # In the mode THETA this is only the start value for a later mode CLIMB or ALTITUDE.
        return pose["climb"], False
    vertical = params.vertical
    target = state.target
    if state.vertical is Vertical.CLIMB:
        climb = target.climb
    else:
        climb = climb_for(target.altitude - pose["altitude"], vertical)
    if state.vertical is Vertical.PROFILE:
        climb = climb + target.climb
    least, largest = protection.climb_range(
        vertical.climb, vertical.sink, state.V_c - speed, params.speed
    )
    xp = array_namespace(speed)
    lower, upper = _climb_within(pose["altitude"], params)
    least = xp.maximum(least, lower)
    largest = xp.minimum(largest, upper)
    fast = protection.sink_limit(vertical.climb, vertical.sink, speed, params.limits.largest_speed)
    least = xp.maximum(least, fast)
    largest = xp.minimum(
        largest, protection.climb_limit(vertical.climb, vertical.sink, speed, params.limits.floor)
    )
    bounded_climb = xp.minimum(xp.maximum(climb, least), largest)
    return slewed(state.climb_c, bounded_climb, vertical.acceleration, dt), bounded_climb != climb


def _pitch_within(
    state: GuidanceState, altitude: Scalar, speed: Scalar, params: GuidanceParams
) -> Scalar:
    """Return the commanded pitch, rad, within the range that the altitude limits allow.

    The range is from the pitch for the least climb rate of `_climb_within` to the pitch for the
    largest one.
    """
    if not any(map(math.isfinite, (params.limits.lowest, params.limits.highest))):
        return state.target.theta
    xp = array_namespace(speed)
    least, largest = (
        pitch_for(rate, speed, state.alpha) for rate in _climb_within(altitude, params)
    )
    return xp.minimum(xp.maximum(state.target.theta, least), largest)


def _climb_within(altitude: Scalar, params: GuidanceParams) -> tuple[Scalar, Scalar]:
    """Return the least and the largest climb rate that the altitude limits allow, m/s.

    `climb_for` gives them, with each of the two limits as the commanded altitude.
    """
    vertical = params.vertical
    limits = params.limits
    return climb_for(limits.lowest - altitude, vertical), climb_for(
        limits.highest - altitude, vertical
    )
