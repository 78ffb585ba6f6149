# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of the programs that measure."""

from collections.abc import Sequence

from rich import box
from rich.table import Table

from flight_core.vectors import FloatArray


def cells(values: FloatArray, factor: float = 1.0) -> str:
    """Values with three digits, joined by slashes."""
    return " / ".join(f"{value:.3g}" if abs(value) >= 5e-4 else "0" for value in values * factor)


def new_table(title: str, columns: Sequence[str], texts: int) -> Table:
    """A table whose first columns hold text, the others figures."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index < texts else "right", no_wrap=True)
    return table
