# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Observer, an extension of the paper, off by default.

Its estimates of states, wind and disturbances correct the trim of a law.

It extends any control law without changing the law's own equations. Its matrices are parameters, so
nothing is solved here. See docs/theory.md.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from flight_core.arithmetic import inverse, product
from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller.law.control_law import ControlLaw, Measurements
from rise_di_controller.law.saturation import Limits, saturate


class VaneParams(NamedTuple):
    """Parameters of k vanes, which are sensors beside y that only the observer uses.

    H z predicts by how much a reading differs from the reading in the reference motion.
    """

    H: Array  # (k, s)
    # (k, s, m + 1) gains of a vane, added to L; the last column acts on the innovation of the vane
    L: Array
    # (k,) mean square of the motion of a reading below which the vane counts as frozen
    least: Array
    time: Array  # () averaging time of the motion, s


class ObserverParams(NamedTuple):
    """Parameters of the extended law and of an observer with s estimates.

    A matrix may have the N aircraft of a campaign as its last axis.

    The model of the deviation from the reference, with u held over a period, is z+ = Phi z + Gamma
    (u - u_trim), e = H z.
    """

    law: Any  # parameters of the extended law
    Phi: Array  # (s, s)
    Gamma: Array  # (s, m)
    H: Array  # (m, s)
    L: Array  # (s, m) correction of the estimates by the innovation
    F: Array  # (m, s) feedback gain, u_o = -F z
    limits: Limits  # of u_o
    fade_rate: Array  # () 1/s, inverse of the fade-in time of u_o after engagement
    vanes: VaneParams | None = None  # None: the observer of y alone


class PastTick(NamedTuple):
    """A tick of the recent record, over which a new observer runs to get its first estimates."""

    e: Array | None  # (m,); None for a tick without a y
    u: Array  # (m,) u less the trim and the feedforward of the tick
    y_m: Array  # (m,)
    dt: Array  # () length of the tick, s
    scale: Array | None = None  # (m,) factor of input_scale; None without a schedule


class ObserverState(NamedTuple):
    """State of the extended law and of the observer between two ticks."""

    law: Any
    z: Array  # (s,) estimates, predicted for the next tick
    u_o: Array  # (m,) the observer's contribution to the trim
    sigma: Array  # (1,) fade-in after engagement, 0 to 1


class VaneObserverState(NamedTuple):
    """State of an observer with vanes."""

    law: Any
    z: Array
    u_o: Array
    sigma: Array
    vane_mean: Array  # (k,) mean of the readings
    vane_square: Array  # (k,) mean square of the readings around the mean
    vane_measures: Array  # (k,) 1 for a vane in use, 0 for a still vane


def predict(z: Array, u: Array, params: ObserverParams) -> Array:
    """Predict the estimates a period later: Phi z + Gamma u, with u the deviation from u_trim."""
    return product(params.Phi, z) + product(params.Gamma, u)


def initial_estimates(e: Array, params: ObserverParams) -> Array:
    """Return the estimates at engagement, H'e: outputs at the errors, the rest at 0."""
    return product(params.H.swapaxes(0, 1), e)


def estimates_after(
    history: tuple[PastTick, ...], change: Array, filters: Sequence[ObserverParams]
) -> Array:
    """Run the filter over the last ticks, and return its estimates for the next tick.

        z = (I - Phi (I - L H))^-1 (mean(Phi L e) + mean(Gamma (u - change)))
            the steady state at the means
        z = z + L (e - H z),  z = Phi z + Gamma (u - change)                       over the ticks,
        that is z = (Phi - Phi L H) z + Phi L e + Gamma (u - change)

    This start includes the disturbances that the law has compensated so far. From z = 0 the filter
    would need longer than the record to estimate them. A tick without a y has no correction. The
    products with e and u are computed for all ticks of a filter at once, in a third of the time.
    `history` must contain at least one y. `change` is the change of the feedforward since the
    record, (m,), and `filters` has the parameters of the observer at each tick.
    """
    known = np.array([tick.e is not None for tick in history])
    e = np.array([np.zeros_like(change) if tick.e is None else tick.e for tick in history]).T
    u = np.array([tick.u - change for tick in history]).T
    tick_filters = np.array([id(params) for params in filters])
    by_e, by_u = np.zeros((2, len(filters[0].Phi), len(history)))
    steps: dict[int, tuple[Array, Array]] = {}
    for params in {id(params): params for params in filters}.values():
        ticks = tick_filters == id(params)
        gain = product(params.Phi, params.L)
        by_e[:, ticks] = product(gain, e[:, ticks])
        by_u[:, ticks] = product(params.Gamma, u[:, ticks])
        steps[id(params)] = params.Phi, params.Phi - product(gain, params.H)
    _, corrected = steps[id(filters[0])]
    z = product(
        inverse(np.eye(len(corrected)) - corrected),
        np.mean(by_e[:, known], axis=1) + np.mean(by_u, axis=1),
    )
    for place, has_y, addend in zip(tick_filters.tolist(), known, (by_e + by_u).T, strict=True):
        predicted, corrected = steps[place]
        z = product(corrected if has_y else predicted, z) + addend
    return z


def with_motion(
    state: VaneObserverState, reading: Array, dt: Array, params: VaneParams
) -> VaneObserverState:
    """Update the motion of the readings, and which vanes are in use.

        part    = min(dt / time, 1)
        mean   += part (reading - mean)
        square += part ((reading - mean)^2 - square)
        measures 1 where square > least, else 0

    A frozen vane shows only electrical noise, with a mean square below `least`. The same is true of
    a vane in calm air, where there is no wind to measure.
    """
    xp = array_namespace(reading)
    part = xp.minimum(dt / params.time, 1.0 + 0.0 * dt)
    mean = state.vane_mean + part * (reading - state.vane_mean)
    square = state.vane_square + part * ((reading - mean) ** 2 - state.vane_square)
    measures = xp.where(square > params.least, 1.0, 0.0)
    return state._replace(vane_mean=mean, vane_square=square, vane_measures=measures)


def by_vanes(
    z: Array, innovation: Array, deviation: Array, measures: Array, params: VaneParams
) -> Array:
    """Compute the correction by the vanes in use, (s,): sum of L_v [e - H z, deviation_v - H_v z].

    `innovation` is e - H z, (m,). `deviation` is the readings minus those of the reference motion,
    (k,).
    """
    xp = array_namespace(z)
    residual = deviation - product(params.H, z)
    total = 0.0 * z
    for v in range(len(params.H)):
        total = total + measures[v] * product(
            params.L[v], xp.concat([innovation, residual[v : v + 1]])
        )
    return total


def without_frozen(params: ObserverParams, frozen: Sequence[bool]) -> ObserverParams:
    """Return parameters with which frozen vanes are never used, and all others always."""
    if params.vanes is None:
        return params
    return params._replace(vanes=params.vanes._replace(least=np.where(frozen, np.inf, 0.0)))


def filter_matrix(params: ObserverParams) -> FloatArray:
    """Compute Phi (I - L H - sum of L_v [H, H_v]), (s, s), the step of z from tick to tick.

    Only vanes with a finite `least` count.
    """
    corrected = params.L @ params.H
    if params.vanes is not None:
        for row, gain, least in zip(
            params.vanes.H, params.vanes.L, params.vanes.least, strict=True
        ):
            corrected = corrected + np.isfinite(least) * (gain @ np.vstack([params.H, row]))
    return np.asarray(params.Phi @ (np.eye(len(params.Phi)) - corrected))


def correct(state: Any, measurements: Measurements, dt: Array, params: ObserverParams) -> Any:
    """Correct the estimates by the measured error, and set the contribution to the trim.

        z     = z + L (e - H z) + by_vanes
        sigma = min(1, sigma + dt fade_rate)
        u_o   = -sigma F z, inside limits of magnitude and rate

    The limits bound u_o and u_o_dot for any measurement. The fade-in makes the engagement bumpless.
    """
    e = measurements.y - measurements.y_m
    innovation = e - product(params.H, state.z)
    z = state.z + product(params.L, innovation)
    if params.vanes is not None and measurements.vane is not None:
        state = with_motion(state, measurements.vane, dt, params.vanes)
        z = z + by_vanes(
            state.z,
            innovation,
            measurements.vane - measurements.vane_m,
            state.vane_measures,
            params.vanes,
        )
    sigma = array_namespace(e).minimum(state.sigma + dt * params.fade_rate, 1.0 + 0.0 * state.sigma)
    u_o = saturate(-sigma * product(params.F, z), state.u_o, dt, params.limits)
    return state._replace(z=z, u_o=u_o, sigma=sigma)


def _at_engagement(
    law_state: Any, measurements: Measurements, params: ObserverParams, *, vanes: bool
) -> Any:
    """Return the state at engagement: estimates from the first e, u_o = 0."""
    e = measurements.y - measurements.y_m
    zero = array_namespace(e).zeros_like(e)
    state = ObserverState(law_state, initial_estimates(e, params), zero, zero[:1])
    if not vanes or measurements.vane is None:
        return state
    none = 0.0 * measurements.vane
    return VaneObserverState(*state, measurements.vane, none, none)


@lru_cache(maxsize=64)
def with_observer(law: ControlLaw, *, vanes: bool = False) -> ControlLaw:
    """Extend a control law so that it starts from the trim u_trim + u_o.

    The observer also takes u after saturation (anti-windup) and the readings of the vanes.

        u_o by `correct`
        u   = law(y, y_m) from the trim u_trim + u_o
        z   = Phi z + Gamma (u - u_trim)        for the next tick, and again per missed tick

    The law takes the measured e, not the estimate.
    """

    def corrected(
        state: Any, measurements: Measurements, dt: Array, params: ObserverParams
    ) -> tuple[Any, Measurements]:
        state = correct(state, measurements, dt, params)
        return state, measurements._replace(u_trim=measurements.u_trim + state.u_o)

    def predicted(
        state: Any, law_state: Any, u: Array, measurements: Measurements, params: ObserverParams
    ) -> Any:
        return state._replace(law=law_state, z=predict(state.z, u - measurements.u_trim, params))

    def engage(measurements: Measurements, params: ObserverParams) -> Any:
        return _at_engagement(
            law.engage(measurements, params.law), measurements, params, vanes=vanes
        )

    def step(
        state: Any, measurements: Measurements, dt: Array, params: ObserverParams
    ) -> tuple[Any, Array]:
        state, inner = corrected(state, measurements, dt, params)
        law_state, u = law.step(state.law, inner, dt, params.law)
        return predicted(state, law_state, u, measurements, params), u

    def limited(
        state: Any, measurements: Measurements, dt: Array, params: ObserverParams, limits: Limits
    ) -> tuple[Any, Array, Array]:
        state, inner = corrected(state, measurements, dt, params)
        law_state, u_free, u = law.limited(state.law, inner, dt, params.law, limits)
        return predicted(state, law_state, u, measurements, params), u_free, u

    def retune(state: Any, old: ObserverParams, new: ObserverParams) -> Any:
        return state._replace(law=law.retune(state.law, old.law, new.law))

    def missed(state: Any, measurements: Measurements, params: ObserverParams) -> Any:
        law_state = law.missed(state.law, measurements, params.law)
        return predicted(state, law_state, measurements.u_before, measurements, params)

    return ControlLaw(
        state=VaneObserverState if vanes else ObserverState,
        engage=engage,
        step=step,
        limited=limited,
        retune=retune,
        missed=missed,
        inner=law,
    )
