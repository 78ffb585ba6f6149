# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Schedule input_scale over dynamic pressure, an extension of the paper, off by default.

The response to a control surface grows with the dynamic pressure. So Omega grows with V^2, and with
fixed gains the delay margin shrinks as V grows. The schedule keeps Omega input_scale near its value
at trim. It works with any law that has the parameter input_scale, and leaves the equations of the
law as they are. A feedforward and an observer also use models for the present airspeed.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller.extensions.feedforward import Nominal
from rise_di_controller.extensions.observer import ObserverParams
from rise_di_controller.law.control_law import ControlLaw, Measurements
from rise_di_controller.law.saturation import Limits

SCALE_RANGE = (0.3, 3.0)
"""Least and largest factor of input_scale, reached at 1.83 and 0.58 of the trim speed."""

TORQUE_SPEEDS = (0.6, 1.6)
"""Airspeeds as fractions of the trim speed. The torque that an exported module gives for a u
follows the dynamic pressure only between these airspeeds, which lie within the
airspeeds of SCALE_RANGE."""

# Number of steps of the model per unit of V / V0. At 25 m/s the model changes every 0.2 m/s, so
# that most ticks find their model in the cache.
STEPS = 128


class OverSpeed(NamedTuple):
    """A model that depends on the airspeed V, by d = V / V0 - 1 between `least` and `most`."""

    model: Callable[[float], Any]  # the model at d, a multiple of 1 / STEPS
    least: float
    most: float
    is_airspeed: FloatArray  # 1 for the output V, else 0, (m,)

    def at_scale(self, scale: FloatArray) -> Any:
        """Return the model at the airspeed that belongs to given factors of input_scale, (m,).

        The factors `scale` are (V0 / V)^2 in every channel except V.
        """
        d = 1.0 / math.sqrt(((1.0 - self.is_airspeed) * scale).max()) - 1.0
        return self.model(round(min(max(d, self.least), self.most) * STEPS) / STEPS)

    def at_scales(self, scales: FloatArray) -> list[Any]:
        """Return the models of T ticks, given the factors of input_scale at each tick, (T, m)."""
        d = 1.0 / np.sqrt(((1.0 - self.is_airspeed) * scales).max(axis=1)) - 1.0
        return [
            self.model(place)
            for place in (np.round(np.clip(d, self.least, self.most) * STEPS) / STEPS).tolist()
        ]


def over_speed(
    ratios: tuple[float, float],
    values: tuple[FloatArray, FloatArray, FloatArray],
    is_airspeed: FloatArray,
    model: Callable[[FloatArray, FloatArray], Any],
) -> OverSpeed:
    """Interpolate a model over the airspeed, as trim + d (slope + d curvature), d = V / V0 - 1.

    `values` has three stacks of the matrices of the model: at the trim speed, at a lower and at a
    higher airspeed. `ratios` are these two airspeeds divided by the trim speed. Matrices that turn
    y_dot into u, such as F of an observer or the inverse of Omega, are divided by the factor of
    input_scale at their airspeed before they are stacked. `model` builds the model from a stack and
    the factors of input_scale, (m,).
    """
    trim, slow, fast = values
    least, most = (ratio - 1.0 for ratio in ratios)
    curvature = ((fast - trim) / most - (slow - trim) / least) / (most - least)
    slope = (slow - trim) / least - least * curvature

    @lru_cache(maxsize=512)
    def model_at(d: float) -> Any:
        return model(
            trim + d * (slope + d * curvature), is_airspeed + (1.0 - is_airspeed) / (1.0 + d) ** 2
        )

    return OverSpeed(model_at, least, most, is_airspeed)


class ScheduleParams(NamedTuple):
    """Parameters of the extended law and of the schedule over m channels."""

    law: Any  # parameters of the extended law
    speed: Array  # trim speed V0, m/s, ()
    is_airspeed: Array  # 1 for the output V, else 0, (m,)
    time: Array  # time constant with which the factor follows the airspeed, s, ()
    # ObserverParams as a function of the airspeed; None without an observer
    observer: OverSpeed | None = None


class ScheduleState(NamedTuple):
    """State of the extended law and of the schedule between two ticks."""

    law: Any
    scale: Array  # factor of input_scale, (m,)


def airspeed_range(params: ScheduleParams) -> tuple[Array, Array]:
    """Return the airspeeds, m/s, between which the factor of input_scale follows the airspeed.

    The factor is limited to SCALE_RANGE. The first airspeed has the largest factor, the second one
    the least.
    """
    return params.speed / math.sqrt(SCALE_RANGE[1]), params.speed / math.sqrt(SCALE_RANGE[0])


def target_scale(y: Array, params: ScheduleParams) -> Array:
    """Compute the factor of input_scale, shape (m,), at the airspeed V0 + V with V from y.

    The factor is (V0 / (V0 + V))^2 within SCALE_RANGE, and 1 in channel V.

    It is a ratio of dynamic pressures at equal density. If V in y is equivalent airspeed, this
    ratio holds at any altitude. If V is true airspeed, it holds near the altitude of the trim.
    Thrust does not follow the ratio.
    """
    xp = array_namespace(y)
    least, largest = airspeed_range(params)
    V = params.speed + (params.is_airspeed * y).sum(axis=0)
    ratio = params.speed / xp.minimum(xp.maximum(V, least + 0.0 * V), largest + 0.0 * V)
    return params.is_airspeed + (1.0 - params.is_airspeed) * (ratio * ratio)


def side_by_side(params: ObserverParams, scale: FloatArray) -> FloatArray:
    """Stack Phi, Gamma, L and (F / `scale`)' of an observer side by side, (s, s + 3 m)."""
    return np.hstack([params.Phi, params.Gamma, params.L, (params.F / scale[:, None]).T])


def observer_of(
    observer: ObserverParams, matrices: FloatArray, scale: FloatArray
) -> ObserverParams:
    """Return the observer with the matrices that `side_by_side` stacked with this `scale`."""
    s, m = observer.Gamma.shape
    F = np.ascontiguousarray(matrices[:, s + 2 * m :].T) * scale[:, None]
    return observer._replace(
        Phi=matrices[:, :s], Gamma=matrices[:, s : s + m], L=matrices[:, s + m : s + 2 * m], F=F
    )


def nominal_side_by_side(nominal: Nominal, scale: FloatArray) -> FloatArray:
    """Stack the matrices of a feedforward side by side, with Omega^-1 divided by `scale`.

    The result is [A, gravity, B, path A, path gravity, inverse'], where inverse' has zeros in the
    rows from m to n.
    """
    n, m = nominal.B.shape
    inverse = np.zeros((n, m))
    inverse[:m] = (nominal.inverse / scale[:, None]).T
    return np.hstack(
        [nominal.A, nominal.gravity, nominal.B, nominal.path_A, nominal.path_gravity, inverse]
    )


def nominal_of(nominal: Nominal, matrices: FloatArray, scale: FloatArray) -> Nominal:
    """Return the model with the matrices that `nominal_side_by_side` stacked with this `scale`."""
    n, m = nominal.B.shape
    ends = (0, n, 2 * n, 2 * n + m, 3 * n + m, 4 * n + m, 4 * n + 2 * m)
    A, gravity, B, path_A, path_gravity, inverse = (
        matrices[:, first:last] for first, last in pairwise(ends)
    )
    inverse = inverse[:m].T * scale[:, None]
    return nominal._replace(
        A=A, gravity=gravity, B=B, path_A=path_A, path_gravity=path_gravity, inverse=inverse
    )


def law_at(params: ScheduleParams, scale: Array) -> Any:
    """Return the parameters of the extended law at the airspeed that belongs to `scale`.

    input_scale is multiplied by `scale`, the factors of input_scale, (m,). An observer gets the
    model of that airspeed.
    """
    return _scaled(
        params.law if params.observer is None else params.observer.at_scale(scale), scale
    )


def _scaled(params: Any, scale: Array) -> Any:
    """Multiply input_scale of the extended law by `scale`."""
    if isinstance(params, ObserverParams):
        return params._replace(law=_scaled(params.law, scale))
    return params._replace(input_scale=params.input_scale * scale)


def observers_of(params: Any, scales: Sequence[Array | None]) -> list[ObserverParams]:
    """Return the parameters of the observer at each of several ticks.

    `scales` has the factors of input_scale at each tick, or None without a schedule.
    """
    if not isinstance(params, ScheduleParams):
        return [params] * len(scales)
    if params.observer is None:
        return [params.law] * len(scales)
    return params.observer.at_scales(np.array(scales))


@lru_cache(maxsize=64)
def with_schedule(law: ControlLaw) -> ControlLaw:
    """Extend a control law by scheduling its input_scale over the dynamic pressure.

        scale += min(dt / time, 1) (target_scale(y) - scale)
        the law is retuned to `scale` times input_scale (bumpless transfer), then takes the step

    The retuning keeps u, so the schedule acts only on u_dot. At engagement scale = target_scale(y).
    An observer keeps its estimates, because they mean the same at every speed, and its output u_o
    moves to the new -F z at the rate limit of u_o.
    """

    def followed(
        state: ScheduleState, y: Array, dt: Array, params: ScheduleParams
    ) -> ScheduleState:
        xp = array_namespace(y)
        part = xp.minimum(dt / params.time, 1.0 + 0.0 * dt)
        scale = state.scale + part * (target_scale(y, params) - state.scale)
        return ScheduleState(
            law.retune(state.law, _scaled(params.law, state.scale), _scaled(params.law, scale)),
            scale,
        )

    def engage(measurements: Measurements, params: ScheduleParams) -> ScheduleState:
        scale = target_scale(measurements.y, params)
        return ScheduleState(law.engage(measurements, law_at(params, scale)), scale)

    def step(
        state: ScheduleState, measurements: Measurements, dt: Array, params: ScheduleParams
    ) -> tuple[ScheduleState, Array]:
        state = followed(state, measurements.y, dt, params)
        law_state, u = law.step(state.law, measurements, dt, law_at(params, state.scale))
        return state._replace(law=law_state), u

    def limited(
        state: ScheduleState,
        measurements: Measurements,
        dt: Array,
        params: ScheduleParams,
        limits: Limits,
    ) -> tuple[ScheduleState, Array, Array]:
        state = followed(state, measurements.y, dt, params)
        law_state, u_free, u = law.limited(
            state.law, measurements, dt, law_at(params, state.scale), limits
        )
        return state._replace(law=law_state), u_free, u

    def retune(state: ScheduleState, old: ScheduleParams, new: ScheduleParams) -> ScheduleState:
        return state._replace(
            law=law.retune(state.law, _scaled(old.law, state.scale), _scaled(new.law, state.scale))
        )

    def missed(
        state: ScheduleState, measurements: Measurements, params: ScheduleParams
    ) -> ScheduleState:
        return state._replace(law=law.missed(state.law, measurements, law_at(params, state.scale)))

    return ControlLaw(
        state=ScheduleState,
        engage=engage,
        step=step,
        limited=limited,
        retune=retune,
        missed=missed,
        inner=law,
    )
