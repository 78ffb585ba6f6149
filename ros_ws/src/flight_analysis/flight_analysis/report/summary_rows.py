# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Declare the metrics of a summary, and turn them into rows of text for tables.

Each metric has its place in the summary, a heading, a unit and a number of digits.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

from flight_analysis.metrics.transients import Air, TransientKind
from flight_analysis.report.display_units import (
    NO_UNIT,
    NO_VALUE,
    QUANTITY_UNITS,
    DisplayUnit,
    channel_label,
    format_value,
)

MILLISECONDS = DisplayUnit(unit="ms", factor=1e3)


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of a table: where the summary has its metric, and how the metric is written.

    `head` is the heading of the column. `group` is the heading above it that neighbouring columns
    share. `path` has the keys that lead to the metric in a summary.
    """

    group: str
    head: str
    path: tuple[str, ...] = ()
    unit: DisplayUnit | None = None  # None for the unit of its row
    decimals: int | None = None  # digits after the point; None for three digits in all

    @property
    def label(self) -> str:
        """The whole heading: the group and then the head."""
        return f"{self.group} {self.head}".strip()

    def value(self, figures: Mapping[str, Any]) -> float | None:
        """Return the metric, SI, or None if there is none.

        `figures` is the part of the summary in which `path` begins.
        """
        value: Any = figures
        for key in self.path:
            value = value.get(key) if isinstance(value, Mapping) else None
        return value if isinstance(value, float | int) else None

    def text(self, figures: Mapping[str, Any], row_unit: DisplayUnit = NO_UNIT) -> str:
        """Return the metric as text, in the unit of the column or, if it has none, of the row."""
        value = self.value(figures)
        factor = (self.unit or row_unit).factor
        if value is None or self.decimals is None:
            return format_value(value, factor)
        return f"{value * factor:.{self.decimals}f}"


# Kinds of transients after which the parts of a flight are named, in the order of the columns.
DISTURBED = (
    TransientKind.COMMAND,
    TransientKind.CAPTURE,
    TransientKind.TURN,
    TransientKind.GUST,
)
RMS_COLUMNS = (
    Column(group="rms", head="whole", path=("whole", "rms")),
    *(Column(group="rms", head=air, path=(air, "rms")) for air in Air),
    *(Column(group="rms", head=kind, path=(kind, "rms")) for kind in DISTURBED),
)


ERROR_COLUMNS = (
    *RMS_COLUMNS,
    *(Column(group="max", head=air, path=(air, "max")) for air in Air if air is not Air.CALM),
    *(Column(group="max", head=kind, path=(kind, "max")) for kind in DISTURBED),
    Column(group="ultimate", head="bound", path=("bound",)),
)
"""Columns that a table of errors can have. `columns_of` chooses the columns for a flight."""


NOISE_FLOOR_COLUMN = Column(group="noise", head="floor", path=("floor",))


SWITCH_COLUMN = Column(group="switches", head="(1/s)", path=("sign_switches",), unit=NO_UNIT)


INPUT_COLUMNS = (
    *RMS_COLUMNS,
    Column(group="", head="max", path=("whole", "max")),
    Column(group="rate", head="whole", path=("whole", "rate")),
    *(Column(group="rate", head=air, path=(air, "rate")) for air in Air),
)
"""Columns that a table of inputs can have before SATURATION_COLUMN. `columns_of` chooses the
columns for a flight."""


SATURATION_COLUMN = Column(group="saturated", head="%")


SETTLING_COLUMNS = {
    kind: Column(group="settling (s)", head=kind)
    for kind in (TransientKind.COMMAND, TransientKind.GUST)
}


HELD_COLUMNS = (
    Column(group="", head="rms", path=("rms",)),
    Column(group="", head="max", path=("max",)),
    Column(group="", head="overshoot", path=("overshoot",)),
    Column(group="", head="settling (s)", path=("settling",), unit=NO_UNIT),
)
"""Columns for the errors of a quantity that guidance held over a segment."""


def _ms(group: str, topic: str, **heads: str) -> tuple[Column, ...]:
    """Return columns for times, ms, in the entry `topic` of a summary.

    `heads` has the heading of each column by the key of its metric.
    """
    return tuple(
        Column(group=group, head=head, path=(topic, key), unit=MILLISECONDS, decimals=3)
        for key, head in heads.items()
    )


TIMING_COLUMNS = (
    Column(group="ticks", head="", path=("ticks", "ticks"), unit=NO_UNIT, decimals=0),
    Column(
        group="periods without a new y",
        head="",
        path=("ticks", "without_new_y"),
        unit=NO_UNIT,
        decimals=0,
    ),
    *_ms("period", "ticks", period_mean="mean", period_p99="p99", period_max="max"),
    *_ms("jitter", "ticks", jitter="rms"),
    *_ms("after the deadline", "ticks", late_p99="p99", late_max="max"),
    *_ms("age of y", "ticks", age_p99="p99"),
    *_ms("y sent to u sent", "latency", median="median", p99="p99", max="max"),
    *_ms("age of u at the aircraft", "age_of_u", mean="mean", max="max"),
)
"""Metrics of the timing of the controller."""


def columns_of(columns: Sequence[Column], channels: Mapping[str, Any]) -> tuple[Column, ...]:
    """Return the columns that have a value for at least one channel.

    For example, a flight without gusts has no value in the columns of gusts.
    """
    return tuple(
        column
        for column in columns
        if any(column.value(metrics) is not None for metrics in channels.values())
    )


def model_rows(
    models: Sequence[Mapping[str, Any]], units: Mapping[str, DisplayUnit]
) -> tuple[list[str], list[list[str]]]:
    """Return the headings and rows of a table of "models", the entry of a summary.

    A row has the name of a model, the times at which it was used, and the rms of the errors. If the
    log has the guarantee of a learned model, a further column has the number of standard deviations
    within which every aircraft is stable.
    """
    channels = list(models[0]["rms"]) if models else []
    headings = ["from (s)", "to (s)", *(f"{name} ({units[name].unit})" for name in channels)]
    # the summary of an earlier version has no guarantees
    guarantees = [span.get("stable") for span in models]
    has_guarantee = any(within is not None for within in guarantees)
    rows = []
    for span, within in zip(models, guarantees, strict=True):
        errors = (format_value(span["rms"][name], units[name].factor) for name in channels)
        stable = "" if within is None else stated_deviations(within)
        row = [span["name"], f"{span['start']:.1f}", f"{span['stop']:.1f}", *errors]
        rows.append([*row, stable] if has_guarantee else row)
    return [*headings, "stable within (deviations)"] if has_guarantee else headings, rows


def stated_deviations(number: float) -> str:
    """Write a proved number of standard deviations as text, rounded down."""
    return f"{math.floor(10.0 * number + 1e-9) / 10.0:.1f}"


def table_rows(
    channels: Mapping[str, Any], columns: Sequence[Column], units: Mapping[str, DisplayUnit]
) -> list[list[str]]:
    """Return the rows of a table for the channels in "errors" or "inputs" of a summary.

    A row begins with the channel and its unit. A cell for each column follows.
    """
    rows = []
    for name, metrics in channels.items():
        cells = [column.text(metrics, units.get(name, NO_UNIT)) for column in columns]
        rows.append([channel_label(name, units), *cells])
    return rows


def timing_rows(summary: Mapping[str, Any], *, is_timed: bool) -> list[tuple[str, str, str]]:
    """Return the rows of a table of the controller's timing, with one row for a group of metrics.

    A row has the entry of the summary, the heading with its unit, and the values. If `is_timed` is
    False, the flight was not flown by the host's clock, and rows with times are left out.
    """
    rows = []
    shown = [column for column in TIMING_COLUMNS if is_timed or column.unit is not MILLISECONDS]
    for group, metrics in groupby(shown, key=lambda column: column.group):
        columns = [column for column in metrics if column.value(summary) is not None]
        if columns:
            unit = columns[0].unit or NO_UNIT
            heads = " / ".join(column.head for column in columns)
            label = f"{group} {heads} ({unit.unit})" if unit.unit else group
            rows.append(
                (columns[0].path[0], label, " / ".join(column.text(summary) for column in columns))
            )
    return rows


def segment_table(
    segments: Sequence[Mapping[str, Any]], units: Mapping[str, DisplayUnit]
) -> tuple[list[Column], list[list[str]]]:
    """Return the columns and rows of a table of the quantities that guidance held in each segment.

    A segment is a span of time with the same modes and commands. A quantity without a unit in
    `units` has its unit from QUANTITY_UNITS.
    """
    units = {**QUANTITY_UNITS, **units}
    columns = [Column(group="", head=head) for head in ("from (s)", "to (s)")]
    for group in ("lateral", "vertical"):
        columns += [
            Column(group=group, head="held"),
            *(replace(each, group=group) for each in HELD_COLUMNS),
        ]
    columns += [replace(each, group="V (m/s)") for each in HELD_COLUMNS[:2]]
    rows = []
    for segment in segments:
        name = segment["lateral"]["quantity"] if segment["leg"] is None else f"leg {segment['leg']}"
        row = [name, f"{segment['start']:.1f}", f"{segment['stop']:.1f}"]
        for quantity in (segment["lateral"], segment["vertical"]):
            row.append(channel_label(quantity["quantity"], units))
            unit = units[quantity["quantity"]]
            row += [each.text(quantity, unit) for each in HELD_COLUMNS]
        rows.append([*row, *(each.text(segment["V"]) for each in HELD_COLUMNS[:2])])
    return columns, rows


def input_rows(summary: Mapping[str, Any], units: Mapping[str, DisplayUnit]) -> list[list[str]]:
    """Return the rows of the table of inputs, with INPUT_COLUMNS and SATURATION_COLUMN.

    Saturation is given in percent of the ticks, first by magnitude and then by rate.
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


def slowest_settling(summary: Mapping[str, Any], channel: str, kind: TransientKind) -> str:
    """Return the longest settling time of a channel after transients of a kind, s.

    If the error did not settle after one of these transients, the result is "> x". Here x is the
    longest time of all, which includes the times after which an error had still not settled.
    """
    times: list[float] = []
    unsettled: list[float] = []
    for transient in summary["transients"]:
        if transient["kind"] == kind and channel in transient["settling"]:
            if (time := transient["settling"][channel]) is None:
                unsettled.append(transient["until"][channel] - transient["start"])
            else:
                times.append(time)
    if unsettled:
        return f"> {max(unsettled + times):.2f}"
    return f"{max(times):.2f}" if times else NO_VALUE
