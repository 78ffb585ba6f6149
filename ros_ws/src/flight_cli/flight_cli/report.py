# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di report`, which writes tables, pages, figures and data of recorded runs."""

import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import typer
from rich.console import Console

from flight_analysis.report import comparison
from flight_analysis.report.export import signal_table
from flight_analysis.report.paper import WIDTH
from flight_analysis.report.recorded_flight import UnflownError
from flight_analysis.report.report import report as write_report
from flight_analysis.report.summary import RecordedFlight, coverage_suffix, labels
from flight_analysis.report.summary_rows import ERROR_COLUMNS
from flight_cli.log_options import REMAP, log_namespace, log_scenario, remaps_of, scenario_file
from flight_cli.output import (
    LATEST,
    STDOUT,
    has_desktop,
    named_numbers,
    new_table,
    print_json,
    print_table,
    say,
    show_flight,
    show_outcome,
    stdout_for,
)
from flight_cli.repair import repair_log
from flight_cli.words import argument, json_option, option, rare_option, values_of, warn
from flight_core.files import display_path
from flight_core.outcome import SEVEREST, STATUS_SHORTFALL

FILES = ("html", "output", "png", "parquet", "figure")


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write the report page of a recorded run again, and print its tables.

    If there are several runs, the page compares them. With --repair, a damaged log is rebuilt. The
    new log has an index and every message that could be read, and the folder of a run also gets
    metadata.yaml. The damaged file is kept as *.damaged. An intact log stays as it is, and
    metadata.yaml of another program is never replaced.

    Exit status: the status of the flight (see docs/outcomes.md), or the gravest of several flights;
    2 bad input.
    """

    runs: list[Path] | None = argument(
        "Folder of a run; by default runs/latest. Several runs are compared with the first."
    )
    html: Path | None = rare_option(
        "Page of a comparison; by default in a new folder beside the first run.", "--page"
    )
    output: Path | None = rare_option(
        "Folder for the report of one run; by default the folder of its log. Use it for archives."
    )
    png: Path | None = option("PNG file to write, with y over y_m, e and u.")
    csv: Path | None = option(
        "CSV file to write, with a row for each instant and a column for each channel; - is "
        "standard output."
    )
    parquet: Path | None = option("Parquet file to write, with the same table.")
    repair: bool = option(
        "Rebuild each log that is damaged or whose recorder was killed, and write no report.",
        default=False,
    )
    scenario: str | None = log_scenario()
    namespace: str | None = log_namespace()
    remap: list[str] | None = option(REMAP, metavar="NAME:=TOPIC")
    figure: Path | None = option(
        "File to write with a figure for a paper: .pdf, .svg, .eps as vectors, or .png."
    )
    width: str = rare_option("Width of the figure, as in 88mm or 3.5in.", default=WIDTH)
    channels: str = rare_option(
        "Channels of the figure: outputs, inputs and errors, as in q,V,e.q,elevator; by default "
        "each output.",
        default="",
    )
    tolerance: list[str] | None = rare_option(
        "Tolerance of a channel in the differences of runs, SI, as in q=0.02; may be repeated.",
        metavar="NAME=VALUE",
    )
    opens: bool | None = rare_option(
        "Open the page in the browser; by default if you are at a terminal on a desktop.",
        "--open/--no-open",
    )
    as_json: bool = json_option()

    def execute(self) -> None:
        """Write the report, or repair the logs, and print the tables."""
        runs = self.runs or [LATEST]
        if self.repair:
            for run in runs:
                repair_log(run)
            return
        try:
            report = write_report(
                *runs,
                **values_of(self, *FILES, "width", "channels", "namespace"),
                csv=None if self.csv == STDOUT else self.csv,
                scenario=scenario_file(self.scenario),
                remaps=remaps_of(self.remap),
                tolerances=named_numbers("tolerance", self.tolerance or (), "q=0.02"),
            )
        except UnflownError as error:
            warn(f"error: {error}")
            raise typer.Exit(error.outcome.status or STATUS_SHORTFALL) from None
        if self.csv == STDOUT:
            print(signal_table(report.flights).write_csv(), end="")
        with stdout_for(self.csv):
            if self.as_json:
                summaries = [flight.summary for flight in report.flights]
                print_json(summaries[0] if len(summaries) == 1 else summaries)
            else:
                _show(report.flights)
                print(f"report:  {display_path(report.page)}")
        is_looked_at = has_desktop() and not self.as_json and self.csv != STDOUT
        if is_looked_at if self.opens is None else self.opens:
            webbrowser.open(report.page.absolute().as_uri())
        statuses = [flight.summary["outcome"]["status"] for flight in report.flights]
        if status := max(statuses, key=SEVEREST.index):
            raise typer.Exit(status)


def _show(flights: Sequence[RecordedFlight]) -> None:
    """Print the tables of one flight, or a comparison of several flights."""
    if len(flights) > 1:
        show_comparison(Console(), flights)
        return
    console = Console()
    show_flight(console, flights[0])
    show_outcome(console, flights[0].summary["outcome"])


def show_comparison(console: Console, flights: Sequence[RecordedFlight]) -> None:
    """Print the errors of several flights, with their ratios to the first flight."""
    for k, (label, flight) in enumerate(zip(labels(flights), flights, strict=True), start=1):
        result = (
            f"{flight.summary['outcome']['sentence']}{coverage_suffix(flight.summary, 'errors')}"
        )
        say(console, f"{k}: {label}, {result}")
    for condition in comparison.conditions(flights):
        say(console, f"{condition.key}: {'; '.join(condition.texts)}")
    if not all(comparison.has_same_conditions(flights)):
        say(console, comparison.UNLIKE, style="bold")
    headings = ("channel", "", *(str(k + 1) for k in range(len(flights))))
    table = new_table(
        "Tracking error, and its ratio to the first", headings, left_aligned=("channel", "")
    )
    for channel in comparison.comparison_tables(
        flights, "errors", ERROR_COLUMNS, lower_is_better=True
    ):
        for k, row in enumerate(channel.rows):
            ratios = (
                "" if j == 0 or ratio is None else f" x{ratio:.3g}"
                for j, ratio in enumerate(row.ratios)
            )
            cells = (f"{text}{ratio}" for text, ratio in zip(row.texts, ratios, strict=True))
            table.add_row(
                channel.caption if k == 0 else "",
                row.name,
                *cells,
                end_section=k == len(channel.rows) - 1,
            )
    print_table(console, table)
