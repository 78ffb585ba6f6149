# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw counter-based random numbers (Philox).

A draw depends only on seed, stream and number, and not on earlier draws. So two flights of a
scenario agree, even if samples are missing in the second flight. Functions that also take other
array types than NumPy's do not call NumPy's generator.
"""

from functools import lru_cache
from threading import get_ident
from typing import Any

import numpy as np

from flight_core.vectors import FloatArray

NOISE, LOSS, DRIFT, TURBULENCE, TURBULENCE_START, AIRFRAME, VANE_LOSS, EQUIPMENT = range(8)
ROTARY, ROTARY_START = range(8, 10)
"""Numbers of the streams, one for each use. Under one seed, different streams are independent."""


# The type is a string, so that np.random is loaded only if it is used.
def generator(number: int, stream: int, seed: int) -> "np.random.Generator":
    """Return the generator for draw `number` >= 0 of a stream, with seed >= 0.

    The generator is valid until the next call for this stream and seed, which moves it to another
    draw. Source: Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC11 (Philox).
    """
    generator, bits, start = _stream(stream, seed, get_ident())
    # The counter's lowest word counts the numbers within a draw.
    start["state"]["counter"][1] = number
    bits.state = start
    return generator


# To move a generator takes a tenth of the time of making one.
@lru_cache(maxsize=64)
def _stream(stream: int, seed: int, _thread: int) -> tuple["np.random.Generator", Any, Any]:
    """Return the generator of a stream for a thread, its bits, and their state before draw 0."""
    bits = np.random.Philox(key=seed, counter=[0, 0, stream, 0])
    return np.random.Generator(bits), bits, bits.state


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
