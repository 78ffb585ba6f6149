# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Build the page that compares several flights, or draws several logs over each other."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report import comparison, display_units, figures, guided_figures
from flight_analysis.report.display_units import about_trim
from flight_analysis.report.flight_head import meta_lines, title_of, verdict_of
from flight_analysis.report.glossary import words_in
from flight_analysis.report.overlay import difference_table
from flight_analysis.report.page import Colour, Figures, Page, Section, TableGroup, Verdict
from flight_analysis.report.plotting import PlotContext
from flight_analysis.report.summary import RecordedFlight, coverage_suffix
from flight_analysis.report.summary_rows import (
    ERROR_COLUMNS,
    INPUT_COLUMNS,
    SETTLING_COLUMNS,
    SWITCH_COLUMN,
    Column,
)
from flight_analysis.report.tables import TIMES, MetricTable


def comparison_page(flights: Sequence[RecordedFlight], tolerances: Mapping[str, float]) -> Page:
    """Return the page of several flights, each with its own colour and compared with the first one.

    If a flight has no scenario, as an imported log, the page has no metrics. It overlays signals of
    the same name, and states their differences. `tolerances` has the allowed difference of each
    channel, SI.
    """
    context = figures.plot_context(flights)
    colours = {label: run.colour for label, run in context.runs.items()}
    scenarios = [flight.scenario for flight in flights if flight.scenario is not None]
    verdicts = [
        _verdict(flight, label, colour)
        for (label, colour), flight in zip(colours.items(), flights, strict=True)
    ]
    differences = TableGroup([difference_table(flights, context.units, tolerances)])
    if len(scenarios) < len(flights):
        return _overlay_page(flights, context, verdicts, differences)
    return Page(
        title=f"{len(flights)} flights compared",
        verdicts=verdicts,
        blocks=[
            Figures(
                groups=_conditions(flights, list(colours)),
                title="What differs",
                contents="What differs",
            ),
            Section(
                "Output y over the reference y_m",
                "",
                figures.tracking_figure(context, _label_of_v(scenarios)),
                contents="Outputs",
            ),
            *_tracks(flights, colours),
            Section(
                "Tracking error e = y - y_m", "", figures.error_figure(context), contents="Errors"
            ),
            Section("Input u", "", figures.input_figure(context), contents="Inputs"),
            _metrics(flights, context, list(colours.values())),
            Figures(
                groups=[differences],
                is_folded=True,
                title="Differences of the signals from the first flight",
                contents="Differences",
            ),
            Section("Spectrum of u", "", figures.spectrum_figure(context), is_over_time=False),
            Section("Timing of the ticks", "", figures.timing_figure(context), is_over_time=False),
        ],
        samples=context.samples,
    )


def _verdict(flight: RecordedFlight, label: str, colour: str) -> Verdict:
    """Return the verdict on a flight, with the label and the colour of this flight."""
    if flight.scenario is None:
        source = flight.summary["source"]
        headline = f"{title_of(flight)}, {source['kind']}."
        return Verdict(headline=headline, colour=Colour.PLAIN, label=label, line=colour)
    verdict = verdict_of(flight, flight.scenario)
    described, _ = meta_lines(flight, flight.scenario)
    error = f"{flight.summary['error']}{coverage_suffix(flight.summary, 'errors')}"
    text = f"{flight.scenario.name}: {described} ({error})"
    return replace(verdict, text=text, step=None, label=label, line=colour)


def _label_of_v(scenarios: Sequence[Scenario]) -> dict[str, str]:
    """Return the axis label of V in a mapping with the key "V".

    The label states the trim speed if all flights have the same trim speed.
    """
    trims = [about_trim(scenario) for scenario in scenarios]
    return trims[0] if all(each == trims[0] for each in trims) else {"V": "V about trim (m/s)"}


def _tracks(flights: Sequence[RecordedFlight], colours: Mapping[str, str]) -> list[Section]:
    """Return the ground tracks of the guided flights, over the routes of the first guided flight.

    The list is empty if no flight is guided.
    """
    guided = {
        label: flight
        for label, flight in zip(colours, flights, strict=True)
        if flight.summary["guidance"] is not None
    }
    if not guided:
        return []
    first = next(iter(guided.values()))
    routes = guided_figures.flown_routes(first.scenario, first.tape)
    tracks = {label: (flight.tape, colours[label]) for label, flight in guided.items()}
    figure = guided_figures.tracks_figure(tracks, routes)
    return [Section("Ground track", "", figure, is_over_time=False, contents="Ground track")]


def _metrics(
    flights: Sequence[RecordedFlight], context: PlotContext, palette: Sequence[str]
) -> Figures:
    """Return the tables of metrics of a comparison. `palette` has the colours of the flights."""
    units = (context.units, display_units.in_radians(context.units))
    errors, errors_in_radians = (comparison.error_tables(flights, each) for each in units)
    inputs, inputs_in_radians = (
        comparison.comparison_tables(
            flights, "inputs", INPUT_COLUMNS, lower_is_better=False, units=each
        )
        for each in units
    )
    ticks = comparison.tick_tables(flights)
    columns = (*ERROR_COLUMNS, SWITCH_COLUMN, *SETTLING_COLUMNS.values(), *INPUT_COLUMNS)
    names = {row.name for table in (*errors, *inputs) for row in table.rows}
    shown = [column for column in columns if column.label in names]
    headings = [heading for each in shown for heading in (each.group, each.head, each.label)]
    timed = TIMES if ticks else ()
    groups = [
        TableGroup(errors, "Tracking error", "", palette, errors_in_radians),
        TableGroup(inputs, "Inputs", "u minus its value at trim", palette, inputs_in_radians),
        TableGroup(ticks, "Time", "", palette),
    ]
    return Figures(groups=groups, words=words_in([*headings, *timed]))


def _conditions(flights: Sequence[RecordedFlight], labels: Sequence[str]) -> list[TableGroup]:
    """Return a table of the parameters that differ between the flights, or [] if none differs."""
    rows = comparison.conditions(flights)
    if not rows:
        return []
    columns = [Column(group="", head=label) for label in labels]
    table = MetricTable("", columns, [(row.key, *row.texts) for row in rows])
    note = "" if all(comparison.has_same_conditions(flights)) else comparison.UNLIKE
    return [TableGroup([table], "", note)]


def _overlay_page(
    flights: Sequence[RecordedFlight],
    context: PlotContext,
    verdicts: Sequence[Verdict],
    differences: TableGroup,
) -> Page:
    """Return the page that draws logs over each other, with the differences from the first log."""
    has_references = all("y_m" in flight.tape for flight in flights)
    return Page(
        title=f"{len(flights)} logs over each other",
        verdicts=verdicts,
        blocks=[
            Section(
                "Output y over the reference y_m" if has_references else "Output y",
                "t = 0 is the start of each log",
                figures.tracking_figure(context)
                if has_references
                else figures.overlay_figure(context, "y"),
                contents="Outputs",
            ),
            Section(
                "Tracking error e = y - y_m",
                "",
                figures.error_figure(context) if has_references else None,
                contents="Errors",
            ),
            Section("Input u", "", figures.input_figure(context), contents="Inputs"),
            Section("Pose", "", figures.overlay_figure(context, "pose"), contents="Pose"),
            Section("Spectrum of u", "", figures.spectrum_figure(context), is_over_time=False),
            Figures(
                groups=[differences],
                title="Differences from the first log",
                contents="Differences",
            ),
        ],
        samples=context.samples,
    )
