# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test draws by counter against NumPy's Philox with the same counter."""

from threading import Barrier, Thread

import numpy as np
from numpy.testing import assert_array_equal

from aircraft_sim.random_streams import DRIFT, NOISE, generator
from flight_core.vectors import FloatArray


def draw(number: int, stream: int, seed: int) -> FloatArray:
    bits = np.random.Philox(key=seed, counter=[0, number, stream, 0])
    return np.random.Generator(bits).standard_normal(5)


def test_draw_depends_on_seed_stream_and_number_alone() -> None:
    """With five numbers, some of the last four numbers of Philox are left.

    No later draw may use them.
    """
    for number, stream, seed in [(7, NOISE, 1), (7, DRIFT, 1), (3, NOISE, 2), (7, NOISE, 1)]:
        assert_array_equal(
            generator(number, stream, seed).standard_normal(5), draw(number, stream, seed)
        )


def test_two_threads_draw_from_the_same_stream() -> None:
    together = Barrier(2)
    drawn: dict[int, FloatArray] = {}

    def take(number: int) -> None:
        ready = generator(number, NOISE, 1)
        together.wait(timeout=60.0)
        drawn[number] = ready.standard_normal(5)

    threads = [Thread(target=take, args=(number,)) for number in (4, 9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for number in (4, 9):
        assert_array_equal(drawn[number], draw(number, NOISE, 1))
