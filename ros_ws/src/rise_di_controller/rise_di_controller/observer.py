# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Observer, an extension of the paper, off by default: estimates of states, wind and disturbances correct the trim of a law.

The observer extends any control law: the law's own equations do not change. The matrices are parameters, so nothing is solved
here. See docs/theory.md.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from flight_core.arithmetic import inverse, product
from flight_core.vectors import Array, array_namespace
from rise_di_controller.control_law import ControlLaw, Measurements
from rise_di_controller.saturation import Limits, saturate


class ObserverParams(NamedTuple):
    """Parameters of the extended law and of the observer, s estimates; a matrix may have the N aircraft as the last axis.

    The model of the deviation from the reference, u held over a period: z+ = Phi z + Gamma (u - u_trim), e = H z.
    """

    law: Any  # parameters of the extended law
    Phi: Array  # (s, s)
    Gamma: Array  # (s, m)
    H: Array  # (m, s)
    L: Array  # (s, m) correction of the estimates by the innovation
    F: Array  # (m, s) u per estimate
    limits: Limits  # of u_o
    fade_rate: Array  # () 1/s, inverse of the fade-in time of u_o after engagement


class PastTick(NamedTuple):
    """A tick in the record from which a new observer starts."""

    e: Array | None  # (m,); None for a tick without a y
    u: Array  # (m,) u less the trim and the feedforward of the tick
    y_m: Array  # (m,)
    dt: Array  # () length of the tick, s


class ObserverState(NamedTuple):
    """State of the extended law and of the observer between two ticks."""

    law: Any
    z: Array  # (s,) estimates, predicted for the next tick
    u_o: Array  # (m,) the observer's contribution to the trim
    sigma: Array  # (1,) fade-in after engagement, 0 to 1


def predict(z: Array, u: Array, params: ObserverParams) -> Array:
    """Estimates a period later: Phi z + Gamma u, with u the deviation from u_trim."""
    return product(params.Phi, z) + product(params.Gamma, u)


def initial_estimates(e: Array, params: ObserverParams) -> Array:
    """Estimates at engagement: H'e, the outputs at the errors and the rest 0."""
    return product(params.H.swapaxes(0, 1), e)


def estimates_after(history: tuple[PastTick, ...], change: Array, params: ObserverParams) -> Array:
    """Estimates of the filter over the last ticks, predicted for the next tick.

        z = (I - Phi (I - L H))^-1 (Phi L mean(e) + Gamma mean(u - change))        its steady state at the means
        z = z + L (e - H z),  z = Phi z + Gamma (u - change)                       over the ticks,
        that is z = (Phi - Phi L H) z + Phi L e + Gamma (u - change)

    So the filter knows what the law held, which takes longer than the record to estimate. A tick without a y has no
    correction. The products with e and u are those of all ticks together, which takes a third of the time. Arguments: `history`
    with a y at least; `change` of the feedforward since then, (m,).
    """
    known = np.array([tick.e is not None for tick in history])
    e = np.array([np.zeros_like(change) if tick.e is None else tick.e for tick in history]).T
    u = np.array([tick.u - change for tick in history]).T
    gain = product(params.Phi, params.L)
    by_e, by_u = product(gain, e), product(params.Gamma, u)
    corrected = params.Phi - product(gain, params.H)
    z = product(inverse(np.eye(len(corrected)) - corrected), np.mean(by_e[:, known], axis=1) + np.mean(by_u, axis=1))
    for has_y, addend in zip(known, (by_e + by_u).T, strict=True):
        z = product(corrected if has_y else params.Phi, z) + addend
    return z


def correct(state: ObserverState, e: Array, dt: Array, params: ObserverParams) -> ObserverState:
    """Correction by the measured error, and the contribution to the trim.

        z     = z + L (e - H z)
        sigma = min(1, sigma + dt fade_rate)
        u_o   = -sigma F z, inside limits of magnitude and rate

    The limits bound u_o and u_o_dot for any measurement. The fade-in makes the engagement bumpless.
    """
    z = state.z + product(params.L, e - product(params.H, state.z))
    sigma = array_namespace(e).minimum(state.sigma + dt * params.fade_rate, 1.0 + 0.0 * state.sigma)
    u_o = saturate(-sigma * product(params.F, z), state.u_o, dt, params.limits)
    return ObserverState(state.law, z, u_o, sigma)


@lru_cache(maxsize=64)
def with_observer(law: ControlLaw) -> ControlLaw:
    """A control law from the trim u_trim + u_o; the observer takes u after saturation (anti-windup).

        u_o by `correct`
        u   = law(y, y_m) from the trim u_trim + u_o
        z  += Phi z + Gamma (u - u_trim)        for the next tick, and again per missed tick

    The law takes the measured e, not the estimate.
    """

    def corrected(
        state: ObserverState, measured: Measurements, dt: Array, params: ObserverParams
    ) -> tuple[ObserverState, Measurements]:
        state = correct(state, measured.y - measured.y_m, dt, params)
        return state, measured._replace(u_trim=measured.u_trim + state.u_o)

    def predicted(state: ObserverState, of_law: Any, u: Array, measured: Measurements, params: ObserverParams) -> ObserverState:
        return ObserverState(of_law, predict(state.z, u - measured.u_trim, params), state.u_o, state.sigma)

    def engage(measured: Measurements, params: ObserverParams) -> ObserverState:
        xp = array_namespace(measured.y)
        e = measured.y - measured.y_m
        zero = xp.zeros_like(e)
        return ObserverState(law.engage(measured, params.law), initial_estimates(e, params), zero, zero[:1])

    def step(state: ObserverState, measured: Measurements, dt: Array, params: ObserverParams) -> tuple[ObserverState, Array]:
        state, inner = corrected(state, measured, dt, params)
        of_law, u = law.step(state.law, inner, dt, params.law)
        return predicted(state, of_law, u, measured, params), u

    def limited(
        state: ObserverState, measured: Measurements, dt: Array, params: ObserverParams, limits: Limits
    ) -> tuple[ObserverState, Array, Array]:
        state, inner = corrected(state, measured, dt, params)
        of_law, u_free, u = law.limited(state.law, inner, dt, params.law, limits)
        return predicted(state, of_law, u, measured, params), u_free, u

    def retune(state: ObserverState, old: ObserverParams, new: ObserverParams) -> ObserverState:
        return state._replace(law=law.retune(state.law, old.law, new.law))

    def missed(state: ObserverState, measured: Measurements, params: ObserverParams) -> ObserverState:
        of_law = law.missed(state.law, measured, params.law)
        return predicted(state, of_law, measured.u_before, measured, params)

    return ControlLaw(ObserverState, engage, step, limited, retune, missed, inner=law)
