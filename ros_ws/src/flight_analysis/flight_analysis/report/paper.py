# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw a figure of flights for a paper, as vector graphics in the width of a column."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flight_analysis.metrics.errors import best_error
from flight_analysis.report.display_units import (
    NO_UNIT,
    about_trim,
    channel_label,
    in_order,
)
from flight_analysis.report.figures import REFERENCE, runs_of
from flight_analysis.report.intervals import GUST, flight_end, gust_intervals
from flight_analysis.report.summary import RecordedFlight, common_units
from flight_core.arguments import as_names
from flight_core.files import replacing
from flight_core.parameters import one_of, require
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.units import FOOT, in_si

if TYPE_CHECKING:  # matplotlib takes some tenths of a second to load
    from matplotlib.axes import Axes

FORMATS = ("pdf", "svg", "eps", "png")
WIDTH = "88mm"  # width of a column of IEEE and of many journals
NARROWEST = 0.03  # m
WIDEST = 1.0  # m
ROW_RATIO = 0.42  # height of the row of a channel, as a fraction of the width
INCH = FOOT / 12.0  # m
LEGEND_HEIGHT = 0.35  # inches
FONT_SIZE = 8.0  # points
LINE_WIDTH = 0.8  # points
DPI = 300.0  # resolution of PNG
STYLE: Any = {
    "font.size": FONT_SIZE,
    "axes.linewidth": 0.5,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "pdf.fonttype": 42,  # TrueType, because publishers refuse Type 3
    "ps.fonttype": 42,
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "rise-di",  # makes the same file for the same flight
}


def write_figure(
    path: Path,
    flights: Sequence[RecordedFlight],
    width: str | float = WIDTH,
    channels: str | Sequence[str] = (),
) -> None:
    """Write a figure for a paper in the width of a column.

    Each channel has a row, with y over y_m, the error, or u.

    Args:
        path: Path of the figure. A .pdf, .svg or .eps file has vectors and text, and a .png has
            pixels.
        flights: The flights. Each has a curve in every row.
        width: Width of the figure, with a unit ("88mm", "3.5in") or in m.
        channels: Names of outputs (y over y_m) and inputs (u), and "e.NAME" for the error of an
            output. If empty, the figure has every output.

    Raises ParameterError if the ending or a channel is unknown, or if the width is not 30 mm
    to 1 m.
    """
    import matplotlib as mpl  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    suffix = path.suffix.removeprefix(".").lower()
    require(
        suffix in FORMATS,
        "figure",
        f"{path.name}",
        f"a name that ends in {', '.join(f'.{name}' for name in FORMATS)}",
    )
    metres = in_si(width, "width", "m")
    require(
        NARROWEST <= metres <= WIDEST, "width", f"{width}", "30 mm to 1 m, with a unit as in 88mm"
    )
    outputs, errors, inputs = channels_by_title(flights).values()
    names = [*outputs, *inputs, *errors]
    rows = as_names(channels, "channels", "names of channels: q,V,elevator") or tuple(outputs)
    for name in rows:
        require(name in names, "channels", f"{name!r}", one_of(names, name))
    inches = metres / INCH
    with mpl.rc_context(STYLE):
        figure = Figure(
            figsize=(inches, ROW_RATIO * inches * len(rows) + LEGEND_HEIGHT), layout="constrained"
        )
        grid = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
        for axes, name in zip(grid, rows, strict=True):
            draw_channel(axes, flights, name)
        grid[-1].set_xlabel("t (s)")
        grid[-1].set_xlim(0.0, last_instant(flights))
        handles: dict[str, Any] = {}
        for axes in grid:
            lines, labels = axes.get_legend_handles_labels()
            handles |= dict(zip(labels, lines, strict=True))
        figure.legend(
            handles.values(), handles.keys(), loc="outside upper left", ncols=2, frameon=False
        )
        stamps = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(suffix, {})
        with replacing(path) as stream:
            figure.savefig(stream, format=suffix, dpi=DPI, metadata=stamps or None)


def channels_by_title(flights: Sequence[RecordedFlight]) -> dict[str, list[str]]:
    """Return the names of outputs, errors ("e.NAME") and inputs of all flights, by title.

    Each list is in the order of the controller, so that the n-th output, error and input belong
    together.
    """
    names: dict[str, dict[str, None]] = {"y": {}, "y_m": {}, "u": {}}
    for flight in flights:
        for topic in names.keys() & flight.tape.signals.keys():
            names[topic] |= dict.fromkeys(flight.tape[topic].names)
    units = common_units(flights)
    outputs = in_order(names["y"], units)
    errors = [f"e.{name}" for name in outputs if names["y_m"]]
    return {"y, over y_m": outputs, "e = y - y_m": errors, "u": in_order(names["u"], units)}


def last_instant(flights: Sequence[RecordedFlight]) -> float:
    """Return the end of the longest flight, s, or 1 if there are no samples."""
    return max(flight_end(flight.tape) for flight in flights) or 1.0


def draw_channel(
    axes: "Axes", flights: Sequence[RecordedFlight], name: str, line_width: float = LINE_WIDTH
) -> None:
    """Draw a channel of each flight, over y_m and the gusts of the first flight.

    If the name is "e.NAME", the error of the output NAME is drawn.
    """
    units = common_units(flights)
    channel = name.removeprefix("e.")
    is_error = name != channel
    first = flights[0]
    is_output = any(channel in flight.tape["y"].names for flight in flights if "y" in flight.tape)
    factor = units.get(channel, NO_UNIT).factor

    def plot(tape: Tape, signal: Signal, **style: Any) -> None:
        axes.plot(
            (signal.stamp_ns - tape.start_ns) / NANOSECONDS, signal[channel] * factor, **style
        )

    for gust in gust_intervals(first.tape, first.gusts):
        axes.axvspan(gust.start, gust.stop, color=GUST, alpha=0.2, linewidth=0, label=gust.label)
    if is_output and not is_error and "y_m" in first.tape and channel in first.tape["y_m"].names:
        plot(
            first.tape, first.tape["y_m"], color=REFERENCE, linewidth=3.0 * line_width, label="y_m"
        )
    for label, run in runs_of(flights).items():
        if is_error:
            signal: Signal | None = best_error(run.tape)[1]
        else:
            signal = run.tape.signals.get("y" if is_output else "u")
        if signal is None or channel not in signal.names:
            continue
        style = {} if is_output else {"drawstyle": "steps-post"}
        # A single flight needs no name in the legend, but y must be distinguished from y_m.
        legend = label
        if len(flights) == 1:
            legend = "y" if is_output and not is_error else ""
        plot(run.tape, signal, color=run.colour, linewidth=line_width, label=legend, **style)
    label = channel_label(channel, units)
    if is_error:
        label = f"{best_error(first.tape)[0]} of {label}"
    elif is_output and first.scenario is not None:
        label = about_trim(first.scenario).get(channel, label)
    axes.set_ylabel(label)
    axes.grid(alpha=0.3, linewidth=0.4)
    axes.spines[["top", "right"]].set_visible(False)
