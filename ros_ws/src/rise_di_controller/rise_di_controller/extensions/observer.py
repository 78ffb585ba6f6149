# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Extend a control law by an observer, an extension of the paper, off by default.

The observer estimates states, wind and disturbances, and corrects the trim of the law. It works
with any control law, and leaves the equations of the law as they are. Its matrices are parameters
that come from a finished design, so nothing is solved here. See docs/theory.md.
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

    A reading differs from what the vane would read in the reference motion. H z predicts this
    difference, where z has the s estimates.
    """

    H: Array  # (k, s)
    # gains that a vane adds to L, (k, s, m + 1); the last column acts on the innovation of the vane
    L: Array
    # mean square of a reading's motion below which the vane counts as frozen, (k,)
    least: Array
    time: Array  # averaging time of the motion, s, ()


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
    L: Array  # correction of the estimates by the innovation, (s, m)
    F: Array  # feedback gain of u_o = -F z, (m, s)
    limits: Limits  # limits of u_o
    fade_rate: Array  # inverse of the fade-in time of u_o after engagement, 1/s, ()
    vanes: VaneParams | None = None  # None if the observer uses y alone


class PastTick(NamedTuple):
    """A past tick. A new observer runs over the past ticks to get its first estimates."""

    e: Array | None  # error, (m,), or None for a tick without a y
    u: Array  # u less the trim and the feedforward of the tick, (m,)
    y_m: Array  # (m,)
    dt: Array  # length of the tick, s, ()
    scale: Array | None = None  # factor of input_scale, (m,); None without a schedule


class ObserverState(NamedTuple):
    """State of the extended law and of the observer between two ticks."""

    law: Any
    z: Array  # estimates, predicted for the next tick, (s,)
    u_o: Array  # the observer's contribution to the trim, (m,)
    sigma: Array  # fade-in after engagement, 0 to 1, (1,)


class VaneObserverState(NamedTuple):
    """State of an observer with vanes."""

    law: Any
    z: Array
    u_o: Array
    sigma: Array
    vane_mean: Array  # mean of the readings, (k,)
    vane_square: Array  # mean square of the readings around their mean, (k,)
    vane_measures: Array  # 1 for a vane in use, 0 for a still vane, (k,)


def predict(z: Array, u: Array, params: ObserverParams) -> Array:
    """Predict the estimates one period ahead: Phi z + Gamma u, with u the deviation from u_trim."""
    return product(params.Phi, z) + product(params.Gamma, u)


def initial_estimates(e: Array, params: ObserverParams) -> Array:
    """Return the estimates at engagement, H'e: outputs at the errors, and all others at 0."""
    return product(params.H.swapaxes(0, 1), e)


def estimates_after(
    history: tuple[PastTick, ...], change: Array, filters: Sequence[ObserverParams]
) -> Array:
    """Run the observer over the last ticks, and return its estimates for the next tick.

        z = (I - Phi (I - L H))^-1 (mean(Phi L e) + mean(Gamma (u - change)))
            the steady state at the means
        z = z + L (e - H z),  z = Phi z + Gamma (u - change)                       over the ticks,
        that is z = (Phi - Phi L H) z + Phi L e + Gamma (u - change)

    The start at the steady state includes the disturbances that the law has compensated so far.
    From z = 0 the observer would need longer than the record to estimate them. A tick without a y
    has no correction. The products with e and u are computed at once for all ticks that have the
    same parameters, which takes a third of the time.

    `history` has the past ticks. At least one of them must have a y. `change`, (m,), is the change
    of the feedforward since these ticks. `filters` has the parameters of the observer at each tick.
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
    """Update how much the readings of the vanes move, and which vanes are in use.

        part    = min(dt / time, 1)
        mean   += part (reading - mean)
        square += part ((reading - mean)^2 - square)
        measures 1 where square > least, else 0

    A frozen vane shows only electrical noise, with a mean square below `least`. A vane in calm air
    shows no more, but then there is no wind to measure.
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
    """Compute how the vanes in use correct the estimates, (s,).

    The correction is the sum over v of L_v [e - H z, deviation_v - H_v z]. `innovation` is e - H z,
    (m,). `deviation` has the readings minus the readings in the reference motion, (k,).
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
    """Return parameters in which the frozen vanes are never used, and all other vanes always."""
    if params.vanes is None:
        return params
    return params._replace(vanes=params.vanes._replace(least=np.where(frozen, np.inf, 0.0)))


def filter_matrix(params: ObserverParams) -> FloatArray:
    """Compute the matrix that advances the estimates z from tick to tick, (s, s).

    It is Phi (I - L H - sum of L_v [H, H_v]). Vanes without a finite `least` are left out.
    """
    corrected = params.L @ params.H
    if params.vanes is not None:
        for row, gain, least in zip(
            params.vanes.H, params.vanes.L, params.vanes.least, strict=True
        ):
            corrected = corrected + np.isfinite(least) * (gain @ np.vstack([params.H, row]))
    return np.asarray(params.Phi @ (np.eye(len(params.Phi)) - corrected))


def correct(state: Any, measurements: Measurements, dt: Array, params: ObserverParams) -> Any:
    """Correct the estimates by the measured error, and compute what the observer adds to the trim.

        z     = z + L (e - H z) + by_vanes
        sigma = min(1, sigma + dt fade_rate)
        u_o   = -sigma F z, inside limits of magnitude and rate

    Whatever is measured, u_o and u_o_dot stay inside these limits. sigma rises from 0 after the
    engagement, so that u does not jump there.
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
    """Return the state at engagement, with u_o = 0 and estimates from the first e.

    With `vanes`, the state has the motion of the vanes as well.
    """
    e = measurements.y - measurements.y_m
    zero = array_namespace(e).zeros_like(e)
    state = ObserverState(law_state, initial_estimates(e, params), zero, zero[:1])
    if not vanes or measurements.vane is None:
        return state
    none = 0.0 * measurements.vane
    return VaneObserverState(*state, measurements.vane, none, none)


@lru_cache(maxsize=64)
def with_observer(law: ControlLaw, *, vanes: bool = False) -> ControlLaw:
    """Extend a control law by an observer, which moves the trim of the law from u_trim by u_o.

    The observer predicts z with u after saturation, so that its disturbance estimates do not wind
    up:

        u_o by `correct`
        u   = law(y, y_m) from the trim u_trim + u_o
        z   = Phi z + Gamma (u - u_trim) for the next tick, and again for each missed tick

    The law takes the measured e, not the estimate. With `vanes`, the observer also uses the
    readings of the vanes.
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
