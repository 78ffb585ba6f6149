# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables, pictures and options of the programs that measure."""

import argparse
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image
from rich import box
from rich.table import Table

from flight_core.vectors import FloatArray


def cells(values: FloatArray, factor: float = 1.0) -> str:
    """Join values with three digits by slashes."""
    return " / ".join(f"{value:.3g}" if abs(value) >= 5e-4 else "0" for value in values * factor)


def new_table(title: str, columns: Sequence[str], texts: int) -> Table:
    """Return a table whose first columns hold text and the others figures."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index < texts else "right", no_wrap=True)
    return table


def parser_of(text: str | None) -> argparse.ArgumentParser:
    """Return a parser of options, with the docstring of the program as its help."""
    return argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def save_picture(figure: Figure, path: Path, colours: int) -> None:
    """Write a figure as a PNG of few colours."""
    rendered = BytesIO()
    figure.savefig(rendered, dpi=110)  # pixels per inch
    Image.open(rendered).convert("RGB").quantize(colours).save(path, optimize=True)


def plain(axis: Any, title: str, lines: str = "both") -> None:
    """Give a panel a title at the left, thin grid lines and two spines."""
    axis.set_title(title, fontsize=10, loc="left")
    axis.grid(axis=lines, color="#dddddd", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)
