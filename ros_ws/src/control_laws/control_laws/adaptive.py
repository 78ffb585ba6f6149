# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Adaptive laws: L1 from outputs alone, and model-reference adaptive inversion from the full state."""

from typing import NamedTuple

from control_laws.nominal_model import NominalModel, filter_gain, params_of_gains, saturate
from flight_core.vectors import Array, array_namespace
from rise_di_controller.control_law import ControlLaw, Measurements
from rise_di_controller.guard import Limits

ADAPTATION_POLE = 1.0
"""1/s, of the predictor of L1. It scales the estimate by a dt / (exp(a dt) - 1), 0.995 at 100 Hz; K corrects the rest."""


class L1Params(NamedTuple):
    """Gains over m channels, (m, 1) or (m, N)."""

    K: Array  # 1/s
    bandwidth: Array  # of the low-pass filter C(s), rad/s
    limits: Limits


class L1State(NamedTuple):
    """State of L1 from tick to tick, (m, N)."""

    y_hat: Array  # predicted for the next tick
    sigma_hat: Array  # estimate of y_dot - Omega u
    sigma_f: Array  # filtered


def l1(model: NominalModel, *, feedforward: bool) -> ControlLaw:
    """L1 adaptive output control with piecewise-constant adaptation. It measures y, y_m and uses the nominal Omega.

        sigma_hat = -Phi^-1 exp(-a dt) (y_hat - y),  Phi = (1 - exp(-a dt)) / a          a = ADAPTATION_POLE
        sigma_f  += (1 - exp(-bandwidth dt)) (sigma_hat - sigma_r - sigma_f)
        u         = u_r - Omega^-1 (K e + sigma_f)
        y_hat     = y + exp(-a dt) (y_hat - y) + dt Omega u + Phi sigma_hat                for the next tick

    the exact step of y_hat_dot = -a (y_hat - y) + Omega u + sigma_hat. Reference input: u_r = Omega^-1 y_m_dot and
    sigma_r = 0. With `feedforward`: u_r = u_ff and sigma_r = y_m_dot - Omega u_ff, the model's part of sigma along the
    reference, so that it is not cancelled twice. Anti-windup: the predictor takes u after saturation.
    Source: N. Hovakimyan, C. Cao, "L1 Adaptive Control Theory", SIAM 2010, section 3.3.
    """
    Omega, inverse = model.Omega, model.inverse

    def start(measured: Measurements, params: L1Params) -> L1State:
        zero = array_namespace(measured.y).zeros_like(measured.y)
        return L1State(measured.y, zero, zero)

    def step(state: L1State, measured: Measurements, dt: Array, params: L1Params) -> tuple[L1State, Array]:
        xp = array_namespace(measured.y)
        error = state.y_hat - measured.y
        a = ADAPTATION_POLE + xp.zeros_like(params.K)
        Phi, left = filter_gain(a, dt) / a, xp.exp(-a * dt)
        sigma_hat = -left / Phi * error
        u_r = measured.u_ff if feedforward else inverse @ measured.y_m_dot
        sigma_r = measured.y_m_dot - Omega @ u_r
        sigma_f = state.sigma_f + filter_gain(params.bandwidth, dt) * (sigma_hat - sigma_r - state.sigma_f)
        nu = -params.K * (measured.y - measured.y_m) - sigma_f
        u, _ = saturate(u_r + inverse @ nu, measured, dt, params.limits)
        y_hat = measured.y + left * error + dt * (Omega @ u) + Phi * sigma_hat
        return L1State(y_hat, sigma_hat, sigma_f), u

    return ControlLaw(start, step)


l1_params = params_of_gains(L1Params)


class MracParams(NamedTuple):
    """Gains over m channels, (m, 1) or (m, N)."""

    K: Array  # 1/s
    adaptation: Array  # of the weights of the states, 1/s^2
    bias: Array  # of the weight of 1, 1/s^2
    leak: Array  # (1, N) of all weights, 1/s
    limits: Limits


def mrac(model: NominalModel, *, vanes: bool) -> ControlLaw:
    """Model-reference adaptive inversion (MRAC). It measures x, with `vanes` relative to the air, and uses the nominal model.

        phi = [x / size, 1],  W (m, n + 1) per aircraft, W(0) = 0
        u   = Omega^-1 (y_m_dot - C (A x + f(x)) - K e - W phi)
        W  += dt (gamma e phi' - leak W),  gamma = adaptation in the columns of x, bias in that of 1

    the inversion of the nominal model, with weights that adapt to the model error. V = e'e / 2 + sum W~^2 / (2 gamma) falls
    with e'K e if the model error is linear in phi and leak is 0. The leak (sigma modification) bounds W under noise.
    Anti-windup: a saturated channel does not adapt. Source: E. Lavretsky, K. A. Wise, "Robust and Adaptive Control",
    ch. 9 to 11; P. A. Ioannou, P. V. Kokotovic, Automatica 20(5), 1984, for the leak.
    """
    drift, gravity = model.C @ model.A, model.C @ model.gravity
    inverse, size = model.inverse, model.size[:, None]

    def start(measured: Measurements, params: MracParams) -> Array:
        xp = array_namespace(measured.y)
        return xp.zeros_like(measured.y[:, None, :] * xp.concat([measured.x, measured.x[:1]])[None, :, :])

    def step(state: Array, measured: Measurements, dt: Array, params: MracParams) -> tuple[Array, Array]:
        xp = array_namespace(measured.y)
        x = measured.x_air if vanes else measured.x
        e = measured.y - measured.y_m
        phi = xp.concat([x / size, xp.ones_like(x[:1])])
        nu = measured.y_m_dot - drift @ x - gravity @ xp.sin(x) - params.K * e - xp.sum(state * phi[None, :, :], axis=1)
        u, beyond = saturate(inverse @ nu, measured, dt, params.limits)
        free = xp.where(beyond == 0.0, xp.ones_like(e), xp.zeros_like(e))
        of_states = (params.adaptation * e * free)[:, None, :] * phi[None, :-1, :]
        update = xp.concat([of_states, (params.bias * e * free)[:, None, :]], axis=1)
        return state + dt * (update - params.leak[None, :, :] * state), u

    return ControlLaw(start, step)


mrac_params = params_of_gains(MracParams)
