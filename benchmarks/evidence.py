# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measures: each measurement writes figures to docs/evidence/NAME.csv, and docs/evidence.md is written from these files.

    make evidence                              # what has no file yet, or failed
    make evidence ARGS="--again faults"        # measure this again; "speed" is every name that begins so; repeatable
    make evidence ARGS="--again long"          # up to 80 min each, by name alone: "long-faults" and more
    make evidence ARGS=--quick                 # short versions, to build/evidence: for a look, not to be quoted

The exit status of a measurement that fails is a goal that is not met. build/evidence/ has logs and results.
"""

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import IO, Any, NamedTuple
from xml.etree import ElementTree

import psutil
from benchmarks import evidence_rows
from benchmarks.evidence_data import BUSY, FOLDER, REPOSITORY, Measured, Row, origin, read, row, write
from benchmarks.evidence_page import TITLES, write_page
from benchmarks.processes import RISE_DI

BUILD = REPOSITORY / "build" / "evidence"
EXIT_STATUS = "exit status"  # name of a row
BUSY_SHARE = 0.1  # of the processors, in use just before or after a measurement
LOAD_INTERVAL = 2.0  # s before and after a measurement, over which the load of the host is measured

FILE, PYTHON = "FILE", "python"  # placeholders in commands
PYTEST = (PYTHON, "-m", "pytest", "-q", f"--junitxml={FILE}")
QUICK_SECONDS = 2.0
FUZZ_LOG = 10_000  # characters of the output of a fuzzer that ended early


class Measurement(NamedTuple):
    """A program that measures."""

    name: str
    command: tuple[str, ...]  # FILE stands for the file with the result; without FILE, the result is the output
    quick: tuple[str, ...]
    rows: evidence_rows.Rows
    takes: str  # about, on two cores
    timed: bool = False  # whether a busy host spoils the figures
    long: bool = False  # whether it is measured by name alone


SPEED = {
    "law": (10.0, "10 s"),
    "receiver": (10.0, "10 s"),
    "node": (10.0, "1 min"),
    "latency": (10.0, "4 min"),
    "ticks": (60.0, "8 min"),
    "flight": (10.0, "1 min"),
    "start": (10.0, "1 min"),
    "import": (10.0, "10 s"),
    "lockstep": (30.0, "1 min"),
    "recorder": (30.0, "1 min"),
}
"""Of each group of benchmarks/speed.py: s a figure, and the time it takes."""

LONG_FLIGHTS = {
    "lockstep": (("--observer", "--one-process", "--rate", "100", "--minutes", "360"), "80 min"),
    "real-time": (("--observer", "--real-time"), "65 min"),
    "jsbsim": (("--one-process",), "25 min"),
}
"""Of each long flight: the options of benchmarks/long_flight.py, and the time it takes."""


def _speed(group: str) -> Measurement:
    seconds, takes = SPEED[group]
    command = (PYTHON, "-m", "benchmarks.speed", "--only", group, "--json", FILE, "--seconds")
    full, quick = ((*command, f"{each:g}") for each in (seconds, QUICK_SECONDS))
    return Measurement(f"speed-{group}", full, quick, evidence_rows.speed, takes, timed=True)


FAULTS = (PYTHON, "-m", "benchmarks.faults", "--json", FILE, "--times")
RANDOM_FAULTS = (PYTHON, "-m", "benchmarks.random_faults", "--json", FILE, "--count")
CAMPAIGN = (PYTHON, "-m", "benchmarks.campaign", "--json", FILE)
FUZZ, REPLAY = ((PYTHON, "-m", "benchmarks.evidence", "--do", task, "--json", FILE) for task in ("fuzz", "replay"))
LONG_FLIGHT = (PYTHON, "-m", "benchmarks.long_flight", "--json", FILE)
QUICK_CAMPAIGN = (*CAMPAIGN, "--aircraft", "2000", "--chunk", "200", "--exact", "1")
CLUSTER = (PYTHON, "-m", "benchmarks.cluster", "--json", FILE)
VIEW = (PYTHON, "-m", "benchmarks.view", "--json", FILE)
QUICK_VIEW = (*VIEW, "--hours", "0.05", "--seconds", "20", "--count", "2")
SECURITY = (*PYTEST, "tests/ros/test_security.py", "tests/nodes/test_security.py")
POLICY = ("tests/ros/test_policy.py", "tests/nodes/test_policy.py")
HYPOTHESIS = (*PYTEST, "-n", "auto", "tests/fuzz")
CAMPAIGN_OF = ("rise-di", "campaign", "--uncertainty", "0.3", "--seed", "7", "--json")
FLEET, MISSIONS = ((*CAMPAIGN_OF, name, "--aircraft") for name in ("osprey_servo", "osprey_route"))
EFFECTORS = (PYTHON, "-m", "benchmarks.effectors", "--json", FILE, "--faults", "lost", "--seeds")
MARGINS = (PYTHON, "-m", "benchmarks.margins", "--json", FILE, "--aircraft")
COMPARE = ("rise-di", "compare", "osprey_servo", "--tuning", "gust,gust_turbulence,delay", "--json", FILE, "--aircraft")

MEASUREMENTS = (
    *(_speed(group) for group in SPEED),
    Measurement("faults", (*FAULTS, "10"), (*FAULTS, "1"), evidence_rows.faults, "30 min", timed=True),
    Measurement(
        "random-faults",
        (*RANDOM_FAULTS, "20", "--lockstep", "2"),
        (*RANDOM_FAULTS, "5", "--lockstep", "1"),
        evidence_rows.random_faults,
        "3 min",
        timed=True,
    ),
    Measurement("security", (*SECURITY, *POLICY), SECURITY, evidence_rows.tests, "2 min"),
    Measurement("fuzz", HYPOTHESIS, HYPOTHESIS, evidence_rows.tests, "1 min"),
    Measurement("fuzz-coverage", (*FUZZ, "--seconds", "30"), (*FUZZ, "--seconds", "5"), evidence_rows.fuzz, "3 min"),
    Measurement("campaign", CAMPAIGN, QUICK_CAMPAIGN, evidence_rows.campaign, "3 min", timed=True),
    Measurement("campaign-fleet", (*FLEET, "10000"), (*FLEET, "1000"), evidence_rows.fleet, "1 min"),
    Measurement("campaign-missions", (*MISSIONS, "5000"), (*MISSIONS, "200"), evidence_rows.fleet, "3 min"),
    Measurement("cluster", CLUSTER, (*CLUSTER, "--aircraft", "1000"), evidence_rows.cluster, "1 min"),
    Measurement("compare", (*COMPARE, "200"), (*COMPARE, "20"), evidence_rows.compare, "5 min"),
    Measurement(
        "compare-self_tuner",
        (*COMPARE, "200", "--laws", "self_tuner"),
        (*COMPARE, "20", "--laws", "self_tuner"),
        evidence_rows.compare,
        "1 min",
    ),
    Measurement("margins", (*MARGINS, "200"), (*MARGINS, "10"), evidence_rows.margins, "15 min"),
    Measurement("effectors", (*EFFECTORS, "50"), (*EFFECTORS, "1"), evidence_rows.effectors, "60 min", long=True),
    Measurement("view", VIEW, QUICK_VIEW, evidence_rows.view, "15 min", timed=True),
    Measurement("replay", REPLAY, (*REPLAY, "--seconds", "5"), evidence_rows.replay, "2 min"),
    Measurement(
        "long-faults",
        (*RANDOM_FAULTS, "1000", "--lockstep", "100"),
        (*RANDOM_FAULTS, "5", "--lockstep", "1"),
        evidence_rows.random_faults,
        "75 min",
        timed=True,
        long=True,
    ),
    Measurement("long-fuzz", (*FUZZ, "--seconds", "600"), (*FUZZ, "--seconds", "5"), evidence_rows.fuzz, "55 min", long=True),
    *(
        Measurement(
            f"long-{name}",
            (*LONG_FLIGHT, *options),
            (*LONG_FLIGHT, *options, "--minutes", "1"),
            evidence_rows.long_flight,
            takes,
            timed=name == "real-time",
            long=True,
        )
        for name, (options, takes) in LONG_FLIGHTS.items()
    ),
)
"""All but guidance and real autopilots, which benchmarks/guidance.py and benchmarks/autopilots.py measure."""


# Measuring


def measure(measurement: Measurement, folder: Path, *, quick: bool) -> int:
    """Run a measurement and write the rows to a folder; the exit status, 1 also where the program left no result."""
    parts = measurement.quick if quick else measurement.command
    busy = psutil.cpu_percent(interval=LOAD_INTERVAL) / 100.0
    begun = origin(" ".join(parts))  # before the run: a commit meanwhile is not what runs
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / ("result.xml" if "--junitxml=FILE" in parts else "result.json")
        programs = {PYTHON: sys.executable, "rise-di": RISE_DI}
        command = [programs.get(part, part.replace(FILE, str(file))) for part in parts]
        if parts[:2] == FLEET[:2]:
            command += ["--runs", place]
        with (BUILD / f"{measurement.name}.log").open("w", encoding="utf-8") as log:
            status, output = run_to_its_end(command, log)
            log.write(output)
        result = read_result(file, output)
    (BUILD / f"{measurement.name}.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    busy = max(busy, psutil.cpu_percent(interval=LOAD_INTERVAL) / 100.0)
    if measurement.timed and busy > BUSY_SHARE:
        begun = begun._replace(host=f"{begun.host}, {100 * busy:.0f} % {BUSY}")
    write(measurement.name, rows_of(measurement, result, status), begun, folder)
    return status or int(result is None)


def rows_of(measurement: Measurement, result: Any, status: int) -> list[Row]:
    """The rows of a result, None where the program left none; an exit status other than 0 is a goal that is not met."""
    failed = [row(EXIT_STATUS, status or "no result", at_most=0)] if status or result is None else []
    return [*failed, *(() if result is None else measurement.rows(result))]


def run_to_its_end(command: Sequence[str], log: IO[str]) -> tuple[int, str]:
    """Exit status and output of a program. A signal to end reaches the program first, which ends the flights that run."""
    with subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=log, text=True) as running:  # noqa: S603
        try:
            output, _ = running.communicate()
        except (KeyboardInterrupt, SystemExit) as ending:
            if isinstance(ending, SystemExit):  # SIGTERM; a Ctrl-C has reached the program too
                running.send_signal(signal.SIGINT)
            running.wait()
            raise
    return running.returncode, output


def read_result(file: Path, output: str) -> Any:
    """The result of a program: the JSON file, the cases of the JUnit file, else the output as JSON; None if none is valid."""
    try:
        if file.suffix == ".xml":
            return cases(file.read_text(encoding="utf-8"))
        return json.loads(file.read_text(encoding="utf-8") if file.exists() else output)
    except (OSError, ValueError, ElementTree.ParseError):
        return None


def cases(junit: str) -> list[dict[str, Any]]:
    """Test cases of a JUnit file: name, outcome ("passed", "failed", "skipped"), seconds."""
    outcomes = []
    for case in ElementTree.fromstring(junit).iter("testcase"):  # noqa: S314 - pytest's own
        kinds = {child.tag for child in case}
        outcome = "failed" if kinds & {"failure", "error"} else "skipped" if "skipped" in kinds else "passed"
        outcomes.append({"name": case.get("name", ""), "outcome": outcome, "seconds": float(case.get("time", "0"))})
    return outcomes


def _run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=REPOSITORY, check=False, capture_output=True, text=True)  # noqa: S603 - this repository


def replays(seconds: float | None) -> dict[str, Any]:
    """Fly every scenario in lockstep over topics, recorded, and recompute u from the log."""
    from flight_analysis.closed_loop.scenario_library import scenarios  # noqa: PLC0415 - not needed to write the page

    results = {}
    duration = [] if seconds is None else ["--duration", f"{seconds:g}"]
    for name in scenarios():
        with tempfile.TemporaryDirectory() as runs:
            flight = _run(RISE_DI, "fly", name, "--one-process", "--runs", runs, "--json", *duration)
            replayed = _run(RISE_DI, "replay", str(Path(runs) / "latest"), "--json")
            try:
                results[name] = {"outcome": json.loads(flight.stdout)["outcome"]} | json.loads(replayed.stdout)
            except (ValueError, KeyError):
                results[name] = {"outcome": (flight.stderr + replayed.stderr).strip().splitlines()[-1:]}
    return results


def fuzz(seconds: float) -> dict[str, Any]:
    """Fuzz every target of benchmarks/fuzz.py for `seconds`, a core for a target: statistics and exit status of the fuzzer."""
    from tests.fuzz.targets import TARGETS  # noqa: PLC0415 - not needed to write the page

    def ran(target: str) -> dict[str, int | None]:
        fuzzer = _run(sys.executable, "-m", "benchmarks.fuzz", target, "--seconds", f"{seconds:.0f}")
        if fuzzer.returncode:  # the log of the measurement then says why
            print(fuzzer.stderr[-FUZZ_LOG:], file=sys.stderr)
        covered = re.findall(r"cov: (\d+)", fuzzer.stderr)
        stats = re.findall(r"^stat::(\w+):\s+(\d+)", fuzzer.stderr, re.MULTILINE)
        return {"status": fuzzer.returncode, "covered": int(covered[-1]) if covered else None} | {
            name: int(value) for name, value in stats
        }

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return dict(zip(TARGETS, pool.map(ran, TARGETS), strict=True))


# The command


def exit_on_sigterm() -> None:
    """Raise SystemExit at SIGTERM."""
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))


def wanted(names: Sequence[str], measured: Mapping[str, Measured]) -> list[Measurement]:
    """Measurements to run: by the beginnings of names; without `names`, what has no file or failed.

    The long ones run by name alone.
    """

    def stale(measurement: Measurement) -> bool:
        known = measured.get(measurement.name)
        return not measurement.long and (known is None or [figure.name for figure in known.rows] == [EXIT_STATUS])

    return [each for each in MEASUREMENTS if (each.name.startswith(tuple(names)) if names else stale(each))]


def main() -> int:
    """Measure, write the rows, write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--again", action="append", default=[], metavar="NAME", help="only measure again what begins so")
    parser.add_argument("--quick", action="store_true", help="short versions, to build/evidence")
    parser.add_argument("--do", choices=("replay", "fuzz"), help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.do is not None:
        result = replays(options.seconds) if options.do == "replay" else fuzz(options.seconds or 60.0)
        options.json.write_text(json.dumps(result, indent=1), encoding="utf-8")
        return 0
    if unknown := [name for name in options.again if not any(each.name.startswith(name) for each in MEASUREMENTS)]:
        parser.error(f"--again: found {unknown[0]!r}, expected one of {', '.join(each.name for each in MEASUREMENTS)}")
    BUILD.mkdir(parents=True, exist_ok=True)
    exit_on_sigterm()
    folder = BUILD if options.quick else FOLDER
    todo = wanted(options.again, read(folder))
    failed = False
    for number, measurement in enumerate(todo, 1):
        takes = "" if options.quick else f" (about {measurement.takes})"
        print(f"[{number} of {len(todo)}] {measurement.name}: {TITLES[measurement.name]}{takes} ...", end=" ", flush=True)
        begin = time.monotonic()
        status = measure(measurement, folder, quick=options.quick)
        write_page()  # after each measurement: a long run may be interrupted
        ended = "done" if status == 0 else f"exit status {status}, see build/evidence/{measurement.name}.log"
        failed = failed or status != 0
        print(f"{ended}, {time.monotonic() - begin:.0f} s", flush=True)
    write_page()
    print(f"figures: {folder.relative_to(REPOSITORY)}; page: docs/evidence.md")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
