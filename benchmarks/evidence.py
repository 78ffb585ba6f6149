# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Writes docs/evidence.md from measurements: runs the missing ones, stores each result, renders the page from the results.

    make evidence                              # the missing measurements, then the page
    make evidence ARGS="--again faults"        # measure this one again; "speed" is all that begin so; repeatable
    make evidence ARGS="--again long"          # those of up to 80 min each, which nothing else runs: "long-faults" is one
    make evidence ARGS=--quick                 # short versions; the page marks them
    make evidence ARGS=--render                # only the page, from the stored results

build/evidence/ holds one file for each result, with its command, date, host, and the load of the host before. A failed
measurement is stored as failed and marked on the page. A section of the page without any result here stays as it is. The text
around the figures is in evidence.md.jinja.
"""

import argparse
import json
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any
from xml.etree import ElementTree

import psutil
from benchmarks.evidence_page import LONG_FLIGHTS, SPEED, Measurement, Result, render
from benchmarks.processes import RISE_DI

REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS = REPOSITORY / "build" / "evidence"
PAGE = REPOSITORY / "docs" / "evidence.md"

LOAD_INTERVAL = 2.0  # s before a measurement, over which the load of the host is measured

FILE, PYTHON = "FILE", "python"  # placeholders in commands
PYTEST = (PYTHON, "-m", "pytest", "-q", f"--junitxml={FILE}")
QUICK_SECONDS = 2.0
FUZZ_LOG = 10_000  # characters of the output of a fuzzer that ended early


def _speed(group: str) -> Measurement:
    what, seconds, takes = SPEED[group]
    command = (PYTHON, "-m", "benchmarks.speed", "--only", group, "--json", FILE, "--seconds")
    return Measurement(f"speed-{group}", (*command, f"{seconds:g}"), (*command, f"{QUICK_SECONDS:g}"), what, takes, timed=True)


FAULTS = (PYTHON, "-m", "benchmarks.faults", "--json", FILE, "--times")
RANDOM_FAULTS = (PYTHON, "-m", "benchmarks.random_faults", "--json", FILE, "--count")
CAMPAIGN = (PYTHON, "-m", "benchmarks.campaign", "--json", FILE)
FUZZ, REPLAY = ((PYTHON, "-m", "benchmarks.evidence", "--do", task, "--json", FILE) for task in ("fuzz", "replay"))
LONG_FLIGHT = (PYTHON, "-m", "benchmarks.long_flight", "--json", FILE)
QUICK_CAMPAIGN = (*CAMPAIGN, "--aircraft", "2000", "--chunk", "200", "--exact", "1")
CLUSTER = (PYTHON, "-m", "benchmarks.cluster", "--json", FILE)
VIEW = (PYTHON, "-m", "benchmarks.view", "--json", FILE)
QUICK_VIEW = (*VIEW, "--hours", "0.05", "--seconds", "20", "--count", "2")
SECURITY = (*PYTEST, "tests/ros/test_security.py")
HYPOTHESIS = (*PYTEST, "-n", "auto", "tests/fuzz")
READERS = "readers of files and messages, coverage-guided fuzzing"
CAMPAIGN_OF = ("rise-di", "campaign", "--uncertainty", "0.3", "--seed", "7", "--json")
FLEET, MISSIONS = ((*CAMPAIGN_OF, name, "--aircraft") for name in ("osprey_servo", "osprey_route"))
COMPARE = ("rise-di", "compare", "osprey_servo", "--tuning", "gust,gust_turbulence,delay", "--json", FILE, "--aircraft")

MEASUREMENTS = (
    *(_speed(group) for group in SPEED),
    Measurement("faults", (*FAULTS, "10"), (*FAULTS, "1"), "faults injected into a flight over DDS", "30 min", timed=True),
    Measurement(
        "random-faults",
        (*RANDOM_FAULTS, "20", "--lockstep", "2"),
        (*RANDOM_FAULTS, "5", "--lockstep", "1"),
        "random faults, also two at a time and in lockstep",
        "3 min",
        timed=True,
    ),
    Measurement("security", (*SECURITY, "tests/ros/test_policy.py"), SECURITY, "who can receive y and command u", "2 min"),
    Measurement("fuzz", HYPOTHESIS, HYPOTHESIS, "external input, fuzzed by hypothesis", "1 min"),
    Measurement("fuzz-coverage", (*FUZZ, "--seconds", "30"), (*FUZZ, "--seconds", "5"), READERS, "3 min"),
    Measurement("campaign", CAMPAIGN, QUICK_CAMPAIGN, "speed and accuracy of campaigns", "3 min", timed=True),
    Measurement("campaign-fleet", (*FLEET, "10000"), (*FLEET, "1000"), "uncertain aircraft flown by the same law", "1 min"),
    Measurement("campaign-missions", (*MISSIONS, "5000"), (*MISSIONS, "200"), "uncertain aircraft on a route", "3 min"),
    Measurement("cluster", CLUSTER, (*CLUSTER, "--aircraft", "1000"), "a campaign on a cluster of dask with faults", "1 min"),
    Measurement("compare", (*COMPARE, "200"), (*COMPARE, "20"), "other laws on the same aircraft and course", "5 min"),
    Measurement("view", VIEW, QUICK_VIEW, "the page beside a flight, and a log of one hour on it", "15 min", timed=True),
    Measurement("replay", REPLAY, (*REPLAY, "--seconds", "5"), "every scenario flown and replayed", "2 min"),
    Measurement(
        "long-faults",
        (*RANDOM_FAULTS, "1000", "--lockstep", "100"),
        (*RANDOM_FAULTS, "5", "--lockstep", "1"),
        "a thousand random faults",
        "75 min",
        timed=True,
        long=True,
    ),
    Measurement("long-fuzz", (*FUZZ, "--seconds", "600"), (*FUZZ, "--seconds", "5"), READERS, "55 min", long=True),
    *(
        Measurement(
            f"long-{name}",
            (*LONG_FLIGHT, *options),
            (*LONG_FLIGHT, *options, "--minutes", "1"),
            f"a guided flight: {what}",
            takes,
            timed=name == "real-time",
            long=True,
        )
        for name, (what, options, takes) in LONG_FLIGHTS.items()
    ),
)


# Measuring


def measure(one: Measurement, *, quick: bool) -> Result:
    """Run a measurement; its result with command, date, revision, host and status."""
    parts = one.quick if quick else one.command
    busy = psutil.cpu_percent(interval=LOAD_INTERVAL) / 100.0
    begin, date = time.monotonic(), datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    measured = revision()  # before it: a commit meanwhile is not what runs
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / ("result.xml" if "--junitxml=FILE" in parts else "result.json")
        programs = {PYTHON: sys.executable, "rise-di": RISE_DI}
        command = [programs.get(part, part.replace(FILE, str(file))) for part in parts]
        if parts[:2] == FLEET[:2]:
            command += ["--runs", folder]
        with (RESULTS / f"{one.name}.log").open("w", encoding="utf-8") as log:
            status, output = run_to_its_end(command, log)
            log.write(output)
        result = read(file, output)
    return {
        "name": one.name,
        "command": " ".join(parts),
        "quick": quick,
        "date": date,
        "revision": measured,
        "machine": host_details(),
        "busy": busy,
        "seconds": time.monotonic() - begin,
        "status": status,
        "result": result,
    }


def run_to_its_end(command: Sequence[str], log: IO[str]) -> tuple[int, str]:
    """Exit status and output of a program. Where this one is ended, the program ends first, with the flights it started."""
    with subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=log, text=True) as running:  # noqa: S603
        try:
            output, _ = running.communicate()
        except (KeyboardInterrupt, SystemExit) as ending:
            if isinstance(ending, SystemExit):  # SIGTERM; a Ctrl-C has reached the program too
                running.send_signal(signal.SIGINT)
            running.wait()
            raise
    return running.returncode, output


def read(file: Path, output: str) -> Any:
    """The result of a program: its JSON file, the cases of its JUnit file, else its output as JSON; None if none is valid."""
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


def host_details() -> dict[str, Any]:
    """The host of the measurement."""
    cpuinfo = Path("/proc/cpuinfo").read_text(encoding="utf-8") if Path("/proc/cpuinfo").exists() else ""
    model = re.search(r"^model name\s*: (.+)$", cpuinfo, re.MULTILINE)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "processor": model.group(1) if model else platform.machine(),
        "cores": os.cpu_count(),
        "memory": round(memory),  # GiB
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
    }


def revision() -> str:
    """The commit, with -dirty if any file but a page of evidence differs from it."""
    changed = _run("git", "status", "--porcelain", "--", ".", ":(exclude)docs/evidence*.md").stdout.strip()
    return _run("git", "describe", "--always").stdout.strip() + ("-dirty" if changed else "")


def _run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=REPOSITORY, check=False, capture_output=True, text=True)  # noqa: S603 - this repository


def replays(seconds: float | None) -> dict[str, Any]:
    """Fly every scenario in lockstep over topics, recorded, and recompute its u from its log."""
    from flight_bringup.scenarios import scenarios  # noqa: PLC0415 - not needed to write the page

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
    """Fuzz every target of benchmarks/fuzz.py for `seconds`, one on each core: statistics of the fuzzer and its exit status."""
    from tests.fuzz.targets import TARGETS  # noqa: PLC0415 - not needed to write the page

    def ran(target: str) -> dict[str, int | None]:
        found = _run(sys.executable, "-m", "benchmarks.fuzz", target, "--seconds", f"{seconds:.0f}")
        if found.returncode:  # the log of the measurement then says why
            print(found.stderr[-FUZZ_LOG:], file=sys.stderr)
        covered = re.findall(r"cov: (\d+)", found.stderr)
        stats = re.findall(r"^stat::(\w+):\s+(\d+)", found.stderr, re.MULTILINE)
        return {"status": found.returncode, "covered": int(covered[-1]) if covered else None} | {
            name: int(value) for name, value in stats
        }

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return dict(zip(TARGETS, pool.map(ran, TARGETS), strict=True))


# The command


def exit_on_sigterm() -> None:
    """Raise SystemExit at SIGTERM."""
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))


def load() -> dict[str, Result]:
    """The stored results, by name."""
    paths = {one.name: RESULTS / f"{one.name}.json" for one in MEASUREMENTS}
    return {name: json.loads(path.read_text(encoding="utf-8")) for name, path in paths.items() if path.exists()}


def write_page(results: Mapping[str, Result]) -> None:
    """Write the page from the results; sections without any stay."""
    before = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    PAGE.write_text(render(MEASUREMENTS, results, before), encoding="utf-8")


def wanted(names: Sequence[str], stored: Mapping[str, Result], *, quick: bool) -> list[Measurement]:
    """Measurements to run: missing, failed, short (unless `quick`), and those whose names begin with one of `names`.

    Of the long ones, only those whose names do.
    """

    def stale(one: Measurement) -> bool:
        result = stored.get(one.name)
        return not one.long and (result is None or result["result"] is None or (result["quick"] and not quick))

    return [one for one in MEASUREMENTS if stale(one) or one.name.startswith(tuple(names))]


def main() -> int:
    """Measure, store, render the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--again", action="append", default=[], metavar="NAME", help="only measure again what begins so")
    parser.add_argument("--quick", action="store_true", help="short versions")
    parser.add_argument("--render", action="store_true", help="write the page from the stored results")
    parser.add_argument("--do", choices=("replay", "fuzz"), help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.do is not None:
        result = replays(options.seconds) if options.do == "replay" else fuzz(options.seconds or 60.0)
        options.json.write_text(json.dumps(result, indent=1), encoding="utf-8")
        return 0
    if unknown := [name for name in options.again if not any(one.name.startswith(name) for one in MEASUREMENTS)]:
        parser.error(f"--again: found {unknown[0]!r}, expected one of {', '.join(one.name for one in MEASUREMENTS)}")
    RESULTS.mkdir(parents=True, exist_ok=True)
    exit_on_sigterm()
    results = load()
    chosen = tuple(options.again) or ("",)
    todo = [] if options.render else wanted(options.again, results, quick=options.quick)
    todo = [one for one in todo if one.name.startswith(chosen)]
    failed = False
    for number, one in enumerate(todo, 1):
        takes = "" if options.quick else f" (about {one.takes})"
        print(f"[{number} of {len(todo)}] {one.name}: {one.what}{takes} ...", end=" ", flush=True)
        result = measure(one, quick=options.quick)
        (RESULTS / f"{one.name}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        results[one.name] = result
        write_page(results)  # after each result: a long run may be interrupted
        ended = "done" if result["status"] == 0 else f"exit status {result['status']}, see build/evidence/{one.name}.log"
        failed = failed or result["status"] != 0
        print(f"{ended}, {result['seconds']:.0f} s", flush=True)
    write_page(results)
    print(f"page: {PAGE.relative_to(REPOSITORY)}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
