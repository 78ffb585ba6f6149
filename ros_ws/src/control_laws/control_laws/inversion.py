# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Dynamic inversion from the full state x (or x_air): cancels the nominal model and places the
poles of the error.
"""

from typing import NamedTuple

from control_laws.nominal_model import (
    ErrorIntegral,
    NominalModel,
    campaign_law,
    conditional_integration,
    saturate,
    start_integral,
    state_of,
)
from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller.control_law import ControlLaw, Measurements
from rise_di_controller.saturation import Limits


class InversionParams(NamedTuple):
    """Gains over m channels, (m,)."""

    K: Array  # 1/s
    Lambda: Array  # 1/s, 0 for inversion without an integral


def control_law(model: NominalModel, *, vanes: bool) -> ControlLaw:
    """Inversion of the nominal model, with `vanes` from the state relative to the air.

        u = Omega^-1 (y_m_dot - C (A x + f(x)) - K (e + Lambda integral of e))

    Without actuators e_dot = -K (e + Lambda integral of e) + C (f of the aircraft - f of the
    model), for the nominal A and B. The integral is a trapezoid with conditional integration
    (anti-windup). Source: B. L. Stevens, F. L. Lewis, E. N. Johnson, "Aircraft Control and
    Simulation", 5.8.
    """
    drift = model.C @ model.A
    gravity = model.C @ model.gravity
    Omega = model.Omega
    inverse = model.inverse

    def limited(
        state: ErrorIntegral,
        measured: Measurements,
        dt: Array,
        params: InversionParams,
        limits: Limits,
    ) -> tuple[ErrorIntegral, Array, Array]:
        x = state_of(measured, vanes=vanes)
        e = measured.y - measured.y_m
        increment = dt * (e + state.e) / 2.0
        integral_e = state.integral_e + increment
        model_part = drift @ x + gravity @ array_namespace(e).sin(x)
        nu = measured.y_m_dot - model_part - params.K * (e + params.Lambda * integral_e)
        u_free = measured.u_trim + inverse @ nu
        u, excess = saturate(u_free, measured, dt, limits)
        effect = -params.K * params.Lambda * increment
        return (
            ErrorIntegral(
                e, conditional_integration(state.integral_e, integral_e, effect, Omega @ excess)
            ),
            u_free,
            u,
        )

    return campaign_law(ErrorIntegral, start_integral, limited)


def inversion_params(gains: dict[str, FloatArray], model: NominalModel) -> InversionParams:
    """Parameters from gains K and, for DI with an integral, Lambda, shapes (m, N)."""
    return InversionParams(gains["K"], gains.get("Lambda", 0.0 * gains["K"]))
