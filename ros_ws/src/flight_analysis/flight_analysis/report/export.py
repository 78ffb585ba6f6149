# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Export of flights: a wide table of the signals (CSV, Parquet), and a figure (PNG)."""

from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from flight_analysis.metrics import best_error
from flight_analysis.report import comparison
from flight_analysis.report.data_frame import data_frame
from flight_analysis.report.figures import GUST, REFERENCE, flight_end, gust_intervals
from flight_analysis.report.summary import NO_UNIT, RecordedFlight, channel_label
from flight_core.files import replacing
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape

# Each loads in some tenths of a second, and most reports need neither.
if TYPE_CHECKING:
    import polars as pl
    from matplotlib.axes import Axes

# inches
FIGURE_WIDTH = 15.0
ROW_HEIGHT = 2.2
DPI = 120


def signal_table(flights: Sequence[RecordedFlight]) -> "pl.DataFrame":
    """The table of a flight, or of several flights with the name of the flight in a first column
    "run".
    """
    import polars as pl  # noqa: PLC0415

    if len(flights) == 1:
        return data_frame(flights[0].tape)
    tables = [
        data_frame(flight.tape).select(pl.lit(label).alias("run"), pl.all())
        for label, flight in zip(comparison.labels(flights), flights, strict=True)
    ]
    return pl.concat(tables, how="diagonal")


def write_csv(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write the wide table as CSV. Numbers read back to the last bit; a null is an empty cell."""
    with replacing(path) as stream:
        signal_table(flights).write_csv(stream)


def write_parquet(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write the wide table as Parquet (zstd)."""
    with replacing(path) as stream:
        signal_table(flights).write_parquet(stream)


class _PlotColumn(NamedTuple):
    """A column of the PNG: a signal of the tapes with some topics, with the channels of the
    first.
    """

    title: str
    topics: tuple[str, ...]
    signal: Callable[[Tape], Signal]
    style: dict[str, Any]
    reference: bool = False


PLOT_COLUMNS = (
    _PlotColumn("y, over y_m", ("y",), lambda tape: tape["y"], {}, reference=True),
    _PlotColumn("e = y - y_m", ("y", "y_m"), lambda tape: best_error(tape)[1], {}),
    _PlotColumn("u", ("u",), lambda tape: tape["u"], {"drawstyle": "steps-post"}),
)


def write_png(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write y over y_m, the best error, and u of a flight or several flights: a column a quantity,
    a row a channel.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415

    require(
        path.suffix.lower() in {"", ".png"},
        "png",
        path.name,
        "a name that ends in .png; figure writes .pdf and .svg",
    )
    columns = [
        (column, names) for column in PLOT_COLUMNS if (names := _channels(flights, column.topics))
    ]
    rows = max(len(names) for _, names in columns)
    figure = Figure(figsize=(FIGURE_WIDTH, ROW_HEIGHT * rows + 0.6), layout="constrained")
    grid = figure.subplots(rows, len(columns), sharex=True, squeeze=False)
    for axes, (column, names) in zip(grid.T, columns, strict=True):
        axes[0].set_title(column.title)
        for axis, name in zip(axes, names, strict=False):
            _plot_channel(axis, flights, column, name)
        axes[len(names) - 1].set_xlabel("t (s)")
        axes[len(names) - 1].tick_params(labelbottom=True)
        for axis in axes[len(names) :]:
            axis.set_axis_off()
    grid[0, 0].set_xlim(0.0, max(flight_end(flight.tape) for flight in flights) or 1.0)
    figure.legend(
        *grid[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4, frameon=False
    )
    with replacing(path) as stream:
        figure.savefig(stream, dpi=DPI, format="png")


def _channels(flights: Sequence[RecordedFlight], topics: Sequence[str]) -> list[str]:
    tapes = [flight.tape for flight in flights if {*topics} <= {*flight.tape.signals}]
    return list(dict.fromkeys(chain.from_iterable(tape[topics[0]].names for tape in tapes)))


def _plot_channel(
    axes: "Axes", flights: Sequence[RecordedFlight], column: _PlotColumn, name: str
) -> None:
    """Plot a channel of the flights, with the reference and the gusts of the first flight."""
    units = comparison.units(flights)
    factor = units.get(name, NO_UNIT).factor

    def plot(tape: Tape, signal: Signal, **style: Any) -> None:
        axes.plot((signal.stamp_ns - tape.start_ns) / NANOSECONDS, signal[name] * factor, **style)

    first = flights[0]
    for gust in gust_intervals(first.tape, first.gusts):
        axes.axvspan(gust.start, gust.stop, color=GUST, alpha=0.2, linewidth=0)
    if column.reference and "y_m" in first.tape and name in first.tape["y_m"].names:
        plot(first.tape, first.tape["y_m"], color=REFERENCE, linewidth=4.0, label="y_m")
    for (label, colour), flight in zip(comparison.colours(flights).items(), flights, strict=True):
        tape = flight.tape
        if {*column.topics} <= {*tape.signals} and name in tape[column.topics[0]].names:
            plot(
                tape, column.signal(tape), color=colour, linewidth=1.0, label=label, **column.style
            )
    axes.set_ylabel(channel_label(name, units))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
