# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw time series with plotly.js, with a subplot for each channel, and shaded intervals.

The figures of a page share the time axis and the margins, so that their subplots line up. A figure
holds short curves itself. `SampleStore` holds the samples of longer curves, and the page decimates
them to the present view. If a curve has more than MAX_STORED samples, the page gets only the
smallest and the largest value of each bin of time. The metrics are always computed from all
samples.
"""

import base64
import zlib
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from hashlib import blake2b
from itertools import chain, product
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from flight_analysis.report.display_units import NO_UNIT, DisplayUnit, channel_label, in_order
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray

T = TypeVar("T", bound=np.generic)
# largest number of points of a curve over the width of the page; beyond it, each pixel shows the
# smallest and the largest value
MAX_POINTS = 2400
LEVEL = 4  # level of zlib, which takes 1 % more space and 60 % of the time of level 6
PACKERS = 2  # threads that pack samples, each of which holds a channel twice
# largest number of samples of a curve on a page. It is 60 s at 500 Hz, or 13 times MAX_POINTS, so
# that one can zoom. With all samples, an hour of flight would take 141 MB.
MAX_STORED = 32_000
BINS = 12_000  # bins of a longer curve, 10 times the pixels of a wide screen
# bits of a stored value, including the leading one. The error is at most 1 in 2^14, which is finer
# than a pixel, and a label at the pointer shows only 4 digits.
MANTISSA = 14
MARGIN = {"l": 80, "r": 36}  # pixels, left and right of the subplots
ACROSS = 0.3  # space between two columns, as a fraction of a column
LABELS = 70  # pixels for the labels and the title of an axis; four columns fit the page
MIN_GAP_PERIODS = 10.0  # a curve is broken at a gap of this many median periods
INTERVAL_OPACITY = 0.25
INTERVAL_LABEL = 11  # size of the label of an interval, pixels
INTERVAL = "interval"  # name of the label of an interval, which the page places
MESSAGE_LINE = {"color": "#7a6a00", "width": 1.2, "dash": "dot"}
SHOWS_ANGLES = {"angles": True}  # marks a figure that the page can also draw in rad
TRANSPARENT = "rgba(0,0,0,0)"
PAPER = "#ffffff"
INK = "#2b3640"
GRID = "#e8ebee"
ZERO = "#c8ced4"
DARK = {PAPER: "#1b1f24", INK: "#d3d9df", GRID: "#2c323a", ZERO: "#4b545e"}
"""Colours of the frame on a light page, with those that replace them on a dark page."""


@dataclass(frozen=True, kw_only=True)
class Instants:
    """The instants at which a curve is drawn, with its gaps."""

    # Instants of the drawn samples, ns since the start of the flight, and a further one where a gap
    # begins. If samples are drawn in bins, each bin has two instants.
    t_ns: NDArray[np.int64]
    gaps: NDArray[np.intp]  # indices of the samples before which a NaN marks a gap
    width: int  # number of samples in a bin; 1 if each sample is drawn


class SampleStore:
    """The samples of the long curves of a page, packed to be stored in the page.

    Equal arrays are stored once, under a hash of their content.
    """

    def __init__(self) -> None:
        self._packed: dict[str, Future[str]] = {}
        # Compression releases the lock of the interpreter, so that threads help.
        self._pool = ThreadPoolExecutor(PACKERS)
        self._instants: dict[tuple[str, int, bool], Instants] = {}
        # Digests of stamps by the id of their array. The arrays are kept, so that Python does not
        # reuse an id.
        self._digests: dict[int, tuple[str, NDArray[np.int64]]] = {}
        self._times: dict[int, tuple[str, NDArray[np.int64]]] = {}

    @property
    def packed(self) -> dict[str, str]:
        """The packed arrays of the page, by name."""
        return {name: packed.result() for name, packed in self._packed.items()}

    def instants(self, stamp_ns: NDArray[np.int64], start_ns: int, *, steps: bool) -> Instants:
        """Return the instants of a curve, cached for equal stamps. A step curve has no gaps."""
        if id(stamp_ns) not in self._digests:
            self._digests[id(stamp_ns)] = _digest(stamp_ns), stamp_ns
        key = self._digests[id(stamp_ns)][0], start_ns, steps
        if key not in self._instants:
            self._instants[key] = _instants(stamp_ns - start_ns, steps)
        return self._instants[key]

    def times(self, t_ns: NDArray[np.int64]) -> str:
        """Store instants, and return the name of the stored array.

        The array has the first instant, and then the steps from each instant to the next, ns,
        float64, because equal steps compress well.
        """
        if id(t_ns) not in self._times:
            self._times[id(t_ns)] = (
                self._add("t", np.diff(t_ns, prepend=np.int64(0)).astype("<f8")),
                t_ns,
            )
        return self._times[id(t_ns)][0]

    def values(self, values: FloatArray) -> str:
        """Store values as float32, rounded to MANTISSA bits, and return the array's name.

        Values are rounded because noise does not compress, and a pixel shows fewer digits. The bits
        of a value are taken as an integer. The array has the first integer, and then the difference
        of each integer from the one before, modulo 2^32, because successive samples hardly differ.
        """
        spare = 24 - MANTISSA
        bits = values.astype("<f4").view("<u4")
        return self._add(
            "v", np.diff(bits + (1 << spare - 1) >> spare << spare, prepend=np.uint32(0))
        )

    def _add(self, kind: str, array: NDArray[Any]) -> str:
        name = kind + _digest(array)
        if name not in self._packed:
            # Each waiting job holds its array, so the number of jobs is limited.
            wait([packed for packed in self._packed.values() if not packed.done()][: 1 - PACKERS])
            self._packed[name] = self._pool.submit(pack, array, array.itemsize)
        return name


def _digest(array: NDArray[Any]) -> str:
    return blake2b(np.ascontiguousarray(array).data, digest_size=8).hexdigest()


def pack(content: bytes | NDArray[Any], width: int = 1) -> str:
    """Shuffle the bytes of items of `width` bytes, compress them by zlib, and encode as base64.

    The shuffle puts the first bytes of all items first, then the second bytes, and so on. The
    shuffled bytes compress better, because the high bytes of small steps are all equal.
    """
    shuffled = np.frombuffer(content, dtype=np.uint8).reshape(-1, width).T.tobytes()
    return base64.b64encode(zlib.compress(shuffled, LEVEL)).decode()


@dataclass(frozen=True, kw_only=True)
class Interval:
    """An interval of time, s, that figures shade, such as a gust."""

    label: str
    start: float
    stop: float
    colour: str
    is_labelled: bool  # whether the label stands over the interval, not in the legend


@dataclass(frozen=True, kw_only=True)
class Run:
    """A flight and what figures need to draw it: its signals, its period and its colour."""

    tape: Tape
    period_ns: int  # period of the controller's ticks
    colour: str


class PlotContext(NamedTuple):
    """What the figures of a page share: flights, units, shaded intervals and samples."""

    runs: Mapping[str, Run]  # by label; a single flight, or several to compare
    units: Mapping[str, DisplayUnit]  # units by channel
    intervals: Sequence[Interval]
    end: float  # end of the longest flight, s
    samples: SampleStore
    messages: Sequence[float] = ()  # times of the messages of a log, s

    @property
    def tape(self) -> Tape:
        """The tape of the flight, or of the first of several flights."""
        return next(iter(self.runs.values())).tape

    @property
    def is_comparison(self) -> bool:
        """Whether the figures have several flights."""
        return len(self.runs) > 1


class Curve(NamedTuple):
    """A signal and the style of its line."""

    signal: Signal
    colour: str
    width: float = 1.4
    is_held: bool = False  # each value is held until the next sample, like u
    is_faint: bool = False
    start_ns: int | None = None  # stamp of t = 0; None for the start of the page's flight


@dataclass(frozen=True, kw_only=True)
class Extent:
    """The smallest and the largest value of a curve in a subplot, in the displayed unit."""

    index: int  # index of the subplot
    name: str
    low: float
    high: float


def _finite(values: Any) -> FloatArray:
    """Return the finite values of a plotly trace, or no values if its data are not numbers."""
    try:
        array = np.asarray([] if values is None else values, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        return np.zeros(0)
    return array[np.isfinite(array)]


class Figure:
    """Subplots for plotly.js: the traces `data` and the `layout`.

    `x` and `y` are the axes of each subplot. There are `count` subplots, which fill the figure row
    by row. Each is `height` pixels high. `spacing` is the space between two rows as a fraction of
    the figure. Source of the names: https://plotly.com/javascript/reference.
    """

    def __init__(self, count: int, columns: int, height: int, spacing: float | None = None) -> None:
        self.rows = -(-count // columns)
        self.height = height
        across = ACROSS / columns
        # least width in pixels. On a narrower page labels would cover the next column, so the page
        # scrolls instead.
        self.least_width = sum(MARGIN.values()) + round(LABELS / across) if columns > 1 else 0
        between = min(0.14, 24.0 / (self.rows * height)) if spacing is None else spacing
        wide = (1.0 - across * (columns - 1)) / columns
        high = (1.0 - between * (self.rows - 1)) / self.rows
        self.data: list[dict[str, Any]] = []
        self.x: list[dict[str, Any]] = []
        self.y: list[dict[str, Any]] = []
        for index in range(count):
            row, column = divmod(index, columns)
            left_edge = column * (wide + across)
            bottom = (self.rows - 1 - row) * (high + between)
            self.x.append({"anchor": axis("y", index), "domain": [left_edge, left_edge + wide]})
            self.y.append({"anchor": axis("x", index), "domain": [bottom, bottom + high]})
        self.extents: list[Extent] = []
        self.layout: dict[str, Any] = {"shapes": [], "annotations": []}
        for letter, axes in (("x", self.x), ("y", self.y)):
            self.layout |= {axis(f"{letter}axis", index): value for index, value in enumerate(axes)}

    def add(self, trace: dict[str, Any], index: int = 0, values: FloatArray | None = None) -> None:
        """Add a trace (plotly's word for a curve or bars) to a subplot.

        If the page holds the samples of the trace, the trace itself has none, and `values` gives
        them.
        """
        self.data.append(trace | {"xaxis": axis("x", index), "yaxis": axis("y", index)})
        shown = trace.get("y") if values is None else values
        finite = _finite(shown)
        if trace.get("name") and len(finite):
            extent = Extent(
                index=index,
                name=trace["name"],
                low=float(finite.min()),
                high=float(finite.max()),
            )
            self.extents.append(extent)

    @property
    def text(self) -> str:
        """The figure in words: by subplot, the smallest and the largest value of each curve."""
        by_plot: dict[int, list[str]] = {}
        for extent in self.extents:
            words = f"{extent.name} from {extent.low:.3g} to {extent.high:.3g}"
            by_plot.setdefault(extent.index, []).append(words)
        parts = []
        for index, ranges in sorted(by_plot.items()):
            title = self.y[index].get("title", {}).get("text", "")
            parts.append(f"{title}: {', '.join(dict.fromkeys(ranges))}".removeprefix(": "))
        return "; ".join(parts)

    def add_scatter(
        self, name: str, x: Any, y: Any, index: int = 0, mode: str = "lines", **style: Any
    ) -> None:
        """Add the points (x, y) as a line, as marks or as texts to a subplot."""
        points = {"type": "scatter", "name": name, "x": x, "y": y, "mode": mode}
        self.add(points | style, index)


def axis(name: str, index: int) -> str:
    """Return the name of an axis of the subplot `index`, counted from 0, such as x, x2 or x3."""
    return name if index == 0 else f"{name}{index + 1}"


def time_series_figure(
    context: PlotContext,
    curves: Mapping[str, Curve],
    *,
    columns: int = 1,
    height: int = 150,
    labels: Mapping[str, str] = MappingProxyType({}),
) -> Figure:
    """Draw a subplot of `height` pixels for each channel, with all curves of this channel.

    Two columns are filled row by row. `labels` has axis labels that replace the names of channels.
    """
    names = dict.fromkeys(chain.from_iterable(curve.signal.names for curve in curves.values()))
    channels = in_order(names, context.units)
    columns = min(columns, len(channels))
    figure = Figure(len(channels), columns, height)
    followed = (figure.rows - 1) * columns
    for index, channel in enumerate(channels):
        unit = context.units.get(channel, NO_UNIT)
        for label, curve in curves.items():
            if channel in curve.signal.names:
                trace = _trace(context, curve, channel, unit.factor, MAX_POINTS // columns)
                values = curve.signal[channel] * unit.factor
                in_legend = len(curves) > 1 and is_first_in_legend(figure, label)
                trace |= {
                    "name": label,
                    # If all entries of a legend are in one group, plotly stacks them.
                    "legendgroup": label if len(curves) > 1 else "",
                    "showlegend": in_legend,
                    "hovertemplate": f"%{{y:.4g}} {unit.unit}",
                }
                figure.add(trace, index, values)
        title = labels.get(channel) or channel_label(channel, context.units)
        figure.y[index]["title"] = {"text": title}
        lowest = index + columns >= len(channels)
        figure.x[index] |= {"range": [0.0, context.end], "showticklabels": lowest}
        figure.x[index] |= {"title": {"text": "t (s)"}} if lowest else {}
        figure.x[index] |= {"matches": axis("x", followed)} if index != followed else {}
    _shade_intervals(figure, context.intervals, columns)
    _mark_messages(figure, context.messages, columns)
    figure.layout |= {"hovermode": "x unified", "meta": SHOWS_ANGLES}
    return set_layout(figure, labels=16 if columns == 1 else 6)


def set_layout(figure: Figure, labels: int = 6, below: int = 40) -> Figure:
    """Set the size, the margins and the colours of a figure.

    The margin above the rows has room for the legend, if any, and `labels` pixels for labels. The
    margin below the rows has `below` pixels for the axis.
    """
    has_legend = any(trace.get("showlegend") for trace in figure.data)
    above = labels + (24 if has_legend else 0)
    rows = figure.height * figure.rows
    for axes, standoff in ((figure.x, 4), (figure.y, 6)):
        for axis in axes:
            axis |= {
                "gridcolor": GRID,
                "zerolinecolor": ZERO,
                "title": axis.get("title", {}) | {"standoff": standoff},
            }
            # Without a type of the axis, plotly would read all samples to find it.
            axis |= {"type": axis.get("type", "linear")}
    for axis in figure.y:
        # The margin has room for the labels, so plotly need not measure each label.
        axis["ticklabeloverflow"] = "allow"
    figure.layout |= {
        "height": above + rows + below,
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": INK},
        "paper_bgcolor": TRANSPARENT,
        "plot_bgcolor": TRANSPARENT,
        # The legend is beside the figure, where it covers no label.
        "modebar": {"bgcolor": TRANSPARENT, "color": ZERO, "activecolor": INK, "orientation": "v"},
        "hoverlabel": {"bgcolor": PAPER, "font": {"color": INK}},
        "margin": MARGIN | {"t": above, "b": below},
        "legend": {
            "orientation": "h",
            "x": 0.0,
            "y": 1.0 + labels / rows,
            "yanchor": "bottom",
            "bgcolor": TRANSPARENT,
        },
    }
    return figure


def is_first_in_legend(figure: Figure, label: str) -> bool:
    """Return whether a label is new to the figure, because the legend shows each label once."""
    return all(trace["name"] != label for trace in figure.data)


def add_line(
    figure: Figure,
    index: int,
    label: str,
    x: Sequence[float | None],
    y: Sequence[float],
    style: Mapping[str, Any],
) -> None:
    """Add a line to a subplot, with an entry in the legend. A None in x breaks the line."""
    if not x:
        return
    in_legend = is_first_in_legend(figure, label)
    figure.add_scatter(
        label, x, y, index, legendgroup=label, line=style, hoverinfo="skip", showlegend=in_legend
    )


def _trace(
    context: PlotContext, curve: Curve, channel: str, factor: float, most: int
) -> dict[str, Any]:
    t_ns, values = _drawn(context, curve, channel, factor)
    style = {
        "color": curve.colour,
        "width": curve.width,
        "shape": "hv" if curve.is_held else "linear",
    }
    # The line is not simplified, because plotly would cut off peaks.
    trace = {"type": "scatter", "mode": "lines", "line": style | {"simplify": False}} | (
        {"opacity": 0.35} if curve.is_faint else {}
    )
    if len(values) <= most:
        return trace | {"x": t_ns / NANOSECONDS, "y": values}
    meta = {
        "t": context.samples.times(t_ns),
        "v": context.samples.values(values),
        "most": most,
    }
    return trace | {"meta": meta}


def stored(context: PlotContext, signal: Signal, channel: str, factor: float) -> tuple[str, str]:
    """Store the times and the scaled values of a channel, and return their names on the page.

    The values are multiplied by `factor`. Arrays that the page already holds are not stored again.
    """
    t_ns, values = _drawn(context, Curve(signal, ""), channel, factor)
    return context.samples.times(t_ns), context.samples.values(values)


def _drawn(
    context: PlotContext, curve: Curve, channel: str, factor: float
) -> tuple[NDArray[np.int64], FloatArray]:
    """Return instants and scaled values of a channel, with a NaN where a gap begins.

    The values are multiplied by `factor`. A long curve is reduced to two values for each bin of
    time.
    """
    start_ns = context.tape.start_ns if curve.start_ns is None else curve.start_ns
    drawn = context.samples.instants(curve.signal.stamp_ns, start_ns, steps=curve.is_held)
    values = curve.signal[channel] * factor
    values = np.insert(values, drawn.gaps, np.nan) if len(drawn.gaps) else values
    return drawn.t_ns, values if drawn.width == 1 else _extremes_of_bins(values, drawn.width)


def _extremes_of_bins(values: FloatArray, width: int) -> FloatArray:
    """Return the smallest and the largest value of each bin, in the order in which they occur.

    A bin has `width` samples. If a bin has a gap, its second value is NaN.
    """
    bins = _bins(values, width)
    gaps = np.isnan(bins)
    low = np.where(gaps, np.inf, bins).argmin(axis=1)
    high = np.where(gaps, -np.inf, bins).argmax(axis=1)
    columns = np.sort(np.column_stack([low, high]), axis=1)
    extremes = np.take_along_axis(bins, columns, axis=1)
    extremes[gaps.any(axis=1), 1] = np.nan
    return extremes.ravel()


def _bins(values: NDArray[T], width: int) -> NDArray[T]:
    """Split values into bins, (N, width). The last value is repeated to fill the last bin."""
    return np.append(values, np.full(-len(values) % width, values[-1])).reshape(-1, width)


def _instants(t_ns: NDArray[np.int64], steps: bool) -> Instants:
    periods = np.diff(t_ns)
    before = np.zeros(0, dtype=np.intp)
    if not steps and len(periods):
        before = np.flatnonzero(periods > MIN_GAP_PERIODS * np.median(periods))
        t_ns = np.insert(t_ns, before + 1, t_ns[before]) if len(before) else t_ns
    width = -(-len(t_ns) // BINS) if len(t_ns) > MAX_STORED else 1
    stamps = t_ns if width == 1 else _bins(t_ns, width)[:, [0, width // 2]].ravel()
    return Instants(t_ns=stamps, gaps=before + 1, width=width)


def _shade_intervals(figure: Figure, intervals: Sequence[Interval], columns: int) -> None:
    for interval in intervals:
        for column in range(columns):
            figure.layout["shapes"].append(
                {
                    "type": "rect", "xref": axis("x", column), "yref": "paper",
                    "x0": interval.start, "x1": interval.stop,
                    "y0": 0, "y1": 1, "fillcolor": interval.colour, "opacity": INTERVAL_OPACITY,
                    "line": {"width": 0},
                    "layer": "below",
                }
            )  # fmt: skip
    has_labels = columns == 1  # two columns are too narrow for labels
    for interval in sorted(intervals, key=lambda interval: interval.start):
        if interval.is_labelled and has_labels:
            position = {"x": interval.start, "xanchor": "left", "y": 1.0, "yref": "paper"}
            text = {"text": interval.label, "font": {"size": INTERVAL_LABEL}}
            style = {"name": INTERVAL, "yanchor": "bottom", "showarrow": False}
            figure.layout["annotations"].append({**position, **text, **style})
    for label, colour in {
        interval.label: interval.colour
        for interval in intervals
        if not (interval.is_labelled and has_labels)
    }.items():
        mark = {"symbol": "square", "size": 12, "color": colour, "opacity": 2 * INTERVAL_OPACITY}
        figure.add_scatter(label, [None], [None], mode="markers", marker=mark, showlegend=True)


def _mark_messages(figure: Figure, times: Sequence[float], columns: int) -> None:
    """Draw a dotted line through every subplot at the time of each message of the log."""
    for time, column in product(times, range(columns)):
        position = {"type": "line", "xref": axis("x", column), "yref": "paper", "y0": 0, "y1": 1}
        figure.layout["shapes"].append(
            {**position, "x0": time, "x1": time, "layer": "below", "line": MESSAGE_LINE}
        )
    if times:
        figure.add_scatter("message of the log", [None], [None], line=MESSAGE_LINE, showlegend=True)
