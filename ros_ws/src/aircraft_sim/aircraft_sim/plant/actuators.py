# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Model the actuators between the command u and the aircraft.

They have a dead zone, a lag, a rate limit, end stops, and the faults of effectors.
"""

from typing import Any, NamedTuple

from flight_core.vectors import Array, array_namespace

# s, in place of a lag of 0. It avoids a division by 0, and exp(-dt / 1e-30) is exactly 0, also in
# float32.
MIN_LAG = 1e-30


class Actuators(NamedTuple):
    """Parameters of m actuators, SI.

    An ideal actuator has a lag of 0 and infinite limits. A field that is None means that no
    actuator has this property.
    """

    lag: Array | None = None  # (m,) time constant of the first-order response, s, 0 = none
    lower: Array | None = None  # (m,) lower end stop, deviation from trim, -inf = none
    upper: Array | None = None  # (m,) upper end stop, deviation from trim, inf = none
    rate: Array | None = None  # (m,) largest rate, units of u / s, inf = none
    dead_zone: Array | None = None  # (m,) half-width of the dead zone, 0 = none
    # The times of faults are flight times, s, and inf means never.
    stuck_at: Array | None = None  # (m,) time at which the actuator gets stuck
    # (m,) time from which on the actuator stays at `no_thrust`
    lost_at: Array | None = None
    # (m,) time from which on the effect of the actuator is multiplied by `weak_effect`
    weak_at: Array | None = None
    weak_effect: Array | None = None  # (m,) factor on the effect
    # (m,) time from which on the lag of the actuator is at least `slow_lag`
    slow_at: Array | None = None
    slow_lag: Array | None = None  # (m,) lag of a slow actuator, s
    # (m,) time from which on the actuator has the backlash `loose_play`
    loose_at: Array | None = None
    loose_play: Array | None = None  # (m,) half-width of the backlash
    # (m,) time from which on the actuator runs away to `hard_over_to`
    hard_over_at: Array | None = None
    hard_over_to: Array | None = None  # (m,) end stop of a runaway, deviation from trim
    backlash: Array | None = None  # (m,) half-width of the backlash in force, see `in_force`
    runs_to: Array | None = None  # (m,) end stop of a runaway in force, nan without a runaway
    # (m,) position at which the effector gives no thrust, deviation from trim, 0 for a surface
    no_thrust: Array | None = None


def step(position: Array, command: Array, dt: Any, params: Actuators) -> Array:
    """Advance the actuator positions, (m,), by a step over which the command is held.

        target  = command - clip(command, -dead_zone, dead_zone)
            dead zone: zero inside, no jump at the edge
        input   = clip(position, target - backlash, target + backlash)
            the play operator: target if there is no backlash; the end stop in a runaway
        lagged  = input - (input - position) exp(-dt / lag)  exact solution of lag p_dot = input - p
        limited = position + clip(lagged - position, -rate dt, rate dt)        rate limit
        p+      = clip(limited, lower, upper)                                  end stops

    Each line models a property of the actuator and takes the result of the previous line. An ideal
    actuator passes the command on exactly, to the last bit, because the difference is zero and the
    limits only choose between values.

    Position and command have shape (m,) and are deviations from trim in SI. dt > 0 is a scalar in
    s. Source: the lag is the zero-order-hold equivalent of 1 / (lag s + 1); Franklin, Powell,
    Workman, Digital Control, 4.3.
    """
    xp = array_namespace(position)
    target = _input(position, command, params)
    if params.lag is not None:
        target = target - (target - position) * xp.exp(-dt / xp.maximum(params.lag, MIN_LAG))
    if params.rate is not None:
        largest = params.rate * dt
        target = xp.minimum(xp.maximum(target, position - largest), position + largest)
    if params.lower is not None:
        target = xp.maximum(target, params.lower)
    return target if params.upper is None else xp.minimum(target, params.upper)


def mean_position(position: Array, command: Array, new: Array, dt: Any, params: Actuators) -> Array:
    """Compute the mean actuator positions over a step from `position` to `new`, shape (m,).

    The mean is the input of the aircraft in this step:

        input                                                                     as in `step`
        lagged  = input - (input - position) lag / dt (1 - exp(-dt / lag))
            exact mean of lag p_dot = input - p
        limited = clip(lagged, position - rate dt / 2, position + rate dt / 2)
            exact mean of a motion at the rate limit
        mean    = clip(limited, min(position, new), max(position, new))
            the motion is monotonic and has end stops

    In a step in which a limit begins or ceases to act, the mean is approximate and lies between the
    two ends. For an ideal actuator the mean is exactly `new`.

    Shapes and units are as in `step`, and `new` is the result of `step`.
    """
    if params.lag is None and params.rate is None:
        return new
    xp = array_namespace(position)
    mean = _input(position, command, params)
    if params.lag is not None:
        mean = mean + (mean - position) * (
            params.lag / dt * xp.expm1(-dt / xp.maximum(params.lag, MIN_LAG))
        )
    if params.rate is not None:
        largest = params.rate * (0.5 * dt)
        mean = xp.minimum(xp.maximum(mean, position - largest), position + largest)
    return xp.minimum(xp.maximum(mean, xp.minimum(position, new)), xp.maximum(position, new))


def move(
    t: Any, position: Array, command: Array, dt: Any, params: Actuators
) -> tuple[Array, Array]:
    """Move the actuators over a step that begins at t, with all faults.

    Returns the positions at the end of the step, and the mean positions, which are the input of the
    aircraft in this step, (m,) each.
    """
    now = in_force(t, position, params)
    end = step(position, command, dt, now)
    mean = mean_position(position, command, end, dt, now)
    return apply_faults(t, position, end, params), effect(
        t, apply_faults(t, position, mean, params), params
    )


def in_force(t: Any, position: Array, params: Actuators) -> Actuators:
    """Return the parameters that the actuators have in a step that begins at t.

    A slow actuator has at least the lag `slow_lag`, and a loose actuator has the backlash
    `loose_play`. A runaway goes to `hard_over_to` at the rate limit, without a lag.
    """
    xp = array_namespace(position)
    if params.slow_at is not None:
        lag = 0.0 * position if params.lag is None else params.lag
        params = params._replace(
            lag=xp.where(t >= params.slow_at, xp.maximum(lag, params.slow_lag), lag)
        )
    if params.loose_at is not None:
        params = params._replace(
            backlash=xp.where(t >= params.loose_at, params.loose_play, 0.0 * position)
        )
    if params.hard_over_at is not None:
        is_hard_over = t >= params.hard_over_at
        lag = 0.0 * position if params.lag is None else params.lag
        params = params._replace(
            lag=xp.where(is_hard_over, 0.0, lag),
            runs_to=xp.where(is_hard_over, params.hard_over_to, xp.nan),
        )
    return params


def effect(t: Any, position: Array, params: Actuators) -> Array:
    """Compute the input of the aircraft at the given actuator positions, shape (m,).

        t >= weak_at    no_thrust + weak_effect (position - no_thrust)
        else            position

    A weak actuator gives a part of its thrust, and thus also only a part of the thrust in trim.

    `position` is the position at t, after `apply_faults`.
    """
    if params.weak_at is None:
        return position
    no_thrust = _no_thrust(position, params)
    weak = no_thrust + params.weak_effect * (position - no_thrust)
    return array_namespace(position).where(t >= params.weak_at, weak, position)


def _input(position: Array, command: Array, params: Actuators) -> Array:
    xp = array_namespace(command)
    if params.dead_zone is not None:
        command = command - xp.minimum(xp.maximum(command, -params.dead_zone), params.dead_zone)
    if params.backlash is not None:
        most = command + params.backlash
        command = xp.minimum(xp.maximum(position, command - params.backlash), most)
    if params.runs_to is None:
        return command
    return xp.where(xp.isnan(params.runs_to), command, params.runs_to)


def apply_faults(t: Any, position: Array, new: Array, params: Actuators) -> Array:
    """Replace the positions of actuators with a fault at the end of a step, shape (m,).

        t >= stuck_at    position    the actuator keeps the position
        t >= lost_at     no_thrust
            an engine or a rotor stops at once, a surface floats at trim; also if stuck before
        else             new

    The step begins at t. `position` is the position at t, and `new` the position at the end of the
    step without faults, or the mean over the step. If a fault begins within a step, it acts from
    the next step on.
    """
    xp = array_namespace(position)
    if params.stuck_at is not None:
        new = xp.where(t >= params.stuck_at, position, new)
    if params.lost_at is None:
        return new
    return xp.where(t >= params.lost_at, _no_thrust(new, params), new)


def _no_thrust(position: Array, params: Actuators) -> Array:
    return 0.0 * position if params.no_thrust is None else params.no_thrust
