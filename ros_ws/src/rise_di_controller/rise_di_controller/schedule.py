# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Schedule of input_scale over dynamic pressure, an extension of the paper, off by default.

A control surface answers with the dynamic pressure: Omega grows with V^2, and the delay margin of fixed gains falls as much.
The schedule keeps Omega input_scale near the value of the trim. The schedule extends a law with the parameter input_scale; the
law's own equations do not change.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

from flight_core.vectors import Array, array_namespace
from rise_di_controller.control_law import ControlLaw, Measurements
from rise_di_controller.saturation import Limits

SCALE_RANGE = (0.3, 3.0)
"""Least and largest factor of input_scale: from 1.83 to 0.58 of the trim speed."""


class ScheduleParams(NamedTuple):
    """Parameters of the extended law and of the schedule over m channels."""

    law: Any  # parameters of the extended law
    speed: Array  # () trim speed V0, m/s
    airspeed: Array  # (m,) 1 for the output V, else 0
    time: Array  # () time constant, s


class ScheduleState(NamedTuple):
    """State of the extended law and of the schedule between two ticks."""

    law: Any
    scale: Array  # (m,) factor of input_scale


def airspeed_range(params: ScheduleParams) -> tuple[Array, Array]:
    """Airspeeds where the factor is the largest and the least of SCALE_RANGE, m/s."""
    return params.speed / math.sqrt(SCALE_RANGE[1]), params.speed / math.sqrt(SCALE_RANGE[0])


def target_scale(y: Array, params: ScheduleParams) -> Array:
    """Factor of input_scale at the airspeed V0 + V of y, shape (m,): (V0 / (V0 + V))^2 within SCALE_RANGE; 1 in channel V.

    A ratio of dynamic pressures at equal density: for V in y as equivalent airspeed at any altitude, for true airspeed
    near the altitude of the trim. A thrust does not follow the ratio.
    """
    xp = array_namespace(y)
    least, largest = airspeed_range(params)
    V = params.speed + (params.airspeed * y).sum(axis=0)
    ratio = params.speed / xp.minimum(xp.maximum(V, least + 0.0 * V), largest + 0.0 * V)
    return params.airspeed + (1.0 - params.airspeed) * (ratio * ratio)


@lru_cache(maxsize=64)
def with_schedule(law: ControlLaw) -> ControlLaw:
    """A control law with input_scale scheduled over the dynamic pressure:

        scale += min(dt / time, 1) (target_scale(y) - scale)
        the law is retuned to input_scale scale (bumpless transfer), then takes the step

    The retuning keeps u: the schedule acts on u_dot alone. Engagement starts at target_scale(y).
    """  # noqa: D400, D415 - what follows is an equation

    def at(params: ScheduleParams, scale: Array) -> Any:
        return params.law._replace(input_scale=params.law.input_scale * scale)

    def followed(state: ScheduleState, y: Array, dt: Array, params: ScheduleParams) -> ScheduleState:
        xp = array_namespace(y)
        part = xp.minimum(dt / params.time, 1.0 + 0.0 * dt)
        scale = state.scale + part * (target_scale(y, params) - state.scale)
        return ScheduleState(law.retune(state.law, at(params, state.scale), at(params, scale)), scale)

    def engage(measured: Measurements, params: ScheduleParams) -> ScheduleState:
        scale = target_scale(measured.y, params)
        return ScheduleState(law.engage(measured, at(params, scale)), scale)

    def step(state: ScheduleState, measured: Measurements, dt: Array, params: ScheduleParams) -> tuple[ScheduleState, Array]:
        state = followed(state, measured.y, dt, params)
        of_law, u = law.step(state.law, measured, dt, at(params, state.scale))
        return state._replace(law=of_law), u

    def limited(
        state: ScheduleState, measured: Measurements, dt: Array, params: ScheduleParams, limits: Limits
    ) -> tuple[ScheduleState, Array, Array]:
        state = followed(state, measured.y, dt, params)
        of_law, u_free, u = law.limited(state.law, measured, dt, at(params, state.scale), limits)
        return state._replace(law=of_law), u_free, u

    def retune(state: ScheduleState, old: ScheduleParams, new: ScheduleParams) -> ScheduleState:
        return state._replace(law=law.retune(state.law, at(old, state.scale), at(new, state.scale)))

    def missed(state: ScheduleState, measured: Measurements, params: ScheduleParams) -> ScheduleState:
        return state._replace(law=law.missed(state.law, measured, at(params, state.scale)))

    return ControlLaw(ScheduleState, engage, step, limited, retune, missed, inner=law)
