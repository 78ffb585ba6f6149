# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What the commands share: tables, JSON, paths, exit statuses."""

import json
import sys
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from typing import Any, Literal

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
from flight_analysis.report.display_units import (
    DisplayUnit,
    format_seconds,
)
from flight_analysis.report.flown_models import flown_loops
from flight_analysis.report.guided import leg_results
from flight_analysis.report.summary import (
    RecordedFlight,
    command_results,
    finite_or_null,
    parts_legend,
    taken_over,
    time_flown,
)
from flight_analysis.report.summary_rows import (
    ERROR_COLUMNS,
    HELD_COLUMNS,
    INPUT_COLUMNS,
    SATURATION_COLUMN,
    Column,
    columns_of,
    input_rows,
    model_rows,
    segment_table,
    table_rows,
    timing_rows,
)
from flight_core.files import write_file, writing
from flight_core.parameters import require

# exit status; bad input is 2 (`flight_cli.cli`)
INTERRUPTED = 130
# of a written file
LICENCE = (
    "# SPDX-FileCopyrightText: RISE-DI contributors\n# SPDX-License-Identifier: Apache-2.0\n#\n"
)
LATEST = Path("runs/latest")  # the run of a command that is given none


def show_flight(console: Console, flight: RecordedFlight) -> None:
    """Print the tables of a flight."""
    summary = flight.summary
    units = flight.units
    if flight.scenario is None:
        _show_imported(console, flight)
        return
    if busy := (summary["account"] or {}).get("busy"):
        say(console, busy, style="bold")
    title = f"Tracking error ({summary['error']}), {time_flown(summary)}"
    columns = columns_of(ERROR_COLUMNS, summary["errors"])
    print_table(
        console,
        grouped_table(title, "channel", columns, table_rows(summary["errors"], columns, units)),
    )
    if rows := input_rows(summary, units):
        title = f"Inputs about trim, and mean abs(u_dot) per second{taken_over(summary, 'inputs')}"
        columns = (*columns_of(INPUT_COLUMNS, summary["inputs"]), SATURATION_COLUMN)
        print_table(console, grouped_table(title, "input", columns, rows))
    if summary["guidance"]:
        title = f"Guidance by segment{taken_over(summary, 'guidance')}"
        segments = segment_table(summary["guidance"]["segments"], HELD_COLUMNS[:2])
        print_table(console, grouped_table(title, "segment", *segments))
        if legs := leg_results(summary["guidance"]["legs"]):
            say(console, f"{legs}{taken_over(summary, 'guidance')}")
    if summary["models"]:
        print_table(console, model_table(summary["models"], units, taken_over(summary, "errors")))
    if flight.controllers:
        _show_margins(console, flight, flight.scenario)
    if commands := command_results(summary):
        say(console, commands)
    say(console, parts_legend(summary), style="dim")
    for line in (
        *_timing(summary),
        *(f"note: {note}" for note in summary["notes"] if note != busy),
    ):
        say(console, line)


def _show_margins(console: Console, flight: RecordedFlight, scenario: Scenario) -> None:
    """Print the margins under the parameters that flew, where these changed in flight."""
    from flight_analysis.report import margin_figures  # noqa: PLC0415 - loads SciPy

    loops = flown_loops(flight.tape, scenario, flight.controllers)
    if not loops:
        return
    margins = margin_figures.flown_margin_table(loops)
    print_table(console, grouped_table(margins.caption, "", margins.columns, margins.rows))


def _show_imported(console: Console, flight: RecordedFlight) -> None:
    """Print y and u of a flight that the stack did not fly."""
    summary = flight.summary
    for title, key in (("Outputs", "outputs"), ("Inputs", "inputs")):
        columns = columns_of(INPUT_COLUMNS, summary[key])
        caption = f"{title} about trim, {format_seconds(summary['duration'])}"
        print_table(
            console,
            grouped_table(
                caption, "channel", columns, table_rows(summary[key], columns, flight.units)
            ),
        )
    for note in summary["notes"]:
        say(console, f"note: {note}")


def model_table(
    models: Sequence[Mapping[str, Any]], units: Mapping[str, DisplayUnit], part: str = ""
) -> Table:
    """The rms of the error before the first learned model and under each. `part` of the flight that
    the log has.
    """
    headings, rows = model_rows(models, units)
    table = new_table(
        f"Rms of the error by model{part}",
        ["", *(heading.replace(" ", "\n") for heading in headings)],
    )
    for row in rows:
        table.add_row(*row)
    return table


def entry_table(title: str, entries: Iterable[Entry]) -> Table:
    """Entries of A and B, nominal and identified, with the standard deviation of the change."""
    headings = ("entry", "nominal", "identified", "change %", "deviation %")
    table = new_table(f"{title}, SI; deviation: of the change, standard", headings)
    for entry in entries:
        values = f"{entry.nominal:.4g}", f"{entry.value:.4g}"
        if entry.nominal:
            percent = f"{100 * entry.error:+.1f}", f"{100 * entry.deviation:.1f}"
        else:  # it is new: there is no change in %
            percent = "", f"{100 * entry.deviation / abs(entry.error or 1.0):.1f}"
        table.add_row(escape(entry.name), *values, *percent)
    return table


def entries_as_json(entries: Iterable[Entry]) -> dict[str, dict[str, float]]:
    """Entries of A and B by name, nominal and identified in SI; change and its deviation in units,
    that of an entry in SI.
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
    """An empty table: columns outside `left_aligned`, by default the first, are aligned right,
    columns outside `wrapped` keep to one line.
    """
    left = headings[:1] if left_aligned is None else left_aligned
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in headings:
        justify: Literal["left", "right"] = "left" if heading in left else "right"
        table.add_column(heading, justify=justify, no_wrap=heading not in wrapped, overflow="fold")
    return table


def print_table(console: Console, table: Table) -> None:
    """Print a table at the width that its figures need: a narrow terminal folds the lines, and no
    cell is cut.
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
    """The text of a cell as it is printed."""
    return Text.from_markup(cell).plain if isinstance(cell, str) else str(cell)


WIDEST = 10_000  # characters, more than any table has


NAME_COLUMN = TextColumn("{task.description}")
COUNT_COLUMNS = (NAME_COLUMN, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
SHOWN_COLUMN = TextColumn("{task.fields[shown]}")
CLOCK_COLUMNS = (TextColumn("{task.fields[clock]}"), BarColumn(), SHOWN_COLUMN)
"""Columns of progress bars: a count and the time that is left, a text, a clock with a text."""


def progress_bar(*columns: ProgressColumn, quiet: bool = False) -> Progress:
    """A progress bar on standard error."""
    return Progress(*columns, console=Console(stderr=True, quiet=quiet))


def clock(t: float, duration: float) -> str:
    """The flight time of a progress bar, s."""
    return f"t = {t:5.1f} of {duration:g} s"


@contextmanager
def flight_progress(
    duration: float, *, quiet: bool
) -> Iterator[tuple[Callable[[float, str], None], Callable[[str], None]]]:
    """The progress bar of a flight, s: a function for the flight time and the text beside it, and
    one for a line above.
    """
    with progress_bar(*CLOCK_COLUMNS, quiet=quiet) as bar:
        task = bar.add_task("flight", total=duration, clock="", shown="")

        def progress(t: float, shown: str) -> None:
            bar.update(task, completed=t, clock=clock(t, duration), shown=shown)

        yield (
            progress,
            lambda line: bar.console.print(line, highlight=False, soft_wrap=True, markup=False),
        )


def grouped_table(
    title: str, first: str, columns: Sequence[Column], rows: Iterable[Sequence[str]]
) -> Table:
    """A table whose adjacent columns of one group share a heading."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    table.add_column(f"\n{first}", no_wrap=True)
    for column, before in zip(columns, (None, *columns), strict=False):
        begins = before is None or column.group != before.group
        heading = f"{column.group if begins else ''}\n{column.head}"
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def _timing(summary: Mapping[str, Any]) -> list[str]:
    """The timing of the controller, a line for each topic of the summary."""
    lines = []
    for topic in ("ticks", "latency", "age_of_u"):
        if rows := timing_rows(summary, topic):
            (first, text), *others = rows
            parts = [f"{first}{taken_over(summary, topic)}: {text}"]
            parts += [f"{label}: {text}" for label, text in others]
            lines.append("; ".join(parts))
    return lines


def parse_numbers(text: str) -> list[float]:
    """Numbers separated by commas; an empty list where one of them is none."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return []


def say(console: Console, text: str, style: str = "") -> None:
    """Print a text as it is, also where it is longer than a line."""
    console.print(text, style=style, highlight=False, soft_wrap=True)


def print_json(value: Any) -> None:
    """Print a value as JSON, with null for NaN and infinity, which JSON does not have."""
    print(json.dumps(finite_or_null(value)))


STDOUT = Path("-")


def stdout_for(file: Path | None) -> AbstractContextManager[object]:
    """Standard output is free for a file that is "-": what the block prints goes to the errors."""
    return redirect_stdout(sys.stderr) if file == STDOUT else nullcontext()


def write_text(option: str, path: Path, text: str) -> None:
    """Write a file that an option names, "-" for standard output. Raises ParameterError where it
    cannot be written.
    """
    if path == STDOUT:
        print(text, end="")
        return
    with writing(option, path, "the path of a file"):
        write_file(path, text)


def require_yaml(option: str, path: Path) -> None:
    """Raise ParameterError unless a path is that of a .yaml file in a folder that exists."""
    require(path.suffix == ".yaml", option, path, "a name that ends in .yaml")
    require(path.parent.is_dir(), option, path, "a file in a folder that exists")
