# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Inject random faults of all kinds, seeded and repeatable, a tenth of them two at a time.

    .venv/bin/python -m benchmarks.random_faults --count 1000 --lockstep 100 --seed 1 [--json FILE]
    .venv/bin/python -m benchmarks.random_faults --count 1 --seed 417    # one of them again

It injects the cases of tests/ros/flight_bringup/faults in real time, and those of failures of the
past (tests/ros/flight_bringup/faults/draws.py). A fault passes if the node that should detects
it, u responds as docs/faults.md states, no process ends or raises, the flight is steady again, and
the log holds every message that was received. For two faults at a time the response of u does not
count. In lockstep, where faults of messages do not exist, a killed node ends the flight with its
name, and a stopped one changes no byte of the log.
"""

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer
from benchmarks.faults import Row, run_campaign
from tests.ros.flight_bringup.faults.draws import FOUND


def main(
    count: Annotated[int, typer.Option(min=0, help="Number of draws in real time.")] = 1000,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the first draw; the others count up.")
    ] = 1,
    lockstep: Annotated[
        int, typer.Option(min=0, help="Number of draws in lockstep, beside the others.")
    ] = 0,
    file: Annotated[Path | None, typer.Option("--json", help="JSON file to write.")] = None,
) -> None:
    """Inject random faults and print what failed; exit status 1 if any did."""
    options = [f"--faults-random={count}", f"--faults-lockstep={lockstep}", f"--faults-seed={seed}"]
    options += [f"--timeout={30 * (count + lockstep) + 300}", "-k", "random or log_holds"]
    total = count + lockstep + (len(FOUND) if count else 0)
    rows, status = run_campaign(options, total)
    failed = [row for row in rows if not row["passed"]]
    two = sum("," in row["case"] for row in rows)
    cases = Counter(name for row in rows for name in row["case"].split(", "))
    result: Row = {
        "seed": seed,
        "draws": total,
        "two": two,
        "lockstep": lockstep,
        "passed": len(rows) - len(failed),
        "draws that fail": total - len(rows) + len(failed),
    }
    result |= {"status": status, "cases": cases, "failed": failed}
    if file is not None:
        file.write_text(json.dumps(result, indent=2) + "\n")
    for row in failed:
        print(f"seed {row['seed']}, {row['case']}: {row['error']}")
    print(f"{result['passed']} of {total} draws passed, {two} of them with two faults at a time")
    sys.exit(int(result["passed"] < total or bool(status)))


if __name__ == "__main__":
    typer.run(main)
