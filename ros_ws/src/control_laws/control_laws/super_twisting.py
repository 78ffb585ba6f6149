# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The super-twisting law on the outputs, from y, y_m and the nominal Omega."""

from typing import NamedTuple

from control_laws.nominal_model import (
    NominalModel,
    campaign_law,
    conditional_integration,
    params_of_gains,
    saturate,
)
from flight_core.vectors import Array, array_namespace
from rise_di_controller.control_law import ControlLaw, Measurements
from rise_di_controller.saturation import Limits


class TwistingParams(NamedTuple):
    """Gains over m channels, (m,)."""

    root: Array  # on sgn(e) sqrt(abs(e)), (units of y)^(1/2) / s
    beta: Array  # on the integral of sgn(e), units of y / s^2


class TwistingState(NamedTuple):
    """State of the law between two ticks, (m,)."""

    z: Array  # integral of the sign, units of y / s


def control_law(model: NominalModel) -> ControlLaw:
    """Second-order sliding on e, by forward Euler.

        z += -dt beta sgn(e)
        u  = Omega^-1 (y_m_dot - root sgn(e) sqrt(abs(e)) + z)

    Without actuators e_dot = -root sgn(e) sqrt(abs(e)) + z + d. For abs(d_dot) <= L, e reaches 0 in
    finite time if beta > L and root^2 > 2 (beta + L)^2 / (beta - L). Source: A. Levant, Int. J.
    Control 58(6), 1993; J. A. Moreno, M. Osorio, IEEE TAC 57(4), 2012; Y. Shtessel et al., "Sliding
    Mode Control and Observation", 4.3.
    """
    Omega = model.Omega
    inverse = model.inverse

    def engage(measured: Measurements, params: TwistingParams) -> TwistingState:
        return TwistingState(array_namespace(measured.y).zeros_like(measured.y))

    def limited(
        state: TwistingState,
        measured: Measurements,
        dt: Array,
        params: TwistingParams,
        limits: Limits,
    ) -> tuple[TwistingState, Array, Array]:
        xp = array_namespace(measured.y)
        e = measured.y - measured.y_m
        increment = -dt * params.beta * xp.sign(e)
        z = state.z + increment
        nu = measured.y_m_dot - params.root * xp.sign(e) * xp.sqrt(xp.abs(e)) + z
        u_free = measured.u_trim + inverse @ nu
        u, excess = saturate(u_free, measured, dt, limits)
        return (
            TwistingState(conditional_integration(state.z, z, increment, Omega @ excess)),
            u_free,
            u,
        )

    return campaign_law(TwistingState, engage, limited)


twisting_params = params_of_gains(TwistingParams)
