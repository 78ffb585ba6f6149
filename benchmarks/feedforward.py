# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What the feedforward is worth with the same gains: osprey_servo on the published airframe and on uncertain ones.

python -m benchmarks.feedforward --aircraft 40 --processes 2    # five minutes
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import typer
from benchmarks.sampling import Case, Figures, cells, fly, new_table
from rich.console import Console
from rich.progress import track

from aircraft_sim.airframe import Airframe
from aircraft_sim.uncertainty import as_yaml, uncertain
from flight_analysis.gain_selection import with_feedforward
from flight_analysis.scenario import Scenario
from flight_bringup.scenarios import find_scenario

UNIT = {"q": 0.010, "V": 0.1, "p": 0.020, "r": 0.010}
"""rad/s and m/s: what a channel's rms is counted in, so that a score of 4 is one such error in each of the four."""

LEVELS = (0.3, 0.5)
WIDTH = 128  # characters, the least that the table takes, also into a file


def score(figures: Figures, outputs: Sequence[str]) -> float:
    """Sum over the channels of rms of the true error / UNIT; outputs in the airframe's order."""
    return float(np.sum(figures.rms / [UNIT[name] for name in outputs]))


def at_100_hz(scenario: Scenario) -> Scenario:
    """The scenario with y and y_m at the controller's rate, in steps of 5 ms: a fifth of the work, scores within 1 %."""
    return scenario.vary(aircraft={"rate": 100.0, "step": 0.005}, reference_model={"rate": 100.0})


def both(scenario: Scenario) -> tuple[Scenario, Scenario]:
    """The scenario without feedforward, and with that of its airframe as published."""
    airframe, _ = scenario.aircraft.load()
    chosen = with_feedforward(scenario.controller, airframe)
    return scenario.vary(controller={"feedforward": None}), scenario.vary(controller=chosen.model_dump())


def around(airframe: Airframe, uncertainty: float, aircraft: int, seed: int, folder: Path) -> Iterator[str]:
    """Paths of files of uncertain airframes: every entry of A and B within +-uncertainty, but for the rows of angles."""
    A, B = uncertain(airframe, uncertainty, aircraft, seed)
    for k in range(1, aircraft + 1):
        path = folder / f"{airframe.name}_{100 * uncertainty:g}_{k}.yaml"
        path.write_text(as_yaml(airframe.with_matrices(A[k], B[k])), encoding="utf-8")
        yield str(path)


def fleet(scenario: Scenario, uncertainty: float, aircraft: int, seed: int, folder: Path) -> list[tuple[Scenario, Scenario]]:
    """Pairs as of `both`, over uncertain airframes; the feedforward's model stays the airframe as published."""
    airframe, _ = scenario.aircraft.load()
    paths = around(airframe, uncertainty, aircraft, seed, folder)
    pair = both(scenario)
    return [(pair[0].vary(aircraft=one), pair[1].vary(aircraft=one)) for one in ({"airframe": path} for path in paths)]


def main(
    aircraft: Annotated[int, typer.Option(min=1, help="Uncertain aircraft at each level.")] = 40,
    processes: Annotated[int, typer.Option(min=1, help="Flights at a time.")] = os.cpu_count() or 1,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the uncertain aircraft.")] = 1,
) -> None:
    """Print scores and activity of u with and without feedforward, the same gains, on the same aircraft."""
    scenario = at_100_hz(find_scenario("osprey_servo"))
    outputs = scenario.aircraft.load()[0].outputs
    calm = scenario.vary(aircraft={"gusts": {}})
    window = (0.0, scenario.flight.duration)
    with TemporaryDirectory() as folder, ProcessPoolExecutor(processes) as pool:
        sets = {"nominal, calm air": [both(calm)], "nominal": [both(scenario)]}
        sets |= {f"+-{100 * level:g} %": fleet(scenario, level, aircraft, seed, Path(folder)) for level in LEVELS}
        cases = [Case(one, window) for pairs in sets.values() for pair in pairs for one in pair]
        flights = track(pool.map(fly, cases), "flights", len(cases), console=Console(stderr=True))
        flown = iter(list(flights))
    table = new_table(
        f"osprey_servo, {aircraft} aircraft a level, seed {seed}: sum of rms errors q / V / p / r in 10 mrad/s, 0.1 m/s, 20 and"
        "\n10 mrad/s; mean rms in mrad/s and mm/s; mean slew of elevator / thrust / aileron / rudder in deg/s and %/s",
        ("aircraft", "feedforward", "score", "worst", "rms", "slew"),
        texts=2,
    )
    for name, pairs in sets.items():
        found = [(next(flown), next(flown)) for _ in pairs]
        for place, label in enumerate(("without", "with")):
            figures = [pair[place] for pair in found]
            scores = [score(one, outputs) for one in figures]
            rms, slew = (np.mean([getattr(one, key) for one in figures], axis=0) for key in ("rms", "activity"))
            row = (name, label, f"{np.mean(scores):.2f}", f"{np.max(scores):.2f}", cells(rms, 1e3), cells(slew))
            table.add_row(*row)
    console = Console()
    console.width = max(console.width, WIDTH)
    console.print(table)


if __name__ == "__main__":
    typer.run(main)
