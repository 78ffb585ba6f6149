# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a law with a model learned in flight diverges: its error beside that of the law that the flight began with."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.vectors import FloatArray

MEMORY = 1.0  # s, time constant of the mean square of e: a few periods of the slowest oscillation that servos allow
FACTOR = 3.0  # of the largest rms error before: gusts that come later are up to twice as strong
LEAST = {"V": 1.0}  # m/s, rms error that does not count as a divergence
LEAST_RATE = 0.1  # rad/s, the same of other outputs: five times that of the law alone in moderate turbulence


class Errors(NamedTuple):
    """Mean squares of e = y - y_m, (m,): the running mean, and its largest value under the first law."""

    now: FloatArray
    largest: FloatArray


def least(outputs: tuple[str, ...]) -> FloatArray:
    """Mean squares that do not count as a divergence, (m,)."""
    return np.array([LEAST.get(name, LEAST_RATE) for name in outputs]) ** 2


def step(errors: Errors, e: FloatArray, dt: float, *, first_law: bool) -> Errors:
    """A tick: now += (1 - exp(-dt / MEMORY)) (e^2 - now); `largest` is held unless the first law flies."""
    now = errors.now - np.expm1(-dt / MEMORY) * (e**2 - errors.now)
    return Errors(now, np.maximum(errors.largest, now) if first_law else errors.largest)


def diverges(errors: Errors, least: FloatArray, learned: NDArray[np.bool_]) -> bool:
    """Whether the rms error of an output is above FACTOR times its largest under the first law, and above `least`.

    Only outputs with a model that was learned count, mask (m,): the others fly the first law.
    """
    return bool(np.any(learned & (errors.now > np.maximum(FACTOR**2 * errors.largest, least))))
