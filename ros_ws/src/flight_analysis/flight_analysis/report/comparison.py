# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compare several flights, whose channels are matched by name.

The result has each metric as a ratio to the same metric of the first flight, and the conditions
that differ between the flights.
"""

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any, NamedTuple

from flight_analysis.closed_loop.scenario import SCHEMAS
from flight_analysis.report.display_units import (
    NO_UNIT,
    NO_VALUE,
    DisplayUnit,
    channel_label,
)
from flight_analysis.report.summary import RecordedFlight, common_units
from flight_analysis.report.summary_rows import (
    ERROR_COLUMNS,
    MILLISECONDS,
    SETTLING_COLUMNS,
    SWITCH_COLUMN,
    TIMING_COLUMNS,
    Column,
    slowest_settling,
)
from flight_core.parameters import flatten
from flight_core.tape import Tape
from flight_log.clock import SINCE_EPOCH_NS

EQUAL_RATIO_TOLERANCE = 0.05  # metrics count as equal if their ratio differs from 1 by less


class ComparisonRow(NamedTuple):
    """One metric of every flight, and its ratio to the metric of the first flight.

    The ratio is None if it cannot be computed.
    """

    name: str
    texts: tuple[str, ...]
    ratios: tuple[float | None, ...]
    lower_is_better: bool = True
    # for each flight, whether it had the conditions of the first. Only then its ratio is a verdict.
    alike: tuple[bool, ...] = ()

    def verdict(self, flight: int) -> str:
        """Compare a flight with the first one: "better", "worse" or "same".

        The result is also "same" if no judgement is possible. This is so if the flight had other
        conditions than the first, or if a smaller value of the metric is not better.
        """
        ratio = self.ratios[flight]
        if self.alike and not self.alike[flight]:
            return "same"
        if ratio is None or not self.lower_is_better or abs(ratio - 1.0) < EQUAL_RATIO_TOLERANCE:
            return "same"
        return "better" if ratio < 1.0 else "worse"


class ComparisonTable(NamedTuple):
    """A table of one channel, or of the controller's ticks: rows of metrics, columns of flights."""

    caption: str
    rows: tuple[ComparisonRow, ...]
    channel: str = ""


# ---- Conditions


class Condition(NamedTuple):
    """A parameter that differs between the flights, with its value in each of them."""

    key: str
    texts: tuple[str, ...]


WINDS = tuple(f"aircraft.{key}" for key in ("gusts", "turbulence", "wind", "shear", "microburst"))
COMPARED = ("controller.",)  # if only these keys differ, ratios have colours
NO_CONDITION = ("recorder.",)
PACE = "flown"
LONG = 40  # a text with more characters, such as a matrix, is shortened
UNLIKE = "the conditions differ: a ratio between unlike flights says nothing of the law"


def conditions(flights: Sequence[RecordedFlight]) -> list[Condition]:
    """Return the parameters that differ between the flights, and the pace if it differs.

    The pace says whether a flight was in real time. Parameters of the wind come first, then all
    other parameters, and then the pace.
    """
    values = [_parameters(flight) for flight in flights]
    keys = sorted(
        {key for key in chain.from_iterable(values) if not key.startswith(NO_CONDITION)},
        key=lambda key: (not key.startswith(WINDS), key.startswith(COMPARED), key),
    )
    rows = [(key, [each.get(key, "none") for each in values]) for key in keys]
    return [Condition(key, _shortened(texts)) for key, texts in rows if len(set(texts)) > 1]


def _parameters(flight: RecordedFlight) -> dict[str, str]:
    """Return the parameters and the pace of a flight as text, by full dotted name."""
    if flight.scenario is None:
        return {}
    tree = {
        section: config.model_dump()
        for section in SCHEMAS
        if (config := getattr(flight.scenario, section)) is not None
    }
    return {key: _text(value) for key, value in flatten(tree)} | {PACE: _pace(flight.tape)}


def _shortened(texts: Sequence[str]) -> tuple[str, ...]:
    """Replace each long list of numbers by the number of its values, as in "12 values".

    If two lists differ but have the same number of values, ", others" is added to the later one.
    """
    counts = [f"{text.count(',') + 1} values" if len(text) > LONG else text for text in texts]
    return tuple(
        f"{count}, others" if texts.index(text) and count in counts[: texts.index(text)] else count
        for text, count in zip(texts, counts, strict=True)
    )


def _pace(tape: Tape) -> str:
    if tape.is_by_clock:
        return "by /clock"
    return "in real time" if tape.start_ns > SINCE_EPOCH_NS else "not in real time"


def _text(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(_text, value)) or "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def has_same_conditions(
    flights: Sequence[RecordedFlight], *, timed: bool = False
) -> tuple[bool, ...]:
    """Return whether each flight had the conditions of the first, except for the controller.

    If `timed` is True, the flight must also have had the same pace as the first, such as real time.
    """
    rows = [
        row
        for row in conditions(flights)
        if not row.key.startswith(COMPARED) and (timed or row.key != PACE)
    ]
    return tuple(all(row.texts[k] == row.texts[0] for row in rows) for k in range(len(flights)))


# ---- Tables


def comparison_tables(
    flights: Sequence[RecordedFlight],
    key: str,
    columns: Sequence[Column],
    *,
    lower_is_better: bool,
    units: Mapping[str, DisplayUnit] | None = None,
) -> list[ComparisonTable]:
    """Return a table for each channel, with metrics from "errors" or "inputs" of the summaries.

    `key` is "errors" or "inputs". A table has a row for each metric of `columns` that has a value
    in a flight. By default `units` are the display units of the flights.
    """
    display = common_units(flights) if units is None else units
    same = has_same_conditions(flights)
    tables = []
    for channel in dict.fromkeys(chain.from_iterable(flight.summary[key] for flight in flights)):
        unit = display.get(channel, NO_UNIT)
        metrics = [flight.summary[key].get(channel, {}) for flight in flights]
        rows = []
        for column in columns:
            row = _row(metrics, column, unit)
            if set(row.texts) != {NO_VALUE}:
                rows.append(row._replace(lower_is_better=lower_is_better, alike=same))
        tables.append(ComparisonTable(channel_label(channel, display), tuple(rows), channel))
    return tables


def error_tables(
    flights: Sequence[RecordedFlight], units: Mapping[str, DisplayUnit] | None = None
) -> list[ComparisonTable]:
    """Return a table for each channel, with the metrics of its error and its settling times."""
    return [
        table._replace(rows=(*table.rows, *_settling_rows(flights, table.channel)))
        for table in comparison_tables(
            flights,
            "errors",
            (*ERROR_COLUMNS, SWITCH_COLUMN),
            lower_is_better=True,
            units=units,
        )
    ]


def _settling_rows(flights: Sequence[RecordedFlight], channel: str) -> list[ComparisonRow]:
    no_ratios = (None,) * len(flights)
    rows = []
    for kind, column in SETTLING_COLUMNS.items():
        texts = tuple(slowest_settling(flight.summary, channel, kind) for flight in flights)
        if set(texts) != {NO_VALUE}:
            rows.append(ComparisonRow(column.label, texts, no_ratios))
    return rows


def tick_tables(flights: Sequence[RecordedFlight]) -> list[ComparisonTable]:
    """Return one table, the timing of the controllers' ticks, or none if all times are 0."""
    same = has_same_conditions(flights, timed=True)
    summaries = [flight.summary for flight in flights]
    rows = []
    for column in TIMING_COLUMNS:
        if column.unit is MILLISECONDS and any(map(column.value, summaries)):
            row = _row(summaries, column, NO_UNIT)
            rows.append(row._replace(name=f"{row.name} ({column.unit.unit})", alike=same))
    return [ComparisonTable("Ticks of the controller", tuple(rows))] if rows else []


def _row(figures: Sequence[Mapping[str, Any]], column: Column, unit: DisplayUnit) -> ComparisonRow:
    """Return a table's row with one metric of every flight, and its ratios to the first.

    `figures` has the metrics of each flight. The row shows them in `unit`.
    """
    values = [column.value(each) for each in figures]
    first = values[0]
    ratios = tuple(None if value is None or not first else value / first for value in values)
    return ComparisonRow(column.label, tuple(column.text(each, unit) for each in figures), ratios)
