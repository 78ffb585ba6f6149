# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure the time of one tick: the law, the law with anti-windup and the whole tick.

The times are compared with a NumPy multiply-add of the same size.

python -m benchmarks.speed --only law
"""

import gc
import time
from collections.abc import Callable

import numpy as np

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.vectors import FloatArray, StampedVector
from rise_di_controller.guard import guard
from rise_di_controller.law.law import engage, step, step_with_anti_windup

REPEATS = 20_000


def percentiles(action: Callable[[int], object]) -> tuple[float, float, float]:
    """Return median, 99.9th percentile and maximum of one call in us, after a warm-up."""
    for k in range(500):
        action(k)
    gc.collect()
    gc.freeze()
    took = np.empty(REPEATS)
    for k in range(REPEATS):
        begin = time.perf_counter_ns()
        action(k)
        took[k] = (time.perf_counter_ns() - begin) * 1e-3
    return float(np.median(took)), float(np.percentile(took, 99.9)), float(took.max())


FLOOR = "NumPy a * x + b"


def ticked(scenario: str, y: FloatArray, y_m: FloatArray) -> Callable[[int], object]:
    """Return a whole tick after the engagement, with the k-th rows of y and y_m."""
    controller = find_scenario(scenario).controller
    tuned = controller.tuned_law()
    limits = controller.guard()
    first = StampedVector(0, y_m[0])
    stamp_ns = limits.period_ns
    state, _ = guard.tick(guard.initial_state(4), 0, StampedVector(0, y[0]), [first], limits, tuned)

    def tick(k: int) -> object:
        references = [first, StampedVector(stamp_ns, y_m[k])]
        return guard.tick(state, stamp_ns, StampedVector(stamp_ns, y[k]), references, limits, tuned)

    return tick


def measure() -> dict[str, tuple[float, float, float]]:
    """Return median, 99.9th percentile and maximum, us.

    They are of a law step, a step with anti-windup, a tick, and the multiply-add.
    """
    controller = find_scenario("osprey_gust").controller
    law = controller.law_params()
    limits = controller.guard().limits
    y = noise()[0]
    y_m = np.zeros(4)
    dt = 0.01
    zero = np.zeros(4)
    state = engage(y[0], y_m)
    return {
        FLOOR: percentiles(lambda k: law.K * y[k] + y_m),
        "law.step": percentiles(lambda k: step(state, y[k], y_m, dt, law)),
        "law.step_with_anti_windup": percentiles(
            lambda k: step_with_anti_windup(state, y[k], y_m, dt, zero, zero, law, limits)
        ),
        "guard.tick": percentiles(ticked("osprey_gust", y, np.zeros_like(y))),
    }


def measure_observer() -> tuple[float, float, float]:
    """Measure a tick with feedforward and observer.

    Returns median, 99.9th percentile and maximum in us.
    """
    return percentiles(ticked("osprey_observer", *noise()))


def noise() -> FloatArray:
    """Draw rows of y and of y_m, shape (2, REPEATS, 4)."""
    return 0.01 * np.random.default_rng(1).normal(size=(2, REPEATS, 4))
