# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Model-reference adaptive inversion (MRAC) from the full state."""

from typing import NamedTuple

from control_laws.nominal_model import (
    NominalModel,
    campaign_law,
    params_of_gains,
    saturate,
    state_of,
)
from flight_core.vectors import Array, array_namespace
from rise_di_controller.control_law import ControlLaw, Measurements
from rise_di_controller.saturation import Limits


class MracParams(NamedTuple):
    """Gains over m channels, (m,)."""

    K: Array  # 1/s
    adaptation: Array  # of the weights of the states, 1/s^2
    bias: Array  # of the weight of 1, 1/s^2
    leak: Array  # (1,) of the weights, 1/s


class MracState(NamedTuple):
    """State of the law between two ticks."""

    W: Array  # (m, n + 1) weights


def control_law(model: NominalModel, *, vanes: bool) -> ControlLaw:
    """Model-reference adaptive inversion (MRAC) from measured x, with `vanes` relative to the air,
    and the nominal model.

        phi = [x / size, 1],  W (m, n + 1) per aircraft, W(0) = 0
        u   = Omega^-1 (y_m_dot - C (A x + f(x)) - K e - W phi)
        W  += dt (gamma e phi' - leak W),
            gamma = adaptation in the columns of x, bias in the column of 1

    the inversion of the nominal model, with weights adapted to the model error. V = e'e / 2 + sum
    W~^2 / (2 gamma) falls with e'K e if the model error is linear in phi and leak is 0. The leak
    (sigma modification) bounds W under noise. Anti-windup: a saturated channel does not adapt.
    Source: E. Lavretsky, K. A. Wise, "Robust and Adaptive Control", ch. 9 to 11; P. A. Ioannou, P.
    V. Kokotovic, Automatica 20(5), 1984, for the leak.
    """
    drift = model.C @ model.A
    gravity = model.C @ model.gravity
    inverse = model.inverse
    size = model.size[:, None]

    def engage(measured: Measurements, params: MracParams) -> MracState:
        xp = array_namespace(measured.y)
        x = state_of(measured)
        return MracState(xp.zeros_like(measured.y[:, None, :] * xp.concat([x, x[:1]])[None, :, :]))

    def limited(
        state: MracState, measured: Measurements, dt: Array, params: MracParams, limits: Limits
    ) -> tuple[MracState, Array, Array]:
        xp = array_namespace(measured.y)
        x = state_of(measured, vanes=vanes)
        e = measured.y - measured.y_m
        phi = xp.concat([x / size, xp.ones_like(x[:1])])
        nu = (
            measured.y_m_dot
            - drift @ x
            - gravity @ xp.sin(x)
            - params.K * e
            - xp.sum(state.W * phi[None, :, :], axis=1)
        )
        u_free = measured.u_trim + inverse @ nu
        u, excess = saturate(u_free, measured, dt, limits)
        free = xp.where(excess == 0.0, xp.ones_like(e), xp.zeros_like(e))
        state_update = (params.adaptation * e * free)[:, None, :] * phi[None, :-1, :]
        update = xp.concat([state_update, (params.bias * e * free)[:, None, :]], axis=1)
        return MracState(state.W + dt * (update - params.leak[None, :, :] * state.W)), u_free, u

    return campaign_law(MracState, engage, limited)


mrac_params = params_of_gains(MracParams)
