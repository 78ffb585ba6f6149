# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Several flights over each other, channels matched by name: every figure beside that of the first, curves in one picture."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go

from flight_analysis.metrics import known_error
from flight_analysis.report import figures
from flight_analysis.report.plotting import Band, Curve, Samples, Scene, stack
from flight_analysis.report.recorded_flight import RecordedFlight
from flight_analysis.report.summary import (
    ERROR_COLUMNS,
    INPUT_COLUMNS,
    NONE,
    PLAIN,
    SWITCHES,
    Column,
    DisplayUnit,
    cell,
    display_units,
    figure,
    slowest,
    titled,
)
from flight_core.tape import Signal, Tape

# Okabe and Ito 2008, told apart by the colour blind too; lighter on a dark ground.
DARK = {"#0072b2": "#4db3ea", "#d55e00": "#ff924a", "#009e73": "#3fcf9f", "#cc79a7": "#e8a3c8", "#7a6a00": "#d9c74a"}
COLOURS = tuple(DARK)
ALIKE = 1e-3  # of the largest value: two curves that are no farther apart are one in a picture
TICKS = {
    "jitter rms (ms)": ("ticks", "jitter"),
    "late p99 (ms)": ("ticks", "late_p99"),
    "age of y p99 (ms)": ("ticks", "age_p99"),
    "y sent to u sent, median (ms)": ("latency", "median"),
    "y sent to u sent, p99 (ms)": ("latency", "p99"),
}
"""Figures of the controller by what they are called, and their path in a summary; s."""


class ComparisonRow(NamedTuple):
    """A figure of every flight, and its ratio to that of the first; None where there is none."""

    what: str
    texts: tuple[str, ...]
    ratios: tuple[float | None, ...]
    judged: bool = True  # less of it is better


class ComparisonBlock(NamedTuple):
    """Rows that belong together."""

    name: str
    rows: tuple[ComparisonRow, ...]
    channel: str = ""


def colours(flights: Sequence[RecordedFlight]) -> dict[str, str]:
    """Colour by the label of a flight."""
    return {label: COLOURS[k % len(COLOURS)] for k, label in enumerate(labels(flights))}


def labels(flights: Sequence[RecordedFlight]) -> list[str]:
    """Names of the flights, with a number where two have the same."""
    names = [flight.name for flight in flights]
    return [f"{name} ({k})" if names.count(name) > 1 else name for k, name in enumerate(names, start=1)]


def units(flights: Sequence[RecordedFlight]) -> dict[str, DisplayUnit]:
    """Units by channel, those of the first flight that has it."""
    return {name: unit for flight in reversed(flights) for name, unit in display_units(flight.scenario).items()}


# ---- Figures


def blocks(flights: Sequence[RecordedFlight], key: str, columns: Sequence[Column], *, judged: bool) -> list[ComparisonBlock]:
    """Figures of "errors" or "inputs" of the summaries: a block a channel, a row for each of the columns that has any."""
    shown, found = units(flights), []
    for channel in dict.fromkeys(name for flight in flights for name in flight.summary[key]):
        factor = shown.get(channel, PLAIN).factor
        rows = [
            _row(flights, f"{one.group} {one.head}".strip(), (key, channel, *one.path), factor if one.scaled else 1.0)
            for one in columns
        ]
        told = tuple(row._replace(judged=judged) for row in rows if set(row.texts) != {NONE})
        found.append(ComparisonBlock(titled(channel, shown), told, channel))
    return found


def error_blocks(flights: Sequence[RecordedFlight]) -> list[ComparisonBlock]:
    """Figures of the error by channel, and how long it took to settle."""
    return [
        block._replace(rows=(*block.rows, *_settling_rows(flights, block.channel)))
        for block in blocks(flights, "errors", (*ERROR_COLUMNS, SWITCHES), judged=True)
    ]


def _settling_rows(flights: Sequence[RecordedFlight], channel: str) -> list[ComparisonRow]:
    times = {kind: tuple(slowest(flight.summary, channel, kind) for flight in flights) for kind in ("command", "gust")}
    none = (None,) * len(flights)
    return [ComparisonRow(f"settling, {kind} (s)", texts, none) for kind, texts in times.items() if set(texts) != {NONE}]


def input_blocks(flights: Sequence[RecordedFlight]) -> list[ComparisonBlock]:
    """Figures of the inputs by channel."""
    return blocks(flights, "inputs", INPUT_COLUMNS, judged=False)


def tick_blocks(flights: Sequence[RecordedFlight]) -> list[ComparisonBlock]:
    """Figures of the controllers' time, in one block; none where all of them are 0."""
    rows = [_row(flights, what, path, 1e3) for what, path in TICKS.items()]
    shown = tuple(row for row in rows if set(row.texts) - {NONE, cell(0.0)})
    return [ComparisonBlock("Ticks of the controller", shown)] if shown else []


def _row(flights: Sequence[RecordedFlight], what: str, path: Sequence[str], factor: float) -> ComparisonRow:
    values = [figure(flight.summary, *path) for flight in flights]
    first = values[0]
    ratios = tuple(None if value is None or not first else value / first for value in values)
    return ComparisonRow(what, tuple(cell(value, factor) for value in values), ratios)


# ---- Pictures


def scene(flights: Sequence[RecordedFlight]) -> Scene:
    """The scene of all flights: each from its own t = 0, with the gusts of all of them."""
    bands: dict[Band, None] = {}
    for flight in flights:
        bands |= dict.fromkeys(figures.gust_bands(flight.tape, flight.scenario.gust_windows()))
    end = max(figures.flight_end(flight.tape) for flight in flights)
    return Scene(Tape({}), units(flights), list(bands), end, Samples())


def tracking_figure(scene: Scene, flights: Sequence[RecordedFlight]) -> go.Figure:
    """Y of every flight over the reference of each that has one of its own."""
    references: dict[str, Signal] = {}
    for label, flight in zip(labels(flights), flights, strict=True):
        y_m = _from_zero(flight.tape["y_m"], flight)
        alike = next((other for other, known in references.items() if _same(known, y_m)), None)
        if alike is None:
            references[label] = y_m
        elif len(y_m.stamp_ns) > len(references[alike].stamp_ns):
            references[alike] = y_m
    palette = colours(flights)
    curves = {f"y_m {label}": Curve(signal, palette[label], 5.0, pale=True) for label, signal in references.items()}
    if len(references) == 1:
        (curve,) = curves.values()
        curves = {"y_m": curve._replace(colour=figures.REFERENCE, width=6.0, pale=False)}
    return stack(scene, curves | _curves(flights, "y", lambda tape: tape["y"]))


def error_figure(scene: Scene, flights: Sequence[RecordedFlight]) -> go.Figure:
    """The best known error of every flight."""
    return stack(scene, _curves(flights, "y", lambda tape: known_error(tape)[1]), height=120)


def input_figure(scene: Scene, flights: Sequence[RecordedFlight]) -> go.Figure | None:
    """U of every flight."""
    curves = _curves(flights, "u", lambda tape: tape["u"], held=True)
    return stack(scene, curves) if curves else None


def spectrum_figure(scene: Scene, flights: Sequence[RecordedFlight]) -> go.Figure | None:
    """Spectra of u of every flight that has enough samples."""
    of = {
        label: (flight.tape["u"], flight.period_ns)
        for label, flight in zip(labels(flights), flights, strict=True)
        if "u" in flight.tape and len(flight.tape["u"].stamp_ns) >= figures.FEWEST
    }
    return figures.draw_spectra(of, colours(flights), scene.units) if of else None


def timing_figure(flights: Sequence[RecordedFlight]) -> go.Figure | None:
    """How the time of every controller was spread."""
    named = zip(labels(flights), flights, strict=True)
    of = {label: figures.timing(flight.tape, flight.period_ns) for label, flight in named}
    return figures.draw_histograms(of, colours(flights)) if any(of.values()) else None


def _curves(flights: Sequence[RecordedFlight], topic: str, of: Callable[[Tape], Signal], **look: Any) -> dict[str, Curve]:
    """A curve of each flight that has a topic, in its colour."""
    return {
        label: Curve(_from_zero(of(flight.tape), flight), colour, **look)
        for (label, colour), flight in zip(colours(flights).items(), flights, strict=True)
        if topic in flight.tape
    }


def _from_zero(signal: Signal, flight: RecordedFlight) -> Signal:
    """The signal with the flight time in ns as its stamps."""
    return Signal(signal.stamp_ns - flight.tape.start_ns, signal.names, signal.values)


def _same(one: Signal, other: Signal) -> bool:
    """Whether two references are one to the eye: within ALIKE of the largest value, as far as both go."""
    if set(one.names) != set(other.names) or len(one.stamp_ns) == 0 or len(other.stamp_ns) == 0:
        return False
    instants = one.stamp_ns[one.stamp_ns <= other.stamp_ns[-1]]
    return all(
        np.max(np.abs(one[name][: len(instants)] - np.interp(instants, other.stamp_ns, other[name])), initial=0.0)
        <= ALIKE * np.max(np.abs(one[name]))
        for name in one.names
    )
