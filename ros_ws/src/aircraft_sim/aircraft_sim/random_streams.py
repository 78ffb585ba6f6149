# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Counter-based random numbers (Philox).

A draw depends on seed, stream and number alone, not on earlier draws. Two flights of a scenario
therefore agree, even if samples are missing in the second flight. NumPy's generator stays outside
the functions on further array types.
"""

import numpy as np

from flight_core.vectors import FloatArray

NOISE, LOSS, DRIFT, TURBULENCE, TURBULENCE_START, AIRFRAME, VANE_LOSS, EQUIPMENT = range(8)
ROTARY, ROTARY_START = range(8, 10)
"""Streams, one for each use. Under the same seed they are independent of each other."""


# The type is a text: np.random loads when it is used.
def generator(number: int, stream: int, seed: int) -> "np.random.Generator":
    """Generator of draw `number` >= 0 of a stream, with seed >= 0.

    Source: Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC11 (Philox).
    """
    # The counter's lowest word counts the numbers within a draw.
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, number, stream, 0]))


def uniform(first: int, count: int, width: int, stream: int, seed: int) -> FloatArray:
    """Draws first, first + 1, ... of `width` numbers, uniform in [0, 1), shape (count, width).

    A draw takes a whole number of counter steps of four numbers, so a single generator gives every
    draw.
    """
    steps = -(-width // 4)
    generator = np.random.Generator(
        np.random.Philox(key=seed, counter=[first * steps, 0, stream, 0])
    )
    return np.asarray(generator.random((count, 4 * steps))[:, :width])
