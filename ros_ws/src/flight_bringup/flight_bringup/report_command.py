# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di report`: the figures of recorded runs, as tables, pages, pictures and data."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from flight_analysis import comparison
from flight_analysis.export import write_csv, write_parquet, write_png
from flight_analysis.metrics import PARTS
from flight_analysis.recorded import Recorded
from flight_analysis.report import write_page
from flight_analysis.summary import ERROR_COLUMNS, INPUT_COLUMNS, Column, figure_rows, limited_cell, shown_units
from flight_bringup import fly as flying
from flight_core.parameters import ParameterError


def report(
    runs: Annotated[list[Path], typer.Argument(help="Folder of a run; several are compared, each with the first.")],
    html: Annotated[Path | None, typer.Option(help="Page of a comparison; comparison.html beside the first run.")] = None,
    png: Annotated[Path | None, typer.Option(help="Write y over y_m, e and u as one picture.")] = None,
    csv: Annotated[
        Path | None, typer.Option(help="Write all signals as a table: a row an instant, a column a channel.")
    ] = None,
    parquet: Annotated[Path | None, typer.Option(help="Write the same table as Parquet.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON, of several runs a list of them.")] = False,
) -> None:
    """Write the report page of a recorded run again, or one that compares several, and print its tables.

    Exit status: 0, or 2 bad input.
    """
    if len(runs) == 1 and html is None:
        concluded = flying.conclude(runs[0])
        flights, page = [concluded.flight], concluded.report
    else:
        flights, page = [flying.read_flight(run) for run in runs], html or runs[0].absolute().parent / "comparison.html"
        _write("--html", page, write_page, flights)
    for option, path, write in (("--png", png, write_png), ("--csv", csv, write_csv), ("--parquet", parquet, write_parquet)):
        if path is not None:
            _write(option, path, write, flights)
    if as_json:
        summaries = [flight.summary for flight in flights]
        print(json.dumps(summaries[0] if len(runs) == 1 else summaries))
        return
    if len(flights) == 1:
        show(Console(), flights[0])
        print(f"outcome: {flights[0].summary['outcome']}")
    else:
        show_comparison(Console(), flights)
    print(f"report:  {short(page)}")


def _write(option: str, path: Path, write: Callable[[Path, Sequence[Recorded]], None], flights: Sequence[Recorded]) -> None:
    try:
        write(path, flights)
    except OSError as error:
        raise ParameterError(
            f"{option}: {path} cannot be written ({error.strerror or error}), expected the path of a file"
        ) from None


def show(console: Console, flight: Recorded) -> None:
    """Print the tables of a flight."""
    summary, units = flight.summary, shown_units(flight.scenario)
    console.print(
        _table(
            f"Tracking error ({summary['error']}), {summary['duration']:.1f} s flown",
            "channel",
            ERROR_COLUMNS,
            figure_rows(summary["errors"], ERROR_COLUMNS, units),
        )
    )
    rows = figure_rows(summary["inputs"], INPUT_COLUMNS, units)
    limited = [limited_cell(of) for of in summary["inputs"].values()]
    if rows:
        columns = (*INPUT_COLUMNS, Column("limited", "%", ()))
        console.print(
            _table(
                "Inputs about trim, and mean abs(u_dot) a second",
                "input",
                columns,
                [[*row, share] for row, share in zip(rows, limited, strict=True)],
            )
        )
    console.print(f"{PARTS}. bound: the largest error in calm", style="dim", highlight=False)
    for line in (*_timing(summary), *(f"note: {note}" for note in summary["notes"])):
        console.print(line, highlight=False)


def show_comparison(console: Console, flights: Sequence[Recorded]) -> None:
    """Print the errors of several flights beside each other, with ratios to the first."""
    for k, (label, flight) in enumerate(zip(comparison.labels(flights), flights, strict=True), start=1):
        console.print(f"{k}: {label}, {flight.summary['outcome']}", highlight=False, soft_wrap=True)
    table = Table(title="Tracking error, and its ratio to the first", title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("channel", no_wrap=True)
    table.add_column("", no_wrap=True)
    for k in range(len(flights)):
        table.add_column(f"{k + 1}", justify="right", no_wrap=True)
    for block in comparison.blocks(flights, "errors", ERROR_COLUMNS, judged=True):
        for k, row in enumerate(block.rows):
            ratios = ("" if j == 0 or ratio is None else f" x{ratio:.3g}" for j, ratio in enumerate(row.ratios))
            cells = (f"{text}{ratio}" for text, ratio in zip(row.texts, ratios, strict=True))
            table.add_row(block.name if k == 0 else "", row.what, *cells, end_section=k == len(block.rows) - 1)
    console.print(table)


def _table(title: str, first: str, columns: Sequence[Column], rows: Iterable[Sequence[str]]) -> Table:
    """A table whose neighbouring columns of one group share a head."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    table.add_column(f"\n{first}", no_wrap=True)
    for column, before in zip(columns, (None, *columns), strict=False):
        begins = before is None or column.group != before.group
        table.add_column(f"{column.group if begins else ''}\n{column.head}", justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def _timing(summary: Mapping[str, Any]) -> list[str]:
    lines = []
    if (ticks := summary["ticks"]) is not None:
        ms = {key: f"{value * 1e3:.3f}" for key, value in ticks.items()}
        lines.append(
            f"ticks: {ticks['ticks']}, {ticks['without_new_y']} without a new y; period mean {ms['period_mean']} ms,"
            f" p99 {ms['period_p99']}, max {ms['period_max']}; late p99 {ms['late_p99']} ms, max {ms['late_max']}"
        )
    if (latency := summary["latency"]) is not None:
        median, p99, largest = (f"{value * 1e3:.3f}" for value in latency.values())
        lines.append(f"y sent to u sent: median {median} ms, p99 {p99}, max {largest}")
    return lines


def short(path: Path) -> str:
    """A path as it is best shown: relative where it is below the working folder."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)
