# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Print tables and JSON, and write files, in the way that all commands share."""

import json
import os
import sys
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich import box
from rich.cells import cell_len
from rich.console import Console, RenderableType
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from flight_analysis.closed_loop.learning_loop import Entry
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.flown_models import flown_loops
from flight_analysis.report.summary import RecordedFlight, command_results, finite_or_null
from flight_analysis.report.summary_rows import Column
from flight_core.files import is_folder, write_file, writing
from flight_core.outcome import STATUS_HOST
from flight_core.parameters import require

if TYPE_CHECKING:
    from flight_analysis.report.tables import MetricTable as PageTable

# Exit statuses. The exit status of bad input is 2 (`flight_cli.cli`).
INTERRUPTED = 130
# First lines of each file that a command writes.
LICENCE = (
    "# SPDX-FileCopyrightText: RISE-DI contributors\n# SPDX-License-Identifier: Apache-2.0\n#\n"
)
LATEST = Path("runs/latest")  # the run that a command takes if the user names none


def has_desktop() -> bool:
    """Return whether the user at the terminal can see a browser that opens on this machine."""
    has_display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    return sys.stdout.isatty() and (has_display or sys.platform in {"darwin", "win32"})


def show_outcome(console: Console, outcome: Mapping[str, Any]) -> None:
    """Print the headline of an outcome, and then the details that are not in the headline."""
    style = {0: "bold", STATUS_HOST: "bold yellow"}.get(outcome["status"], "bold red")
    say(console, f"outcome: {outcome['sentence']}", style=style)
    for detail in outcome["details"]:
        say(console, f"  - {detail}")


def show_errors(console: Console, flight: RecordedFlight) -> None:
    """Print the first table of a flight: its errors, or for an imported log its outputs."""
    first, *_ = _tables(flight)
    print_table(console, grouped_table(first.caption, first.columns, first.rows))


def _tables(flight: RecordedFlight) -> "Sequence[PageTable]":
    from flight_analysis.report import tables  # noqa: PLC0415 - loads the figures of pages

    tables_of = tables.imported_tables if flight.scenario is None else tables.metric_tables
    return tables_of(flight.summary, flight.units)


def show_flight(console: Console, flight: RecordedFlight) -> None:
    """Print the tables of a flight."""
    summary = flight.summary
    if busy := (summary["account"] or {}).get("busy"):
        say(console, busy, style="bold")
    for table in _tables(flight):
        show_table(console, table)
    if flight.controllers and flight.scenario is not None:
        _show_margins(console, flight, flight.scenario)
    if commands := command_results(summary):
        say(console, commands)
    for note in summary["notes"]:
        if note != busy:
            say(console, f"note: {note}")


def _show_margins(console: Console, flight: RecordedFlight, scenario: Scenario) -> None:
    """Print the margins for each set of parameters, if they changed in flight."""
    from flight_analysis.report import margin_figures  # noqa: PLC0415 - loads SciPy

    flown = flown_loops(flight.tape, scenario, flight.controllers, flight.later_aircraft)
    if flown.loops:
        show_table(console, margin_figures.flown_margin_table(flown))


def show_table(console: Console, table: "PageTable") -> None:
    """Print a table of the report page with its legend."""
    print_table(console, grouped_table(table.caption, table.columns, table.rows))
    if table.legend:
        say(console, table.legend, style="dim")


def entry_table(title: str, entries: Iterable[Entry]) -> Table:
    """Return a table of entries of A and B, with nominal and identified values and changes."""
    headings = ("entry", "nominal", "identified", "change %", "deviation %")
    table = new_table(f"{title}, SI; deviation: standard deviation of the change", headings)
    for entry in entries:
        values = f"{entry.nominal:.4g}", f"{entry.value:.4g}"
        if entry.nominal:
            percent = f"{100 * entry.error:+.1f}", f"{100 * entry.deviation:.1f}"
        else:
            # The nominal entry is zero, so there is no change in %.
            percent = "", f"{100 * entry.deviation / abs(entry.error or 1.0):.1f}"
        table.add_row(escape(entry.name), *values, *percent)
    return table


def entries_as_json(entries: Iterable[Entry]) -> dict[str, dict[str, float]]:
    """Return the nominal and the identified values of entries of A and B by name, in SI.

    The change of an entry and its standard deviation are fractions of the nominal value. If the
    nominal value is 0, they are in SI.
    """
    return {
        entry.name: {
            "nominal": entry.nominal,
            "value": entry.value,
            "change": entry.error,
            "deviation": entry.deviation,
            "unit": entry.unit,
        }
        for entry in entries
    }


def new_table(
    title: str,
    headings: Sequence[str],
    left_aligned: Container[str] | None = None,
    wrapped: Container[str] = (),
) -> Table:
    """Return an empty table.

    Columns are aligned right, except those in `left_aligned`, which is the first by default. Cells
    have one line, except in the columns in `wrapped`.
    """
    left_columns = headings[:1] if left_aligned is None else left_aligned
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in headings:
        justify: Literal["left", "right"] = "left" if heading in left_columns else "right"
        table.add_column(heading, justify=justify, no_wrap=heading not in wrapped, overflow="fold")
    return table


def print_table(console: Console, table: Table) -> None:
    """Print a table as wide as its content.

    If the terminal is narrower, the lines fold, but no cell is cut.
    """
    for column in table.columns:
        if column.no_wrap:
            texts = map(_plain, (column.header, *column.cells))
            lines = [line for text in texts for line in text.split("\n")]
            column.min_width = max(map(cell_len, lines), default=0)
    width = console.width
    wide = console.options.update(width=WIDEST)
    console.width = max(width, console.measure(table, options=wide).minimum)
    console.print(table)
    console.width = width


def _plain(cell: RenderableType) -> str:
    """Return the text of a cell as it is printed, without its markup."""
    return Text.from_markup(cell).plain if isinstance(cell, str) else str(cell)


WIDEST = 10_000  # width in characters; every table is narrower


NAME_COLUMN = TextColumn("{task.description}")
COUNT_COLUMNS = (NAME_COLUMN, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
SHOWN_COLUMN = TextColumn("{task.fields[shown]}")
CLOCK_COLUMNS = (TextColumn("{task.fields[clock]}"), BarColumn(), SHOWN_COLUMN)
"""Columns of progress bars. NAME_COLUMN has a name, COUNT_COLUMNS have a count and the remaining
time, SHOWN_COLUMN has a text, and CLOCK_COLUMNS have a clock and a text."""


def progress_bar(*columns: ProgressColumn, quiet: bool = False) -> Progress:
    """Return a progress bar that draws on standard error."""
    return Progress(*columns, console=Console(stderr=True, quiet=quiet))


def clock(t: float, duration: float) -> str:
    """Write the flight time, s, of `duration`, s, for a progress bar."""
    return f"t = {t:5.1f} of {duration:g} s"


@contextmanager
def flight_progress(
    duration: float, *, quiet: bool
) -> Iterator[tuple[Callable[[float, str], None], Callable[[str], None]]]:
    """Show the progress bar of a flight of `duration` s.

    Yields two functions. The first is called with the flight time and a text to show beside it. The
    second prints a line above the bar.
    """
    with progress_bar(*CLOCK_COLUMNS, quiet=quiet) as bar:
        task = bar.add_task("flight", total=duration, clock="", shown="")

        def progress(t: float, text: str) -> None:
            bar.update(task, completed=t, clock=clock(t, duration), shown=text)

        yield (
            progress,
            lambda line: bar.console.print(line, highlight=False, soft_wrap=True, markup=False),
        )


def grouped_table(title: str, columns: Sequence[Column], rows: Iterable[Sequence[str]]) -> Table:
    """Return a table whose first column has the names of the rows.

    Adjacent columns of the same group share a heading.
    """
    table = Table(title=escape(title), title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    table.show_header = any(column.label for column in columns)
    table.add_column("", no_wrap=True)
    for column, before in zip(columns, (None, *columns), strict=False):
        begins = before is None or column.group != before.group
        heading = f"{column.group if begins else ''}\n{column.head}"
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def parse_numbers(text: str) -> list[float]:
    """Parse numbers that commas separate, or return [] if a part is not a number."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return []


def named_numbers(option: str, texts: Sequence[str], example: str) -> dict[str, float]:
    """Parse texts of the form NAME=NUMBER into numbers by name."""
    numbers = {}
    for text in texts:
        name, _, value = text.rpartition("=")
        parsed = parse_numbers(value)
        is_single = bool(name) and "=" not in name and len(parsed) == 1
        again = f"; --{option} again for each further one" if "=" in name else ""
        require(
            is_single and name not in numbers,
            option,
            repr(text),
            f"a name and a number: {example}{again}",
        )
        numbers[name] = parsed[0]
    return numbers


def parse_lags(text: str) -> list[float]:
    """Parse lags such as "0.02,0.1", or one value for all. Raises ParameterError if invalid."""
    values = parse_numbers(text)
    require(bool(values), "--lag", repr(text), "seconds separated by commas")
    return values


def say(console: Console, text: str, style: str = "") -> None:
    """Print a text as it is, even if it is longer than a line."""
    console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def print_json(value: Any) -> None:
    """Print a value as JSON, with null for NaN and infinity, which JSON does not have."""
    print(json.dumps(finite_or_null(value)))


STDOUT = Path("-")


def stdout_for(file: Path | None) -> AbstractContextManager[object]:
    """Let a block print on standard error if `file` is "-", which stands for standard output."""
    return redirect_stdout(sys.stderr) if file == STDOUT else nullcontext()


def write_text(option: str, path: Path, text: str) -> None:
    """Write a file that an option names, where "-" stands for standard output.

    Raises ParameterError if the file cannot be written.
    """
    if path == STDOUT:
        print(text, end="")
        return
    with writing(option, path, "the path of a file"):
        write_file(path, text)


def require_writable(option: str, path: Path) -> None:
    """Check that a file that an option names can be written, before long work begins.

    Raises ParameterError if not.
    """
    fits = os.access(path.parent, os.W_OK) and not is_folder(path)
    require(fits, option, path, "a file in a folder that can be written")


def require_yaml(option: str, path: Path) -> None:
    """Check that a path ends in .yaml and lies in an existing folder.

    Raises ParameterError if not.
    """
    require(path.suffix == ".yaml", option, path, "a name that ends in .yaml")
    require(path.parent.is_dir(), option, path, "a file in a folder that exists")
