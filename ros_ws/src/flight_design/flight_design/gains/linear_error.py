# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The error of a linear loop along a manoeuvre."""

import numpy as np

from flight_analysis.closed_loop.loop_margins import LinearLoop
from flight_core.vectors import FloatArray
from flight_design.gains.ideal_control import STEP
from rise_di_controller.linear_loop import closed_loop, zero_order_hold


def linear_error(loop: LinearLoop, u_dot: FloatArray) -> FloatArray:
    """Rms of e of the nominal linear loop that has to give the ideal control u*, (..., m), SI; the
    leading axes are those of the laws of the loop.

    u* keeps y on y_m, so e is the response of the loop to the disturbance -u* at the input of the
    aircraft, from trim on. `u_dot` (T, m) is the rate of u* every STEP, inputs in the law's order.
    """
    period = loop.loop.period
    u = np.concatenate(
        [np.zeros((1, u_dot.shape[1])), np.cumsum((u_dot[1:] + u_dot[:-1]) / 2.0 * STEP, axis=0)]
    )
    t = period * (np.arange(int((len(u) - 1) * STEP / period)) + 0.5)
    held = np.array([np.interp(t, STEP * np.arange(len(u)), column) for column in u.T]).T
    step = closed_loop(loop.nominal, loop.law, loop.loop, np.zeros(u.shape[1]))
    _, drive = zero_order_hold(loop.nominal.A, loop.nominal.B, period)
    n = len(loop.nominal.A)
    state = np.zeros((*step.shape[:-1], 1))
    x = np.empty((len(t), *step.shape[:-2], n))
    for k, disturbance in enumerate(-(held @ drive.T)):
        state = step @ state
        state[..., :n, 0] += disturbance
        x[k] = state[..., :n, 0]
    return np.asarray(np.sqrt(np.mean((x @ loop.nominal.C.T) ** 2, axis=0)))
