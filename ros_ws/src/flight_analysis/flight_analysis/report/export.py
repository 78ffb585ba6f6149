# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Export flights as a table with a column for each channel (CSV, Parquet) or a figure (PNG)."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flight_analysis.report.data_frame import data_frame
from flight_analysis.report.paper import channels_by_title, draw_channel, last_instant
from flight_analysis.report.summary import RecordedFlight, labels
from flight_core.files import replacing
from flight_core.parameters import require

if TYPE_CHECKING:  # polars takes some tenths of a second to load, and few reports need it
    import polars as pl

# in inches
FIGURE_WIDTH = 15.0
ROW_HEIGHT = 2.2
DPI = 120


def signal_table(flights: Sequence[RecordedFlight]) -> "pl.DataFrame":
    """Return the samples of one or several flights as one table.

    The table has a column for each channel. For several flights, its first column, "run", has the
    name of the flight.
    """
    import polars as pl  # noqa: PLC0415

    if len(flights) == 1:
        return data_frame(flights[0].tape)
    tables = [
        data_frame(flight.tape).select(pl.lit(label).alias("run"), pl.all())
        for label, flight in zip(labels(flights), flights, strict=True)
    ]
    return pl.concat(tables, how="diagonal")


def write_csv(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write the table of one or several flights as CSV.

    Every number has enough digits to be read back to the last bit. A null is an empty cell.
    """
    with replacing(path) as stream:
        signal_table(flights).write_csv(stream)


def write_parquet(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write the table of one or several flights as Parquet, compressed with zstd."""
    with replacing(path) as stream:
        signal_table(flights).write_parquet(stream)


def write_png(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write a figure of one or several flights, with a row for each channel.

    The figure has three columns: y drawn over y_m, the error e, and u.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415

    require(
        path.suffix.lower() in {"", ".png"},
        "png",
        path.name,
        "a name that ends in .png; figure writes .pdf and .svg",
    )
    columns = {title: names for title, names in channels_by_title(flights).items() if names}
    rows = max(map(len, columns.values()))
    figure = Figure(figsize=(FIGURE_WIDTH, ROW_HEIGHT * rows + 0.6), layout="constrained")
    grid = figure.subplots(rows, len(columns), sharex=True, squeeze=False)
    for axes, (title, names) in zip(grid.T, columns.items(), strict=True):
        axes[0].set_title(title)
        for axis, name in zip(axes, names, strict=False):
            draw_channel(axis, flights, name, line_width=1.0)
        axes[len(names) - 1].set_xlabel("t (s)")
        axes[len(names) - 1].tick_params(labelbottom=True)
        for axis in axes[len(names) :]:
            axis.set_axis_off()
    grid[0, 0].set_xlim(0.0, last_instant(flights))
    figure.legend(
        *grid[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4, frameon=False
    )
    with replacing(path) as stream:
        figure.savefig(stream, dpi=DPI, format="png")
