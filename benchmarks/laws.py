# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Scores of tuned laws on courses without tuning: other gusts, sines, turbulence, and an observer with a wrong wind model.

python -m benchmarks.laws    # the gains of osprey_servo that ship, some minutes
"""

from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np
import typer
from benchmarks.sampling import SINES, new_table, wide_console
from rich.console import Console
from rich.progress import track

from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup.scenarios import find_scenario
from flight_campaign.law_comparison import LawResult, compare
from flight_campaign.tuning import Benchmark, TuningResult, build_benchmark, load, tuned_file

LAWS = ("rise", "rise_ff", "rise_observer", "lqg", "pi", "pi_ff", "l1", "indi", "lqi_vanes")
OBSERVER = "rise_observer"
LEVELS = (0.3, 0.5)
GUSTS = {
    "vertical": {"start": 41.3, "speed": -8.0, "length": 30.0},
    "lateral": {"start": 47.0, "speed": -6.0, "length": 25.0},
}  # s, m/s, m: longer, upwards, from the left
TURBULENCE = {"altitude": 100.0, "wind": 15.4, "seed": 3}  # m; m/s at 20 ft, moderate by MIL-F-8785C
NOISE_SEED = 7
WRONG = (0.3, 0.5, 0.5, 1.0)
"""Largest relative error of each entry of the observer's wind columns, sampled for each; 1 stands for no wind model."""


def courses(scenario: Scenario) -> dict[str, Scenario]:
    """The scenario of the tuning, and others."""
    sensors: dict[str, Any] = scenario.aircraft.sensors.model_dump() | {"seed": NOISE_SEED}
    return {
        "as tuned": scenario,
        "other gusts and noise": scenario.vary(aircraft={"gusts": GUSTS, "sensors": sensors}),
        "sines": scenario.vary(reference_model={"pulses": {}, "sines": SINES}),
        "turbulence": scenario.vary(aircraft={"gusts": {}, "turbulence": TURBULENCE}),
    }


def wrong_wind(benchmark: Benchmark) -> Iterator[tuple[str, Benchmark]]:
    """The benchmark with errors in the wind columns of the observer's model; the aircraft do not change."""
    generator = np.random.default_rng(5)
    for part in WRONG:
        factor = 1.0 + part * generator.uniform(-1.0, 1.0, benchmark.model.wind.shape) if part < 1.0 else 0.0
        name = f"wind wrong by up to {100.0 * part:g} %" if part < 1.0 else "no wind model"
        yield name, benchmark._replace(model=benchmark.model._replace(wind=benchmark.model.wind * factor))


def main(
    aircraft: Annotated[int, typer.Option(min=1, help="Uncertain aircraft at each level.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the uncertain aircraft.")] = 1,
) -> None:
    """Print scores of laws tuned on osprey_servo, on courses that were not part of the tuning."""
    scenario = find_scenario("osprey_servo")
    tuned = load(tuned_file(scenario))
    chosen: dict[str, dict[str, TuningResult]] = {name: {"uncertain": tuned[name]["uncertain"]} for name in LAWS}
    chosen[OBSERVER] |= {"late": tuned[OBSERVER]["late"]}
    cases: list[tuple[str, Benchmark, dict[str, dict[str, TuningResult]]]] = [
        (name, build_benchmark(one), chosen) for name, one in courses(scenario).items()
    ]
    cases += [(name, one, {OBSERVER: chosen[OBSERVER]}) for name, one in wrong_wind(build_benchmark(scenario))]
    rows: list[tuple[str, LawResult]] = []
    for name, benchmark, laws in track(cases, "courses", console=Console(stderr=True)):
        rows += [(name, one) for one in compare(benchmark, laws, aircraft, LEVELS, seed)]
    levels = tuple(f"+-{100.0 * level:g} %" for level in LEVELS)
    title = f"Scores, mean (worst) of {aircraft} aircraft a level, seed {seed}"
    table = new_table(title, ("course", "law", "tuned on", "nominal", *levels), texts=3)
    for name, one in rows:
        cells = (f"{level.mean:.2f} ({level.worst:.2f})" for level in one.levels)
        table.add_row(name, one.law, one.objective, f"{one.score:.2f}", *cells)
    wide_console().print(table)


if __name__ == "__main__":
    typer.run(main)
