# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Stacks of signals over time, as plotly draws them: a row a channel, bands over all rows, few enough points for a page.

Every stack shows all of its scene's time between the same margins, so that the rows of different stacks line up. What a curve
leaves out of the first view is kept in the scene's `Samples`, for the page to draw from when it is zoomed.
"""

import base64
import zlib
from collections.abc import Mapping, Sequence
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from flight_analysis.report.summary import PLAIN, DisplayUnit, titled
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray

MOST_POINTS = 2400  # of a curve over the page's width: the smallest and the largest value of each pixel, and some to spare
GAP = 10.0  # times the median period: a curve is broken where as much is missing
SHADE = 0.25  # opacity of bands
NAME = 0.08  # of the flight's time, which the name of a band takes
CLEAR = "rgba(0,0,0,0)"
PAPER, INK, GRID, ZERO = "#ffffff", "#2b3640", "#e8ebee", "#c8ced4"
DARK = {PAPER: "#1b1f24", INK: "#d3d9df", GRID: "#2c323a", ZERO: "#4b545e"}
"""Colours of the frame and what the page draws in their place on a dark ground."""


class Samples:
    """All samples behind the curves of a page, packed: each array once, by a name that says what is in it."""

    def __init__(self) -> None:
        self.packed: dict[str, str] = {}

    def times(self, t_ns: NDArray[np.int64]) -> str:
        """Keep instants; float64 steps in ns, the first from 0, which are as good as always alike."""
        return self._keep("t", np.diff(t_ns, prepend=np.int64(0)).astype("<f8"))

    def values(self, values: FloatArray) -> str:
        """Keep values, as float32."""
        return self._keep("v", values.astype("<f4"))

    def _keep(self, kind: str, array: NDArray[Any]) -> str:
        name = kind + blake2b(array.tobytes(), digest_size=8).hexdigest()
        if name not in self.packed:
            self.packed[name] = pack(array.tobytes(), array.itemsize)
        return name


def pack(content: bytes, width: int = 1) -> str:
    """Base64 of the zlib stream of bytes, those of the same place in items of `width` bytes next to each other.

    The high bytes of successive samples hardly differ: sorted so, they take a fifth less.
    """
    by_place = np.frombuffer(content, dtype=np.uint8).reshape(-1, width).T.tobytes()
    return base64.b64encode(zlib.compress(by_place)).decode()


class Band(NamedTuple):
    """A stretch of time to mark, s."""

    label: str
    start: float
    stop: float
    colour: str
    named: bool  # over the band; else in the legend


class Scene(NamedTuple):
    """What all pictures of a flight share."""

    tape: Tape
    units: Mapping[str, DisplayUnit]  # by channel
    bands: Sequence[Band]
    end: float  # of the flight, s
    samples: Samples


class Curve(NamedTuple):
    """A signal to draw, and how."""

    signal: Signal
    colour: str
    width: float = 1.4
    held: bool = False  # from one sample to the next, as u is
    pale: bool = False  # under others of its colour


def drawn_points(values: FloatArray, most: int = MOST_POINTS) -> NDArray[np.int64]:
    """Places of the samples to draw of values of shape (N,): all of at most `most`, else the smallest and largest of each bin.

    The bins are alike and at most most / 2 many. A NaN, which breaks the curve, is drawn beside them.
    """
    if len(values) <= most:
        return np.arange(len(values))
    width = -(-len(values) // (most // 2))
    padded = np.pad(values, (0, -len(values) % width), mode="edge").reshape(-1, width)
    missing = np.isnan(padded)
    lowest = np.where(missing, np.inf, padded).argmin(axis=1)
    highest = np.where(missing, -np.inf, padded).argmax(axis=1)
    starts = np.arange(len(padded)) * width
    places = np.concatenate([starts + lowest, starts + highest, np.flatnonzero(np.isnan(values))])
    return np.unique(np.minimum(places, len(values) - 1))


def spans(t: FloatArray, mask: NDArray[np.bool_], join: float = 0.0) -> list[tuple[float, float]]:
    """From when to when a mask of shape (N,) holds, s: from the sample where it begins to the one where it no longer does.

    Spans less than `join` apart are one, and none is shorter.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    found: list[tuple[float, float]] = []
    for first, after in zip(edges[::2], edges[1::2], strict=True):
        start = float(t[first])
        stop = max(float(t[min(after, len(t) - 1)]), start + join)
        if found and start - found[-1][1] < join:
            start, _ = found.pop()
        found.append((start, stop))
    return found


def stack(scene: Scene, curves: Mapping[str, Curve], *, columns: int = 1, height: int = 150) -> go.Figure:
    """A row a channel, `height` pixels each, curves that have it over each other; two columns are filled row by row."""
    channels = list(dict.fromkeys(name for curve in curves.values() for name in curve.signal.names))
    columns = min(columns, len(channels))
    figure = grid(len(channels), columns, height, shared_xaxes="all")
    for place, channel in enumerate(channels):
        at = cell(place, columns)
        unit, factor = scene.units.get(channel, PLAIN)
        for label, curve in curves.items():
            if channel in curve.signal.names:
                trace = _trace(scene, curve, channel, factor, MOST_POINTS // columns)
                trace.update(name=label, legendgroup=label, showlegend=len(curves) > 1 and is_new(figure, label))
                figure.add_trace(trace.update(hovertemplate=f"%{{y:.4g}} {unit}"), **at)
        figure.update_yaxes(title_text=titled(channel, scene.units), **at)
    figure.update_xaxes(range=[0.0, scene.end], showticklabels=False)
    for col in range(columns):
        last = -(-(len(channels) - col) // columns)  # row of the lowest cell of the column
        figure.update_xaxes(title_text="t (s)", showticklabels=True, row=last, col=col + 1)
    _mark_bands(figure, scene.bands, columns, scene.end)
    return framed(figure, height, labels=16 if columns == 1 else 6).update_layout(hovermode="x unified")


def cell(place: int, columns: int) -> dict[str, int]:
    """Row and column, from 1, of a cell counted from 0."""
    return {"row": place // columns + 1, "col": place % columns + 1}


def grid(count: int, columns: int, height: int, **options: Any) -> go.Figure:
    """An empty figure of `count` cells, filled row by row, `height` pixels each."""
    rows = -(-count // columns)
    cells: list[dict[str, Any] | None] = [{}] * count + [None] * (rows * columns - count)
    specs = [cells[row * columns :][:columns] for row in range(rows)]
    spacing = {"vertical_spacing": min(0.14, 24.0 / (rows * height)), "horizontal_spacing": 0.24 / columns}
    return make_subplots(rows, columns, specs=specs, **(spacing | options))


def framed(figure: go.Figure, height: int, labels: int = 6, below: int = 40) -> go.Figure:
    """The figure with its frame: rows of `height`, over them the legend and `labels` pixels, `below` them their axis."""
    rows = len({axis.domain for axis in figure.select_yaxes()})
    legend = 24 * any(trace.showlegend for trace in figure.data)
    figure.update_xaxes(gridcolor=GRID, zerolinecolor=ZERO, title_standoff=4)
    figure.update_yaxes(gridcolor=GRID, zerolinecolor=ZERO, title_standoff=6)
    return figure.update_layout(
        height=legend + labels + height * rows + below,
        template="none",
        font={"family": "system-ui, sans-serif", "size": 12, "color": INK},
        paper_bgcolor=CLEAR,
        plot_bgcolor=CLEAR,
        modebar_bgcolor=CLEAR,
        hoverlabel={"bgcolor": PAPER, "font": {"color": INK}},
        margin={"l": 80, "r": 20, "t": legend + labels, "b": below},
        legend={"orientation": "h", "x": 0.0, "y": 1.0 + labels / (height * rows), "yanchor": "bottom", "bgcolor": CLEAR},
    )


def is_new(figure: go.Figure, label: str) -> bool:
    """Whether the figure has nothing yet under a label, which the legend shows once."""
    return all(trace.name != label for trace in figure.data)


def add_line(
    figure: go.Figure, row: int, label: str, x: Sequence[float | None], y: Sequence[float], look: Mapping[str, Any]
) -> None:
    """Add a line that is no signal to a row, once to the legend; it is broken where x is None."""
    if not x:
        return
    trace = go.Scatter(x=x, y=y, mode="lines", name=label, legendgroup=label, line=dict(look), hoverinfo="skip")
    figure.add_trace(trace.update(showlegend=is_new(figure, label)), row=row, col=1)


def _trace(scene: Scene, curve: Curve, channel: str, factor: float, most: int) -> go.Scatter:
    t_ns, values = _broken(curve.signal.stamp_ns - scene.tape.start_ns, curve.signal[channel] * factor, curve.held)
    keep = drawn_points(values, most)
    look = {"color": curve.colour, "width": curve.width, "shape": "hv" if curve.held else "linear"}
    trace = go.Scatter(
        x=(t_ns[keep] / NANOSECONDS).astype(np.float32),  # finer than a screen, and half the page of float64
        y=values[keep].astype(np.float32),
        mode="lines",
        line=look | {"simplify": False},  # simplified lines cut corners of many pixels
        opacity=0.35 if curve.pale else None,
    )
    if len(keep) == len(values):
        return trace
    return trace.update(meta={"t": scene.samples.times(t_ns), "v": scene.samples.values(values), "most": most})


def _broken(t_ns: NDArray[np.int64], values: FloatArray, held: bool) -> tuple[NDArray[np.int64], FloatArray]:
    """Instants and values with a NaN behind each sample that nothing follows for GAP periods, unless it is held."""
    periods = np.diff(t_ns)
    if held or len(periods) == 0:
        return t_ns, values
    before = np.flatnonzero(periods > GAP * np.median(periods))
    return np.insert(t_ns, before + 1, t_ns[before]), np.insert(values, before + 1, np.nan)


def _mark_bands(figure: go.Figure, bands: Sequence[Band], columns: int, end: float) -> None:
    for band in bands:
        for axis in ("x", "x2")[:columns]:
            look = {"fillcolor": band.colour, "opacity": SHADE, "line_width": 0, "layer": "below"}
            figure.add_shape(type="rect", xref=axis, yref="paper", x0=band.start, x1=band.stop, y0=0, y1=1, **look)
    if columns > 1:
        return  # too narrow for words
    for start, text in _names([band for band in bands if band.named], end).items():
        place = {"x": start, "xanchor": "left", "y": 1.0, "yref": "paper", "yanchor": "bottom"}
        figure.add_annotation(text=text, **place, showarrow=False, font={"size": 11})
    for label, colour in {band.label: band.colour for band in bands if not band.named}.items():
        mark = {"symbol": "square", "size": 12, "color": colour, "opacity": 2 * SHADE}
        figure.add_trace(go.Scatter(x=[None], y=[None], mode="markers", name=label, marker=mark, showlegend=True), row=1, col=1)


def _names(bands: Sequence[Band], end: float) -> dict[float, str]:
    """What stands over the bands, by where it begins: names that would run into each other are one."""
    names: dict[float, str] = {}
    for band in sorted(bands, key=lambda band: band.start):
        place = next((start for start in names if band.start - start < NAME * end), band.start)
        names[place] = f"{names[place]}, {band.label}" if place in names else band.label
    return names
