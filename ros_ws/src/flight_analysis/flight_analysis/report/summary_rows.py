# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The columns and rows of the tables of a summary, as text."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from flight_analysis.metrics import AIRS, CALM
from flight_analysis.report.display_units import (
    NO_UNIT,
    NO_VALUE,
    DisplayUnit,
    channel_label,
    format_value,
)


class Column(NamedTuple):
    """A column of a table: the heading, the common heading of neighbouring columns above, and the
    path of the metric.
    """

    group: str
    head: str
    path: tuple[str, ...] = ()
    scaled: bool = True  # in the unit of its row


RMS_COLUMNS = (
    Column("rms", "whole", ("whole", "rms")),
    *(Column("rms", air, (air, "rms")) for air in AIRS),
    Column("rms", "command", ("command", "rms")),
    Column("rms", "capture", ("capture", "rms")),
    Column("rms", "turn", ("turn", "rms")),
    Column("rms", "gust", ("gust", "rms")),
)


ERROR_COLUMNS = (
    *RMS_COLUMNS,
    *(Column("max", air, (air, "max")) for air in AIRS if air != CALM),
    Column("max", "command", ("command", "max")),
    Column("max", "capture", ("capture", "max")),
    Column("max", "turn", ("turn", "max")),
    Column("max", "gust", ("gust", "max")),
    Column("ultimate", "bound", ("bound",)),
)
"""Columns of every table of errors; `columns_of` chooses those of a flight."""


NOISE_FLOOR_COLUMN = Column("noise", "floor", ("floor",))


SWITCH_COLUMN = Column("switches", "(1/s)", ("sign_switches",), scaled=False)


INPUT_COLUMNS = (
    *RMS_COLUMNS,
    Column("", "max", ("whole", "max")),
    Column("rate", "whole", ("whole", "rate")),
    *(Column("rate", air, (air, "rate")) for air in AIRS),
)
"""Columns of every table of inputs, before SATURATION_COLUMN; `columns_of` chooses those of a
flight."""


SATURATION_COLUMN = Column("saturated", "%")


SETTLING_COLUMNS = {kind: Column("settling (s)", kind) for kind in ("command", "gust")}


def columns_of(columns: Sequence[Column], channels: Mapping[str, Any]) -> tuple[Column, ...]:
    """The columns with a value: a part of the flight that did not occur has none."""
    return tuple(
        column
        for column in columns
        if any(metric(metrics, *column.path) is not None for metrics in channels.values())
    )


def metric(summary: Mapping[str, Any], *path: str) -> float | None:
    """A metric by the path in a summary; None for a missing metric."""
    value: Any = summary
    for key in path:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value if isinstance(value, float | int) else None


def model_rows(
    models: Sequence[Mapping[str, Any]], units: Mapping[str, DisplayUnit]
) -> tuple[list[str], list[list[str]]]:
    """Headings and rows for "models" of a summary: model, times and rms of the errors."""
    channels = list(models[0]["rms"]) if models else []
    headings = ["from (s)", "to (s)", *(f"{name} ({units[name].unit})" for name in channels)]
    rows = []
    for span in models:
        errors = (format_value(span["rms"][name], units[name].factor) for name in channels)
        rows.append([span["name"], f"{span['start']:.1f}", f"{span['stop']:.1f}", *errors])
    return headings, rows


def table_rows(
    channels: Mapping[str, Any], columns: Sequence[Column], units: Mapping[str, DisplayUnit]
) -> list[list[str]]:
    """Rows for "errors" or "inputs" of a summary: the channel with the unit, then a cell per
    column.
    """
    rows = []
    for name, metrics in channels.items():
        factor = units.get(name, NO_UNIT).factor
        cells = [
            format_value(metric(metrics, *column.path), factor if column.scaled else 1.0)
            for column in columns
        ]
        rows.append([channel_label(name, units), *cells])
    return rows


def input_rows(summary: Mapping[str, Any], units: Mapping[str, DisplayUnit]) -> list[list[str]]:
    """Rows for the flight's INPUT_COLUMNS and SATURATION_COLUMN: ticks with saturation in percent,
    by magnitude / by rate.
    """
    rows = table_rows(summary["inputs"], columns_of(INPUT_COLUMNS, summary["inputs"]), units)
    for row, metrics in zip(rows, summary["inputs"].values(), strict=True):
        shares = metrics["limited"]
        row.append(
            NO_VALUE
            if shares is None
            else " / ".join(f"{100 * shares[kind]:.3g}" for kind in ("magnitude", "rate"))
        )
    return rows


def slowest_settling(summary: Mapping[str, Any], channel: str, kind: str) -> str:
    """The longest settling time of a channel after transients of a kind, s.

    "> x" where the error did not settle after a transient; x is then the longest time, settled or
    not.
    """
    settled: list[float] = []
    unsettled: list[float] = []
    for transient in summary["transients"]:
        if transient["kind"] == kind and channel in transient["settling"]:
            if (time := transient["settling"][channel]) is None:
                unsettled.append(transient["until"][channel] - transient["start"])
            else:
                settled.append(time)
    if unsettled:
        return f"> {max(unsettled + settled):.2f}"
    return f"{max(settled):.2f}" if settled else NO_VALUE
