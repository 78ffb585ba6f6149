# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a campaign costs and how exact it is: speed beside the loop in one process, error of its integration, memory.

python -m benchmarks.campaign                     # 10,000 aircraft of osprey_servo, a minute on two cores
"""

import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, NamedTuple

import numpy as np
import psutil
import typer
from benchmarks.sampling import new_table
from rich.console import Console

from aircraft_sim.airframe import load_airframe
from aircraft_sim.uncertainty import sampled_matrices
from control_laws import rise_di
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import true_error
from flight_bringup.scenarios import find_scenario
from flight_campaign import engines, fleet
from flight_campaign.benchmark_course import build_course
from flight_campaign.campaign import Campaign, define
from flight_core.vectors import FloatArray

FINE = 1e-4  # s: a twentieth of the scenario's step, at which an integration counts as exact
PART, SEED = 0.3, 7


class Speed(NamedTuple):
    """How fast a campaign went."""

    whole: float  # aircraft-seconds per second, from the first job to the last, compiling included
    flown: float  # the same after the first chunk of each worker
    memory_early: float  # MB resident, when a third was flown
    memory: float  # MB at its end


def speed(scenario: Scenario, aircraft: int, chunk: int, workers: int) -> Speed:
    """Fly a campaign in threads of this process."""
    with TemporaryDirectory() as folder:
        campaign = Campaign.begin(Path(folder), define(scenario, aircraft, PART, SEED, chunk))
        begin, process = time.perf_counter(), psutil.Process()
        done = [
            (time.perf_counter() - begin, flights, process.memory_info().rss / 1e6)
            for flights in campaign.fly(engines.threads(workers))
        ]
    seconds, end = scenario.flight.duration, done[-1]
    first, later = done[workers - 1], sum(flights for _, flights, _ in done[workers:])
    flown = later * seconds / (end[0] - first[0]) if later else float("nan")
    return Speed(aircraft * seconds / end[0], flown, done[len(done) // 3][2], end[2])


def alone(scenario: Scenario) -> tuple[float, FloatArray]:
    """One flight in the loop of one process: aircraft-seconds per second, and rms of the true error at the ticks, (m,)."""
    begin = time.perf_counter()
    tape = simulate(scenario)
    took = time.perf_counter() - begin
    error = true_error(tape)
    if error is None:
        raise RuntimeError("a simulation without truth")
    ticks = error.stamp_ns % round(1e9 / scenario.controller.rate) == 0
    rms = np.array([np.sqrt(np.mean(error[name][ticks] ** 2)) for name in scenario.controller.outputs])
    return scenario.flight.duration / took, rms


def integration_error(scenario: Scenario, count: int) -> tuple[float, FloatArray]:
    """Largest difference of rms between a fleet's aircraft and the same ones integrated finely, as a share of the rms, (m,).

    Also the speed of the loop in one process at the scenario's own step, aircraft-seconds per second.
    """
    course = build_course(scenario)
    A, B = sampled_matrices(load_airframe(scenario.aircraft.airframe), PART, PART, SEED, 0, count)
    flown = fleet.fly(
        fleet.assemble(A, B, scenario.aircraft.plant(), course),
        fleet.vehicle(scenario),
        course,
        rise_di.control_law(scenario.controller.law().sign),
        rise_di.params(scenario.controller),
    )
    worst, plain = np.zeros(len(scenario.controller.outputs)), 0.0
    for number in range(count):
        drawn = scenario.vary(aircraft={"uncertainty": {"A": PART, "B": PART, "seed": SEED, "number": number}})
        plain = max(plain, alone(drawn)[0])
        _, rms = alone(drawn.vary(aircraft={"step": FINE}))
        worst = np.maximum(worst, np.abs(np.asarray(flown.rms)[:, number] / rms - 1.0))
    return plain, worst


def main(
    aircraft: Annotated[int, typer.Option(min=1, help="Aircraft of the campaign.")] = 10_000,
    chunk: Annotated[int, typer.Option(min=1, help="How many fly at once.")] = 1000,
    workers: Annotated[int, typer.Option(min=1, help="Threads.")] = psutil.cpu_count() or 1,
    exact: Annotated[int, typer.Option(min=1, help="Aircraft whose integration is checked.")] = 4,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures to a file.")] = None,
) -> None:
    """Print speed, ratio to the loop in one process, memory, and the error of the integration."""
    scenario = find_scenario("osprey_servo")
    many = speed(scenario, aircraft, chunk, workers)
    plain, errors = integration_error(scenario, exact)
    table = new_table(
        f"osprey_servo, 60 s, +-{100 * PART:g} %, {workers} threads, chunks of {chunk}", ("figure", "value"), texts=1
    )
    shares = dict(zip(scenario.controller.outputs, errors.tolist(), strict=True))
    rows = {
        f"{aircraft} aircraft, all in": f"{many.whole:,.0f} aircraft-s/s",
        "after the first chunks": f"{many.flown:,.0f} aircraft-s/s",
        "beside the loop in one process": f"{many.flown / plain:,.0f} x",
        "memory after a third, at the end": f"{many.memory_early:,.0f} and {many.memory:,.0f} MB",
        "integration error, share of rms": ", ".join(f"{name} {share:.1e}" for name, share in shares.items()),
    }
    for row in rows.items():
        table.add_row(*row)
    Console().print(table)
    if json_file is not None:
        figures = {**many._asdict(), "aircraft": aircraft, "plain": plain, "integration": shares}
        json_file.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
