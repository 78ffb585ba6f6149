# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Convert u so that a first-order model of an actuator moves as a better model of a servo.

The better model has a delay, an inertia and a limited rate. The first-order model gets the result
of the conversion as its input, and then has the position of the servo at each tick. This is
possible because an actuator has no noise, so its position follows from u alone. The filters in
`innovation_filters` can therefore keep their first-order actuators.
"""

import numpy as np
from scipy import signal

from flight_core.vectors import FloatArray
from flight_design.identification.innovation_filters import delayed
from rise_di_controller.law.linear_loop import zero_order_hold

# Least inertia of a servo, as a share of the square of the lag of the first-order actuator. It is
# far below the step in `inertia` with which the search takes finite differences.
LEAST_INERTIA = 1e-5


def behind_servos(
    u: FloatArray,
    late: FloatArray,
    period: float,
    lag: FloatArray,
    servo_lag: FloatArray,
    inertia: FloatArray,
    rate_limit: FloatArray | None = None,
) -> FloatArray:
    """Delay the commanded u, (T, m), and apply `behind_servo`, for each of N models, (N, T, m).

    `late`, (N, m), are the delays of the inputs in periods. `lag`, (m,), s, has the lags of the
    actuators in the filters. `servo_lag` and `inertia`, (N, m), and `rate_limit`, (m,), have the
    meaning that they have in `behind_servo`.
    """
    acting = np.empty((len(late), *u.shape))
    limits = np.full(u.shape[1], np.inf) if rate_limit is None else rate_limit
    for j, column in enumerate(u.T):
        found: dict[tuple[float, ...], FloatArray] = {}
        of_models = np.stack([late[:, j], servo_lag[:, j], inertia[:, j]], axis=1)
        for n, servo in enumerate(map(tuple, of_models.tolist())):
            if servo not in found:
                periods, its_lag, its_inertia = servo
                later = delayed(column[:, None], max(periods, 0.0))[:, 0]
                found[servo] = behind_servo(
                    later, period, float(lag[j]), its_lag, its_inertia, float(limits[j])
                )
            acting[n, :, j] = found[servo]
    return acting


def behind_servo(
    u: FloatArray,
    period: float,
    lag: float,
    servo_lag: float,
    inertia: float,
    rate_limit: float = np.inf,
) -> FloatArray:
    """Return the input, (T,), with which a first-order actuator moves as a servo with the input u.

        inertia lag^2 p_ddot + servo_lag p_dot + p = u,   abs(p_dot) <= rate_limit

    p is the position of the servo, and `lag` is the lag of the first-order actuator, s. Both have
    the same position at each tick. The servo is at rest at the first u. Without an inertia the
    servo is of first order. If `lag` is 0, the result is u, whatever the servo.
    """
    if lag == 0.0:
        return u
    square = max(inertia, LEAST_INERTIA) * lag**2
    motion = np.array([[0.0, 1.0], [-1.0 / square, -servo_lag / square]])
    Phi, Gamma = zero_order_hold(motion, np.array([[0.0], [1.0 / square]]), period)
    # transfer function from u to the position at the next tick
    numerator = [Gamma[0, 0], Phi[0, 1] * Gamma[1, 0] - Phi[1, 1] * Gamma[0, 0]]
    denominator = [1.0, -np.trace(Phi), np.linalg.det(Phi)]
    position = np.asarray(signal.lfilter(numerator, denominator, u - u[0]))
    if np.abs(np.diff(position, prepend=0.0)).max() > rate_limit * period:
        position = _within_rate(u - u[0], Phi, Gamma[:, 0], rate_limit, period)
    elif inertia == 0.0 and servo_lag == lag:
        return u
    keep = np.exp(-period / lag)
    before = np.concatenate([[0.0], position[:-1]])
    return np.asarray(u[0] + (position - keep * before) / (1.0 - keep))


def _within_rate(
    u: FloatArray, Phi: FloatArray, Gamma: FloatArray, rate_limit: float, period: float
) -> FloatArray:
    """Return the positions of a servo with limited rate after each tick, (T,).

    The servo is at rest at 0. Without the limit, position and rate after a tick would be Phi times
    position and rate before the tick, plus Gamma u.
    """
    (by_position, by_rate), (rate_by_position, rate_by_rate) = Phi.tolist()
    by_u, rate_by_u = Gamma.tolist()
    farthest = rate_limit * period
    positions = []
    position = rate = 0.0
    for commanded in u.tolist():
        step = (by_position - 1.0) * position + by_rate * rate + by_u * commanded
        turned = rate_by_position * position + rate_by_rate * rate + rate_by_u * commanded
        position += min(max(step, -farthest), farthest)
        rate = min(max(turned, -rate_limit), rate_limit)
        positions.append(position)
    return np.array(positions)
