# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""docs/evidence.md from measurements: runs what has not been measured yet, keeps each result, writes the page from the results.

    make evidence                              # what is missing, then the page
    make evidence ARGS="--again faults"        # this one anew; "speed" is all that begins so; may be given several times
    make evidence ARGS=--quick                 # short versions, which the page marks
    make evidence ARGS=--render                # the page alone, from what is there

Results are kept in build/evidence/, one file each with its command, date, machine, and how busy that was before. A measurement
that fails is kept as failed, and the page says so; nothing on the page is written by hand but the words around the figures.
"""

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import psutil
from benchmarks.evidence_page import SPEED, Measurement, Result, render

REPOSITORY = Path(__file__).resolve().parents[1]
KEPT = REPOSITORY / "build" / "evidence"
PAGE = REPOSITORY / "docs" / "evidence.md"

LOOK = 2.0  # s, before a measurement, at how busy the machine is

FILE, SHORT = "FILE", "python"  # as commands are shown


PYTEST = (SHORT, "-m", "pytest", "-q", f"--junitxml={FILE}")
QUICK_SECONDS = 2.0


def _speed(group: str) -> Measurement:
    what, seconds = SPEED[group]
    command = (SHORT, "-m", "benchmarks.speed", "--only", group, "--json", FILE, "--seconds")
    takes = {"law": "10 s", "ticks": "8 min", "latency": "3 min"}.get(group, "1 min")
    return Measurement(f"speed-{group}", (*command, f"{seconds:g}"), (*command, f"{QUICK_SECONDS:g}"), what, takes, timed=True)


def _own(task: str, *options: str) -> tuple[str, ...]:
    return (SHORT, "-m", "benchmarks.evidence", "--do", task, "--json", FILE, *options)


FAULTS = (SHORT, "-m", "benchmarks.faults", "--json", FILE, "--times")
CAMPAIGN = (SHORT, "-m", "benchmarks.campaign", "--json", FILE)
FLEET = ("rise-di", "campaign", "osprey_servo", "--uncertainty", "0.3", "--seed", "7", "--json", "--aircraft")
COMPARE = ("rise-di", "compare", "osprey_servo", "--tuning", "nominal,uncertain,late", "--json", FILE, "--aircraft")

MEASUREMENTS = (
    *(_speed(group) for group in SPEED),
    Measurement("faults", (*FAULTS, "10"), (*FAULTS, "1"), "faults put into a flight over DDS", "20 min", timed=True),
    Measurement(
        "security",
        (*PYTEST, "tests/ros/test_security.py", "tests/ros/test_policy.py"),
        (*PYTEST, "tests/ros/test_security.py"),
        "who can hear y and have a u flown",
        "2 min",
    ),
    Measurement("fuzz", (*PYTEST, "tests/fuzz"), (*PYTEST, "tests/fuzz"), "inputs from outside, by hypothesis", "2 min"),
    Measurement(
        "fuzz-coverage",
        _own("fuzz", "--seconds", "120"),
        _own("fuzz", "--seconds", "5"),
        "readers of files and messages, guided by the lines that they run",
        "12 min",
    ),
    Measurement(
        "campaign",
        CAMPAIGN,
        (*CAMPAIGN, "--aircraft", "2000", "--chunk", "200", "--exact", "1"),
        "speed and exactness of campaigns",
        "3 min",
        timed=True,
    ),
    Measurement("campaign-fleet", (*FLEET, "10000"), (*FLEET, "1000"), "uncertain aircraft flown by the same law", "1 min"),
    Measurement("compare", (*COMPARE, "200"), (*COMPARE, "20"), "other laws on the same aircraft and course", "5 min"),
    Measurement("replay", _own("replay"), _own("replay", "--seconds", "5"), "every scenario flown and recomputed", "2 min"),
)


# Measuring


def measure(one: Measurement, *, quick: bool) -> Result:
    """Run it, and what it left behind, with what is known of the run."""
    shown = one.quick if quick else one.command
    busy = psutil.cpu_percent(interval=LOOK) / 100.0
    begin, date = time.monotonic(), datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    with tempfile.TemporaryDirectory() as folder:
        left = Path(folder) / ("left.xml" if "--junitxml=FILE" in shown else "left.json")
        programs = {SHORT: sys.executable, "rise-di": str(Path(sys.executable).parent / "rise-di")}
        command = [programs.get(part, part.replace(FILE, str(left))) for part in shown]
        if shown[:2] == FLEET[:2]:
            command += ["--runs", folder]
        log = KEPT / f"{one.name}.log"
        with log.open("w", encoding="utf-8") as stream:
            ran = subprocess.run(command, cwd=REPOSITORY, check=False, stdout=subprocess.PIPE, stderr=stream, text=True)  # noqa: S603
            stream.write(ran.stdout)
        result = read(left, ran.stdout)
    return {
        "name": one.name,
        "command": " ".join(shown),
        "quick": quick,
        "date": date,
        "revision": revision(),
        "machine": machine(),
        "busy": busy,
        "seconds": time.monotonic() - begin,
        "status": ran.returncode,
        "result": result,
    }


def read(left: Path, output: str) -> Any:
    """What a program left: its JSON file, the cases of its JUnit file, else its output as JSON; None where it is none."""
    try:
        if left.suffix == ".xml":
            return cases(left.read_text(encoding="utf-8"))
        return json.loads(left.read_text(encoding="utf-8") if left.exists() else output)
    except (OSError, ValueError, ElementTree.ParseError):
        return None


def cases(junit: str) -> list[dict[str, Any]]:
    """Test cases of a JUnit file: name, outcome ("passed", "failed", "skipped"), seconds."""
    found = []
    for case in ElementTree.fromstring(junit).iter("testcase"):  # noqa: S314 - pytest's own
        kinds = {child.tag for child in case}
        outcome = "failed" if kinds & {"failure", "error"} else "skipped" if "skipped" in kinds else "passed"
        found.append({"name": case.get("name", ""), "outcome": outcome, "seconds": float(case.get("time", "0"))})
    return found


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    about = Path("/proc/cpuinfo").read_text(encoding="utf-8") if Path("/proc/cpuinfo").exists() else ""
    model = re.search(r"^model name\s*: (.+)$", about, re.MULTILINE)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "processor": model.group(1) if model else platform.machine(),
        "cores": os.cpu_count(),
        "memory": round(memory),  # GiB
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
    }


def revision() -> str:
    """The commit, and whether anything but the page differs from it."""
    changed = _said("git", "status", "--porcelain", "--", ".", f":(exclude){PAGE.relative_to(REPOSITORY)}")
    return _said("git", "describe", "--always") + ("-dirty" if changed else "")


def _said(*command: str) -> str:
    ran = subprocess.run(command, cwd=REPOSITORY, check=False, capture_output=True, text=True)  # noqa: S603
    return ran.stdout.strip()


def replays(seconds: float | None) -> dict[str, Any]:
    """Fly every scenario in lockstep over topics, recorded, and recompute its u from its log."""
    from flight_bringup.scenarios import scenarios  # noqa: PLC0415 - not needed to write the page

    rise_di, found = str(Path(sys.executable).parent / "rise-di"), {}
    duration = [] if seconds is None else ["--duration", f"{seconds:g}"]
    for name in scenarios():
        with tempfile.TemporaryDirectory() as runs:
            fly = [rise_di, "fly", name, "--one-process", "--runs", runs, "--json", *duration]
            flown = subprocess.run(fly, check=False, capture_output=True, text=True)  # noqa: S603 - this stack
            again = [rise_di, "replay", str(Path(runs) / "latest"), "--json"]
            replayed = subprocess.run(again, check=False, capture_output=True, text=True)  # noqa: S603 - this stack
            try:
                found[name] = {"outcome": json.loads(flown.stdout)["outcome"]} | json.loads(replayed.stdout)
            except (ValueError, KeyError):
                found[name] = {"outcome": (flown.stderr + replayed.stderr).strip().splitlines()[-1:]}
    return found


def fuzz(seconds: float) -> dict[str, Any]:
    """Every target of benchmarks/fuzz.py for so long: what its fuzzer says of itself, and whether it found anything."""
    from tests.fuzz.targets import TARGETS  # noqa: PLC0415 - not needed to write the page

    found = {}
    for target in TARGETS:
        command = [sys.executable, "-m", "benchmarks.fuzz", target, "--seconds", f"{seconds:.0f}"]
        ran = subprocess.run(command, cwd=REPOSITORY, check=False, capture_output=True, text=True)  # noqa: S603 - this repository
        stats = re.findall(r"^stat::(\w+):\s+(\d+)", ran.stderr, re.MULTILINE)
        covered = re.findall(r"cov: (\d+)", ran.stderr)
        found[target] = {"status": ran.returncode, "covered": int(covered[-1]) if covered else None}
        found[target] |= {name: int(value) for name, value in stats}
    return found


# The command


def load() -> dict[str, Result]:
    """The results that are there, by name."""
    found = {}
    for one in MEASUREMENTS:
        path = KEPT / f"{one.name}.json"
        if path.exists():
            found[one.name] = json.loads(path.read_text(encoding="utf-8"))
    return found


def wanted(names: Sequence[str], there: Mapping[str, Result], *, quick: bool) -> list[Measurement]:
    """What is to be measured: what is missing, failed or, unless `quick`, a short version, and what is asked for anew."""

    def stale(one: Measurement) -> bool:
        result = there.get(one.name)
        return result is None or result["result"] is None or (result["quick"] and not quick)

    return [one for one in MEASUREMENTS if stale(one) or one.name.startswith(tuple(names))]


def main() -> int:
    """Measure, keep, write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--again", action="append", default=[], metavar="NAME", help="measure anew what begins so, that alone")
    parser.add_argument("--quick", action="store_true", help="short versions")
    parser.add_argument("--render", action="store_true", help="write the page from what is there")
    parser.add_argument("--do", choices=("replay", "fuzz"), help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.do is not None:
        did = replays(asked.seconds) if asked.do == "replay" else fuzz(asked.seconds or 60.0)
        asked.json.write_text(json.dumps(did, indent=1), encoding="utf-8")
        return 0
    unknown = [name for name in asked.again if not any(one.name.startswith(name) for one in MEASUREMENTS)]
    if unknown:
        parser.error(f"--again: found {unknown[0]!r}, expected one of {', '.join(one.name for one in MEASUREMENTS)}")
    KEPT.mkdir(parents=True, exist_ok=True)
    results = load()
    todo = [] if asked.render else wanted(asked.again, results, quick=asked.quick)
    if asked.again:
        todo = [one for one in todo if one.name.startswith(tuple(asked.again))]
    failed = False
    for number, one in enumerate(todo, 1):
        takes = "" if asked.quick else f" (about {one.takes})"
        print(f"[{number} of {len(todo)}] {one.name}: {one.what}{takes} ...", end=" ", flush=True)
        result = measure(one, quick=asked.quick)
        (KEPT / f"{one.name}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        results[one.name] = result
        PAGE.write_text(render(MEASUREMENTS, results), encoding="utf-8")  # as far as it is: a long run may be broken off
        ended = "done" if result["status"] == 0 else f"exit status {result['status']}, see build/evidence/{one.name}.log"
        failed = failed or result["status"] != 0
        print(f"{ended}, {result['seconds']:.0f} s", flush=True)
    PAGE.write_text(render(MEASUREMENTS, results), encoding="utf-8")
    print(f"page: {PAGE.relative_to(REPOSITORY)}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
