# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement incremental nonlinear dynamic inversion (INDI).

The law takes y, y_m, the measured actuator positions and the nominal Omega.
"""

from typing import NamedTuple

from control_laws.nominal_model import (
    NominalModel,
    campaign_law,
    filter_gain,
)
from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller.law.control_law import ControlLaw, Measurements
from rise_di_controller.law.saturation import Limits, saturate
from rise_di_controller.params import ControllerConfig


class IndiParams(NamedTuple):
    """Gains of INDI over m channels, each with the shape (m,)."""

    K: Array  # 1/s
    bandwidth: Array  # bandwidth of both filters, rad/s
    share: Array  # factor of Omega^-1 in an increment, 1 in the literature


class IndiState(NamedTuple):
    """State of INDI between two ticks, each field with the shape (m,)."""

    y: Array
    y_dot: Array  # difference of y after the filter, units of y / s
    position: Array  # measured position of the actuators after the filter


def control_law(model: NominalModel) -> ControlLaw:
    """Return INDI, which inverts only the increment of y_dot at a tick.

        y_dot_f    += a ((y - y_p) / dt - y_dot_f),  position_f += a (position - position_f),
            a = 1 - exp(-bandwidth dt)
        u           = position_f + share Omega^-1 (y_m_dot - K e - y_dot_f)

    y_p is the y of the previous tick. The measured y_dot already contains the model error. The two
    filters are equal, so y_dot_f and position_f belong to the same instant. The law has no
    integral, so it cannot wind up. Source: S. Sieberling, Q. P. Chu, J. A. Mulder, JGCD 33(6),
    2010. E. J. J. Smeur, Q. P. Chu, G. C. H. E. de Croon, JGCD 39(3), 2016, for the filters.
    """
    inverse = model.inverse

    def engage(measurements: Measurements, params: IndiParams) -> IndiState:
        return IndiState(
            measurements.y,
            array_namespace(measurements.y).zeros_like(measurements.y),
            measurements.position,
        )

    def limited(
        state: IndiState, measurements: Measurements, dt: Array, params: IndiParams, limits: Limits
    ) -> tuple[IndiState, Array, Array]:
        a = filter_gain(params.bandwidth, dt)
        y_dot = state.y_dot + a * ((measurements.y - state.y) / dt - state.y_dot)
        position = state.position + a * (measurements.position - state.position)
        nu = measurements.y_m_dot - params.K * (measurements.y - measurements.y_m) - y_dot
        u_free = position + params.share * (inverse @ nu)
        u = saturate(u_free, measurements.u_before, dt, limits)
        return IndiState(measurements.y, y_dot, position), u_free, u

    return campaign_law(IndiState, engage, limited)


def indi_params(gains: dict[str, FloatArray], _: NominalModel) -> IndiParams:
    """Return the parameters for N sets of gains, each of the shape (m, N)."""
    return IndiParams(**gains)


class IndiConfig(ControllerConfig):
    """INDI, flown by campaigns only."""

    needs = "the positions of the actuators"
