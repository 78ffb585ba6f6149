# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The report: one page that needs no network, the flight's figures first, then its pictures."""

from collections.abc import Iterable, Sequence
from html import escape
from itertools import groupby, product
from pathlib import Path
from typing import Any, NamedTuple

import plotly.graph_objects as go

from flight_analysis import pictures
from flight_analysis.metrics import PARTS, Windows
from flight_analysis.pictures import Limits
from flight_analysis.scenario import Scenario
from flight_analysis.summary import PART_NAMES, Shown, error_rows, shown_units
from flight_core.outcome import COMPLETED
from flight_core.tape import Tape
from rise_di_controller.internals import Limited

# In the dark the pictures are inverted, and their hues turned back.
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
:root {{ color-scheme: light dark; --line: #8884; --quiet: #777 }}
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 1.5rem auto; padding: 0 1rem }}
h1 {{ font-size: 1.6rem; margin: 0 }}
h2 {{ font-size: 1.1rem; margin: 2rem 0 0 }}
p {{ margin: .3rem 0 }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .85rem; margin: 1rem 0 .3rem }}
th, td {{ padding: .15rem .5rem; text-align: right; border-bottom: 1px solid var(--line) }}
th:first-child, td:first-child {{ text-align: left }}
th {{ font-weight: 500; color: var(--quiet) }}
caption {{ text-align: left; font-weight: 600; padding-bottom: .2rem }}
.tables {{ display: flex; flex-wrap: wrap; gap: 0 2.5rem }}
.outcome {{ padding: .1rem .6rem; border-radius: 1rem; color: #fff; background: #a3242b }}
.outcome.good {{ background: #23784f }}
.note {{ color: #b06000 }}
.hint {{ color: var(--quiet); font-size: .85rem }}
section {{ break-inside: avoid }}
@media screen and (prefers-color-scheme: dark) {{ .plotly-graph-div {{ filter: invert(.9) hue-rotate(180deg) }} }}
@media print {{ body {{ margin: 0; font-size: 12px }} .modebar {{ display: none }} }}
</style></head><body>
<h1>{title}</h1>
<p><span class="outcome{good}">{outcome}</span> {lead}</p>
{notes}
<div class="tables"><div>{errors}</div><div>{happened}</div></div>
{pictures}
<script>
const plots = [...document.querySelectorAll(".plotly-graph-div")];
let following = false;
for (const plot of plots) plot.on("plotly_relayout", moved => {{  // a zoom in time is one in all pictures
  if (following || !Object.keys(moved).some(key => /^xaxis\\d*\\.(range|autorange)/.test(key))) return;
  following = true;
  const range = [...plot.layout.xaxis.range];
  Promise.all(plots.filter(other => other !== plot).map(other => Plotly.relayout(other, {{"xaxis.range": range}})))
    .finally(() => following = false);
}});
</script>
</body></html>
"""


class Event(NamedTuple):
    """Something that happened in a flight, from its first to its last instant in s."""

    what: str
    start: float
    stop: float
    how_much: str


def write_report(path: Path, scenario: Scenario, tape: Tape, summary: dict[str, Any]) -> None:
    """Write the page of one flight."""
    units = shown_units(scenario)
    scene = pictures.flight_scene(tape, units, scenario.gust_windows())
    sections = [
        ("Output y over the reference y_m", "", pictures.tracking_picture(scene)),
        ("Tracking error e = y - y_m", "", pictures.error_picture(scene)),
        (
            "Input u and the actuators",
            "Limits are in view where u comes near them. Above each row: when the controller held it back.",
            pictures.input_picture(scene, known_limits(scenario, tape)),
        ),
        ("Wind", "along the body axes of trim", pictures.wind_picture(scene)),
        ("States", "SI where no unit is given", pictures.state_picture(scene)),
        ("Error of the sensors", "y less the true output", pictures.sensor_picture(scene)),
        (
            "Ticks of the controller",
            "late: after its deadline; age: of y at the tick; dt: as integrated",
            pictures.tick_picture(scene),
        ),
    ]
    drawn = [(title, hint, figure) for title, hint, figure in sections if figure is not None]
    law = scenario.controller.sampled_sign()[1]
    page = PAGE.format(
        title=escape(f"Flight {path.parent.name}"),
        good=" good" if summary["outcome"] == COMPLETED else "",
        outcome=escape(summary["outcome"]),
        lead=escape(f"{summary['duration']:.1f} s flown at {scenario.controller.rate:g} Hz with the {law}."),
        notes="".join(f'<p class="note">{escape(note)}</p>' for note in summary["notes"]),
        errors=_error_table(summary, units),
        happened=_event_table(events(tape, scenario.gust_windows())) + _tick_table(summary),
        pictures="\n".join(_section(*one, with_library=index == 0) for index, one in enumerate(drawn)),
    )
    path.write_text(page, encoding="utf-8")


def known_limits(scenario: Scenario, tape: Tape) -> dict[str, Limits]:
    """Limits of u by whose they are and by input: of the actuators where they are simulated, and of the controller."""
    actuators, controller = scenario.aircraft.actuators, scenario.controller
    limits = {"limits of the controller": _pairs(controller.inputs, controller.lower or (), controller.upper or ())}
    if "truth" not in tape or not tape["truth"].group("actuator").names:
        return limits
    return {"end stops": _pairs(tuple(scenario.aircraft.channels().inputs), actuators.lower, actuators.upper)} | limits


def _pairs(names: Sequence[str], lower: Sequence[float], upper: Sequence[float]) -> Limits:
    none = [float("inf")] * len(names)
    return dict(zip(names, zip(lower or [-bound for bound in none], upper or none, strict=True), strict=True))


def events(tape: Tape, gusts: Windows) -> list[Event]:
    """Gusts, modes other than ENGAGED, and limits that the controller reached, one event each, by their first instant."""
    found = []
    marked = pictures.gust_bands(tape, gusts) + pictures.mode_bands(tape)
    for label, group in groupby(marked, key=lambda band: band.label):
        bands = list(group)
        times = f", {len(bands)} times" if len(bands) > 1 else ""
        found.append(Event(label, bands[0].start, bands[-1].stop, f"{sum(b.stop - b.start for b in bands):.2f} s{times}"))
    if "internals" in tape:
        limited, t = tape["internals"].group("limited"), tape.time("internals")
        for name, what in product(limited.names, (Limited.MAGNITUDE, Limited.RATE)):
            hit = limited[name] == what
            if hit.any():
                first, last = t[hit][[0, -1]]
                found.append(Event(f"{name} limited: {what.name.lower()}", first, last, f"{hit.sum()} of {len(hit)} ticks"))
    return sorted(found, key=lambda event: event.start)


def _section(title: str, hint: str, figure: go.Figure, *, with_library: bool) -> str:
    plot = figure.to_html(full_html=False, include_plotlyjs=with_library, config={"displaylogo": False, "responsive": True})
    said = f'<p class="hint">{escape(hint)}</p>' if hint else ""
    return f"<section><h2>{escape(title)}</h2>{said}{plot}</section>"


def _table(caption: str, head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    def row(cells: Iterable[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return f"<table><caption>{escape(caption)}</caption>{row(head, 'th')}{''.join(row(cells, 'td') for cells in rows)}</table>"


def _error_table(summary: dict[str, Any], units: dict[str, Shown]) -> str:
    head = ["channel", *(f"{part} {figure}" for part in PART_NAMES for figure in ("rms", "max"))]
    table = _table(f"Tracking error ({summary['error']})", head, error_rows(summary, units))
    return f'{table}<p class="hint">{escape(PARTS)}</p>'


def _event_table(happened: Sequence[Event]) -> str:
    if not happened:
        return ""
    rows = [(event.what, f"{event.start:.2f}", f"{event.stop:.2f}", event.how_much) for event in happened]
    return _table("What happened", ("", "from (s)", "to (s)", ""), rows)


def _tick_table(summary: dict[str, Any]) -> str:
    ticks = summary["ticks"]
    if ticks is None:
        return ""
    rows = (
        ("ticks", f"{ticks['ticks']}"),
        ("periods without a new y", f"{ticks['without_new_y']}"),
        ("period mean / p99 / max (ms)", " / ".join(f"{ticks[f'period_{k}'] * 1e3:.3f}" for k in ("mean", "p99", "max"))),
        ("after the deadline p99 / max (ms)", " / ".join(f"{ticks[f'late_{k}'] * 1e3:.3f}" for k in ("p99", "max"))),
        ("age of y p99 (ms)", f"{ticks['age_p99'] * 1e3:.3f}"),
    )
    return _table("Ticks of the controller", ("", ""), rows)
