# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement PI control of the outputs, which is RISE-DI without the sign term."""

from typing import NamedTuple

import numpy as np

from control_laws.nominal_model import NominalModel, saturate_with_excess
from flight_core.fields import Field
from flight_core.parameters import NonNegatives, Positives, require_length
from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller.law.control_law import ControlLaw, Measurements, without_limits
from rise_di_controller.law.saturation import Limits, limited_integral, saturate
from rise_di_controller.params import ControllerConfig


class PiParams(NamedTuple):
    """Parameters of PI control over m channels, each with the shape (m,)."""

    K: Array  # 1/s
    Lambda: Array  # 1/s
    D: Array  # +1 or -1
    input_scale: Array  # u per scaled input


class PiState(NamedTuple):
    """State of PI control between two ticks, each field with the shape (m,)."""

    e_0: Array  # e at engagement, until `_retune` chooses another value
    e: Array
    integral_e: Array


def _u(state: PiState, params: PiParams) -> Array:
    """Compute u - u_trim, shape (m,), as -input_scale D K (e - e_0 + Lambda integral of e)."""
    return (
        -params.input_scale
        * params.D
        * params.K
        * (state.e - state.e_0 + params.Lambda * state.integral_e)
    )


def _engage(measurements: Measurements, params: PiParams) -> PiState:
    e = measurements.y - measurements.y_m
    return PiState(e, e, array_namespace(e).zeros_like(e))


def _limited(
    state: PiState, measurements: Measurements, dt: Array, params: PiParams, limits: Limits
) -> tuple[PiState, Array, Array]:
    """Advance the law by a tick: u = u_trim - input_scale D K (e - e_0 + Lambda integral of e).

    The integral uses the trapezoidal rule, with the anti-windup of `limited_integral`.
    """
    e = measurements.y - measurements.y_m
    after = PiState(state.e_0, e, state.integral_e + dt * (e + state.e) / 2.0)
    _, excess = saturate_with_excess(
        measurements.u_trim + _u(after, params), measurements, dt, limits
    )
    change = (
        -params.input_scale
        * params.D
        * params.K
        * params.Lambda
        * (after.integral_e - state.integral_e)
    )
    after = after._replace(
        integral_e=limited_integral(state.integral_e, after.integral_e, change, excess)
    )
    u_free = measurements.u_trim + _u(after, params)
    return after, u_free, saturate(u_free, measurements.u_before, dt, limits)


def _retune(state: PiState, old: PiParams, new: PiParams) -> PiState:
    """Return the state for new parameters, without a jump of u (bumpless transfer).

    e_0 is chosen so that u stays the same. The integral cannot serve, because Lambda may be 0.
    """
    start_error = -new.D * _u(state, old) / (new.input_scale * new.K)
    return state._replace(e_0=state.e + new.Lambda * state.integral_e - start_error)


CONTROL_LAW = ControlLaw(
    state=PiState, engage=_engage, step=without_limits(_limited), limited=_limited, retune=_retune
)


def params_of(gains: dict[str, FloatArray], model: NominalModel) -> PiParams:
    """Return the parameters for N sets of the gains K and Lambda, each (m, N)."""
    return PiParams(gains["K"], gains["Lambda"], model.D[:, None], model.input_scale[:, None])


class PiConfig(ControllerConfig):
    """The controller under PI control."""

    K: Positives = Field(description="proportional gains in scaled inputs, 1/s")
    Lambda: NonNegatives = Field(description="integral gains divided by the proportional ones, 1/s")

    def check_law(self) -> None:
        """Check that each parameter has a value for each channel."""
        for key in ("K", "Lambda"):
            require_length(key, getattr(self, key), self.outputs)

    def control_law(self) -> ControlLaw:
        """Return PI control as a control law."""
        return CONTROL_LAW

    def law_params(self) -> PiParams:
        """Return the arrays of the law."""
        return PiParams(
            np.array(self.K),
            np.array(self.Lambda),
            np.array(self.D, dtype=float),
            np.array(self.input_scale),
        )
