# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Trains a policy u = K (y - y_m) with a diagonal K on the environment rise_di/Flight-v0.

    python cross_entropy.py [GENERATIONS]

The cross-entropy method: each aircraft of a fleet flies a K of its own, drawn from a normal
distribution, which moves to the best quarter. Source: R. Y. Rubinstein, D. P. Kroese, "The
Cross-Entropy Method", 2004.
"""

import sys
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

import rise_di  # noqa: F401 - registers its environments

FLEET = 32
BEST = FLEET // 4
# s, with pulses of the commands
DURATION = 20.0


def returns(
    env: gymnasium.vector.VectorEnv[Any, Any, Any], gains: NDArray[np.float64], seed: int
) -> NDArray[np.float64]:
    """Return the sum of the rewards of each aircraft under its own gains (FLEET, 4)."""
    observed, _ = env.reset(seed=seed)
    total = np.zeros(FLEET)
    is_flying = np.ones(FLEET, dtype=bool)
    while True:
        y, y_m = np.split(observed, 2, axis=1)
        u = gains * (y - y_m)
        observed, rewards, terminated, truncated, _ = env.step(u)
        # A lost aircraft starts again; its return is that up to the loss.
        total += np.where(is_flying, rewards, 0.0)
        is_flying &= ~terminated
        if truncated.any() or not is_flying.any():
            return total


def main() -> None:
    """Print the mean return of each generation, and the gains at the end."""
    generations = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    env = gymnasium.make_vec(
        "rise_di/Flight-v0",
        num_envs=FLEET,
        scenario="osprey_servo",
        duration=DURATION,
        uncertainty=0.0,
    )
    random = np.random.default_rng(1)
    mean = np.zeros(4)
    deviation = np.full(4, 0.3)
    for generation in range(generations):
        gains = mean + deviation * random.standard_normal((FLEET, 4))
        # Without control for comparison.
        gains[0] = 0.0
        scores = returns(env, gains, seed=generation)
        best = gains[np.argsort(scores)[-BEST:]]
        mean = best.mean(axis=0)
        deviation = best.std(axis=0) + 0.02
        print(f"{generation}: best {scores.max():.2f}, without control {scores[0]:.2f}")
    print("K", mean.round(3))


if __name__ == "__main__":
    main()
