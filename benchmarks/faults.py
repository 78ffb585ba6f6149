# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run the fault campaign of tests/ros/flight_bringup/faults several times in a row, as a table.

    .venv/bin/python -m benchmarks.faults [--times 10] [--scenario osprey_observer] [--json FILE]
    [--only "killed or stopped"]
    .venv/bin/python -m benchmarks.faults --only roll-in --guided jsbsim_c172p_route
        # another aircraft under guidance

The reaction is the time from the fault to its first detection by a node. The recovery is the time
from the end of the fault, or for a killed node from when it is ready, until the law flies again. An
instant is the reception time of the message that shows the event. The host delay is the longest
time that a process of the flight, or the probe, waited for a processor; the other times include it.
"""

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from benchmarks.tables import new_table
from rich.console import Console
from rich.table import Table

from flight_cli.output import COUNT_COLUMNS, progress_bar

REPOSITORY = Path(__file__).resolve().parents[1]
CAMPAIGN = REPOSITORY / "tests" / "ros" / "flight_bringup" / "faults"

STARTS = ("exec_to_ready", "start_run", "start_waited")
"""Times of the start of a killed node: from its start until it is ready, and for how long of this
time its main thread runs, and waits for a processor."""

# times of a killed node
TRAFFIC = ("exec_to_traffic", "ready_to_traffic", "ready_to_caught_up")
TIMES = ("reaction", "recovery", "longest_pause", "held_back", "page", *TRAFFIC, *STARTS)
# largest bank after the loss of u_m, and the bank when the wings have to be level again
BANKS = ("bank_deg", "last_bank_deg")

Row = dict[str, Any]


def fly(times: int, seed: int, only: str, scenario: str, guided: str) -> tuple[list[Row], int]:
    """Inject every case `times` times in a row.

    Returns one row for each injection, and the exit status of the tests.
    """
    options = [f"--faults-times={times}", f"--faults-seed={seed}", f"--timeout={120 * times}"]
    words = only.replace(",", " ").split() or ["test"]
    # the name of a case has blanks
    expression = only if {"and", "or", "not"} & set(words) else " and ".join(words)
    options += [f"--faults-scenario={scenario}", f"--faults-guided={guided}"]
    return run_campaign([*options, "-k", f"not random and ({expression} or log_holds)"])


def run_campaign(options: Sequence[str], total: int | None = None) -> tuple[list[Row], int]:
    """Run the tests with options of pytest. Returns their rows, and the exit status.

    Exits if no test matches. `total` is the number of injections, for the progress bar, or None if
    it is unknown.
    """
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "rows.jsonl"
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            str(CAMPAIGN),
            f"--faults-table={table}",
            *options,
        ]
        with (
            subprocess.Popen(command, cwd=REPOSITORY, stdout=sys.stderr) as tests,  # noqa: S603
            progress_bar(*COUNT_COLUMNS) as bar,
        ):
            task = bar.add_task("faults", total=total)
            while tests.poll() is None:
                time.sleep(1.0)
                if table.exists():
                    bar.update(task, completed=table.read_text().count("\n"))
        if not table.exists():
            sys.exit("error: no case matches")
        status = tests.returncode
        return [json.loads(line) for line in table.read_text().splitlines()], status


def summarise(rows: Sequence[Row]) -> list[Row]:
    """Return one row for each case, in the order of their first injection.

    It has how many faults were injected and passed, and the median and the worst of each time, s,
    over those that passed.
    """
    cases: dict[str, list[Row]] = {}
    for row in rows:
        cases.setdefault(row["case"], []).append(row)
    return [_summary(case, runs) for case, runs in cases.items()]


def _summary(case: str, rows: Sequence[Row]) -> Row:
    passed_rows = [row for row in rows if row["passed"]]
    summary: Row = {
        "case": case,
        "u": rows[0]["does"],
        "injected": len(rows),
        "passed": len(passed_rows),
    }
    summary["any_delay"] = sum(row["any_delay"] for row in passed_rows)
    for key in (*TIMES, *BANKS):
        values = [row[key] for row in passed_rows if row.get(key) is not None]
        summary[key] = (
            {"median": statistics.median(values), "worst": max(values)} if values else None
        )
    return summary


def milliseconds(times: Mapping[str, float] | None) -> str:
    """Write times in s as median / worst in ms."""
    return "-" if times is None else f"{1e3 * times['median']:.0f} / {1e3 * times['worst']:.0f}"


def to_table(summaries: Sequence[Row]) -> Table:
    """Make the table for a terminal, in ms."""
    columns = (
        "fault",
        "injected",
        "passed",
        "reaction",
        "recovery",
        "traffic",
        "pause",
        "host delay",
    )
    table = new_table("Faults, times in ms, median / worst", columns, texts=1)
    for summary in summaries:
        times = [
            milliseconds(summary[key])
            for key in ("reaction", "recovery", "ready_to_traffic", "longest_pause", "held_back")
        ]
        table.add_row(summary["case"], str(summary["injected"]), str(summary["passed"]), *times)
    table.caption = "traffic: from ready until a killed node publishes all its topics; "
    table.caption += "pause: the longest of a topic that continues; "
    table.caption += "host delay: the longest that a process waited for a processor"
    return table


def main(
    times: Annotated[int, typer.Option(min=1, help="Number of injections of each fault.")] = 10,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the first injection; the others count up.")
    ] = 1,
    scenario: Annotated[
        str, typer.Option(help="Scenario of the flight without guidance.")
    ] = "osprey_gust",
    guided: Annotated[
        str, typer.Option(help="Scenario of the flight under guidance.")
    ] = "osprey_route",
    only: Annotated[
        str, typer.Option(help="Cases by words of their names, or an expression of pytest's -k.")
    ] = "",
    file: Annotated[Path | None, typer.Option("--json", help="JSON file to write.")] = None,
) -> None:
    """Run the fault campaign and print its table.

    Exit status 1 if a case did not pass each time, or a log lacks messages.
    """
    rows, status = fly(times, seed, only, scenario, guided)
    summaries = summarise(rows)
    if file is not None:
        file.write_text(json.dumps(summaries, indent=2) + "\n")
    Console(width=None if sys.stdout.isatty() else 160).print(to_table(summaries))
    for bank in (summary for summary in summaries if summary["bank_deg"]):
        largest, last = (
            f"{bank[key]['median']:.1f} / {bank[key]['worst']:.1f} deg" for key in BANKS
        )
        print(f"{bank['case']}: largest bank {largest}, after ten seconds {last} (median / worst)")
    if status or any(summary["passed"] < times for summary in summaries):
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
