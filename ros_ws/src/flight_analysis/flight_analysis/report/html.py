# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the report as an HTML page that needs no network.

The page has tables and figures of a flight, or compares several flights.
"""

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.linear_loop.certificate import kept_guarantee
from flight_analysis.linear_loop.loop_margins import LinearLoop, loop_margins
from flight_analysis.report import (
    comparison,
    display_units,
    figures,
    guided,
    guided_figures,
    margin_figures,
    plotting,
    tables,
)
from flight_analysis.report.display_units import (
    QUANTITY_UNITS,
    format_seconds,
    format_value,
    state_units,
)
from flight_analysis.report.flown_models import (
    FILE,
    TRUE,
    FlownLoop,
    FlownLoops,
    flown_loops,
    learned_lines,
)
from flight_analysis.report.learned_figure import learned_figure
from flight_analysis.report.parameter_rows import parameter_rows
from flight_analysis.report.plotting import Curve, Figure, SampleStore, pack, time_series_figure
from flight_analysis.report.replay_scene import Replay, replay_of
from flight_analysis.report.summary import (
    RecordedFlight,
    command_results,
    finite_or_null,
    summary_legend,
    time_flown,
)
from flight_analysis.report.summary_rows import INPUT_COLUMNS, Column
from flight_core.files import replacing
from flight_core.outcome import STATUS_HOST
from flight_core.vectors import FloatArray

HERE = Path(__file__).parent
MOST_MESSAGES = 500  # messages of a log on a page


class TitleLine(NamedTuple):
    """A line under the title: colour and label of a flight, its outcome, and text.

    Any of them may be empty. The `details` of the outcome stand below the line.
    """

    text: str
    outcome: str = ""
    details: Sequence[str] = ()
    is_success: bool = False
    is_of_host: bool = False  # amber: nothing is wrong with the aircraft
    label: str = ""
    colour: str = ""


Tables = Sequence[tables.MetricTable] | Sequence[comparison.ComparisonTable]


class TableGroup(NamedTuple):
    """Tables that stand together, and the same in radians.

    Tables of a comparison have the `colours` of the flights.
    """

    tables: Tables
    title: str = ""
    legend: str = ""
    colours: Sequence[str] = ()
    in_radians: Tables = ()


class MessageLine(NamedTuple):
    """A message of the log as text."""

    time: str
    kind: str
    text: str


class Section(NamedTuple):
    """A figure with a heading. If there is no figure, the section is left out."""

    title: str
    hint: str
    figure: Figure | None
    over_time: bool = True  # all figures over time are zoomed together
    opens: bool = False  # whether the section stands before the tables


class Page(NamedTuple):
    """The content of a page."""

    title: str
    lines: Sequence[TitleLine]
    tables: Sequence[TableGroup]
    sections: Sequence[Section]
    samples: SampleStore
    notes: Sequence[str] = ()
    replay: Replay | None = None
    messages: Sequence[MessageLine] = ()
    parameters: tables.MetricTable | None = None

    @property
    def has_angles(self) -> bool:
        """Return whether the page can show its angles both in deg and in rad."""
        return any(group.in_radians for group in self.tables)


def write_page(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write the page of a flight, or of a comparison if there are several."""
    if len(flights) > 1:
        page = _comparison_page(flights)
    elif flights[0].scenario is None:
        page = _imported_page(flights[0])
    else:
        page = _flight_page(flights[0], flights[0].scenario)
    _write(path, page)


def _write(path: Path, page: Page) -> None:
    with replacing(path) as stream:
        stream.writelines(part.encode() for part in _parts(page))


def write_loop_page(path: Path, title: str, loop: LinearLoop) -> None:
    """Write a page of a linear loop that need not have flown: margins, Bode and Nyquist plot."""
    differences = [each.sentence for each in loop.differences]
    table = margin_figures.margin_table(loop_margins(loop), kept_guarantee(loop), differences)
    sections = _loop_sections({"": loop})
    _write(
        path,
        Page(
            title=title,
            lines=[],
            tables=[TableGroup([table])],
            sections=sections,
            samples=SampleStore(),
        ),
    )


def _imported_page(flight: RecordedFlight) -> Page:
    """Return the page of y, u and pose of an aircraft that the log does not describe."""
    tape = flight.tape
    source = flight.summary["source"]
    context = figures.plot_context([flight])
    flight_tables = tables.imported_tables(flight.summary, flight.units)
    colour = figures.PLANT
    pose = None
    if "pose" in tape:
        pose = time_series_figure(
            context._replace(units=QUANTITY_UNITS), {"pose": Curve(tape["pose"], colour)}, columns=2
        )
    by_map = f", by the map {source['map']}" if "map" in source else ""
    length = format_seconds(flight.summary["duration"])
    text = f"{length} of {source['log']}, {source['kind']}{by_map}."
    outputs = {"y": Curve(tape["y"], colour)}
    if "y_m" in tape:
        outputs["y_m"] = Curve(tape["y_m"], figures.REFERENCE)
    return Page(
        title=f"Flight {flight.name}",
        lines=[TitleLine(text)],
        tables=[TableGroup(flight_tables)],
        sections=[
            Section(
                "Output y",
                "about trim",
                time_series_figure(context, outputs),
            ),
            Section("Input u", "about trim", figures.input_figure(context)),
            Section("Pose", "", pose),
            Section(
                "Spectrum of u",
                "amplitude spectral density",
                figures.spectrum_figure(context),
                over_time=False,
            ),
        ],
        samples=context.samples,
        notes=flight.summary["notes"],
        replay=replay_of(flight, context),
    )


def _flight_page(flight: RecordedFlight, scenario: Scenario) -> Page:
    units = flight.units
    gusts = flight.gusts
    context = figures.plot_context([flight])
    flown = flown_loops(flight.tape, scenario, flight.controllers, flight.later_aircraft)
    events = tables.events(flight.tape, gusts, scenario)
    margins = _margin_tables(flown)
    shown, in_radians = (
        [*tables.flight_tables(flight.summary, each, events), *margins]
        for each in (units, display_units.in_radians({**QUANTITY_UNITS, **units}))
    )
    description = filter(None, [_description(flight, scenario), command_results(flight.summary)])
    return Page(
        title=f"Flight {flight.name}",
        lines=[_outcome_line(f"{'; '.join(description)}.", flight)],
        tables=[
            TableGroup(shown, in_radians=in_radians),
        ],
        sections=[
            *_sections(flight, scenario, context),
            *_loop_sections(_drawn_loops(flown.loops)),
        ],
        samples=context.samples,
        notes=[*flight.summary["notes"], *([] if flown.loops else flown.sentences)],
        replay=replay_of(flight, context),
        messages=_message_lines(flight),
        parameters=_parameter_table(scenario),
    )


def _message_lines(flight: RecordedFlight) -> list[MessageLine]:
    """Return the messages of the log, at most MOST_MESSAGES."""
    lines = [
        MessageLine(f"{time:.2f} s", message.kind, message.text)
        for time, message in zip(flight.message_times, flight.messages, strict=True)
    ]
    more = len(lines) - MOST_MESSAGES
    return lines if more <= 0 else [*lines[:MOST_MESSAGES], MessageLine("", "", f"and {more} more")]


def _parameter_table(scenario: Scenario) -> tables.MetricTable:
    columns = [Column("", head) for head in ("flown", "default")]
    return tables.MetricTable("", columns, parameter_rows(scenario))


def _outcome_line(text: str, flight: RecordedFlight) -> TitleLine:
    """Return a line with the outcome of a flight."""
    outcome = flight.summary["outcome"]
    return TitleLine(
        text,
        outcome["sentence"],
        outcome["details"],
        is_success=outcome["status"] == 0,
        is_of_host=outcome["status"] == STATUS_HOST,
    )


def _comparison_page(flights: Sequence[RecordedFlight]) -> Page:
    context = figures.plot_context(flights)
    colours = {label: run.colour for label, run in context.runs.items()}
    scenarios = [flight.scenario for flight in flights if flight.scenario is not None]
    # Each flight has a line in its colour.
    lines = []
    for (label, colour), flight, scenario in zip(colours.items(), flights, scenarios, strict=True):
        text = f"{scenario.name}: {_description(flight, scenario)} ({flight.summary['error']})"
        line = _outcome_line(text, flight)
        lines.append(line._replace(label=label, colour=colour))
    trims = [_about_trim(scenario) for scenario in scenarios]
    trim = trims[0] if all(each == trims[0] for each in trims) else {"V": "V about trim (m/s)"}
    sections = [
        Section("Output y over the reference y_m", "", figures.tracking_figure(context, trim)),
        Section("Tracking error e = y - y_m", "", figures.error_figure(context)),
        Section("Input u", "", figures.input_figure(context)),
        Section("Spectrum of u", "", figures.spectrum_figure(context), over_time=False),
        Section("Timing of the ticks", "", figures.timing_figure(context), over_time=False),
    ]
    # The ground tracks of guided flights come first.
    guided = {
        label: flight
        for label, flight in zip(colours, flights, strict=True)
        if flight.summary["guidance"] is not None
    }
    if guided:
        first = next(iter(guided.values()))
        routes = guided_figures.flown_routes(first.scenario, first.tape)
        tracks = {label: (flight.tape, colours[label]) for label, flight in guided.items()}
        sections.insert(
            0,
            Section(
                "Ground track", "", guided_figures.tracks_figure(tracks, routes), over_time=False
            ),
        )
    return Page(
        title=f"{len(flights)} flights compared",
        lines=lines,
        tables=_comparison_groups(flights, context, colours),
        sections=sections,
        samples=context.samples,
    )


def _comparison_groups(
    flights: Sequence[RecordedFlight], context: plotting.PlotContext, colours: Mapping[str, str]
) -> list[TableGroup]:
    """Return the tables of a comparison; `colours` are those of the flights by label."""
    palette = list(colours.values())
    legend = ". ".join(
        dict.fromkeys(
            [*(summary_legend(flight.summary) for flight in flights), tables.ERROR_LEGEND]
        )
    )
    units = (context.units, display_units.in_radians(context.units))
    errors, errors_in_radians = (comparison.error_tables(flights, each) for each in units)
    inputs, inputs_in_radians = (
        comparison.comparison_tables(
            flights, "inputs", INPUT_COLUMNS, lower_is_better=False, units=each
        )
        for each in units
    )
    return [
        *_condition_group(flights, list(colours)),
        TableGroup(errors, "Tracking error", legend, palette, errors_in_radians),
        TableGroup(inputs, "Inputs", tables.INPUT_LEGEND, palette, inputs_in_radians),
        TableGroup(comparison.tick_tables(flights), "Time", "", palette),
    ]


def _condition_group(flights: Sequence[RecordedFlight], labels: Sequence[str]) -> list[TableGroup]:
    """Return a table of the parameters that differ, if any do."""
    rows = comparison.conditions(flights)
    if not rows:
        return []
    columns = [Column("", label) for label in labels]
    table = tables.MetricTable("", columns, [(row.key, *row.texts) for row in rows])
    legend = "" if all(comparison.has_same_conditions(flights)) else comparison.UNLIKE
    return [TableGroup([table], "What differs", legend)]


def _description(flight: RecordedFlight, scenario: Scenario) -> str:
    """Describe a flight by its airframe, duration, distance and top speed."""
    parts = [scenario.aircraft.airframe, time_flown(flight.summary)]
    distance = guided.distance(flight.tape)
    if distance is not None:
        parts.append(f"{distance / 1e3:.2f} km over ground")
    speed = guided.top_speed(flight.tape, scenario.aircraft.channels().speed)
    if speed is not None:
        parts.append(f"at most {speed:.1f} m/s")
    return ", ".join(parts)


def _law(scenario: Scenario) -> str:
    """Return the rate of the law, and how the law flies."""
    controller = scenario.controller
    return f"At {controller.rate:g} Hz with the {controller.summary()}"


def _about_trim(scenario: Scenario) -> dict[str, str]:
    """Return what stands in place of V in a figure of y: the airspeed less that of trim."""
    channels = scenario.aircraft.channels()
    return {"V": f"V - {channels.speed:g} (m/s)"} if "V" in channels.outputs else {}


def _sections(
    flight: RecordedFlight, scenario: Scenario, context: plotting.PlotContext
) -> list[Section]:
    floors = {name: metrics["floor"] or 0.0 for name, metrics in flight.summary["errors"].items()}
    limits = figures.input_limits(scenario, flight.tape)
    spectrum = figures.spectrum_figure(context)
    trim = _about_trim(scenario)
    about = "V is the airspeed; its value at trim is subtracted." if trim else ""
    return [
        *_guidance_sections(flight, scenario, context),
        Section("Output y over the reference y_m", about, figures.tracking_figure(context, trim)),
        Section(
            "Tracking error e = y - y_m",
            "The noise floor is drawn where it is wide enough to see.",
            figures.error_figure(context, floors),
        ),
        Section(
            "Input u and the actuators",
            "Limits are in view where u comes near them. Marks above each row: the controller "
            "saturated the input.",
            figures.input_figure(context, limits),
        ),
        Section(
            "What was learned",
            "A and B as identified, SI, with bars of two standard deviations; open marks: no "
            "model was proposed. Lines: the true value before a drift, and the value of the file",
            learned_figure(context, learned_lines(flight.tape, scenario)),
        ),
        Section("Wind", "along the body axes of trim", figures.wind_figure(context)),
        Section("States", about, figures.state_figure(context, state_units(scenario), trim)),
        Section(
            "Integrals of the law",
            f"{_law(scenario)}. Pi, the integral of the sign term, is in scaled inputs.",
            figures.integral_figure(context),
        ),
        Section("Error of the sensors", "y less the true output", figures.sensor_figure(context)),
        Section("Spectrum of u", "amplitude spectral density", spectrum, over_time=False),
        Section(
            "Ticks of the controller",
            "late: after its deadline; age: of y at the tick; dt: as integrated",
            figures.tick_figure(context),
        ),
        Section("Timing of the ticks", "", figures.timing_figure(context), over_time=False),
    ]


def _margin_tables(flown: FlownLoops) -> list[tables.MetricTable]:
    """Return the margins of a single loop by input, or the least margins of several loops."""
    if not flown.loops:
        return []
    if len(flown.loops) > 1:
        return [margin_figures.flown_margin_table(flown)]
    loop = flown.loops[0].loop
    margins = loop_margins(loop)
    return [margin_figures.margin_table(margins, kept_guarantee(loop), flown.sentences)]


def _drawn_loops(loops: Sequence[FlownLoop]) -> dict[str, LinearLoop]:
    """Return the loops of a flight by name, around the true aircraft if it is known."""
    aircraft = TRUE if any(each.aircraft == TRUE for each in loops) else FILE
    return {each.name: each.loop for each in loops if each.aircraft == aircraft}


def _loop_sections(loops: Mapping[str, LinearLoop]) -> list[Section]:
    if not loops:
        return []
    hint = (
        "L at each input, the other inputs closed: the sampled loop with actuators, delay "
        f"and hold; {next(iter(loops.values())).model}"
    )
    return [
        Section("Bode plot of the loop", hint, margin_figures.bode_figure(loops), over_time=False),
        Section(
            "Nyquist plot of the loop",
            "Inside the circle around -1 the sensitivity is above 2.",
            margin_figures.nyquist_figure(loops),
            over_time=False,
        ),
    ]


def _guidance_sections(
    flight: RecordedFlight, scenario: Scenario, context: plotting.PlotContext
) -> list[Section]:
    if flight.summary["guidance"] is None:
        return []
    speed = scenario.aircraft.channels().speed
    bounds = guided_figures.bounds_of(scenario)
    guidance = scenario.guidance
    routes = guided_figures.flown_routes(scenario, flight.tape)
    context = guided_figures.guided_context(context)
    return [
        Section(
            "Ground track",
            "North is up. Numbers: legs of the route. Arrows: mean wind over a part of the "
            "flight, from the velocities over ground and through the air.",
            guided_figures.track_figure(
                flight.tape, routes, speed, None if guidance is None else guidance.fence_zones()
            ),
            over_time=False,
            opens=True,
        ),
        Section(
            "Altitude and airspeed over their commands",
            "Shaded: beyond the limits of the commands.",
            guided_figures.vertical_figure(context, speed, bounds),
        ),
        Section("Attitude over its commands", "", guided_figures.attitude_figure(context, bounds)),
        Section(
            "Cross-track error",
            "Positive to the right. Numbers: legs of the route.",
            guided_figures.cross_track_figure(context),
        ),
    ]


def page_html(page: Page) -> str:
    """Return the page as HTML, with plotly, the script and the samples inside."""
    return "".join(_parts(page))


def _parts(page: Page) -> Iterator[str]:
    """Return the text of a page in parts: the page of a long flight has some 100 MB."""
    environment = Environment(
        loader=FileSystemLoader(HERE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"script_json": script_json, "ratio": format_ratio, "css": Markup}
    return environment.get_template("page.html.jinja").generate(
        page=page,
        dark=plotting.DARK | figures.DARK,
        library=pack((HERE / "vendor" / "plotly-basic.min.js").read_bytes()),
        script=Markup((HERE / "page.js").read_text(encoding="utf-8")),  # noqa: S704 - our own file
    )


def script_json(value: Any) -> Markup:
    """Write JSON for a script element: "<" occurs only in strings, as an escape."""
    content = finite_or_null(
        {"data": value.data, "layout": value.layout} if isinstance(value, Figure) else value
    )
    text = json.dumps(content, default=_typed_array, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c"))  # noqa: S704


def _typed_array(array: FloatArray | NDArray[np.float32]) -> dict[str, str]:
    """Return an array for plotly.js: type "f8" or "f4", and bytes, little endian."""
    return {"dtype": array.dtype.str[1:], "bdata": base64.b64encode(array.tobytes()).decode()}


def format_ratio(ratio: float | None) -> Markup:
    """Write a ratio with three digits, or as a whole number from 100 on."""
    if ratio is None:
        return Markup()
    return Markup("&times;{}").format(format_value(ratio) if ratio < 100.0 else f"{ratio:.0f}")
