# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Flights for other programs: one wide table of all signals (CSV, Parquet), and a picture (PNG)."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from flight_analysis.metrics import known_error
from flight_analysis.report import comparison
from flight_analysis.report.figures import GUST, REFERENCE, flight_end, gust_bands
from flight_analysis.report.recorded_flight import RecordedFlight
from flight_analysis.report.summary import PLAIN, titled
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape

# Both load in some tenths of a second, which a report without them need not wait for.
if TYPE_CHECKING:
    import polars as pl
    from matplotlib.axes import Axes

INCHES = (15.0, 2.2)  # width of the picture, and height of one of its rows
DOTS = 120  # an inch


def table(tape: Tape) -> "pl.DataFrame":
    """All signals as one table, SI: a row an instant at which any has a sample, a column a channel as "topic.channel".

    First "stamp_ns" (int64) and "t" = (stamp_ns - start) / 1e9. Null where a topic has no sample of that instant; of two with
    one stamp the later counts.
    """
    import polars as pl  # noqa: PLC0415

    stamps = np.unique(np.concatenate([signal.stamp_ns for signal in tape.signals.values()]))
    columns: dict[str, np.ndarray] = {"stamp_ns": stamps, "t": (stamps - tape.start_ns) / NANOSECONDS}
    missing: dict[str, np.ndarray] = {}
    for topic, signal in tape.signals.items():
        rows = np.searchsorted(stamps, signal.stamp_ns)
        absent = np.ones(len(stamps), dtype=bool)
        absent[rows] = False
        for name in signal.names:
            column = np.full(len(stamps), np.nan)
            column[rows] = signal[name]
            columns[f"{topic}.{name}"], missing[f"{topic}.{name}"] = column, absent
    whole = pl.DataFrame(columns)
    return whole.with_columns(
        pl.when(pl.Series(absent)).then(None).otherwise(pl.col(name)).alias(name)
        for name, absent in missing.items()
        if absent.any()
    )


def _tables(flights: Sequence[RecordedFlight]) -> "pl.DataFrame":
    """The table of a flight; those of several under each other, the column "run" in front says which."""
    import polars as pl  # noqa: PLC0415

    if len(flights) == 1:
        return table(flights[0].tape)
    named = [
        table(flight.tape).select(pl.lit(label).alias("run"), pl.all())
        for label, flight in zip(comparison.labels(flights), flights, strict=True)
    ]
    return pl.concat(named, how="diagonal")


def write_csv(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write `table` as CSV, in digits that come back to the last bit; an empty cell is no sample."""
    _tables(flights).write_csv(path)


def write_parquet(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write `table` as Parquet (zstd)."""
    _tables(flights).write_parquet(path)


class _Column(NamedTuple):
    """A column of the picture: what it shows of the tapes that have a topic."""

    title: str
    topic: str
    of: Callable[[Tape], Signal]
    look: dict[str, Any]
    reference: bool = False


COLUMNS = (
    _Column("y, over y_m", "y", lambda tape: tape["y"], {}, reference=True),
    _Column("e = y - y_m", "y", lambda tape: known_error(tape)[1], {}),
    _Column("u", "u", lambda tape: tape["u"], {"drawstyle": "steps-post"}),
)


def write_png(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write y over y_m, the best known error, and u of one flight or several: a column each, a row a channel."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    shown = [(column, names) for column in COLUMNS if (names := _names(flights, column.topic))]
    rows = max(len(names) for _, names in shown)
    figure = Figure(figsize=(INCHES[0], INCHES[1] * rows + 0.6), layout="constrained")
    grid = figure.subplots(rows, len(shown), sharex=True, squeeze=False)
    for axes, (column, names) in zip(grid.T, shown, strict=True):
        axes[0].set_title(column.title)
        for one, name in zip(axes, names, strict=False):
            _draw(one, flights, column, name)
        axes[len(names) - 1].set_xlabel("t (s)")
        axes[len(names) - 1].tick_params(labelbottom=True)
        for one in axes[len(names) :]:
            one.set_axis_off()
    grid[0, 0].set_xlim(0.0, max(flight_end(flight.tape) for flight in flights) or 1.0)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4, frameon=False)
    figure.savefig(path, dpi=DOTS, format="png")


def _names(flights: Sequence[RecordedFlight], topic: str) -> list[str]:
    return list(dict.fromkeys(name for flight in flights if topic in flight.tape for name in flight.tape[topic].names))


def _draw(axes: "Axes", flights: Sequence[RecordedFlight], column: _Column, name: str) -> None:
    """One channel of all flights that have it, with the reference and the gusts of the first."""
    units = comparison.units(flights)
    factor = units.get(name, PLAIN).factor

    def draw(tape: Tape, signal: Signal, **look: Any) -> None:
        axes.plot((signal.stamp_ns - tape.start_ns) / NANOSECONDS, signal[name] * factor, **look)

    first = flights[0]
    for band in gust_bands(first.tape, first.scenario.gust_windows()):
        axes.axvspan(band.start, band.stop, color=GUST, alpha=0.2, linewidth=0)
    if column.reference and name in first.tape["y_m"].names:
        draw(first.tape, first.tape["y_m"], color=REFERENCE, linewidth=4.0, label="y_m")
    for (label, colour), (_, _, tape, _) in zip(comparison.colours(flights).items(), flights, strict=True):
        if column.topic in tape and name in tape[column.topic].names:
            draw(tape, column.of(tape), color=colour, linewidth=1.0, label=label, **column.look)
    axes.set_ylabel(titled(name, units))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
