# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di report`: tables, report page, figures and data of recorded runs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from flight_analysis.report import comparison
from flight_analysis.report.export import signal_table
from flight_analysis.report.paper import WIDTH
from flight_analysis.report.report import report as write_report
from flight_analysis.report.summary import ERROR_COLUMNS, RecordedFlight, taken_over
from flight_cli.log_options import LogNamespace, LogRemaps, LogScenario, remaps_of, scenario_file
from flight_cli.output import LATEST, STDOUT, new_table, print_json, say, show_flight, stdout_for
from flight_cli.repair import repair_log
from flight_cli.words import AsJson, argument, option, setting
from flight_core.files import display_path
from flight_core.outcome import STATUS_INCOMPLETE


def report(
    runs: Annotated[
        list[Path] | None,
        argument("Folder of a run, by default runs/latest; several are compared with the first."),
    ] = None,
    html: Annotated[
        Path | None,
        setting("html", "Page of a comparison; by default comparison.html beside run 1."),
    ] = None,
    output: Annotated[
        Path | None,
        setting(
            "output", "Folder for the report of one run, by default that of its log: for archives."
        ),
    ] = None,
    png: Annotated[Path | None, option("Write y over y_m, e and u as one PNG figure.")] = None,
    csv: Annotated[
        Path | None,
        option(
            "Write all signals as CSV, one row an instant, one column a channel; - for standard "
            "output."
        ),
    ] = None,
    parquet: Annotated[Path | None, option("Write the same table as Parquet.")] = None,
    repair: Annotated[
        bool,
        option(
            "Rebuild each log whose recorder was killed, or that is damaged, and write no report.",
            "--repair",
        ),
    ] = False,
    scenario: LogScenario = None,
    namespace: LogNamespace = None,
    remap: LogRemaps = None,
    figure: Annotated[
        Path | None, option("Write a figure for a paper: .pdf, .svg, .eps as vectors, or .png.")
    ] = None,
    width: Annotated[str, setting("width", "Width of the figure: 88mm, 3.5in.")] = WIDTH,
    channels: Annotated[
        str,
        setting(
            "channels",
            "Channels of the figure: outputs, inputs, errors, as in q,V,e.q,elevator; by "
            "default each output.",
        ),
    ] = "",
    mat: Annotated[
        Path | None, setting("mat", "Write all signals as a MAT-file, a structure a topic.")
    ] = None,
    tables: Annotated[Path | None, setting("tables", "Folder for a CSV a topic.")] = None,
    latex: Annotated[
        Path | None, setting("latex", "Write the tables of errors and inputs as LaTeX.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write the report page of a recorded run again, or one that compares several, and print its
    tables.

    A log of --repair holds every message that could be read, an index and, in the folder of a run,
    metadata.yaml. The damaged file stays as *.damaged, an intact log as it is, and metadata.yaml of
    another program is never replaced. Exit status: 0, 2 bad input, 4 a log is incomplete.
    """
    if repair:
        for run in runs or [LATEST]:
            repair_log(run)
        return
    scenario_source = scenario_file(scenario)
    page, flights = write_report(
        *(runs or [LATEST]),
        html=html,
        output=output,
        png=png,
        csv=None if csv == STDOUT else csv,
        parquet=parquet,
        figure=figure,
        width=width,
        channels=channels,
        mat=mat,
        tables=tables,
        latex=latex,
        namespace=namespace,
        scenario=scenario_source,
        remaps=remaps_of(remap),
    )
    if csv == STDOUT:
        print(signal_table(flights).write_csv(), end="")
    with stdout_for(csv):
        if as_json:
            summaries = [flight.summary for flight in flights]
            print_json(summaries[0] if len(flights) == 1 else summaries)
        else:
            if len(flights) == 1:
                show_flight(Console(), flights[0])
                print(f"outcome: {flights[0].summary['outcome']}")
            else:
                show_comparison(Console(), flights)
            print(f"report:  {display_path(page)}")
    if any(flight.summary["account"] and flight.summary["account"]["lacks"] for flight in flights):
        raise typer.Exit(STATUS_INCOMPLETE)


def show_comparison(console: Console, flights: Sequence[RecordedFlight]) -> None:
    """Print the errors of several flights with their ratios to the first."""
    for k, (label, flight) in enumerate(
        zip(comparison.labels(flights), flights, strict=True), start=1
    ):
        result = f"{flight.summary['outcome']}{taken_over(flight.summary, 'errors')}"
        say(console, f"{k}: {label}, {result}")
    headings = ("channel", "", *(str(k + 1) for k in range(len(flights))))
    table = new_table(
        "Tracking error, and its ratio to the first", headings, left_aligned=("channel", "")
    )
    for channel in comparison.metric_tables(flights, "errors", ERROR_COLUMNS, lower_is_better=True):
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
    console.print(table)
