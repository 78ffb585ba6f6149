# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Random numbers by counter: a draw depends on its seed, stream and number alone, whatever was drawn before.

Two flights of one scenario therefore agree, whatever either of them missed. The generator is NumPy's and stays outside the
maths that other array types run.
"""

import numpy as np

from flight_core.vectors import FloatArray

NOISE, LOSS, DRIFT, TURBULENCE, TURBULENCE_START, AIRFRAME = range(6)
"""Streams, one for each use. They are independent of one another under the same seed."""


def generator(number: int, stream: int, seed: int) -> np.random.Generator:
    """Generator of draw `number` >= 0 of a stream, with seed >= 0.

    Source: Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC11 (Philox).
    """
    # The counter's lowest word counts the numbers within a draw.
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, number, stream, 0]))


def uniform(first: int, count: int, width: int, stream: int, seed: int) -> FloatArray:
    """Draws first, first + 1, ... of `width` numbers each, uniform in [0, 1), shape (count, width), at once.

    Here a draw is a whole number of the counter's steps, each of four numbers, so that draws follow each other.
    """
    steps = -(-width // 4)
    generator = np.random.Generator(np.random.Philox(key=seed, counter=[first * steps, 0, stream, 0]))
    return np.asarray(generator.random((count, 4 * steps))[:, :width])
