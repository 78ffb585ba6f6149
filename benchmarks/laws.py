# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Scores of tuned laws on courses without tuning: other gusts, sines, other turbulence, and observers with a wrong wind model.

python -m benchmarks.laws    # the gains of osprey_servo that ship, some minutes
"""

from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np
import typer
from benchmarks.sampling import SINES, new_table, wide_console
from rich.console import Console
from rich.progress import track

from aircraft_sim.uncertainty import AIR_RELATIVE, WindEffect
from control_laws.catalogue import LAWS
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_campaign.law_comparison import TURBULENCE_SEED, LawResult, compare, score_cells
from flight_campaign.tuning import Benchmark, build_benchmark
from flight_design.gains.tuned_gains import load, tuned_file

TUNED_ON = "gust_turbulence"
LEVELS = (0.3, 0.5)
GUSTS = {
    "vertical": {"start": 41.3, "speed": -8.0, "length": 30.0},
    "lateral": {"start": 47.0, "speed": -6.0, "length": 25.0},
}  # s, m/s, m: longer, upwards, from the left
NOISE_SEED = 7
OTHER_TURBULENCE_SEED = 4
WRONG = (0.3, 0.5, 0.5, 1.0)
"""Largest relative error of each entry of the observer's wind columns, sampled for each; 1 stands for no wind model."""


def benchmarks(scenario: Scenario) -> dict[str, Benchmark]:
    """The scenario of the tuning, and others, none in the turbulence of the tuning."""
    sensors: dict[str, Any] = scenario.aircraft.sensors.model_dump() | {"seed": NOISE_SEED}
    other = scenario.vary(aircraft={"gusts": GUSTS, "sensors": sensors})
    return {
        "as tuned": build_benchmark(scenario, TURBULENCE_SEED),
        "other gusts, turbulence, noise": build_benchmark(other, OTHER_TURBULENCE_SEED),
        "sines": build_benchmark(scenario.vary(reference_model={"pulses": {}, "sines": SINES}), TURBULENCE_SEED),
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
    tuning: Annotated[str, typer.Option(help="What the gains were tuned on.")] = TUNED_ON,
    wind: Annotated[
        WindEffect, typer.Option(help="Effect of wind: by each aircraft's own A, or that of the airframe.")
    ] = AIR_RELATIVE,
) -> None:
    """Print scores of laws tuned on osprey_servo, on courses that were not part of the tuning."""
    scenario = find_scenario("osprey_servo").vary(aircraft={"uncertainty": {"wind": wind}})
    tuned = {name: {tuning: sets[tuning]} for name, sets in load(tuned_file(scenario)).items() if tuning in sets}
    observers = {name: sets for name, sets in tuned.items() if "wind" in LAWS[name].model_data}
    flown = benchmarks(scenario)
    cases = [(name, benchmark, tuned) for name, benchmark in flown.items()]
    cases += [(name, benchmark, observers) for name, benchmark in wrong_wind(flown["as tuned"])]
    rows: list[tuple[str, LawResult]] = []
    for name, benchmark, laws in track(cases, "courses", console=Console(stderr=True)):
        rows += [(name, result) for result in compare(benchmark, laws, aircraft, LEVELS, seed, delays=())]
    levels = ("nominal", *(f"+-{100.0 * level:g} %" for level in LEVELS))
    title = f"Scores, mean (worst) of {aircraft} aircraft a level, seed {seed}, tuned on {tuning}, effect of wind: {wind}"
    heads = (f"{wind}\n{level}" for wind in flown["as tuned"].courses for level in levels)
    table = new_table(title, ("course", "law", *heads), texts=2)
    for name, result in rows:
        table.add_row(name, result.law, *score_cells(result))
    wide_console().print(table)


if __name__ == "__main__":
    typer.run(main)
