# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo campaign: speed relative to the simulation in one process, integration error, memory.

python -m benchmarks.campaign  # 10,000 aircraft of osprey_servo, a minute on two cores
python -m benchmarks.campaign --scenario osprey_route --aircraft 2000 --exact 1        # missions
"""

import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, NamedTuple

import numpy as np
import psutil
import typer
from benchmarks.tables import new_table
from rich.console import Console

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import true_error
from flight_campaign import engines
from flight_campaign.campaign import Campaign, define, fly_chunk_figures
from flight_core.vectors import FloatArray

FINE = 1e-4  # s: a twentieth of the scenario's step, the reference for the integration error
UNCERTAINTY, SEED = 0.3, 7


class Speed(NamedTuple):
    """Speed and memory of a campaign."""

    whole: float  # aircraft-seconds per second, from the first job to the last, with compilation
    flown: float  # the same after the first chunk of each worker
    memory_early: float  # MB resident, after a third of the chunks
    memory: float  # MB at its end


def speed(scenario: Scenario, aircraft: int, chunk: int, workers: int) -> Speed:
    """Fly a campaign in threads of this process."""
    with TemporaryDirectory() as folder:
        campaign = Campaign.begin(
            Path(folder), define(scenario, aircraft, UNCERTAINTY, SEED, chunk)
        )
        begin, process = time.perf_counter(), psutil.Process()
        done = [
            (time.perf_counter() - begin, flights, process.memory_info().rss / 1e6)
            for flights in campaign.fly(engines.threads(workers))
        ]
    seconds, end = scenario.flight.duration, done[-1]
    first, later = done[workers - 1], sum(flights for _, flights, _ in done[workers:])
    after_first = later * seconds / (end[0] - first[0]) if later else float("nan")
    return Speed(aircraft * seconds / end[0], after_first, done[len(done) // 3][2], end[2])


def alone(scenario: Scenario) -> tuple[float, FloatArray]:
    """One flight in one process: aircraft-seconds per second, and rms of the true error at the
    ticks, (m,).
    """
    begin = time.perf_counter()
    tape = simulate(scenario)
    took = time.perf_counter() - begin
    error = true_error(tape)
    assert error is not None  # noqa: S101 - a simulated flight has the truth
    ticks = error.stamp_ns % round(1e9 / scenario.controller.rate) == 0
    rms = np.array(
        [np.sqrt(np.mean(error[name][ticks] ** 2)) for name in scenario.controller.outputs]
    )
    return scenario.flight.duration / took, rms


def integration_error(scenario: Scenario, count: int) -> tuple[float, FloatArray]:
    """Largest relative difference of rms between a fleet and the same aircraft with the step FINE,
    (m,).

    The first result is the speed of the simulation in one process at the scenario's own step,
    aircraft-seconds per second.
    """
    definition = define(scenario, count, UNCERTAINTY, SEED, count)
    figures = fly_chunk_figures(definition.model_dump_json(), (0, 0)).figures
    outputs = scenario.controller.outputs
    worst, single_speed = np.zeros(len(outputs)), 0.0
    for number in range(count):
        sampled = definition.aircraft_scenario(number)
        single_speed = max(single_speed, alone(sampled)[0])
        _, rms = alone(sampled.vary(aircraft={"step": FINE}))
        worst = np.maximum(
            worst, np.abs([figures[f"rms.{name}"][number] for name in outputs] / rms - 1.0)
        )
    return single_speed, worst


def main(
    scenario: Annotated[
        str, typer.Option(help="Name of a scenario; one with guidance flies missions.")
    ] = "osprey_servo",
    aircraft: Annotated[int, typer.Option(min=1, help="Aircraft of the campaign.")] = 10_000,
    chunk: Annotated[int, typer.Option(min=1, help="How many fly at once.")] = 1000,
    workers: Annotated[int, typer.Option(min=1, help="Threads.")] = psutil.cpu_count() or 1,
    exact: Annotated[int, typer.Option(min=1, help="Aircraft whose integration is checked.")] = 4,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to a file.")
    ] = None,
) -> None:
    """Print speed, ratio to the simulation in one process, memory, and integration error."""
    chosen = find_scenario(scenario)
    many = speed(chosen, aircraft, chunk, workers)
    single_speed, errors = integration_error(chosen, exact)
    table = new_table(
        f"{scenario}, {chosen.flight.duration:g} s, +-{100 * UNCERTAINTY:g} %, {workers} "
        f"threads, chunks of {chunk}",
        ("figure", "value"),
        texts=1,
    )
    shares = dict(zip(chosen.controller.outputs, errors.tolist(), strict=True))
    rows = {
        f"{aircraft} aircraft, all in": f"{many.whole:,.0f} aircraft-s/s",
        "after the first chunks": f"{many.flown:,.0f} aircraft-s/s",
        "ratio to a simulation in one process": f"{many.flown / single_speed:,.0f} x",
        "memory after a third, at the end": f"{many.memory_early:,.0f} and {many.memory:,.0f} MB",
        "integration error, share of rms": ", ".join(
            f"{name} {share:.1e}" for name, share in shares.items()
        ),
    }
    for row in rows.items():
        table.add_row(*row)
    Console().print(table)
    if json_file is not None:
        figures = {
            **many._asdict(),
            "aircraft": aircraft,
            "plain": single_speed,
            "exact": exact,
            "integration": shares,
        }
        figures["memory_growth"] = many.memory / many.memory_early
        figures["1,000,000 aircraft of 60 s with gusts on a GPU"] = None  # s; no host has had a GPU
        json_file.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    typer.run(main)
