# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement LQI, which is model following by linear-quadratic design with integral action.

The law takes y_m and the full state x, or x_air with vanes.
"""

from typing import NamedTuple

import numpy as np

from control_laws.nominal_model import (
    ErrorIntegral,
    NominalModel,
    campaign_law,
    conditional_integration,
    saturate_with_excess,
    start_integral,
    state_of,
)
from control_laws.riccati import gain_of
from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller.law.control_law import ControlLaw, Measurements
from rise_di_controller.law.linear_loop import zero_order_hold
from rise_di_controller.law.saturation import Limits
from rise_di_controller.params import ControllerConfig

LEAK = 0.01
"""Decay of the angles and of y_m in the design model, 1/s. The design needs it, because every mode
that the inputs do not control, or that the cost does not contain, must be stable."""


class LqiParams(NamedTuple):
    """The gain of LQI on z = [x, y_m, y_m_dot, integral of e], for N sets of weights."""

    gain: Array  # (m, n + 3 m, 1) or (m, n + 3 m, N)


def control_law(_: NominalModel, *, vanes: bool) -> ControlLaw:
    """Return the law u = u_trim - gain [x, y_m, y_m_dot, integral of e].

    With `vanes`, x is relative to the air. The integral uses the trapezoidal rule. Anti-windup is
    conditional integration: while u_i is saturated, the integral of channel i stays the same if its
    increment would move u_i further beyond the limit.
    """

    def limited(
        state: ErrorIntegral,
        measurements: Measurements,
        dt: Array,
        params: LqiParams,
        limits: Limits,
    ) -> tuple[ErrorIntegral, Array, Array]:
        xp = array_namespace(measurements.y)
        e = measurements.y - measurements.y_m
        increment = dt * (e + state.e) / 2.0
        integral_e = state.integral_e + increment
        # Adding this gives y_m and y_m_dot a column for each aircraft.
        zeros = xp.zeros_like(e)
        z = xp.concat(
            [
                state_of(measurements, vanes=vanes),
                measurements.y_m + zeros,
                measurements.y_m_dot + zeros,
                integral_e,
            ]
        )
        u_free = measurements.u_trim - xp.sum(params.gain * z[None, :, :], axis=1)
        u, excess = saturate_with_excess(u_free, measurements, dt, limits)
        m = e.shape[0]
        integral_gain = xp.stack(
            [params.gain[i, params.gain.shape[1] - m + i, :] for i in range(m)]
        )
        effect = -integral_gain * increment
        return (
            ErrorIntegral(e, conditional_integration(state.integral_e, integral_e, effect, excess)),
            u_free,
            u,
        )

    return campaign_law(ErrorIntegral, start_integral, limited)


class LqiConfig(ControllerConfig):
    """LQI, flown by campaigns only."""

    needs = "the full state"


def design(model: NominalModel, fade: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the matrices F, G and E of the model z+ = F z + G u, z = [x, y_m, w, integral of e].

        x_dot   = (A + gravity) x + B u
        y_m_dot = w - LEAK y_m,  w_dot = -fade w,  e = C x - y_m

    The law has y_m_dot in the place of w. F is (n + 3 m, n + 3 m), G (n + 3 m, m) and E
    (2 m, n + 3 m). The model is sampled with u held over a period, and the cost is on E z, which is
    e and the integral of e. In this model an angle only decays, angle_dot = -LEAK angle, so that
    the design takes the angles as measured disturbances. In reality an angle integrates the
    controlled rates. A model with these integrals could not control the integral of e as well.
    """
    n, m = model.B.shape
    free = 1.0 - model.kinematic[:, None]
    motion = np.zeros((n + 3 * m, n + 3 * m))
    x, y_m, w, integral = np.split(np.arange(n + 3 * m), [n, n + m, n + 2 * m])
    motion[np.ix_(x, x)] = free * (model.A + model.gravity) - LEAK * np.diag(model.kinematic)
    motion[y_m, y_m] = -LEAK
    motion[y_m, w] = 1.0
    motion[w, w] = -fade
    motion[np.ix_(integral, x)] = model.C
    motion[integral, y_m] = -1.0
    drive = np.vstack([free * model.B, np.zeros((3 * m, m))])
    F, G = zero_order_hold(motion, drive, model.period)
    E = np.zeros((2 * m, n + 3 * m))
    E[:m, x] = model.C
    E[np.arange(m), y_m] = -1.0
    E[np.arange(m, 2 * m), integral] = 1.0
    return F, G, E


def lqi_params(gains: dict[str, FloatArray], model: NominalModel) -> LqiParams:
    """Compute the gain of least cost along z+ = F z + G u for N sets of weights, (m, n + 3 m, N).

    The cost is the sum of e'Q e + q'Q_i q + u'R u:

        Q = 1 / size^2,  Q_i = integral^2 / size^2,  R = (effort / input_scale)^2 / size^2,
            q the integral of e

    `integral` (m, N) and `fade` (1, N) are in 1/s, and `effort` (m, N) is in s. An input that gives
    y the rate of change a costs as much as an error of `effort` times a. Source: E. Kreindler, D.
    Rothschild, AIAA J. 14(7), 1976, for model following. B. D. O. Anderson, J. B. Moore, "Optimal
    Control", ch. 9.
    """
    size = (model.C @ model.size)[:, None]
    gains_by_set = []
    for k, fade in enumerate(gains["fade"][0]):
        F, G, E = design(model, float(fade))
        weights = np.concatenate([np.ones(len(size)), gains["integral"][:, k] ** 2]) / np.tile(
            size[:, 0] ** 2, 2
        )
        R = np.diag((gains["effort"][:, k] / model.input_scale / size[:, 0]) ** 2)
        gains_by_set.append(gain_of(F, G, E.T @ np.diag(weights) @ E, R))
    return LqiParams(np.stack(gains_by_set, axis=-1))
