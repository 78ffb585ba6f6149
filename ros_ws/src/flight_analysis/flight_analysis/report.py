# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The report: one page that needs no network, the flight's figures first, then its pictures."""

import itertools
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from flight_analysis.metrics import PARTS, tracking_error
from flight_analysis.scenario import Scenario
from flight_analysis.summary import PART_NAMES, Shown, error_rows, shown_units
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray

PLANT, REFERENCE, ERROR = "#123c52", "#f6a85f", "#8b1f4f"
GUST = "#7f7f7f"
MOST_POINTS = 6000  # of a trace; 100 Hz over a minute

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2rem auto; padding: 0 1rem }}
table {{ border-collapse: collapse; margin: 1rem 0 }}
th, td {{ padding: .25rem .9rem; text-align: right; border-bottom: 1px solid #ddd }}
th:first-child, td:first-child {{ text-align: left }}
caption {{ text-align: left; font-weight: 600; padding-bottom: .4rem }}
.note {{ color: #8a4b00 }}
</style></head><body>
<h1>{title}</h1>
<p>{lead}</p>
{tables}
{pictures}
</body></html>
"""


def write_report(path: Path, scenario: Scenario, tape: Tape, summary: dict[str, Any]) -> None:
    """Write the page of one flight."""
    units = shown_units(scenario)
    gusts = scenario.gust_windows()
    pictures = [
        tracking_picture(tape, units, gusts),
        _stack(tape, "Tracking error e = y - y_m", {"e": (tracking_error(tape), ERROR)}, units, gusts),
        _stack(tape, "Input u", {"u": (tape["u"], PLANT)}, units, gusts) if "u" in tape else None,
        _ticks_picture(tape),
    ]
    drawn = [figure for figure in pictures if figure is not None]
    html = [
        figure.to_html(full_html=False, include_plotlyjs=index == 0, config={"displaylogo": False})
        for index, figure in enumerate(drawn)
    ]
    lead = f"{summary['duration']:.1f} s flown, {summary['outcome']}."
    notes = "".join(f'<p class="note">{escape(note)}</p>' for note in summary["notes"])
    page = PAGE.format(
        title=escape(f"Flight {path.parent.name}"),
        lead=escape(lead),
        tables=notes + _error_table(summary, units) + _tick_table(summary),
        pictures="\n".join(html),
    )
    path.write_text(page, encoding="utf-8")


def tracking_picture(tape: Tape, units: dict[str, Shown], gusts: dict[str, tuple[float, float]]) -> go.Figure:
    """Picture of y over y_m for every channel, the gusts marked."""
    signals = {"y_m": (tape["y_m"], REFERENCE), "y": (tape["y"], PLANT)}
    return _stack(tape, "Output y over the reference y_m", signals, units, gusts)


def drawn_points(values: FloatArray, most: int = MOST_POINTS) -> NDArray[np.int64]:
    """Places of at most `most` >= 2 samples to draw of values of shape (N,): all, else the smallest and largest of each bin."""
    if len(values) <= most:
        return np.arange(len(values))
    edges = np.linspace(0, len(values), most // 2 + 1).astype(np.int64)
    bins = itertools.pairwise(edges)
    extremes = [start + extreme(values[start:stop]) for start, stop in bins for extreme in (np.argmin, np.argmax)]
    return np.unique(np.array(extremes, dtype=np.int64))


def _stack(
    tape: Tape,
    title: str,
    signals: dict[str, tuple[Signal, str]],
    units: dict[str, Shown],
    gusts: dict[str, tuple[float, float]],
) -> go.Figure:
    """One row a channel, all signals that have it over each other."""
    channels = next(reversed(signals.values()))[0].names
    figure = make_subplots(rows=len(channels), cols=1, shared_xaxes=True, vertical_spacing=0.03)
    for row, channel in enumerate(channels, start=1):
        unit, factor = units[channel]
        for label, (signal, colour) in signals.items():
            keep = drawn_points(signal[channel])
            figure.add_trace(
                go.Scattergl(
                    x=((signal.stamp_ns - tape.start_ns) / 1e9)[keep],
                    y=(signal[channel] * factor)[keep],
                    name=label,
                    legendgroup=label,
                    showlegend=row == 1,
                    line={"color": colour, "width": 6 if label == "y_m" else 1.4},
                ),
                row=row,
                col=1,
            )
        figure.update_yaxes(title_text=f"{channel} ({unit})", row=row, col=1)
        for name, (start, stop) in gusts.items():
            mark = {"annotation_text": f"{name} gust", "annotation_position": "top left"} if row == 1 else {}
            figure.add_vrect(x0=start, x1=stop, fillcolor=GUST, opacity=0.25, line_width=0, row=row, col=1, **mark)
    figure.update_xaxes(title_text="t (s)", row=len(channels), col=1)
    figure.update_layout(
        title=title,
        height=150 + 150 * len(channels),
        template="plotly_white",
        margin={"l": 80, "r": 20, "t": 60, "b": 40},
        legend={"orientation": "h", "y": 1.02, "x": 1, "xanchor": "right", "yanchor": "bottom"},
        hovermode="x unified",
    )
    return figure


def _ticks_picture(tape: Tape) -> go.Figure | None:
    if "internals" not in tape or not tape["internals"]["late"].any():
        return None
    figure = go.Figure()
    for name, meaning in (("late", "tick after its deadline"), ("age", "y at the tick")):
        figure.add_trace(go.Scattergl(x=tape.time("internals"), y=tape["internals"][name] * 1e3, name=f"{name}: {meaning}"))
    figure.update_layout(
        title="Ticks of the controller", height=320, template="plotly_white", xaxis_title="t (s)", yaxis_title="ms"
    )
    return figure


def _error_table(summary: dict[str, Any], units: dict[str, Shown]) -> str:
    head = "".join(f"<th>{part} rms</th><th>{part} max</th>" for part in PART_NAMES)
    rows = ["<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in error_rows(summary, units)]
    caption = f"Tracking error ({escape(summary['error'])}; {PARTS})"
    return f"<table><caption>{caption}</caption><tr><th>channel</th>{head}</tr>{''.join(rows)}</table>"


def _tick_table(summary: dict[str, Any]) -> str:
    ticks = summary["ticks"]
    if ticks is None:
        return ""
    rows = "".join(
        f"<tr><td>{name}</td><td>{value}</td></tr>"
        for name, value in (
            ("ticks", ticks["ticks"]),
            ("periods without a new y", ticks["without_new_y"]),
            ("period mean / p99 / max (ms)", " / ".join(f"{ticks[f'period_{k}'] * 1e3:.3f}" for k in ("mean", "p99", "max"))),
            ("after the deadline p99 / max (ms)", " / ".join(f"{ticks[f'late_{k}'] * 1e3:.3f}" for k in ("p99", "max"))),
            ("age of y p99 (ms)", f"{ticks['age_p99'] * 1e3:.3f}"),
        )
    )
    return f"<table><caption>Ticks of the controller</caption>{rows}</table>"
