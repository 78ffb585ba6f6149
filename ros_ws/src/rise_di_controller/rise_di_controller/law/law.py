# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the control law of the paper, equations (20)-(22), as a pure step.

Its only inputs are y and y_m. It needs no A, B or f, and no acceleration.

`CONTROL_LAWS` offers the law through the protocol of `control_law`, with anti-windup and retuning.
"""

from enum import IntEnum
from typing import NamedTuple

from flight_core.vectors import Array, array_namespace
from rise_di_controller.law.control_law import ControlLaw, Measurements, TunedLaw
from rise_di_controller.law.saturation import LEAST_DIVISOR, Limits, saturate

# Lower bound of k_d (1/s), k_g (1/s) and beta (units of y / s^2), because (21) and (22) require
# positive values.
MIN_GAIN = 0.01


class Sign(IntEnum):
    """How Sgn(e) of equation (21) is evaluated at the samples."""

    LITERAL = 0
    IMPLICIT = 1
    SOFT = 2


class LawParams(NamedTuple):
    """Parameters of the law over m channels.

    The law works in inputs scaled to unit response, v_i = u_i / input_scale_i with abs(Omega_ii)
    about 1. Therefore K is a bandwidth in rad/s, and beta has units of y / s^2. The theorem holds
    for v as well as for u.

    Attributes:
        K: Diagonal of equation (22), shape (m,), 1/s.
        Lambda: Diagonal of Lambda, shape (m,), 1/s.
        beta: Diagonal of beta, shape (m,), units of y / s^2.
        D: Diagonal of D, shape (m,), +1 or -1.
        input_scale: u per scaled input, shape (m,), units of u s / units of y.
        omega: abs(Omega_ii) in scaled inputs, or an over-estimate of it, shape (m,). Only
            Sign.IMPLICIT uses it.
        eps: Half-width of the softened sign, shape (m,), units of y, > 0. Only Sign.SOFT uses it.
        sign: How the sign is sampled. It is None in parameters for many aircraft, because in that
            case the functions of the control law contain the choice.

    Examples:
        >>> rise_di.find_scenario("osprey_servo").rise_di().law_params().D.shape
        (4,)
    """

    K: Array
    Lambda: Array
    beta: Array
    D: Array
    input_scale: Array
    omega: Array
    eps: Array
    sign: Sign | None


class LawState(NamedTuple):
    """State of the law between two ticks, fields of shape (m,).

    Attributes:
        e_0: e at engagement, units of y.
        e: e at the previous tick, units of y.
        integral_e: Integral of e, units of y s.
        Pi: Equation (21), scaled input.

    Examples:
        >>> rise_di.engage(np.ones(2), np.zeros(2)).Pi.tolist()
        [0.0, 0.0]
    """

    e_0: Array
    e: Array
    integral_e: Array
    Pi: Array


def gain(k_g: Array, k_d: Array) -> Array:
    """Compute the diagonal of K, equation (22): K = I + k_g I + diag(k_d, 0), shape (m,).

    k_g has shape () and k_d shape (m - 1,).
    """
    xp = array_namespace(k_d)
    return 1.0 + k_g + xp.concat([k_d, xp.zeros(1, dtype=k_d.dtype)])


def total_lag(lag: Array, delay: float, period: float) -> Array:
    """Compute the lag from y to the actuator positions, s, in the shape of `lag`.

    It is the sum of actuator lag, 1.5 periods (sampling and hold) and delay.
    """
    return lag + 1.5 * period + delay


def engage(y: Array, y_m: Array) -> LawState:
    """Return the state at engagement: e_0 = y - y_m, integral_e = 0, Pi = 0.

    u is then 0 at engagement, so the transfer is bumpless.

    Args:
        y: Outputs, shape (m,), SI.
        y_m: Reference, shape (m,), SI.

    Returns:
        The state for the first `step`.

    Raises:
        ParameterError: `y` is no array of NumPy or of JAX.

    Examples:
        >>> rise_di.engage(np.ones(2), np.zeros(2)).e_0.tolist()
        [1.0, 1.0]
    """
    xp = array_namespace(y)
    e = y - y_m
    return LawState(e, e, xp.zeros_like(e), xp.zeros_like(e))


def step(
    state: LawState, y: Array, y_m: Array, dt: Array, params: LawParams
) -> tuple[LawState, Array]:
    """Advance the law by a tick, and return the state and u.

    With e = y - y_m (3), e_p the e at the previous tick, and dt the time between the two ticks:

        integral_e += dt (e + e_p) / 2                                    trapezoid
        LITERAL:   u from the present Pi, then Pi += dt beta sgn(e)       (21) by forward Euler
        IMPLICIT:  Pi += dt beta s first, s = clip(e_hat / (dt^2 omega beta), -1, 1)
                   e_hat = e + (e - e_p) - dt omega K ((e - e_p) + Lambda dt (e + e_p) / 2)
        SOFT:      Pi += dt beta s first, s = clip(e / eps, -1, 1)
        u = -input_scale D (K (e - e_0 + Lambda integral_e) + Pi)         (20)

    e_hat predicts e one tick ahead if Pi does not change, and s is the element of Sgn(e one tick
    ahead) that agrees with this prediction. This is backward Euler of (21), with an error of order
    dt^2 and without chatter. SOFT is for loops with lag. u is the deviation from the input at
    engagement, and sgn(0) = 0.

    Source: (20)-(22) of Tanyer, Tatlicioglu, Zergeroglu. The sampling is of this project (see
    docs/theory.md).

    Args:
        state: State after the previous tick, fields (m,).
        y: Outputs, shape (m,), SI.
        y_m: Reference, shape (m,), SI.
        dt: Time since the previous tick, shape (), s, above 0.
        params: Parameters, fields (m,).

    Returns:
        The state after the tick, and u, shape (m,), in the units of input_scale.

    Raises:
        ParameterError: `y` is no array of NumPy or of JAX.

    Examples:
        >>> params = rise_di.find_scenario("osprey_servo").rise_di().law_params()
        >>> y = np.full(4, 0.01)
        >>> state = rise_di.engage(y, y)
        >>> state, u = rise_di.step(state, y, y, 0.01, params)
        >>> u.shape
        (4,)
    """
    xp = array_namespace(y)
    e = y - y_m
    increment = dt * (e + state.e) / 2.0
    integral_e = state.integral_e + increment
    if params.sign is Sign.LITERAL:
        Pi = state.Pi + dt * params.beta * xp.sign(e)
    else:
        if params.sign is Sign.IMPLICIT:
            change = e - state.e
            e_hat = e + change - dt * params.omega * params.K * (change + params.Lambda * increment)
            s = e_hat / (dt * dt * params.omega * params.beta)
        else:
            s = e / params.eps
        unit = xp.ones_like(e)
        s = xp.minimum(xp.maximum(s, -unit), unit)
        Pi = state.Pi + dt * params.beta * s
    after = LawState(state.e_0, e, integral_e, Pi)
    return after, control(state, after, params)


def control(before: LawState, after: LawState, params: LawParams) -> Array:
    """Compute u of (20), shape (m,): u = -input_scale D (K (e - e_0 + Lambda integral_e) + Pi).

    e and integral_e are taken after the tick. Pi is taken after the tick with the soft and implicit
    signs, and before the tick with the literal sign, which uses Pi first and updates it afterwards.
    u has the units of input_scale.
    """
    Pi = before.Pi if params.sign is Sign.LITERAL else after.Pi
    return params.input_scale * (
        -params.D * (params.K * (after.e - after.e_0 + params.Lambda * after.integral_e) + Pi)
    )


def step_with_anti_windup(
    state: LawState,
    y: Array,
    y_m: Array,
    dt: Array,
    u_trim: Array,
    u_before: Array,
    params: LawParams,
    limits: Limits,
) -> tuple[LawState, Array, Array]:
    """Advance the law by a step with anti-windup.

    Returns the state of the law, u before saturation, and the commanded u. Each u has the shape
    (m,).

    The anti-windup is conditional integration. If u_trim + u exceeds a magnitude or rate limit,
    increments of integral_e and of Pi that push u further out are reduced, and increments that
    bring u back stay. The increment of integral_e is dropped. The increment of Pi, the faster
    integral, is scaled so that u ends at the limit:

        beyond = abs(u_trim + u - saturated)
        excess = max(beyond - abs(change of u by the increment of integral_e), 0)
        change = abs(change of u by the increment of Pi)
        Pi+    = Pi + (max(change - excess, 0) / change) * increment of Pi

    Without saturation every bit is the same as with the law alone. Theorem 1 does not cover
    saturation.
    """
    xp = array_namespace(y)
    after, u = step(state, y, y_m, dt, params)
    total = u_trim + u
    beyond = total - saturate(total, u_before, dt, limits)
    increment = after.integral_e - state.integral_e
    increment_Pi = after.Pi - state.Pi
    change = -params.input_scale * params.D * params.K * params.Lambda * increment
    change_Pi = -params.input_scale * params.D * increment_Pi
    outward = change * beyond > 0
    outward_Pi = change_Pi * beyond > 0
    zero = xp.zeros_like(total)
    excess = xp.maximum(xp.abs(beyond) - xp.where(outward, xp.abs(change), zero), zero)
    size_Pi = xp.where(outward_Pi, xp.abs(change_Pi), zero)
    divisor = xp.where(size_Pi > LEAST_DIVISOR, size_Pi, zero + 1.0)
    share = xp.maximum(size_Pi - excess, zero) / divisor
    after = after._replace(
        integral_e=xp.where(outward, state.integral_e, after.integral_e),
        Pi=xp.where(outward_Pi, state.Pi + share * increment_Pi, after.Pi),
    )
    u_free = u_trim + control(state, after, params)
    return after, u_free, saturate(u_free, u_before, dt, limits)


def retune(state: LawState, old: LawParams, new: LawParams) -> LawState:
    """Return the state for new parameters, without a jump of u (bumpless transfer).

    Pi absorbs the change of the linear term:

        Pi+ = -D u / input_scale - K (e - e_0 + Lambda integral_e)

    D, input_scale, K and Lambda are the new parameters, and u is computed with the old ones. All
    other states stay. Equation (23) continues from the same u with the new gains.
    """
    u = control(state, state, old)
    Pi = -new.D * u / new.input_scale - new.K * (
        state.e - state.e_0 + new.Lambda * state.integral_e
    )
    return state._replace(Pi=Pi)


def shifted(state: LawState, u: Array, params: LawParams) -> LawState:
    """Shift Pi so that u of (20) grows by the given u, (m,): Pi+ = Pi - D u / input_scale."""
    return state._replace(Pi=state.Pi - params.D * u / params.input_scale)


def _control_law(sign: Sign) -> ControlLaw:
    def with_sign(params: LawParams) -> LawParams:
        return params if params.sign is sign else params._replace(sign=sign)

    def start(measurements: Measurements, params: LawParams) -> LawState:
        return engage(measurements.y, measurements.y_m)

    def tick(
        state: LawState, measurements: Measurements, dt: Array, params: LawParams
    ) -> tuple[LawState, Array]:
        after, u = step(state, measurements.y, measurements.y_m, dt, with_sign(params))
        return after, measurements.u_trim + u

    def limited(
        state: LawState, measurements: Measurements, dt: Array, params: LawParams, limits: Limits
    ) -> tuple[LawState, Array, Array]:
        y = measurements.y
        y_m = measurements.y_m
        u_trim = measurements.u_trim
        u_before = measurements.u_before
        return step_with_anti_windup(state, y, y_m, dt, u_trim, u_before, with_sign(params), limits)

    return ControlLaw(state=LawState, engage=start, step=tick, limited=limited, retune=retune)


CONTROL_LAWS = {sign: _control_law(sign) for sign in Sign}
"""RISE-DI as a control law, by the sampling of its sign."""


def tuned(params: LawParams) -> TunedLaw:
    """Return the law RISE-DI together with these parameters, as the controller uses it."""
    return TunedLaw(CONTROL_LAWS[Sign.SOFT if params.sign is None else params.sign], params)
