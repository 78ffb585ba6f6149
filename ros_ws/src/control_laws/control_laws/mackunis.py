# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement the acceleration-based RISE inversion of MacKunis et al.

The law takes y, y_m, the nominal Omega, and optionally a perfect y_dot.
"""

from typing import NamedTuple

from control_laws.nominal_model import (
    NominalModel,
    campaign_law,
    conditional_integration,
    filter_gain,
    saturate_with_excess,
)
from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller.law.control_law import ControlLaw, Measurements
from rise_di_controller.law.saturation import Limits
from rise_di_controller.params import ControllerConfig


class MacKunisParams(NamedTuple):
    """Gains of the law over m channels, each with the shape (m,), or (m, N) for N sets of gains."""

    K: Array  # 1/s
    Lambda: Array  # 1/s
    beta: Array  # units of y / s^2
    eps: Array  # half-width of the softened sign, units of y / s
    bandwidth: Array  # bandwidth of the filter of e_dot, rad/s; unused with a perfect y_dot


class MacKunisState(NamedTuple):
    """State of the law between two ticks, each field with the shape (m,)."""

    e_0: Array
    e: Array
    e_dot: Array  # difference of e after the filter
    integral_e: Array
    Pi: Array


def control_law(model: NominalModel, *, ideal: bool) -> ControlLaw:
    """Return the law, which has e_dot in the sign term.

        r          = e_dot + Lambda e
        Pi        += dt beta clip(r / eps, -1, 1)
        integral_e += dt (e + e_p) / 2
        u          = u_trim - Omega^-1 (K (e - e_0 + Lambda integral_e) + Pi)

    The clip stands for sgn(r), because a measured r is noisy. e_0 is the e at engagement, and e_p
    is the e of the previous tick. If u_trim is constant and abs(r) > eps, then u_dot = -Omega^-1 (K
    r + beta sgn(r)). With `ideal`, e_dot = y_dot - y_m_dot with the perfect derivative of C x.
    Otherwise e_dot is a filtered difference, e_dot += (1 - exp(-bandwidth dt)) ((e - e_p) / dt -
    e_dot). Steps of Pi and of integral_e that would increase a saturation of u are dropped. Source:
    W. MacKunis, P. M. Patre, M. K. Kaiser, W. E. Dixon, IEEE TCST 18(6), 2010. The matrix that the
    law inverts is the nominal Omega.
    """
    Omega = model.Omega
    inverse = model.inverse

    def engage(measurements: Measurements, params: MacKunisParams) -> MacKunisState:
        e = measurements.y - measurements.y_m
        zero = array_namespace(e).zeros_like(e)
        return MacKunisState(e_0=e, e=e, e_dot=zero, integral_e=zero, Pi=zero)

    def limited(
        state: MacKunisState,
        measurements: Measurements,
        dt: Array,
        params: MacKunisParams,
        limits: Limits,
    ) -> tuple[MacKunisState, Array, Array]:
        xp = array_namespace(measurements.y)
        e = measurements.y - measurements.y_m
        e_dot = state.e_dot + filter_gain(params.bandwidth, dt) * ((e - state.e) / dt - state.e_dot)
        r = (measurements.y_dot - measurements.y_m_dot if ideal else e_dot) + params.Lambda * e
        unit = xp.ones_like(e)
        Pi_step = dt * params.beta * xp.minimum(xp.maximum(r / params.eps, -unit), unit)
        increment = dt * (e + state.e) / 2.0
        integral_e = state.integral_e + increment
        Pi = state.Pi + Pi_step
        nu = -params.K * (e - state.e_0 + params.Lambda * integral_e) - Pi
        u_free = measurements.u_trim + inverse @ nu
        u, excess = saturate_with_excess(u_free, measurements, dt, limits)
        y_dot_excess = Omega @ excess
        integral_e = conditional_integration(state.integral_e, integral_e, -increment, y_dot_excess)
        Pi = conditional_integration(state.Pi, Pi, -Pi_step, y_dot_excess)
        return (
            MacKunisState(e_0=state.e_0, e=e, e_dot=e_dot, integral_e=integral_e, Pi=Pi),
            u_free,
            u,
        )

    return campaign_law(MacKunisState, engage, limited)


class MacKunisConfig(ControllerConfig):
    """The acceleration-based RISE inversion, which only comparisons of laws use."""

    needs = "a derivative of y"


def mackunis_params(gains: dict[str, FloatArray], model: NominalModel) -> MacKunisParams:
    """Return the parameters for the gains of a search.

    N candidates have K, Lambda and beta (m, N), softening (1, N) and, without a perfect y_dot, the
    bandwidth `filter` (1, N), rad/s. eps is softening times beta / K. Inside eps, the softened sign
    is linear, and its gain K / softening adds to K.
    """
    K = gains["K"]
    beta = gains["beta"]
    eps = beta / K * gains["softening"]
    return MacKunisParams(
        K=K,
        Lambda=gains["Lambda"],
        beta=beta,
        eps=eps,
        bandwidth=gains.get("filter", 0.0) + 0.0 * K,
    )
