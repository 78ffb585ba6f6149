# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Indirect self-tuning regulator: dynamic inversion of the model of y that recursive least squares
estimates in flight.
"""

from typing import NamedTuple

import numpy as np

from control_laws.nominal_model import (
    NominalModel,
    campaign_law,
    conditional_integration,
    filter_gain,
    params_of_gains,
    saturate,
)
from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller.control_law import ControlLaw, Measurements
from rise_di_controller.saturation import Limits

LEAST_EFFECT = 0.3
"""Least pivot of the estimated effect over that of the nominal one: below the half that is left at
-50 %."""


class SelfTunerParams(NamedTuple):
    """Gains over m channels, (m,), and (1,) of the estimation."""

    K: Array  # 1/s
    Lambda: Array  # 1/s
    filter: Array  # bandwidth of the state-variable filter, rad/s
    memory: Array  # time constant of the return to the nominal model, s
    prior_A: Array  # deviation of an entry of A_hat a priori, 1/s, over the noise
    prior_Omega: Array  # the same of Omega_hat
    prior_bias: Array  # the same of the bias


class SelfTunerState(NamedTuple):
    """State of the law between two ticks; k = 2 m + 1."""

    e: Array  # (m,)
    integral_e: Array  # (m,)
    u_late: Array  # (m,) u behind the lags
    u_f: Array  # (m,) filtered
    y_f: Array  # (m,) filtered
    theta: Array  # (m, k) estimate
    # (k, k) covariance of a row of theta, the same for all rows: they have the same regressor
    P: Array


def control_law(model: NominalModel) -> ControlLaw:
    """Certainty equivalence: the control takes the estimate for the aircraft.

        u_late += (1 - exp(-dt / lag)) (u_before - u_late),  u_f += a (u_late - u_f),
            a = 1 - exp(-filter dt)
        y_dot_f = a (y - y_f) / dt,  then y_f += a (y - y_f)
        theta   = [A_hat, Omega_hat, bias] = nominal + exp(-dt / memory) (theta - nominal)
        P       = P_0 + exp(-2 dt / memory) (P - P_0),
            P_0 = diag(prior_A^2, .., prior_Omega^2, .., prior_bias^2)
        phi     = [y_f, u_f, 1],  g = dt P phi / (1 + dt phi' P phi),  theta += (y_dot_f - theta phi) g',  P -= g phi' P
        u       = u_trim + Omega_hat^-1 (y_m_dot - A_hat y - K (e + Lambda integral of e))

    y and u are in scaled units. The filtered difference of y is that of the filtered y, without
    differentiation. Forgetting returns theta to the nominal C A C' and Omega and P to P_0, so that
    P stays bounded without excitation. The bias keeps the mean disturbance out of A_hat and
    Omega_hat; the integral cancels the disturbance. The pivots of Omega_hat keep their signs and
    LEAST_EFFECT. Source: K. J. Astrom, B. Wittenmark, "Adaptive Control", 2nd ed., ch. 2, 3 and 11;
    P. A. Ioannou, J. Sun, "Robust Adaptive Control", 4.4 and ch. 7; R. Kulhavy, M. B. Zarrop, Int.
    J. Control 58(4), 1993, for the forgetting.
    """  # noqa: E501 - a text as it is written
    m = len(model.D)
    size = (model.C @ model.size)[:, None]
    unit = model.input_scale[:, None] * size
    nominal = nominal_theta(model)[..., None]
    # the hold is in the difference
    inverse_lag = 1.0 / np.maximum(model.total_lag - 1.5 * model.period, 1e-6)[:, None]

    def covariance(params: SelfTunerParams) -> Array:
        xp = array_namespace(params.prior_A)
        deviations = xp.concat(
            [params.prior_A] * m + [params.prior_Omega] * m + [params.prior_bias]
        )
        return np.eye(2 * m + 1)[..., None] * deviations[None, :, :] ** 2

    def engage(measured: Measurements, params: SelfTunerParams) -> SelfTunerState:
        zero = array_namespace(measured.y).zeros_like(measured.y)
        e = measured.y - measured.y_m
        u = measured.u_before + zero
        none = zero[None, :1, :]
        return SelfTunerState(e, zero, u, u, measured.y, nominal + none, covariance(params) + none)

    def limited(
        state: SelfTunerState,
        measured: Measurements,
        dt: Array,
        params: SelfTunerParams,
        limits: Limits,
    ) -> tuple[SelfTunerState, Array, Array]:
        xp = array_namespace(measured.y)
        e = measured.y - measured.y_m
        a = filter_gain(params.filter, dt)
        u_late = state.u_late + filter_gain(inverse_lag + xp.zeros_like(e), dt) * (
            measured.u_before - state.u_late
        )
        u_f = state.u_f + a * (u_late - state.u_f)
        y_dot = a * (measured.y - state.y_f) / dt / size
        phi = xp.concat([state.y_f / size, u_f / unit, xp.ones_like(e[:1])])
        remembered = xp.exp(-dt / params.memory)[None, :, :]
        P_0 = covariance(params)
        theta = nominal + remembered * (state.theta - nominal)
        P = P_0 + remembered**2 * (state.P - P_0)
        theta, P = least_squares_step(theta, P, phi, y_dot, dt)
        increment = dt * (e + state.e) / 2.0
        integral_e = state.integral_e + increment
        nu = measured.y_m_dot - params.K * (e + params.Lambda * integral_e)
        drift = xp.sum(theta[:, :m, :] * (measured.y / size)[None, :, :], axis=1)
        u_free = measured.u_trim + unit * solve(theta[:, m : 2 * m, :], nu / size - drift, model.D)
        u, excess = saturate(u_free, measured, dt, limits)
        effect = -params.K * params.Lambda * increment
        integral_e = conditional_integration(
            state.integral_e, integral_e, effect, model.Omega @ excess
        )
        y_f = state.y_f + a * (measured.y - state.y_f)
        after = SelfTunerState(e, integral_e, u_late, u_f, y_f, theta, P)
        return after, u_free, u

    return campaign_law(SelfTunerState, engage, limited)


def least_squares_step(
    theta: Array, P: Array, phi: Array, y_dot: Array, dt: Array
) -> tuple[Array, Array]:
    """A step of recursive least squares: theta, shape (m, k, N), and P, shape (k, k, N), after.

        g = dt P phi / (1 + dt phi' P phi),  theta += (y_dot - theta phi) g',  P -= g phi' P

    phi: regressor, shape (k, N); y_dot, shape (m, N), in scaled units, 1/s.
    """
    xp = array_namespace(phi)
    P_phi = xp.sum(P * phi[None, :, :], axis=1)
    gain = dt * P_phi / (1.0 + dt * xp.sum(phi * P_phi, axis=0))
    residual = y_dot - xp.sum(theta * phi[None, :, :], axis=1)
    return theta + residual[:, None, :] * gain[None, :, :], P - gain[:, None, :] * P_phi[None, :, :]


def nominal_theta(model: NominalModel) -> FloatArray:
    """[C A C', Omega, 0] in scaled units, 1/s, shape (m, 2 m + 1): sizes of y and inputs of
    abs(Omega_ii) = 1.
    """
    size = model.C @ model.size
    drift = model.C @ model.A @ model.C.T * size
    effect = model.Omega * (model.input_scale * size)
    return np.concatenate([drift, effect, np.zeros((len(size), 1))], axis=1) / size[:, None]


def solve(Omega: Array, nu: Array, D: FloatArray) -> Array:
    """Omega^-1 nu by elimination, shapes (m, m, N) and (m, N), with pivots of the signs D and of at
    least LEAST_EFFECT.
    """
    xp = array_namespace(nu)
    rows = [xp.concat([Omega[i], nu[i : i + 1]]) for i in range(len(D))]
    for i, sign in enumerate(D):
        rows[i] = rows[i] / (sign * xp.clip(sign * rows[i][i : i + 1], LEAST_EFFECT, xp.inf))
        rows = [row if k == i else row - row[i : i + 1] * rows[i] for k, row in enumerate(rows)]
    return xp.stack([row[-1] for row in rows])


self_tuner_params = params_of_gains(SelfTunerParams)
