# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Let actuators whose model has a lag of first order move as late servos of the second order do.

An actuator has no noise, so its position follows from u alone. The filters can therefore keep the
model of first order. They get the u with which this model has the position of the servo at each
tick.
"""

import numpy as np
from scipy import signal

from flight_core.vectors import FloatArray
from flight_design.identification.innovation_filters import delayed
from rise_di_controller.law.linear_loop import zero_order_hold

# Least inertia of a servo, as a share of the square of its lag. It is far below the step of the
# finite differences.
LEAST_INERTIA = 1e-5


def behind_servos(
    u: FloatArray,
    late: FloatArray,
    period: float,
    lag: FloatArray,
    servo_lag: FloatArray,
    inertia: FloatArray,
) -> FloatArray:
    """Delay the commanded u, (T, m), and apply `behind_servo`, for each of N models, (N, T, m).

    `late`, (N, m), are the delays of the inputs in periods. `lag`, (m,), s, is that of the filters,
    and `servo_lag` and `inertia`, (N, m), are those of `behind_servo`.
    """
    acting = np.empty((len(late), *u.shape))
    for j, column in enumerate(u.T):
        found: dict[tuple[float, ...], FloatArray] = {}
        of_models = np.stack([late[:, j], servo_lag[:, j], inertia[:, j]], axis=1)
        for n, servo in enumerate(map(tuple, of_models.tolist())):
            if servo not in found:
                later = delayed(column[:, None], max(servo[0], 0.0))[:, 0]
                found[servo] = behind_servo(later, period, float(lag[j]), *servo[1:])
            acting[n, :, j] = found[servo]
    return acting


def behind_servo(
    u: FloatArray, period: float, lag: float, servo_lag: float, inertia: float
) -> FloatArray:
    """Return the u, (T,), with which a first-order actuator moves as a servo does at each tick.

        inertia lag^2 p_ddot + servo_lag p_dot + p = u

    `lag` is that of the first-order actuator, s. The servo is at rest at the first u. Without an
    inertia it is of first order. An actuator without a lag has no inertia either.
    """
    if lag == 0.0 or (inertia == 0.0 and servo_lag == lag):
        return u
    square = max(inertia, LEAST_INERTIA) * lag**2
    motion = np.array([[0.0, 1.0], [-1.0 / square, -servo_lag / square]])
    Phi, Gamma = zero_order_hold(motion, np.array([[0.0], [1.0 / square]]), period)
    # position at the next tick over u: of second order, and then the inverse of the first order
    position = [Gamma[0, 0], Phi[0, 1] * Gamma[1, 0] - Phi[1, 1] * Gamma[0, 0]]
    keep = np.exp(-period / lag)
    numerator = np.convolve(position, [1.0, -keep]) / (1.0 - keep)
    denominator = [1.0, -np.trace(Phi), np.linalg.det(Phi)]
    return np.asarray(u[0] + signal.lfilter(numerator, denominator, u - u[0]))
