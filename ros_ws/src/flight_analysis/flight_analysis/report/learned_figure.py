# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw the entries of A and B that a learner identified in a flight."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from flight_analysis.metrics.controller_log import known_entries
from flight_analysis.report.figures import PLANT, REFERENCE
from flight_analysis.report.plotting import Figure, PlotContext, add_line, set_layout

BEYOND_END = 1.02  # end of the time axis as a multiple of the flight, to show the last bar
LEARNED_LINES: tuple[dict[str, Any], ...] = (
    {"color": REFERENCE, "width": 1.6},
    {"color": PLANT, "width": 1.2, "dash": "dot"},
)


def learned_figure(context: PlotContext, lines: Mapping[str, Mapping[str, float]]) -> Figure | None:
    """Draw the identified entries of A and B over time, with bars of two standard deviations.

    A mark is open if no parameters were proposed after the identification. `lines` has known values
    of the entries, by label and entry. Only the entries of `known_entries` are drawn. Returns None
    if nothing was learned.
    """
    if "learned" not in context.tape:
        return None
    t = context.tape.time("learned")
    identification = context.tape["learned"]
    entries = known_entries(identification)
    values = identification.group("value")
    deviations = identification.group("deviation")
    if not entries:
        return None
    columns = min(len(entries), 3)
    symbols = np.where(identification["proposed"] > 0.0, "circle", "circle-open").tolist()
    figure = Figure(len(entries), columns, 110, spacing=0.06)
    for index, name in enumerate(entries):
        bars = {"type": "data", "array": 2.0 * deviations[name], "thickness": 1.2, "width": 3}
        style: dict[str, Any] = {
            "error_y": bars,
            "marker": {"color": PLANT, "size": 7, "symbol": symbols},
            "showlegend": False,
            "cliponaxis": False,
            "hovertemplate": "%{y:.4g} at %{x:.1f} s",
        }
        for (label, known_values), line in zip(lines.items(), LEARNED_LINES, strict=False):
            if name in known_values:
                level = known_values[name]
                add_line(figure, index, label, [0.0, context.end], [level, level], line)
        figure.add_scatter(name, t, values[name], index, "markers", **style)
        figure.x[index] |= {
            "range": [0.0, BEYOND_END * context.end],
            "showticklabels": index + columns >= len(entries),
        }
        figure.x[index] |= {"title": {"text": "t (s)"}} if index + columns >= len(entries) else {}
        figure.y[index]["title"] = {"text": name}
    return set_layout(figure)
