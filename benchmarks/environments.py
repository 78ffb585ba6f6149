# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Steps a second of CPU time of `rise_di.FlightEnv`, over the step of the integration.

python -m benchmarks.environments
"""

import time

import numpy as np
from benchmarks.sampling import new_table
from rich.console import Console

import rise_di

STEPS, REPEATS = 500, 6


def speed(scenario: rise_di.Scenario) -> float:
    """Steps of the environment a second of CPU time, the best of REPEATS."""
    env, best = rise_di.FlightEnv(scenario), 0.0
    action = np.zeros(len(env.inputs))
    for _ in range(REPEATS):
        env.reset(seed=1)
        begin = time.process_time()
        for _ in range(STEPS):
            env.step(action)
        best = max(best, STEPS / (time.process_time() - begin))
    return best


def main() -> None:
    """Measure and print."""
    table = new_table("FlightEnv of osprey_servo, 100 Hz", ("integration", "steps / CPU s"), texts=1)
    for rate in (500.0, 200.0, 100.0):
        scenario = rise_di.find_scenario("osprey_servo", 20.0).vary(
            aircraft={"rate": rate, "step": 1.0 / rate}, reference_model={"rate": rate}
        )
        table.add_row(f"{1e3 / rate:g} ms", f"{speed(scenario):,.0f}")
    Console().print(table)


if __name__ == "__main__":
    main()
