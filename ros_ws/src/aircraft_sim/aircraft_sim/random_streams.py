# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw counter-based random numbers (Philox).

A draw depends only on seed, stream and number, and not on earlier draws. So two flights of a
scenario agree, even if samples are missing in the second flight. Functions that also take other
array types than NumPy's do not call NumPy's generator.
"""

import numpy as np

from flight_core.vectors import FloatArray

NOISE, LOSS, DRIFT, TURBULENCE, TURBULENCE_START, AIRFRAME, VANE_LOSS, EQUIPMENT = range(8)
ROTARY, ROTARY_START = range(8, 10)
"""Numbers of the streams, one for each use. Under one seed, different streams are independent."""


# The type is a string, so that np.random is loaded only if it is used.
def generator(number: int, stream: int, seed: int) -> "np.random.Generator":
    """Return the generator for draw `number` >= 0 of a stream, with seed >= 0.

    Source: Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC11 (Philox).
    """
    # The counter's lowest word counts the numbers within a draw.
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, number, stream, 0]))


def uniform(first: int, count: int, width: int, stream: int, seed: int) -> FloatArray:
    """Return the draws first, first + 1, ... of `width` uniform numbers in [0, 1), (count, width).

    Each draw takes a whole number of counter steps, which have four numbers each, so that one
    generator can make all draws.
    """
    steps = -(-width // 4)
    generator = np.random.Generator(
        np.random.Philox(key=seed, counter=[first * steps, 0, stream, 0])
    )
    return np.asarray(generator.random((count, 4 * steps))[:, :width])
