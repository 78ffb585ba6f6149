# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A long guided flight over topics in lockstep: the c172p round a triangle in turbulence.

    .venv/bin/python -m benchmarks.long_flight [--minutes 60] [--runs FOLDER]

Prints JSON and writes it to docs/evidence_guidance.md: the outcome, the samples that the log lacks, the largest cross-track
error, the memory of each process in the middle and at the end of the flight, and how long a browser takes to open the report.
"""

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from benchmarks import guidance_page
from tests.browser import CHROMIUM, Browser

from flight_analysis.closed_loop.guidance_replay import replay_guidance
from flight_analysis.closed_loop.scenario import Scenario, load_scenario, scenario_yaml
from flight_bringup.scenarios import find_scenario
from flight_core.rates import NANOSECONDS, period_ns
from flight_core.tape import Tape
from flight_log.tape_reader import read_run

SIDE = 6000.0  # m, of the triangle
SIGMA = 1.5  # m/s, of the turbulence
PERIOD = 2.0  # s between samples of the memory
MIB = 2**20


def triangle(minutes: float) -> Scenario:
    """The flight: laps round an equilateral triangle in turbulence, without wind."""
    base = find_scenario("jsbsim_c172p_route")
    speed, altitude = base.aircraft.channels().speed, base.aircraft.altitude
    laps = math.ceil(60.0 * minutes * speed / (2.0 * SIDE))  # the fillets shorten a lap
    corners = [(0.0, 0.0), (SIDE, 0.0), (SIDE / 2.0, SIDE * math.sqrt(0.75))] * laps
    north, east = (list(values) for values in zip(*corners, strict=True))
    return base.vary(
        flight={"duration": 60.0 * minutes},
        aircraft={"wind": [0.0, 0.0], "turbulence": {"altitude": altitude, "sigma": SIGMA, "seed": 1}},
        guidance={"wind": 0.0, "route": {"north": north, "east": east, "altitude": [altitude] * len(north)}},
    )


def fly(scenario: Path, runs: Path, *, together: bool) -> dict[str, list[int]]:
    """Fly in lockstep; the memory of each process by its command, bytes every PERIOD."""
    command = [
        sys.executable,
        "-m",
        "flight_cli.cli",
        "fly",
        str(scenario),
        "--one-process" if together else "--lockstep",
        "--runs",
        str(runs),
    ]
    memory: dict[str, list[int]] = {}
    with psutil.Popen(command, stdout=subprocess.DEVNULL) as flight:
        while flight.poll() is None:
            for process in (flight, *flight.children(recursive=True)):
                with suppress(psutil.Error):
                    modules = [word for word in process.cmdline() if word.endswith((".main", ".cli"))]
                    if modules:
                        memory.setdefault(modules[0], []).append(process.memory_info().rss)
            time.sleep(PERIOD)
    return memory


def missing(tape: Tape, scenario: Scenario) -> dict[str, int]:
    """How many samples of each topic the log lacks, from its first to its last instant."""
    guidance = scenario.guidance
    if guidance is None:
        raise ValueError("found no guidance")
    rates = {"y": scenario.aircraft.rate, "y_m": scenario.reference_model.rate, "u": scenario.controller.rate}
    rates |= dict.fromkeys(("u_m", "guidance"), guidance.rate)
    lacking = {}
    for name, rate in rates.items():
        stamps = tape[name].stamp_ns
        lacking[name] = int((stamps[-1] - stamps[0]) // period_ns(rate, name)) + 1 - len(stamps)
    return lacking


def opened(report: Path) -> float | None:
    """Time from the address to all figures drawn in a browser, s; None without a browser."""
    if CHROMIUM is None:
        return None
    with tempfile.TemporaryDirectory() as profile, Browser(Path(profile)) as browser:
        begin = time.monotonic()
        browser.open(report)
        browser.wait_for("Number(document.body?.dataset.drawn ?? 0) > 0", limit=120.0)
        return time.monotonic() - begin


def figures(run: Path, memory: Mapping[str, list[int]]) -> dict[str, Any]:
    """The figures of a flight from its run."""
    read = read_run(run)
    tape, scenario = read.tape, load_scenario(run.parent / "flown.yaml")
    log = tape["guidance"]
    xtrack = log["xtrack"][tape.time("guidance") > 30.0]
    replay = replay_guidance(tape, scenario.guidance)
    half = {name: values[len(values) // 2] for name, values in memory.items()}
    return {
        "outcome": json.loads((run / "summary.json").read_text(encoding="utf-8"))["outcome"],
        "minutes": round((tape["y"].stamp_ns[-1] - tape.start_ns) / NANOSECONDS / 60.0, 3),
        "legs": int(log["leg"].max()),
        "samples missing": missing(tape, scenario),
        "steps of guidance that replay differently": [replay.differing, replay.steps],
        "largest cross-track error (m)": round(float(np.abs(xtrack).max()), 1),
        "largest bank (deg)": round(math.degrees(float(np.abs(log["pose.phi"]).max())), 1),
        "V least (m/s)": round(float(log["y.V"].min()) + scenario.aircraft.channels().speed, 1),
        "memory, middle and end (MiB)": {
            name: [round(half[name] / MIB, 1), round(values[-1] / MIB, 1)] for name, values in memory.items()
        },
        "report (MB)": round((run / "report.html").stat().st_size / 1e6, 2),
        "report opened in (s)": opened(run / "report.html"),
    }


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="of flight time")
    parser.add_argument("--runs", type=Path, help="folder for the run; by default it is removed")
    parser.add_argument("--one-process", action="store_true", help="all nodes in one process")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        runs = options.runs or Path(folder)
        runs.mkdir(parents=True, exist_ok=True)
        path = runs / "flown.yaml"
        path.write_text(scenario_yaml(triangle(options.minutes)), encoding="utf-8")
        begin = time.monotonic()
        memory = fly(path, runs, together=options.one_process)
        took = time.monotonic() - begin
        run = (runs / "latest").resolve()
        found = {"minutes it took": round(took / 60.0, 1)} | figures(run, memory)
        guidance_page.store("long flight", found)
        print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
