# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Build and write the page of a flight, of an imported log, or of a linear loop.

The module `comparison_page` builds the page of several flights. The module `page` turns any of
these pages into HTML.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.linear_loop.certificate import kept_guarantee
from flight_analysis.linear_loop.loop_margins import LinearLoop, loop_margins
from flight_analysis.report import (
    display_units,
    figures,
    guided_figures,
    margin_figures,
    plotting,
    tables,
)
from flight_analysis.report.cards import claims
from flight_analysis.report.comparison_page import comparison_page
from flight_analysis.report.display_units import (
    POSE_UNITS,
    QUANTITY_UNITS,
    about_trim,
    format_seconds,
    state_units,
)
from flight_analysis.report.flight_head import (
    meta_lines,
    run_argument,
    tiles_of,
    title_of,
    verdict_of,
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
from flight_analysis.report.page import (
    Block,
    Cards,
    Colour,
    Figures,
    MessageLine,
    Messages,
    Page,
    ReplayBlock,
    Section,
    Step,
    TableGroup,
    Verdict,
    page_parts,
)
from flight_analysis.report.parameter_rows import parameter_rows
from flight_analysis.report.plotting import Curve, PlotContext, time_series_figure
from flight_analysis.report.replay_scene import replay_of
from flight_analysis.report.summary import RecordedFlight
from flight_analysis.report.summary_rows import Column
from flight_core.files import replacing

ABOUT_V = "V is the airspeed; its value at trim is subtracted."
ABOUT_Y_M = "y_m is what the aircraft was asked to follow, and y what it did."
MOST_MESSAGES = 500  # largest number of messages of a log on a page


def write_page(
    path: Path,
    flights: Sequence[RecordedFlight],
    tolerances: Mapping[str, float] = MappingProxyType({}),
) -> None:
    """Write the page of a flight, or the page that compares several flights.

    `tolerances` has the allowed difference between the flights by channel, SI.
    """
    if len(flights) > 1:
        page = comparison_page(flights, tolerances)
    elif flights[0].scenario is None:
        page = _imported_page(flights[0])
    else:
        page = _flight_page(flights[0], flights[0].scenario)
    _write(path, page)


def _write(path: Path, page: Page) -> None:
    with replacing(path) as stream:
        stream.writelines(part.encode() for part in page_parts(page))


def write_loop_page(path: Path, title: str, loop: LinearLoop) -> None:
    """Write the page of a linear loop, with its margins, Bode and Nyquist plots.

    No flight with this loop is needed.
    """
    differences = [each.sentence for each in loop.differences]
    table = margin_figures.margin_table(loop_margins(loop), kept_guarantee(loop), differences)
    figures_of_loop = Figures(groups=[TableGroup([table])])
    _write(path, Page(title=title, blocks=[figures_of_loop, *_loop_sections({"": loop})]))


# ---- An imported log


def _imported_page(flight: RecordedFlight) -> Page:
    """Return the page of an imported log, which has y, u and pose but no aircraft."""
    tape = flight.tape
    source = flight.summary["source"]
    context = figures.plot_context([flight])
    pose = None
    if "pose" in tape:
        of_pose = {"pose": Curve(tape["pose"], figures.PLANT)}
        in_units = context._replace(units=POSE_UNITS)
        pose = time_series_figure(in_units, of_pose, columns=2)
    outputs = {"y": Curve(tape["y"], figures.PLANT)}
    if "y_m" in tape:
        outputs = {"y_m": Curve(tape["y_m"], figures.REFERENCE, width=6.0)} | outputs
    by_map = f", by the map {source['map']}" if "map" in source else ""
    length = format_seconds(flight.summary["duration"])
    flight_tables = tables.imported_tables(flight.summary, flight.units)
    replay = replay_of(flight, context)
    spectrum = figures.spectrum_figure(context)
    return Page(
        title=title_of(flight),
        lines=[f"{length}, {source['kind']}{by_map} · run {flight.name}"],
        verdicts=[_not_judged(flight)],
        tiles=tiles_of(flight),
        notes=flight.summary["notes"],
        blocks=[
            Section(
                "Output y over the reference y_m" if "y_m" in tape else "Output y",
                "about trim",
                time_series_figure(context, outputs, labels={"V": "V about trim (m/s)"}),
                contents="Outputs",
            ),
            *([] if replay is None else [ReplayBlock(replay=replay)]),
            Section("Input u", "about trim", figures.input_figure(context), contents="Inputs"),
            Section("Pose", "", pose, contents="Pose"),
            Section("Spectrum of u", "amplitude spectral density", spectrum, is_over_time=False),
            Figures(groups=[TableGroup(flight_tables)], is_folded=True),
        ],
        samples=context.samples,
    )


def _not_judged(flight: RecordedFlight) -> Verdict:
    """Return the verdict that says why an imported flight is not judged."""
    lack = "no reference" if "y_m" not in flight.tape else "no model of its aircraft"
    return Verdict(
        headline="Not judged.",
        colour=Colour.PLAIN,
        text=f"The log has {lack}, so its errors cannot be judged.",
        step=Step(
            sentence="Lay it over another log:",
            command=f"rise-di report {run_argument(flight)} OTHER",
        ),
    )


# ---- A flight


def _flight_page(flight: RecordedFlight, scenario: Scenario) -> Page:
    context = figures.plot_context([flight])
    flown = flown_loops(flight.tape, scenario, flight.controllers, flight.later_aircraft)
    return Page(
        title=title_of(flight),
        lines=meta_lines(flight, scenario),
        verdicts=[verdict_of(flight, scenario)],
        tiles=tiles_of(flight),
        notes=[*flight.summary["notes"], *([] if flown.loops else flown.sentences)],
        blocks=_blocks(flight, scenario, context, flown),
        samples=context.samples,
    )


def _blocks(
    flight: RecordedFlight, scenario: Scenario, context: PlotContext, flown: FlownLoops
) -> list[Block]:
    """Return the blocks below the head: what the aircraft did, why it did so, and the tables."""
    return [
        *_motion(flight, scenario, context),
        Cards(
            title="What holds for this flight",
            cards=claims(flight, scenario, flown),
            contents="Claims",
        ),
        *_causes(flight, scenario, context, flown),
        Messages(lines=_message_lines(flight)),
        _flight_figures(flight, scenario, flown),
        Figures(
            groups=[TableGroup([_parameter_table(scenario)])],
            is_folded=True,
            title="Parameters other than the default, and those without one",
            contents="Parameters",
        ),
    ]


def _motion(flight: RecordedFlight, scenario: Scenario, context: PlotContext) -> list[Block]:
    """Return the figures of what the aircraft did: outputs, track, replay, inputs and errors."""
    trim = about_trim(scenario)
    about = ABOUT_V if trim else ""
    floors = {name: metrics["floor"] or 0.0 for name, metrics in flight.summary["errors"].items()}
    replay = replay_of(flight, context)
    return [
        Section(
            "Output y over the reference y_m",
            f"{ABOUT_Y_M} {about}".rstrip(),
            figures.tracking_figure(context, trim),
            contents="Outputs",
        ),
        *_guidance_sections(flight, scenario, context),
        *([] if replay is None else [ReplayBlock(replay=replay)]),
        Section(
            "Input u and the actuators",
            "Limits are in view where u comes near them. Marks above each row: the controller "
            "saturated the input.",
            figures.input_figure(context, figures.input_limits(scenario, flight.tape)),
            contents="Inputs",
        ),
        Section(
            "Tracking error e = y - y_m",
            "The measured error has the noise of the sensors; the true error has not. The noise "
            "floor is drawn where it is wide enough to see.",
            figures.error_figure(context, floors),
            contents="Errors",
        ),
    ]


def _causes(
    flight: RecordedFlight, scenario: Scenario, context: PlotContext, flown: FlownLoops
) -> list[Block]:
    """Return the figures that show causes: models, wind, states, the law and its loop, timing."""
    trim = about_trim(scenario)
    about = ABOUT_V if trim else ""
    spectrum = figures.spectrum_figure(context)
    return [
        Section(
            "What was learned",
            "A and B as identified, SI, with bars of two standard deviations; open marks: no "
            "model was proposed. Lines: the true value before a drift, and the value of the file",
            learned_figure(context, learned_lines(flight.tape, scenario)),
            contents="Learned",
        ),
        Section("Wind", "along the body axes of trim", figures.wind_figure(context)),
        Section(
            "States",
            about,
            figures.state_figure(context, state_units(scenario), trim),
            contents="States",
        ),
        Section(
            "Integrals of the law",
            f"{_law(scenario)}. Pi, the integral of the sign term, is in scaled inputs.",
            figures.integral_figure(context),
            contents="Law",
        ),
        Section("Error of the sensors", "y less the true output", figures.sensor_figure(context)),
        Section("Spectrum of u", "amplitude spectral density", spectrum, is_over_time=False),
        *_loop_sections(_drawn_loops(flown.loops)),
        Section(
            "Ticks of the controller",
            "late: after its deadline; age: of y at the tick; dt: as integrated",
            figures.tick_figure(context),
            contents="Timing",
        ),
        Section("Timing of the ticks", "", figures.timing_figure(context), is_over_time=False),
    ]


def _flight_figures(flight: RecordedFlight, scenario: Scenario, flown: FlownLoops) -> Figures:
    """Return the tables of a flight, in deg and in rad."""
    events = tables.events(flight.tape, flight.gusts, scenario)
    margins = _margin_tables(flown)
    shown, in_radians = (
        [*tables.flight_tables(flight.summary, units, events), *margins]
        for units in (flight.units, display_units.in_radians({**QUANTITY_UNITS, **flight.units}))
    )
    return Figures(groups=[TableGroup(shown, in_radians=in_radians)], is_folded=True)


def _message_lines(flight: RecordedFlight) -> list[MessageLine]:
    """Return the messages of the log, at most MOST_MESSAGES."""
    lines = [
        MessageLine(f"{time:.2f} s", message.kind, message.text)
        for time, message in zip(flight.message_times, flight.messages, strict=True)
    ]
    more = len(lines) - MOST_MESSAGES
    return lines if more <= 0 else [*lines[:MOST_MESSAGES], MessageLine("", "", f"and {more} more")]


def _parameter_table(scenario: Scenario) -> tables.MetricTable:
    columns = [Column(group="", head=head) for head in ("flown", "default")]
    return tables.MetricTable("", columns, parameter_rows(scenario))


def _law(scenario: Scenario) -> str:
    """Return a text that names the control law and its rate."""
    controller = scenario.controller
    return f"At {controller.rate:g} Hz with the {controller.summary()}"


def _margin_tables(flown: FlownLoops) -> list[tables.MetricTable]:
    """Return a table of one loop's margins by input, or of several loops' least margins."""
    if not flown.loops:
        return []
    if len(flown.loops) > 1:
        return [margin_figures.flown_margin_table(flown)]
    (single,) = flown.loops
    guarantee = kept_guarantee(single.loop)
    return [margin_figures.margin_table(single.margins, guarantee, flown.sentences)]


def _drawn_loops(loops: Sequence[FlownLoop]) -> dict[str, LinearLoop]:
    """Return the loops that Bode and Nyquist plots show, by name.

    If the true aircraft is known, these are the loops around the true aircraft.
    """
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
        Section(
            "Bode plot of the loop", hint, margin_figures.bode_figure(loops), is_over_time=False
        ),
        Section(
            "Nyquist plot of the loop",
            "Inside the circle around -1 the sensitivity is above 2.",
            margin_figures.nyquist_figure(loops),
            is_over_time=False,
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
            is_over_time=False,
            contents="Ground track",
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
