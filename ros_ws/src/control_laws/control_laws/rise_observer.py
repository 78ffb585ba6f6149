# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""RISE-DI with an observer: the estimates of states, wind and disturbance, from y alone, correct the trim input.

This is an extension of the paper, like the feedforward: it adds to the trim input and does not change the law.
"""

from typing import NamedTuple

import numpy as np

from control_laws import rise_di
from control_laws.nominal_model import NominalModel
from control_laws.riccati import diagonals, gain_of, riccati, zero_order_hold
from control_laws.rise_di import RiseParams
from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller import guard
from rise_di_controller import law as feedback
from rise_di_controller.control_law import ControlLaw, Measurements
from rise_di_controller.guard import Limits
from rise_di_controller.law import LawParams, LawState, Sign

LEAK = 0.01  # 1/s, decay of angles and disturbances in the observer's model: each of its modes is then observable or stable
GUST_TIME_CONSTANT = 0.6  # s, time constant of the wind in the model: the time to the peak of the 1-cosine gust, H / V0

AUTHORITY_FRACTION, RAMP_TIME = 0.6, 0.1
"""Bound of the observer's contribution to the trim, as a fraction of the limits of u, and the time from 0 to it, s. They bound
the contribution and its derivative for any measurement."""

ACTUATOR_NOISE = 1e-6  # rad or 1 per root s, noise of the actuators' positions: negligible


class ObserverParams(NamedTuple):
    """Parameters of RISE-DI, and the two gains of the observer."""

    rise: RiseParams
    gain: Array  # (m, s, N) u per estimated state
    correction: Array  # (s, m, N) of the estimate by the innovation


class ObserverState(NamedTuple):
    """State of the law and the observer from tick to tick."""

    law: LawState
    z: Array  # (s, N) predicted for the next tick
    u_o: Array  # (m, N) the observer's contribution to the trim


class ObserverModel(NamedTuple):
    """The observer's model of the deviation from the reference, z = [dx, position, wind, d], s = n + m + G + m.

    In discrete time, u held over a period: z+ = F z + G (u - u_ff), e = H z.
    """

    F: FloatArray  # (s, s)
    G: FloatArray  # (s, m)
    H: FloatArray  # (m, s)


def observer(model: NominalModel) -> ObserverModel:
    """The nominal aircraft around its reference, its actuators, wind and a disturbance of each output.

        dx_dot       = (A + gravity) dx + B position + wind_direction w + C' d
        position_dot = (u - u_ff - position) / lag,  w_dot = -w / GUST_TIME_CONSTANT,  d_dot = -LEAK d

    Angles also decay with LEAK. u_ff produces the motion along the reference: the model is that of small deviations from it.
    """
    (n, m), G = model.B.shape, model.wind.shape[1]
    s = n + m + G + m
    x, p, w, d = np.split(np.arange(s), [n, n + m, n + m + G])
    lag = np.maximum(model.lag, 1e-4)
    motion, drive = np.zeros((s, s)), np.zeros((s, m))
    motion[np.ix_(x, x)] = model.A + model.gravity - LEAK * np.diag(model.kinematic)
    motion[np.ix_(x, p)], motion[np.ix_(x, w)], motion[np.ix_(x, d)] = model.B, model.wind, model.C.T
    motion[p, p], motion[w, w], motion[d, d] = -1.0 / lag, -1.0 / GUST_TIME_CONSTANT, -LEAK
    drive[p, np.arange(m)] = 1.0 / lag
    F, G_u = zero_order_hold(motion, drive, model.period)
    H = np.zeros((m, s))
    H[:, x] = model.C
    return ObserverModel(F, G_u, H)


def observer_gains(model: NominalModel, gains: dict[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Gain (m, s, N) and correction (s, m, N), linear-quadratic, for N sets of weights.

    Control: sum of (e / size)^2 + (effort (u - u_ff) / (input_scale size))^2 with `effort` (m, N), s. Estimate: the wind driven
    by white noise of `gust` (G, N), m/s per root s; the disturbances by `drift` (m, N), sizes / s per root s; the states by
    `loose` (1, N), sizes per root s, for the model error; the noise of e as measured. Source: H. Kwakernaak,
    R. Sivan, "Linear Optimal Control Systems", ch. 5 and 6.
    """
    estimator, size, count = observer(model), (model.C @ model.size)[:, None], gains["effort"].shape[1]
    Q = np.tile(estimator.H.T @ np.diag(1.0 / size[:, 0] ** 2) @ estimator.H, (count, 1, 1))
    R = diagonals((gains["effort"] / model.input_scale[:, None] / size) ** 2)
    gain = gain_of(estimator.F, estimator.G, Q, R)
    states, positions = gains["loose"] * model.size[:, None], np.full((len(size), count), ACTUATOR_NOISE)
    process = np.concatenate([states, positions, gains["gust"], gains["drift"] * size]) ** 2 * model.period
    noise = np.tile(np.diag(model.noise**2), (count, 1, 1))
    S = riccati(estimator.F.T, estimator.H.T, diagonals(process), noise)
    correction = np.swapaxes(np.linalg.solve(estimator.H @ S @ estimator.H.T + noise, estimator.H @ S), 1, 2)
    return np.moveaxis(gain, 0, -1), np.moveaxis(correction, 0, -1)


def control_law(model: NominalModel, *, authority: float) -> ControlLaw:
    """The law's step from a trim that the observer corrects within a fraction of the limits.

        z_hat = z + correction (e - H z)
        u_o   = -gain z_hat, held inside `authority` of the limits and of their upper ones / RAMP_TIME in rate
        u     = `step_with_anti_windup` from the trim u_ff + u_o
        z+    = F z_hat + G (u - u_ff)

    Anti-windup: the observer takes u after saturation. The law takes the measured e, not the estimate.
    """
    estimator = observer(model)

    def start(measured: Measurements, params: ObserverParams) -> ObserverState:
        xp = array_namespace(measured.y)
        e = measured.y - measured.y_m
        return ObserverState(feedback.engage(measured.y, measured.y_m), estimator.H.T @ e, xp.zeros_like(e))

    def step(state: ObserverState, measured: Measurements, dt: Array, params: ObserverParams) -> tuple[ObserverState, Array]:
        xp = array_namespace(measured.y)
        limits = params.rise.limits
        innovation = measured.y - measured.y_m - estimator.H @ state.z
        z = state.z + xp.sum(params.correction * innovation[None, :, :], axis=1)
        inside = Limits(authority * limits.lower, authority * limits.upper, authority / RAMP_TIME * limits.upper)
        u_o = guard.saturate(-xp.sum(params.gain * z[None, :, :], axis=1), state.u_o, dt, inside)
        law = LawParams(*params.rise[:-1], Sign.SOFT)
        after, _, u = guard.step_with_anti_windup(
            state.law, measured.y, measured.y_m, dt, measured.u_ff + u_o, measured.u_before, law, limits
        )
        return ObserverState(after, estimator.F @ z + estimator.G @ (u - measured.u_ff), u_o), u

    return ControlLaw(start, step)


def observer_params(gains: dict[str, FloatArray], model: NominalModel) -> ObserverParams:
    """Parameters from the gains of RISE-DI, if there are any, and from effort and drift (m, N), gust (G, N), loose (1, N)."""
    none = 0.0 * gains["effort"]
    return ObserverParams(rise_di.of_gains({"K": none, "Lambda": none} | gains, model), *observer_gains(model, gains))
