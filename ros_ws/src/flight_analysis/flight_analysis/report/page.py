# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The report: one page that needs no network, the figures of a flight first, then its pictures; or of several, compared."""

import json
import re
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from flight_analysis.report import comparison, figures, plotting, tables
from flight_analysis.report.plotting import Samples, Scene, pack
from flight_analysis.report.recorded_flight import RecordedFlight
from flight_analysis.report.summary import display_units
from flight_core.outcome import COMPLETED

HERE = Path(__file__).parent


class Section(NamedTuple):
    """A picture with what stands over it."""

    title: str
    hint: str
    figure: go.Figure | None
    over_time: bool = True  # of the flight, in which all such pictures are zoomed together


class Page(NamedTuple):
    """What a page shows, as HTML but for its title."""

    title: str
    head: str
    tables: str
    sections: Sequence[Section]
    samples: Samples


def write_page(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write the page of a flight, or of several, compared."""
    page = _flight_page(flights[0]) if len(flights) == 1 else _comparison_page(flights)
    path.write_text(page_html(page), encoding="utf-8")


def _flight_page(flight: RecordedFlight) -> Page:
    summary, units, gusts = flight.summary, display_units(flight.scenario), flight.scenario.gust_windows()
    scene = figures.flight_scene(flight.tape, units, gusts)
    title = f"Flight {flight.name}"
    notes = "".join(f'<p class="note">{escape(note)}</p>' for note in summary["notes"])
    shown = [
        tables.error_table(summary, units),
        tables.input_table(summary, units),
        tables.event_table(tables.events(flight.tape, gusts)),
        tables.tick_table(summary),
    ]
    head = f"<h1>{escape(title)}</h1><p>{_outcome(flight)} {escape(_flown(flight))}.</p>{notes}"
    return Page(title, head, f'<div class="tables">{"".join(shown)}</div>', _sections(flight, scene), scene.samples)


def _comparison_page(flights: Sequence[RecordedFlight]) -> Page:
    scene, colours = comparison.scene(flights), comparison.colours(flights)
    dots = [tables.dot(colour, comparison.DARK[colour]) for colour in colours.values()]
    title = f"{len(flights)} flights compared"
    rows = "".join(
        f"<p>{dot}<b>{escape(label)}</b> {_outcome(flight)} {escape(flight.scenario.name)}: {escape(_flown(flight))}"
        f" ({flight.summary['error']})</p>"
        for label, dot, flight in zip(colours, dots, flights, strict=True)
    )
    figures = {
        "Tracking error": (comparison.error_blocks(flights), tables.READING),
        "Inputs": (comparison.input_blocks(flights), tables.INPUT_READING),
        "Time": (comparison.tick_blocks(flights), ""),
    }
    shown = "".join(
        f'<h2>{what}</h2><div class="tables">{tables.compared_tables(blocks, dots)}</div><p class="hint">{escape(said)}</p>'
        for what, (blocks, said) in figures.items()
        if blocks
    )
    sections = [
        Section("Output y over the reference y_m", "", comparison.tracking_figure(scene, flights)),
        Section("Tracking error e = y - y_m", "", comparison.error_figure(scene, flights)),
        Section("Input u", "", comparison.input_figure(scene, flights)),
        Section("Spectrum of u", "", comparison.spectrum_figure(scene, flights), over_time=False),
        Section("How the ticks were spread", "", comparison.timing_figure(flights), over_time=False),
    ]
    return Page(title, f"<h1>{title}</h1>{rows}", shown, sections, scene.samples)


def _flown(flight: RecordedFlight) -> str:
    controller = flight.scenario.controller
    return f"{flight.summary['duration']:.1f} s flown at {controller.rate:g} Hz with the {controller.sampled_sign()[1]}"


def _outcome(flight: RecordedFlight) -> str:
    outcome = flight.summary["outcome"]
    return f'<span class="outcome{" good" if outcome == COMPLETED else ""}">{escape(outcome)}</span>'


def _sections(flight: RecordedFlight, scene: Scene) -> list[Section]:
    floors = {name: of["floor"] for name, of in flight.summary["errors"].items()}
    limits = figures.known_limits(flight.scenario, flight.tape)
    return [
        Section("Output y over the reference y_m", "", figures.tracking_figure(scene)),
        Section(
            "Tracking error e = y - y_m",
            "The floor is drawn where it is wide enough to see.",
            figures.error_figure(scene, floors),
        ),
        Section(
            "Input u and the actuators",
            "Limits are in view where u comes near them. Above each row: when the controller held it back.",
            figures.input_figure(scene, limits),
        ),
        Section("Wind", "along the body axes of trim", figures.wind_figure(scene)),
        Section("States", "SI where no unit is given", figures.state_figure(scene)),
        Section(
            "Integrals of the law",
            "of e, in SI times s; and Pi, that of the sign term, in scaled inputs",
            figures.integral_figure(scene),
        ),
        Section("Error of the sensors", "y less the true output", figures.sensor_figure(scene)),
        Section(
            "Spectrum of u", "amplitude spectral density", figures.spectrum_figure(scene, flight.period_ns), over_time=False
        ),
        Section(
            "Ticks of the controller",
            "late: after its deadline; age: of y at the tick; dt: as integrated",
            figures.tick_figure(scene),
        ),
        Section("How the ticks were spread", "", figures.timing_figure(scene, flight.period_ns), over_time=False),
    ]


def page_html(page: Page) -> str:
    """The page as HTML that needs nothing else."""
    parts = {
        "title": escape(page.title),
        "head": page.head,
        "tables": page.tables,
        "pictures": "\n".join(_sections_shown(page.sections)),
        "dark": _json(plotting.DARK | figures.DARK | comparison.DARK),
        "library": pack(get_plotlyjs().encode()),
        "script": (HERE / "page.js").read_text(encoding="utf-8"),
        "samples": "\n".join(
            f'<script type="text/plain" id="{key}">{text}</script>' for key, text in page.samples.packed.items()
        ),
    }
    template = (HERE / "page.html").read_text(encoding="utf-8")
    return re.sub(r"{{(\w+)}}", lambda place: parts[place[1]], template)


def _sections_shown(sections: Sequence[Section]) -> Iterable[str]:
    for title, hint, figure, over_time in sections:
        if figure is not None:
            said, time = f'<p class="hint">{escape(hint)}</p>' if hint else "", " data-time" if over_time else ""
            room, specification = f'<div style="height: {figure.layout.height}px"></div>', _json(figure)
            drawn = f'<figure{time}>{room}<script type="application/json">{specification}</script></figure>'
            yield f"<section><h2>{escape(title)}</h2>{said}{drawn}</section>"


def _json(value: Any) -> str:
    """JSON that cannot end the script it stands in."""
    text = value.to_json() if isinstance(value, go.Figure) else json.dumps(value)
    return str(text).replace("<", "\\u003c")  # stands in texts alone; "<!--" would hide the end too
