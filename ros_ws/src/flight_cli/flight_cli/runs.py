# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di runs`, which lists the recorded flights in a folder."""

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from flight_analysis.report.run_folder import SUMMARY
from flight_cli.output import LATEST, new_table, print_json, print_table, say
from flight_cli.words import argument, json_option
from flight_core.files import display_path

LOGS = "*.mcap"
NO_REPORT = "no report yet: rise-di report {run}"


@dataclass(frozen=True, kw_only=True)
class Runs:
    """List the recorded flights in a folder, the newest first.

    Each row says what flew, for how long, and how the flight ended. Exit status: 0.
    """

    folder: Path = argument("Folder of the runs.", default=LATEST.parent)
    as_json: bool = json_option()

    def execute(self) -> None:
        """Print a row for each run."""
        runs = [path for path in self.folder.glob("*") if path.is_dir() and not path.is_symlink()]
        flown = [run for run in runs if any(run.glob(LOGS))]
        rows = [_row(run) for run in sorted(flown, key=lambda run: run.name, reverse=True)]
        if self.as_json:
            print_json(rows)
            return
        console = Console()
        if not rows:
            say(console, f"no runs in {display_path(self.folder)}: rise-di fly records one")
            return
        headings = ("run", "scenario", "flown (s)", "outcome")
        table = new_table(
            f"Runs in {display_path(self.folder)}",
            headings,
            left_aligned=headings,
            wrapped=("outcome",),
        )
        for row in rows:
            duration = "" if row["duration"] is None else f"{row['duration']:.1f}"
            table.add_row(Path(row["run"]).name, row["scenario"], duration, row["outcome"])
        print_table(console, table)


def _row(run: Path) -> dict[str, Any]:
    """Return the row of a run from its report. Without a report, the row says how to write one."""
    name = display_path(run)
    row = {"run": name, "scenario": "", "duration": None, "outcome": NO_REPORT.format(run=name)}
    # A killed flight has no summary, and a summary of another version may lack a key.
    with suppress(OSError, ValueError, KeyError, TypeError):
        summary = json.loads((run / SUMMARY).read_text(encoding="utf-8"))
        sentence = summary["outcome"]["sentence"]
        row |= {
            "scenario": summary["scenario"],
            "duration": summary["duration"],
            "outcome": sentence,
        }
    return row
