# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure how long a Monte Carlo campaign takes on the device of this host.

`floor` estimates the least time that it could take there. Further figures are the ratio of the
speed to that on the host's CPU and to that of a simulation in one process, the integration error
and the memory.

python -m benchmarks.campaign  # 10,000 aircraft of osprey_servo, a minute on two cores
    # 1,000,000 on a GPU, and 10,000 on the CPU of its host

The rows of the device are written to docs/evidence/tables/campaign-devices.csv.
"""

import csv
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import psutil
import typer
from benchmarks.evidence import FOLDER, Origin, Row, origin
from benchmarks.tables import new_table
from jax import numpy as jnp
from rich.console import Console

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.uncertainty import sampled_matrices
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics.errors import true_error
from flight_campaign import engines
from flight_campaign.batch import batch_matrices, device
from flight_campaign.batch.batch_schedule import without_branches
from flight_campaign.batch.campaign_course import build_course
from flight_campaign.campaign import MonteCarlo, define, fly_chunk, fly_chunk_figures
from flight_core.vectors import FloatArray

FINE = 1e-4  # s: a twentieth of the scenario's step, the reference for the integration error
UNCERTAINTY, SEED = 0.3, 7
DEVICES = FOLDER / "tables/campaign-devices.csv"
MILLION = 1_000_000
COPIED = 2**27  # numbers of 8 bytes, 1 GiB, more than any cache holds


class Speed(NamedTuple):
    """Speed and memory of a campaign."""

    compiled: float  # time to compile and fly the first chunk once before the campaign, s
    took: float  # time of the campaign, with the writing of its rows, s
    memory_early: float  # resident memory after a third of the chunks, MB
    memory: float  # resident memory at the end of the campaign, MB


def speed(scenario: Scenario, aircraft: int, chunk: int | None, workers: int | None) -> Speed:
    """Fly a campaign in threads of this process."""
    with TemporaryDirectory() as folder:
        campaign = MonteCarlo.begin(
            Path(folder),
            define(scenario, aircraft=aircraft, uncertainty=UNCERTAINTY, seed=SEED, chunk=chunk),
        )
        process = psutil.Process()
        before = time.perf_counter()
        fly_chunk(campaign.definition.model_dump_json(), (0, 0))
        begin = time.perf_counter()
        memory = [process.memory_info().rss / 1e6 for _ in campaign.fly(engines.threads(workers))]
        took = time.perf_counter() - begin
    return Speed(begin - before, took, memory[len(memory) // 3], memory[-1])


def floor(scenario: Scenario, aircraft: int) -> float:
    """Compute a lower bound of the time of a campaign on the device, s.

    Each tick has to read the matrices of all aircraft, which do not fit into a cache. The bound is
    the time to read them at the measured speed of a copy.
    """
    course = build_course(scenario)
    airframe = load_airframe(scenario.aircraft.airframe)
    A, B = sampled_matrices(airframe, UNCERTAINTY, UNCERTAINTY, SEED, 0, 1)
    fleet = batch_matrices.assemble(A, B, scenario.aircraft.plant(), course)
    tick = sum(matrix.nbytes for matrix in fleet.tick)
    size = sum(
        run.length * (tick + (fleet.forced.nbytes if run.pattern[0].is_forced else 0))
        for run in without_branches(course)
    )
    copy = jax.jit(lambda numbers: numbers + 1.0)
    numbers = jnp.zeros(COPIED)
    times = []
    for _ in range(6):
        begin = time.perf_counter()
        copy(numbers).block_until_ready()
        times.append(time.perf_counter() - begin)
    return float(aircraft * size * min(times) / (2 * numbers.nbytes))


def on_cpu(scenario: str, aircraft: int) -> dict[str, Any]:
    """Run this program on the CPU of this host, and return its figures."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "cpu.json"
        words = ["--scenario", scenario, "--aircraft", str(aircraft), "--exact", "0"]
        subprocess.run(  # noqa: S603 - this program
            [sys.executable, "-m", "benchmarks.campaign", *words, "--json", str(path)],
            check=True,
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
            stdout=subprocess.DEVNULL,
        )
        return dict(json.loads(path.read_text()))


def write_rows(label: str, figures: dict[str, tuple[float, str]], begun: Origin) -> None:
    """Write rows to DEVICES, in place of all rows whose name begins with `label`.

    `figures` has value and unit of each row by its name.
    """
    DEVICES.touch()
    with DEVICES.open(newline="") as stream:
        other_rows = [
            line for line in list(csv.reader(stream))[1:] if not line[0].startswith(label)
        ]
    new = [
        [*Row(f"{label}{name}", f"{value:.4g}", unit), *begun]
        for name, (value, unit) in figures.items()
    ]
    with DEVICES.open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(Row._fields + Origin._fields)
        writer.writerows(sorted(other_rows + new))


def alone(scenario: Scenario) -> tuple[float, FloatArray]:
    """Fly one flight in one process.

    Returns aircraft-seconds per second, and the rms of the true error at the ticks, (m,).
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
    """Compare the rms of a fleet with that of the same aircraft with the step FINE.

    Returns the speed of the simulation in one process at the scenario's own step, in
    aircraft-seconds per second, and the largest relative difference of the rms of each output,
    (m,).
    """
    definition = define(scenario, aircraft=count, uncertainty=UNCERTAINTY, seed=SEED, chunk=count)
    figures = fly_chunk_figures(definition.model_dump_json(), (0, 0)).figures
    outputs = scenario.controller.outputs
    worst = np.zeros(len(outputs))
    single_speed = 0.0
    for number in range(count):
        aircraft = definition.aircraft_scenario(number)
        single_speed = max(single_speed, alone(aircraft)[0])
        _, rms = alone(aircraft.vary(aircraft={"step": FINE}))
        worst = np.maximum(
            worst, np.abs([figures[f"rms.{name}"][number] for name in outputs] / rms - 1.0)
        )
    return single_speed, worst


def main(
    scenario: Annotated[
        str, typer.Option(help="Name of a scenario without guidance and learner.")
    ] = "osprey_servo",
    aircraft: Annotated[
        int | None,
        typer.Option(min=1, help="Aircraft, by default 10,000, on a GPU 1,000,000."),
    ] = None,
    chunk: Annotated[int | None, typer.Option(min=1, help="How many fly at once.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Threads.")] = None,
    exact: Annotated[int, typer.Option(min=0, help="Aircraft whose integration is checked.")] = 4,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to a file.")
    ] = None,
) -> None:
    """Print and write speed, floor, ratios, memory, and integration error."""
    start = origin("python -m benchmarks.campaign")
    definition_scenario = find_scenario(scenario)
    seconds = definition_scenario.flight.duration
    count = aircraft or (10_000 if device.is_cpu() else MILLION)
    many = speed(definition_scenario, count, chunk, workers)
    aircraft_seconds = count * seconds / many.took
    rows = {
        "seconds": (many.took, "s"),
        "first chunk, with compilation": (many.compiled, "s"),
        "speed": (aircraft_seconds, "aircraft-s/s"),
    }
    figures: dict[str, Any] = {
        **many._asdict(),
        "flown": aircraft_seconds,
        "whole": count * seconds / (many.took + many.compiled),
        "memory_growth": many.memory / many.memory_early,
        "aircraft": count,
    }
    if not device.is_cpu():
        figures["of_cpu"] = aircraft_seconds / on_cpu(scenario, 10_000)["flown"]
        rows["ratio to the CPU of its host"] = (figures["of_cpu"], "")
        rows["floor"] = (floor(definition_scenario, count), "s")
    if exact:
        plain, errors = integration_error(definition_scenario, exact)
        shares = dict(zip(definition_scenario.controller.outputs, errors.tolist(), strict=True))
        rows["ratio to a simulation in one process"] = (aircraft_seconds / plain, "")
        rows |= {f"{name}: integration error": (share, "") for name, share in shares.items()}
        figures |= {"plain": plain, "exact": exact, "integration": shares}
    is_goal = not device.is_cpu() and (scenario, count) == ("osprey_servo", MILLION)
    figures["1,000,000 aircraft of 60 s with gusts on a GPU"] = many.took if is_goal else None
    label = f"{scenario}, {count:,} flights of {seconds:g} s on {device.device_name()}: "
    table = new_table(label, ("figure", "value", "unit"), texts=1)
    for name, (value, unit) in rows.items():
        table.add_row(name, f"{value:,.4g}", unit)
    Console().print(table)
    if json_file is not None:
        json_file.write_text(json.dumps(figures, indent=1))
    write_rows(label, rows, start)


if __name__ == "__main__":
    typer.run(main)
