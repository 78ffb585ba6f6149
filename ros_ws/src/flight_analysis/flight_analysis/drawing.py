# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Stacks of signals over time, as plotly draws them: a row a channel, bands over all rows, few enough points for a page.

Every stack shows all of its scene's time between the same margins, so that the rows of different stacks line up.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from flight_analysis.summary import Shown
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray

PLAIN = Shown("", 1.0)  # a channel whose unit is not known is shown in SI
MOST_POINTS = 6000  # of a curve over the page's width; 100 Hz over a minute
GAP = 10.0  # times the median period: a curve is broken where as much is missing
SHADE = 0.25  # opacity of bands
CLEAR = "rgba(0,0,0,0)"


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
    units: Mapping[str, Shown]  # by channel
    bands: Sequence[Band]
    end: float  # of the flight, s


class Curve(NamedTuple):
    """A signal to draw, and how."""

    signal: Signal
    colour: str
    width: float = 1.4
    held: bool = False  # from one sample to the next, as u is


def drawn_points(values: FloatArray, most: int = MOST_POINTS) -> NDArray[np.int64]:
    """Places of at most `most` >= 2 samples to draw of values of shape (N,): all, else the smallest and largest of each bin."""
    if len(values) <= most:
        return np.arange(len(values))
    edges = np.linspace(0, len(values), most // 2 + 1).astype(np.int64)
    bins = itertools.pairwise(edges)
    extremes = [start + extreme(values[start:stop]) for start, stop in bins for extreme in (np.argmin, np.argmax)]
    return np.unique(np.array(extremes, dtype=np.int64))


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
    rows = -(-len(channels) // columns)
    cells: list[dict[str, Any] | None] = [{}] * len(channels) + [None] * (rows * columns - len(channels))
    spacing = {"vertical_spacing": min(0.14, 24.0 / (rows * height)), "horizontal_spacing": 0.1}
    grid = [cells[row * columns :][:columns] for row in range(rows)]
    figure = make_subplots(rows, columns, shared_xaxes="all", specs=grid, **spacing)
    for place, channel in enumerate(channels):
        cell = {"row": place // columns + 1, "col": place % columns + 1}
        unit, factor = scene.units.get(channel, PLAIN)
        for label, curve in curves.items():
            if channel in curve.signal.names:
                trace = _trace(scene.tape.start_ns, curve, channel, factor, MOST_POINTS // columns)
                trace.update(name=label, legendgroup=label, showlegend=place == 0 and len(curves) > 1)
                figure.add_trace(trace.update(hovertemplate=f"%{{y:.4g}} {unit}"), **cell)
        figure.update_yaxes(title_text=f"{channel} ({unit})" if unit else channel, title_standoff=6, **cell)
    figure.update_xaxes(range=[0.0, scene.end], showticklabels=False)
    for col in range(columns):
        last = -(-(len(channels) - col) // columns)  # row of the lowest cell of the column
        figure.update_xaxes(title_text="t (s)", title_standoff=4, showticklabels=True, row=last, col=col + 1)
    _mark_bands(figure, scene.bands, columns)
    # Pixels: the legend and under it the names of bands, the axis of time.
    legend, labels, below = 24 * any(trace.showlegend for trace in figure.data), 16 if columns == 1 else 6, 40
    figure.update_layout(
        height=legend + labels + height * rows + below,
        template="plotly_white",
        paper_bgcolor=CLEAR,
        plot_bgcolor=CLEAR,
        modebar_bgcolor=CLEAR,
        margin={"l": 80, "r": 20, "t": legend + labels, "b": below},
        legend={"orientation": "h", "x": 0.0, "y": 1.0 + labels / (height * rows), "yanchor": "bottom", "bgcolor": CLEAR},
        hovermode="x unified",
    )
    return figure


def add_line(
    figure: go.Figure, row: int, label: str, x: Sequence[float | None], y: Sequence[float], look: Mapping[str, Any]
) -> None:
    """Add a line that is no signal to a row, once to the legend; it is broken where x is None."""
    if not x:
        return
    known = any(trace.name == label for trace in figure.data)
    trace = go.Scatter(x=x, y=y, mode="lines", name=label, legendgroup=label, showlegend=not known, line=dict(look))
    figure.add_trace(trace.update(hoverinfo="skip"), row=row, col=1)


def _trace(start_ns: int, curve: Curve, channel: str, factor: float, most: int) -> go.Scatter:
    values = curve.signal[channel] * factor
    t, keep = (curve.signal.stamp_ns - start_ns) / NANOSECONDS, drawn_points(values, most)
    periods = np.diff(t)
    missing = periods > GAP * np.median(periods) if len(periods) and not curve.held else np.zeros(0)
    before = np.flatnonzero(missing)
    broken = np.searchsorted(keep, before, side="right")
    look = {"color": curve.colour, "width": curve.width, "shape": "hv" if curve.held else "linear"}
    return go.Scatter(
        x=np.insert(t[keep], broken, t[before]).astype(np.float32),  # finer than a screen, and half the page of float64
        y=np.insert(values[keep], broken, np.nan).astype(np.float32),
        mode="lines",
        line=look | {"simplify": False},  # simplified lines cut corners of many pixels
    )


def _mark_bands(figure: go.Figure, bands: Sequence[Band], columns: int) -> None:
    for band in bands:
        for axis in ("x", "x2")[:columns]:
            look = {"fillcolor": band.colour, "opacity": SHADE, "line_width": 0, "layer": "below"}
            figure.add_shape(type="rect", xref=axis, yref="paper", x0=band.start, x1=band.stop, y0=0, y1=1, **look)
    if columns > 1:
        return  # too narrow for words
    for band in bands:
        if band.named:
            place = {"x": band.start, "xanchor": "left", "y": 1.0, "yref": "paper", "yanchor": "bottom"}
            figure.add_annotation(text=band.label, **place, showarrow=False, font={"size": 11})
    for label, colour in {band.label: band.colour for band in bands if not band.named}.items():
        mark = {"symbol": "square", "size": 12, "color": colour, "opacity": 2 * SHADE}
        figure.add_trace(go.Scatter(x=[None], y=[None], mode="markers", name=label, marker=mark, showlegend=True), row=1, col=1)
