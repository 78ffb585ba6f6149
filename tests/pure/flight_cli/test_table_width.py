# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that no figure of a table is cut, at any width of a terminal and in a pipe."""

import io
import re

import pytest
from rich.console import Console
from tests.conftest import REPOSITORY

from flight_analysis.report.summary import RecordedFlight
from flight_analysis.report.summary_rows import ERROR_COLUMNS, columns_of, table_rows
from flight_cli.output import new_table, print_table, show_flight
from flight_cli.report import show_comparison

WIDTHS = [10, 40, 80, 120, 300]


def printed(width: int) -> tuple[Console, io.StringIO]:
    """Return a console of a width, and the text that is printed on it."""
    output = io.StringIO()
    return Console(file=output, width=width), output


@pytest.mark.parametrize("width", WIDTHS)
def test_every_cell_is_printed_whole(width: int) -> None:
    """The cells are those of a comparison of laws.

    In a pipe, the last columns had lost their digits.
    """
    cells = [
        "rise_observer",
        "1.60 (1.98)",
        "10.19 +0.12",
        "elevator / aileron / rudder",
        "[dim]x[/]",
    ]
    table = new_table("A title that is longer than the table is wide", [*"abcde"])
    table.add_row(*cells)
    console, output = printed(width)
    print_table(console, table)
    assert all(cell in output.getvalue() for cell in [*cells[:-1], "x"])
    assert console.width == width


@pytest.mark.parametrize("width", WIDTHS)
def test_column_that_wraps_keeps_its_words(width: int) -> None:
    table = new_table("", ["name", "text"], wrapped=("text",))
    table.add_row("trim", "operating point of states and inputs")
    console, output = printed(width)
    print_table(console, table)
    assert {*["operating", "point", "of", "states", "and", "inputs"]} <= {
        *output.getvalue().split()
    }


@pytest.mark.parametrize("width", WIDTHS)
def test_figures_of_a_flight_and_of_a_comparison_are_whole(
    width: int, flight: RecordedFlight
) -> None:
    columns = columns_of(ERROR_COLUMNS, flight.summary["errors"])
    rows = table_rows(flight.summary["errors"], columns, flight.units)
    for show in (show_flight, lambda console, each: show_comparison(console, [each, each])):
        console, output = printed(width)
        show(console, flight)
        words = output.getvalue().split()
        for name, *figures in rows:
            assert {*name.split(), *figures} <= {*words}, name


def test_commands_print_no_table_past_the_width() -> None:
    """`console.print` cuts a table if the terminal has no room for it."""
    for path in (REPOSITORY / "ros_ws/src/flight_cli/flight_cli").glob("*.py"):
        calls = re.findall(r"console\.print\(\s*\w*table\w*", path.read_text())
        assert len(calls) == (path.name == "output.py"), path.name  # in `print_table`
