# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a long guided flight over topics, round a triangle in turbulence.

A client of the live page watches it.

    .venv/bin/python -m benchmarks.long_flight  # the c172p of JSBSim, 60 min in lockstep
    .venv/bin/python -m benchmarks.long_flight --observer
        # the osprey, with an observer beside the law
    .venv/bin/python -m benchmarks.long_flight --observer --real-time
    .venv/bin/python -m benchmarks.long_flight --observer --one-process --rate 100 --minutes 360

Prints JSON: the outcome, the samples that the log lacks, missed ticks, the largest cross-track
error, the memory of each process in the middle and at the end of the flight, and the times to write
and to open the report.
"""

import json
import math
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from benchmarks.host_delays import Intervals, missed_excluding_delays
from benchmarks.processes import PRIORITY, RISE_DI, delay_monitors, real_time
from benchmarks.tables import parser_of
from benchmarks.view import Client, figures_of_ticks, watching
from numpy.typing import NDArray
from tests.browser import CHROMIUM, Browser

from aircraft_sim.atmosphere.turbulence import MODERATE
from flight_analysis.closed_loop.guidance_replay import replay_guidance
from flight_analysis.closed_loop.scenario import Scenario, load_scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.run_report import rewrite_report
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns
from flight_core.tape import Tape
from flight_log.bag import LOST_MESSAGES
from flight_log.tape_reader import read_run

SIDE = 6000.0  # m, of the triangle
# of about 1.5 m/s: for the c172p at its altitude; for the osprey moderate at 100 m above the ground
# (MIL-F-8785C)
TURBULENCE = {
    "c172p": {"altitude": 1219.2, "sigma": 1.5, "seed": 1},
    "osprey": MODERATE | {"seed": 1},
}
# s between samples of the memory, in flight and while the report is written
PERIOD, REPORT_PERIOD = (2.0, 0.1)
IN_VIEW = """(() => {
  document.querySelector("figure")?.scrollIntoView();
  const place = ({node}) => node.getBoundingClientRect(), all = typeof figures === "undefined" ? [] : figures;
  const found = all.filter(one => place(one).top < innerHeight && place(one).bottom > 0);
  return found.length > 0 && found.every(one => one.drawn);
})()"""  # scrolls to the first figure; true if all figures in view are drawn  # noqa: E501 - a text as it is written
MODES = {
    "in lockstep": ["--lockstep"],
    "in lockstep in one process": ["--lockstep", "--composed"],
    "in real time": ["--real-time"],
}


def triangle(minutes: float, *, observer: bool, rate: float | None = None) -> Scenario:
    """Return the flight: laps round an equilateral triangle in turbulence, without wind.

    If there is no `rate`, the scenario's own rates hold.
    """
    base = find_scenario("osprey_route" if observer else "jsbsim_c172p_route")
    if observer:
        base = replace(base, controller=find_scenario("osprey_observer").controller)
    # the triangle lies at the altitude of the start
    speed = base.aircraft.channels().speed
    altitude = base.aircraft.altitude or 0.0
    laps = math.ceil(60.0 * minutes * speed / (2.0 * SIDE))  # the fillets shorten a lap
    corners = [(0.0, 0.0), (SIDE, 0.0), (SIDE / 2.0, SIDE * math.sqrt(0.75))] * laps
    north, east = (list(values) for values in zip(*corners, strict=True))
    rates = {} if rate is None else {"rate": rate}
    return base.vary(
        flight={"duration": 60.0 * minutes},
        aircraft={
            "wind": [0.0, 0.0],
            "turbulence": TURBULENCE["osprey" if observer else "c172p"],
            **rates,
        },
        reference_model=rates,
        guidance={
            "wind": 0.0,
            "route": {"north": north, "east": east, "altitude": [altitude] * len(north)},
        },
    )


def fly(scenario: Path, runs: Path, mode: str) -> tuple[dict[str, list[int]], int]:
    """Fly with a client of the page, and return how much memory the processes need, bytes.

    The first result has samples each PERIOD until the nodes end, by the command of the process. The
    second result is the largest memory of `rise-di fly` after that, while it writes the report.
    """
    prefix = real_time() if mode == "in real time" else ()
    command = [*prefix, RISE_DI, "fly", str(scenario), *MODES[mode], "--runs", str(runs)]
    memory: dict[str, list[int]] = {}
    with ExitStack() as stack:
        flight = stack.enter_context(psutil.Popen(command, stdout=subprocess.DEVNULL))
        stack.callback(end, flight)
        while flight.poll() is None and not any(runs.glob("*/*.mcap")):
            time.sleep(0.1)
        (log,) = runs.glob("*/*.mcap")
        server, address = stack.enter_context(watching(log.parent))
        client = Client(address)
        stack.callback(client.stop)
        client.start()
        while nodes := flight.children(recursive=True):
            for process in (flight, *nodes, server):
                with suppress(psutil.Error, IndexError):  # of one that ends just now
                    words = process.cmdline()
                    name = next(
                        (word for word in words if word.endswith(".main")), f"rise-di {words[2]}"
                    )
                    memory.setdefault(name, []).append(process.memory_info().rss)
            time.sleep(PERIOD)
        most = memory["rise-di fly"][-1]
        while flight.poll() is None:
            with suppress(psutil.Error):
                most = max(most, flight.memory_info().rss)
            time.sleep(REPORT_PERIOD)
    if flight.returncode != 0:
        sys.exit(f"the flight ended with status {flight.returncode}")
    return memory, most


def end(flight: psutil.Popen) -> None:
    """End a flight that is still going on, with its processes."""
    if flight.poll() is None:
        flight.terminate()
        flight.wait()


def skips(
    tape: Tape, scenario: Scenario, *, real_time: bool
) -> dict[str, tuple[NDArray[np.int64], int]]:
    """Return begin and end of each gap between the samples of a topic, and its period, ns.

    Only samples during the flight count, not those while the processes end. In real time a tick
    that is late skips instants. It is late by 0 to 1 period, so the gap ends half a period after
    the stamp of the next sample. u is left out in real time, because it carries the stamp of a y;
    there `figures_of_ticks` counts the ticks of the controller.
    """
    guidance = scenario.guidance
    if guidance is None:
        raise ValueError("found no guidance")
    rates = {"y": scenario.aircraft.rate, "y_m": scenario.reference_model.rate}
    rates |= {} if real_time else {"u": scenario.controller.rate}
    rates |= dict.fromkeys(("u_m", "guidance"), guidance.rate)
    figures_found = {}
    end_ns = tape.start_ns + nanoseconds(scenario.flight.duration)
    for name, rate in rates.items():
        stamps = tape[name].until(end_ns).stamp_ns
        period = period_ns(rate, name)
        lateness = period // 2 if real_time else 0
        ends = np.column_stack((stamps[:-1] + period, stamps[1:] + lateness))
        figures_found[name] = (ends[np.diff(stamps) > 1.5 * period], period)
    return figures_found


def missing(
    tape: Tape, scenario: Scenario, delays: Intervals | None, *, real_time: bool
) -> dict[str, dict[str, int]]:
    """Count the samples of each topic that the log lacks.

    If host delays are known, the samples that they explain are left out of a second count.
    """
    skipped = skips(tape, scenario, real_time=real_time)
    return {
        words: {
            name: missed_excluding_delays(ends, delays_known, period)
            for name, (ends, period) in skipped.items()
        }
        for words, delays_known in (
            ("missing samples", ()),
            ("missing samples, excluding host delays", delays),
        )
        if delays_known is not None
    }


def opened(report: Path) -> dict[str, float] | None:
    """Return how long a browser takes to draw the figures of a report, s.

    Returns None without a browser. Both times begin when the browser opens the report. The page
    draws the figures in view first. The first time ends when these are drawn for a reader who goes
    to the first figure at once. The second time ends when all figures are drawn.
    """
    if CHROMIUM is None:
        return None
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        Browser(Path(profile)) as browser,
    ):
        begin = time.monotonic()
        browser.open(report)
        browser.wait_for(IN_VIEW, limit=120.0)
        in_view = time.monotonic() - begin
        browser.wait_for("Number(document.body?.dataset.drawn ?? 0) > 0", limit=120.0)
        return {"figures in view": in_view, "all figures": time.monotonic() - begin}


def figures(
    run: Path, memory: Mapping[str, list[int]], delays: Intervals | None, *, real_time: bool
) -> dict[str, Any]:
    """Return the figures of a flight from its run, SI.

    The memory is in bytes, in the middle and at the end of the flight. `delays` are those of the
    host, by the clock of the stamps, or None if unknown. `figures_of_ticks` counts ticks in real
    time alone, because in lockstep they wait for their inputs.
    """
    begin = time.monotonic()
    rewrite_report(run)
    write_time = time.monotonic() - begin
    run_read = read_run(run)
    tape = run_read.tape
    scenario = load_scenario(run.parent / "flown.yaml")
    log = tape["guidance"]
    xtrack = log["xtrack"][tape.time("guidance") > 30.0]
    replay = replay_guidance(tape, scenario.guidance)
    return {
        "outcome": json.loads((run / "summary.json").read_text())["outcome"],
        "minutes": (tape["y"].stamp_ns[-1] - tape.start_ns) / NANOSECONDS / 60.0,
        "legs": int(log["leg"].max()),
        "missing": missing(tape, scenario, delays, real_time=real_time),
        "lost": sum(int(count) for count in run_read.metadata.get(LOST_MESSAGES, {}).values()),
        "ticks": figures_of_ticks(
            tape["internals"], delays, period_ns(scenario.controller.rate, "rate")
        )
        if real_time
        else {},
        "guidance": {"steps": replay.steps, "differing": replay.differing},
        "xtrack": float(np.abs(xtrack).max()),
        "bank_deg": math.degrees(float(np.abs(log["pose.phi"]).max())),
        "V": float(log["y.V"].min()) + scenario.aircraft.channels().speed,
        "memory": {
            name: {
                "middle": values[len(values) // 2],
                "end": values[-1],
                "growth": values[-1] / values[len(values) // 2] - 1.0,
            }
            for name, values in memory.items()
        },
        "report": {
            "size": (run / "report.html").stat().st_size,
            "written": write_time,
            "opened": opened(run / "report.html"),
        },
    }


def main() -> None:
    """Fly and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="of flight time")
    parser.add_argument(
        "--observer",
        action="store_true",
        help="the osprey with its observer, in place of the c172p",
    )
    mode = parser.add_mutually_exclusive_group()
    for name, words in (
        ("--one-process", "in lockstep in one process"),
        ("--real-time", "in real time"),
    ):
        mode.add_argument(
            name, dest="mode", action="store_const", const=words, default="in lockstep", help=words
        )
    parser.add_argument("--rate", type=float, help="of y and y_m, Hz; by default the scenario's")
    parser.add_argument("--json", type=Path, help="JSON file to write")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the flight ends too
    timed = options.mode == "in real time"
    with (
        tempfile.TemporaryDirectory() as folder,
        delay_monitors(timed and bool(real_time())) as delays,
    ):
        runs = Path(folder)
        path = runs / "flown.yaml"
        path.write_text(
            scenario_yaml(triangle(options.minutes, observer=options.observer, rate=options.rate))
        )
        begin = time.monotonic()
        memory, report_memory = fly(path, runs, options.mode)
        took = time.monotonic() - begin
        clock = time.time_ns() - time.monotonic_ns()
        host = [(since + clock, until + clock) for since, until in delays()] if delays else None
        aircraft = "osprey with an observer" if options.observer else "c172p"
        priority = "" if host is None else f" at FIFO {PRIORITY}"
        result = {
            "flight": f"the {aircraft}, {options.mode}{priority}",
            "took": took,
            **figures((runs / "latest").resolve(), memory, host, real_time=timed),
        }
        result["report"]["memory"] = report_memory
        text = json.dumps(result, indent=1)
        print(text)
        if options.json is not None:
            options.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
