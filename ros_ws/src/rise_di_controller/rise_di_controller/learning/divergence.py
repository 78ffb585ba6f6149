# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test whether a law with a learned model diverges or oscillates.

The error is compared with the error before a model was learned, when the flight used the law with
which it started.
"""

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.vectors import FloatArray

# Time constant of the mean square of e, s, which is a few periods of the slowest oscillation that
# servos allow.
MEMORY = 1.0
# An output diverges above this multiple of its largest rms error under the initial law. Later
# gusts can be twice as strong.
FACTOR = 3.0
LEAST = {"V": 1.0}  # rms error of V that does not yet count as a divergence, m/s
# The same limit for every other output, rad/s. It is five times the rms error of the law alone in
# moderate turbulence.
LEAST_RATE = 0.1

WINDOW = 10.0  # length of the record of e, s
# Time over which each value of the record is averaged, s. A loop with servos oscillates more
# slowly.
STEP = 0.02
TEST = 50  # number of averaged values between two tests for an oscillation, 1 s
# Correlation of e with e a period later. It is 0.9 in a limit cycle, and at most 0.5 in turbulence
# and gusts.
LIKENESS = 0.7
# Factor on the largest rms error over a WINDOW under the initial law. If the error has grown
# by less, the initial law is not clearly better.
GROWN = 1.5
HARMLESS = 0.2  # fraction of LEAST or LEAST_RATE below which an oscillation does not count


class Errors(NamedTuple):
    """Mean squares of the error e = y - y_m, each with the shape (m,).

    `now` is the running mean of e^2. `largest` is the largest value that `now` reached before a
    model was learned, or while the controller had fallen back to the initial law.
    """

    now: FloatArray
    largest: FloatArray


def least(outputs: tuple[str, ...]) -> FloatArray:
    """Return the mean square below which the error of each output is no divergence, (m,)."""
    return np.array([LEAST.get(name, LEAST_RATE) for name in outputs]) ** 2


def step(errors: Errors, e: FloatArray, dt: float, *, has_learned_model: bool) -> Errors:
    """Update the mean squares by a tick: now += (1 - exp(-dt / MEMORY)) (e^2 - now).

    `largest` changes only while no learned model is in use.
    """
    now = errors.now - np.expm1(-dt / MEMORY) * (e**2 - errors.now)
    return Errors(now, errors.largest if has_learned_model else np.maximum(errors.largest, now))


def diverging(
    errors: Errors, least: FloatArray, is_learned: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return which outputs, (m,), diverge under a learned model.

    An output diverges if its rms error is above FACTOR times the largest rms error that it had
    without a learned model, and above `least`. Outputs that have no learned model yet are left out.
    `is_learned` (m,) is False for them.
    """
    return is_learned & (errors.now > np.maximum(FACTOR**2 * errors.largest, least))


class Oscillations:
    """The error e over the last WINDOW, and the outputs in which it oscillates.

    In a limit cycle, e repeats itself after a period over the whole window. Under wind and single
    commands it does not. An output is included only if it oscillates more than it did without a
    learned model.
    """

    def __init__(self, least: FloatArray) -> None:
        """Begin without a record.

        `least` is the mean square below which the error of each output is no divergence, (m,).
        """
        # Period of each output's oscillation at the last test, s, (m,), or 0 for none.
        self.periods = np.zeros_like(least)
        self._least = HARMLESS**2 * least
        self._largest = np.zeros_like(least)
        self._record = deque[FloatArray](maxlen=round(WINDOW / STEP))
        self._sum = 0.0 * least
        self._count = 0
        self._time = 0.0
        self._means = 0
        self._has_learned_model = False

    def take(self, e: FloatArray, dt: float, is_learned: NDArray[np.bool_] | None) -> None:
        """Record a tick, and test for oscillations once a second.

        `is_learned` is the mask of the outputs with a learned model, (m,), or None if no learned
        model flies.
        """
        if (is_learned is not None) is not self._has_learned_model:
            self._has_learned_model = is_learned is not None
            self._record.clear()
            self.periods = 0.0 * self.periods
        self._sum = self._sum + e
        self._count = self._count + 1
        self._time = self._time + dt
        if self._time < 0.99 * STEP:  # 0.99 because dt is rounded
            return
        self._record.append(self._sum / self._count)
        spacing = self._time
        self._means = self._means + 1
        self._sum = 0.0 * e
        self._count = 0
        self._time = 0.0
        if self._means % TEST:
            return
        record = np.array(self._record)
        square = np.mean(record**2, axis=0)
        if is_learned is None:
            self._largest = np.maximum(self._largest, square)
        elif len(record) == self._record.maxlen:
            has_grown = square > np.maximum(GROWN**2 * self._largest, self._least)
            self.periods = np.array(
                [
                    spacing * period(x) * is_tested
                    for x, is_tested in zip(record.T, is_learned & has_grown, strict=True)
                ]
            )


def oscillating(y: FloatArray, least: FloatArray) -> NDArray[np.bool_]:
    """Return which outputs, (m,), oscillate over a record y, (N, m).

    The variance of an output over the record must be above HARMLESS^2 `least`. Commands that repeat
    themselves are found as an oscillation, too.
    """
    is_moving = np.var(y, axis=0) > HARMLESS**2 * least
    return np.array(
        [bool(moves) and period(x) > 0 for x, moves in zip(y.T, is_moving, strict=True)]
    )


def period(x: FloatArray) -> int:
    """Return the period of an oscillation that fills a record, (N,), in samples.

        r_k = N / (N - k) sum x_i x_(i+k) / sum x_i^2,  x less its mean

    The period is the lag of the first peak above LIKENESS that comes after the first negative r. It
    is at most N / 4. Returns 0 if there is no oscillation.
    """
    n = len(x)
    lags = len(x) // 4
    x = x - np.mean(x)
    sums = np.fft.irfft(np.abs(np.fft.rfft(x, 2 * n)) ** 2)[:lags]
    r = n / (n - np.arange(lags)) * sums / max(sums[0], np.finfo(float).tiny)
    like = np.flatnonzero((r > LIKENESS) & np.logical_or.accumulate(r < 0.0))
    peak = np.split(like, np.flatnonzero(np.diff(like) > 1) + 1)[0]
    return int(peak[np.argmax(r[peak])]) if len(peak) else 0
