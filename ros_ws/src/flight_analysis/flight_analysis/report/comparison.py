# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of several flights, channels matched by name: ratios of metrics to the first flight,
and overlaid curves.
"""

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from flight_analysis.closed_loop.scenario import SCHEMAS
from flight_analysis.metrics import best_error
from flight_analysis.report import figures
from flight_analysis.report.display_units import (
    NO_UNIT,
    NO_VALUE,
    DisplayUnit,
    channel_label,
    format_value,
)
from flight_analysis.report.plotting import (
    Curve,
    Figure,
    Interval,
    PlotContext,
    SampleStore,
    time_series_figure,
)
from flight_analysis.report.summary import RecordedFlight
from flight_analysis.report.summary_rows import (
    ERROR_COLUMNS,
    SWITCH_COLUMN,
    Column,
    metric,
    slowest_settling,
)
from flight_core.parameters import flatten
from flight_core.tape import Signal, Tape
from flight_log.clock import SINCE_EPOCH_NS

# Okabe and Ito 2008, distinct to the colour blind too; lighter on a dark page.
DARK = {
    "#0072b2": "#4db3ea",
    "#d55e00": "#ff924a",
    "#009e73": "#3fcf9f",
    "#cc79a7": "#e8a3c8",
    "#7a6a00": "#d9c74a",
}
COLOURS = tuple(DARK)
SAME_CURVE_TOLERANCE = 1e-3  # of the largest value: closer references are drawn as one curve
EQUAL_RATIO_TOLERANCE = 0.05  # metrics with a ratio closer to 1 count as equal
TIMING_METRICS = {
    "jitter rms (ms)": ("ticks", "jitter"),
    "late p99 (ms)": ("ticks", "late_p99"),
    "age of y p99 (ms)": ("ticks", "age_p99"),
    "y sent to u sent, median (ms)": ("latency", "median"),
    "y sent to u sent, p99 (ms)": ("latency", "p99"),
}
"""Timing metrics of the controller by row name: their path in a summary; s."""


class ComparisonRow(NamedTuple):
    """A metric of every flight and the ratio to the first flight; None without a ratio."""

    name: str
    texts: tuple[str, ...]
    ratios: tuple[float | None, ...]
    lower_is_better: bool = True
    # whether each flight had the conditions of the first, so that the ratio says better or worse
    alike: tuple[bool, ...] = ()

    def verdict(self, flight: int) -> str:
        """A flight beside the first: "better", "worse" or "same"; an unlike flight is "same"."""
        ratio = self.ratios[flight]
        if self.alike and not self.alike[flight]:
            return "same"
        if ratio is None or not self.lower_is_better or abs(ratio - 1.0) < EQUAL_RATIO_TOLERANCE:
            return "same"
        return "better" if ratio < 1.0 else "worse"


class ComparisonTable(NamedTuple):
    """Metrics of a channel, or of the controller's ticks."""

    caption: str
    rows: tuple[ComparisonRow, ...]
    channel: str = ""


def colours(flights: Sequence[RecordedFlight]) -> dict[str, str]:
    """Colour by the label of a flight."""
    return {label: COLOURS[k % len(COLOURS)] for k, label in enumerate(labels(flights))}


def labels(flights: Sequence[RecordedFlight]) -> list[str]:
    """Names of the flights; equal names get a number."""
    names = [flight.name for flight in flights]
    return [
        f"{name} ({k})" if names.count(name) > 1 else name for k, name in enumerate(names, start=1)
    ]


def units(flights: Sequence[RecordedFlight]) -> dict[str, DisplayUnit]:
    """Units by channel, of the first flight with the channel."""
    by_channel: dict[str, DisplayUnit] = {}
    for flight in reversed(flights):
        by_channel |= flight.units
    return by_channel


# ---- Conditions


class Condition(NamedTuple):
    """A parameter that differs, by flight."""

    key: str
    texts: tuple[str, ...]


WINDS = tuple(f"aircraft.{key}" for key in ("gusts", "turbulence", "wind", "shear", "microburst"))
COMPARED = ("controller.",)  # what a comparison may be of: the ratios keep their colours
NO_CONDITION = ("recorder.",)
PACE = "flown"
LONG = 40  # characters of a value, as of a matrix
UNLIKE = "the conditions differ: a ratio between unlike flights says nothing of the law"


def conditions(flights: Sequence[RecordedFlight]) -> list[Condition]:
    """The parameters with unlike values, wind first, and whether a flight was in real time."""
    values = [_parameters(flight) for flight in flights]
    keys = sorted(
        {key for each in values for key in each if not key.startswith(NO_CONDITION)},
        key=lambda key: (not key.startswith(WINDS), key.startswith(COMPARED), key),
    )
    rows = [(key, [each.get(key, "none") for each in values]) for key in keys]
    return [Condition(key, _shortened(texts)) for key, texts in rows if len(set(texts)) > 1]


def _parameters(flight: RecordedFlight) -> dict[str, str]:
    """The parameters of a flight as text, by full name."""
    if flight.scenario is None:
        return {}
    tree = {
        section: config.model_dump()
        for section in SCHEMAS
        if (config := getattr(flight.scenario, section)) is not None
    }
    return {key: _text(value) for key, value in flatten(tree)} | {PACE: _pace(flight.tape)}


def _shortened(texts: Sequence[str]) -> tuple[str, ...]:
    """The texts; of a long list of numbers the count, and whether the numbers differ."""
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


def alike(flights: Sequence[RecordedFlight], *, timed: bool = False) -> tuple[bool, ...]:
    """Whether each flight had the conditions of the first, but for the controller; `timed`: with
    the same time.
    """
    rows = [
        row
        for row in conditions(flights)
        if not row.key.startswith(COMPARED) and (timed or row.key != PACE)
    ]
    return tuple(all(row.texts[k] == row.texts[0] for row in rows) for k in range(len(flights)))


# ---- Tables


def metric_tables(
    flights: Sequence[RecordedFlight], key: str, columns: Sequence[Column], *, lower_is_better: bool
) -> list[ComparisonTable]:
    """Metrics of "errors" or "inputs" of the summaries: a table per channel, a row per column with
    a value.
    """
    display = units(flights)
    same = alike(flights)
    tables = []
    for channel in dict.fromkeys(chain.from_iterable(flight.summary[key] for flight in flights)):
        factor = display.get(channel, NO_UNIT).factor
        rows = []
        for group, head, path, scaled in columns:
            row = _row(
                flights, f"{group} {head}".strip(), (key, channel, *path), factor if scaled else 1.0
            )
            if set(row.texts) != {NO_VALUE}:
                rows.append(row._replace(lower_is_better=lower_is_better, alike=same))
        tables.append(ComparisonTable(channel_label(channel, display), tuple(rows), channel))
    return tables


def error_tables(flights: Sequence[RecordedFlight]) -> list[ComparisonTable]:
    """Metrics of the error and settling times, by channel."""
    return [
        table._replace(rows=(*table.rows, *_settling_rows(flights, table.channel)))
        for table in metric_tables(
            flights, "errors", (*ERROR_COLUMNS, SWITCH_COLUMN), lower_is_better=True
        )
    ]


def _settling_rows(flights: Sequence[RecordedFlight], channel: str) -> list[ComparisonRow]:
    times = {}
    for kind in ("command", "gust"):
        times[kind] = tuple(slowest_settling(flight.summary, channel, kind) for flight in flights)
    no_ratios = (None,) * len(flights)
    return [
        ComparisonRow(f"settling, {kind} (s)", texts, no_ratios)
        for kind, texts in times.items()
        if set(texts) != {NO_VALUE}
    ]


def tick_tables(flights: Sequence[RecordedFlight]) -> list[ComparisonTable]:
    """Timing metrics of the controllers as a table; none for zeros alone."""
    same = alike(flights, timed=True)
    rows = [
        _row(flights, name, path, 1e3)._replace(alike=same) for name, path in TIMING_METRICS.items()
    ]
    nonzero = tuple(row for row in rows if set(row.texts) - {NO_VALUE, format_value(0.0)})
    return [ComparisonTable("Ticks of the controller", nonzero)] if nonzero else []


def _row(
    flights: Sequence[RecordedFlight], name: str, path: Sequence[str], factor: float
) -> ComparisonRow:
    values = [metric(flight.summary, *path) for flight in flights]
    first = values[0]
    ratios = tuple(None if value is None or not first else value / first for value in values)
    return ComparisonRow(name, tuple(format_value(value, factor) for value in values), ratios)


# ---- Figures


def plot_context(flights: Sequence[RecordedFlight]) -> PlotContext:
    """The context of the flights, from t = 0 of every flight on, with common gusts alone."""
    gusts = flights[0].gusts
    longest = max(flights, key=lambda flight: figures.flight_end(flight.tape))
    intervals: list[Interval] = []
    if all(flight.gusts == gusts for flight in flights):
        intervals = figures.gust_intervals(longest.tape, gusts)
    end = figures.flight_end(longest.tape)
    return PlotContext(Tape({}), units(flights), intervals, end, SampleStore())


def tracking_figure(context: PlotContext, flights: Sequence[RecordedFlight]) -> Figure:
    """Y of every flight over the distinct references."""
    references: dict[str, Signal] = {}
    for label, flight in zip(labels(flights), flights, strict=True):
        y_m = _from_zero(flight.tape["y_m"], flight)
        equal = next(
            (name for name, reference in references.items() if _same_curve(reference, y_m)), None
        )
        if equal is None:
            references[label] = y_m
        elif len(y_m.stamp_ns) > len(references[equal].stamp_ns):
            references[equal] = y_m
    palette = colours(flights)
    curves = {
        f"y_m {label}": Curve(signal, palette[label], 5.0, faint=True)
        for label, signal in references.items()
    }
    if len(references) == 1:
        (curve,) = curves.values()
        curves = {"y_m": curve._replace(colour=figures.REFERENCE, width=6.0, faint=False)}
    return time_series_figure(context, curves | _curves(flights, "y", lambda tape: tape["y"]))


def error_figure(context: PlotContext, flights: Sequence[RecordedFlight]) -> Figure:
    """The best error of every flight."""
    return time_series_figure(
        context, _curves(flights, "y", lambda tape: best_error(tape)[1]), height=120
    )


def input_figure(context: PlotContext, flights: Sequence[RecordedFlight]) -> Figure | None:
    """U of every flight."""
    curves = _curves(flights, "u", lambda tape: tape["u"], steps=True)
    return time_series_figure(context, curves) if curves else None


def _curves(
    flights: Sequence[RecordedFlight], topic: str, signal: Callable[[Tape], Signal], **style: Any
) -> dict[str, Curve]:
    """A curve of every flight with a topic, in the colour of the flight."""
    return {
        label: Curve(_from_zero(signal(flight.tape), flight), colour, **style)
        for (label, colour), flight in zip(colours(flights).items(), flights, strict=True)
        if topic in flight.tape
    }


def _from_zero(signal: Signal, flight: RecordedFlight) -> Signal:
    """The signal with the flight time in ns as stamps."""
    return Signal(signal.stamp_ns - flight.tape.start_ns, signal.names, signal.values)


def _same_curve(first: Signal, second: Signal) -> bool:
    """Whether two references differ by at most SAME_CURVE_TOLERANCE of the largest value over their
    common time.
    """
    if (
        set(first.names) != set(second.names)
        or len(first.stamp_ns) == 0
        or len(second.stamp_ns) == 0
    ):
        return False
    instants = first.stamp_ns[first.stamp_ns <= second.stamp_ns[-1]]
    return all(
        np.max(
            np.abs(
                first[name][: len(instants)] - np.interp(instants, second.stamp_ns, second[name])
            ),
            initial=0.0,
        )
        <= SAME_CURVE_TOLERANCE * np.max(np.abs(first[name]))
        for name in first.names
    )
