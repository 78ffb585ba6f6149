# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""PID control of each output, with a filtered derivative.

It is an example of a control law in a package of its own.
"""

from typing import NamedTuple

import numpy as np

from rise_di import (
    Array,
    ControlLaw,
    ControllerConfig,
    Field,
    Limits,
    Measurements,
    NonNegatives,
    Positives,
    array_namespace,
    limited_integral,
    require_length,
    saturate,
    without_limits,
)


class PidParams(NamedTuple):
    """Parameters over m channels, (m,)."""

    K: Array  # 1/s
    Lambda: Array  # 1/s
    lead: Array  # derivative time, s
    filter_time: Array  # of the derivative, s
    D: Array  # +1 or -1
    input_scale: Array  # u per scaled input


class PidState(NamedTuple):
    """State of the law between two ticks, (m,): what the log holds."""

    e_0: Array  # e at engagement, changed by a retuning
    e: Array
    e_dot: Array  # filtered
    integral_e: Array


def u_from_trim(state: PidState, params: PidParams) -> Array:
    """Compute the deviation of u from trim, shape (m,).

    It is -input_scale D K (e - e_0 + Lambda integral of e + lead e_dot).
    """
    terms = state.e - state.e_0 + params.Lambda * state.integral_e + params.lead * state.e_dot
    return -params.input_scale * params.D * params.K * terms


def engage(measurements: Measurements, params: PidParams) -> PidState:
    """Return the state at engagement: u = u_trim, however large e is (bumpless transfer)."""
    e = measurements.y - measurements.y_m
    zero = array_namespace(e).zeros_like(e)
    return PidState(e, e, zero, zero)


def limited(
    state: PidState, measurements: Measurements, dt: Array, params: PidParams, limits: Limits
) -> tuple[PidState, Array, Array]:
    """Compute a tick inside the limits: u = u_trim + u_from_trim.

    e_dot      += (1 - exp(-dt / filter_time)) ((e - e_p) / dt - e_dot)
    integral_e += dt (e + e_p) / 2, or less of it where u is saturated and would move further
    outwards (anti-windup)
    """
    e = measurements.y - measurements.y_m
    share = -array_namespace(e).expm1(-dt / params.filter_time)
    e_dot = state.e_dot + share * ((e - state.e) / dt - state.e_dot)
    after = PidState(state.e_0, e, e_dot, state.integral_e + dt * (e + state.e) / 2.0)
    u_free = measurements.u_trim + u_from_trim(after, params)
    beyond = u_free - saturate(u_free, measurements.u_before, dt, limits)
    change = (
        -params.input_scale
        * params.D
        * params.K
        * params.Lambda
        * (after.integral_e - state.integral_e)
    )
    after = after._replace(
        integral_e=limited_integral(state.integral_e, after.integral_e, change, beyond)
    )
    u_free = measurements.u_trim + u_from_trim(after, params)
    return after, u_free, saturate(u_free, measurements.u_before, dt, limits)


def retune(state: PidState, old: PidParams, new: PidParams) -> PidState:
    """Keep u under new parameters: e_0 takes the difference (bumpless transfer)."""
    terms = -new.D * u_from_trim(state, old) / (new.input_scale * new.K)
    return state._replace(
        e_0=state.e + new.Lambda * state.integral_e + new.lead * state.e_dot - terms
    )


CONTROL_LAW = ControlLaw(
    state=PidState,
    engage=engage,
    step=without_limits(limited),
    limited=limited,
    retune=retune,
)


class PidConfig(ControllerConfig):
    """The controller under PID control.

    It has the parameters of a scenario's section beside those of every law.
    """

    K: Positives = Field(description="proportional gains in scaled inputs, 1/s")
    Lambda: NonNegatives = Field(description="integral gains over proportional ones, 1/s")
    lead: NonNegatives = Field(description="derivative gains over proportional ones, s")
    filter_time: Positives = Field(
        description="time constants of the filters of the derivatives, s"
    )

    def check_law(self) -> None:
        """Require one value for each channel."""
        for key in ("K", "Lambda", "lead", "filter_time"):
            require_length(key, getattr(self, key), self.outputs)

    def control_law(self) -> ControlLaw:
        """Return the functions of PID control."""
        return CONTROL_LAW

    def law_params(self) -> PidParams:
        """Return the arrays of the law."""
        return PidParams(
            K=np.array(self.K),
            Lambda=np.array(self.Lambda),
            lead=np.array(self.lead),
            filter_time=np.array(self.filter_time),
            D=np.array(self.D, dtype=np.float64),
            input_scale=np.array(self.input_scale),
        )
