# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the report of a campaign: tables, histograms of errors, score over a swept gain."""

import json
import shlex
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.uncertainty import WindEffect, as_yaml, with_entries
from flight_analysis.closed_loop.scenario import Scenario, scenario_yaml
from flight_analysis.linear_loop.loop_margins import LoopMargins
from flight_analysis.metrics.transients import CAPTURE_TIME
from flight_analysis.report import plotting
from flight_analysis.report.display_units import (
    NO_UNIT,
    NO_VALUE,
    QUANTITY_UNITS,
    DisplayUnit,
    display_units,
)
from flight_analysis.report.figures import COLOURS
from flight_analysis.report.margin_figures import (
    LEAST_MARGINS,
    least_margins,
    margins_as_json,
)
from flight_analysis.report.page import Figures, Page, Section, TableGroup, page_html
from flight_analysis.report.plotting import set_layout
from flight_analysis.report.run_folder import REPORT, SUMMARY
from flight_analysis.report.summary import finite_or_null
from flight_analysis.report.summary_rows import Column
from flight_analysis.report.tables import MetricTable
from flight_campaign import equipment
from flight_campaign.campaign import MonteCarlo
from flight_campaign.definition import Definition
from flight_campaign.statistics import (
    EDGES,
    FIRST_MODEL,
    LOSS_OF_TRACK_SCORE,
    PER_DECADE,
    SCORE_UNIT,
    SCORE_UNIT_OF,
    FigureStatistics,
    Tally,
)
from flight_core.files import display_path, write_file, writing
from flight_core.units import ANGULAR_RATE, SPEED
from flight_core.vectors import FloatArray

# number of bins of the statistics in one bin of a figure, which is 5 % wide
COARSE = PER_DECADE // 50
WIND_EFFECTS: dict[WindEffect, str] = {
    "air_relative": "by each aircraft's own A",
    "published": "from the airframe file",
}
SPREAD = {"median": 0.5, "95 %": 0.95, "99 %": 0.99}
ENTRIES_SHOWN = 6
STATED = ("aircraft", "uncertainty", "entries", "distribution", "score_units", "wind", "seed")
"""Keys of the definition that the summary repeats."""
RERUN = 3  # number of worst aircraft of a case for which scenarios are written
FIGURE_HEADINGS = ("mean", *SPREAD, "worst")
OF_LEARNER = {
    FIRST_MODEL: "first model (s)",
    "models": "models used",
    "refused": "models refused",
}


OVERVIEW_LEGEND = (
    "phase and gain margin, sensitivity: of the worst input, the others closed; disk and delay "
    "margin: of all inputs at once."
    " Nominal aircraft, and in parentheses the worst found by a search over the box of A and B; "
    "lags and delay come from the controller's section. Uniform samples miss the corners of the "
    "box: the distribution corners flies these, and rise-di gains guarantee bounds every "
    "aircraft"
)


GUARANTEE_LEGEND = (
    "largest deviation of each entry of A and B, with u in time and no saturation, as "
    "rise-di gains guarantee has computed for this loop"
)


LEARNER_LEGEND = (
    "first model: from when on it was used; models refused: by the learner, which says why during "
    "the flight, or by the controller; fallbacks: to the initial law, in all outputs or in some. "
    "The margins above belong to the initial law"
)


def write_results(campaign: MonteCarlo) -> tuple[dict[str, Any], MetricTable]:
    """Write the summary, the report and the scenarios of the worst aircraft.

    Returns the summary and the table of the overview. Raises ParameterError if a file cannot be
    written.
    """
    definition = campaign.definition
    tallies = [campaign.tally(case) for case in range(definition.cases)]
    margins = [campaign.margins(case) for case in range(definition.cases)]
    with writing("", campaign.folder, "a writable folder and space on the disk"):
        cases = []
        for case, (tally, loop_margins) in enumerate(zip(tallies, margins, strict=True)):
            guarantee = campaign.guarantee(case)
            cases.append(
                {
                    "factor": definition.factor(case),
                    **tally.summary(),
                    "fly_again": _write_worst(campaign, case, tally),
                    "margins": None if loop_margins is None else margins_as_json(loop_margins),
                    "guarantee": None if guarantee is None else guarantee.as_json(),
                    "influence": _influence(campaign, case, tally),
                }
            )
        statement = {key: getattr(definition, key) for key in STATED}
        sweep = None if definition.sweep is None else definition.sweep.parameter
        figures = {"scenario": definition.name} | statement | {"sweep": sweep, "cases": cases}
        figures = finite_or_null(figures)
        write_file(campaign.folder / SUMMARY, json.dumps(figures, indent=1))
        write_page(campaign.folder / REPORT, definition, tallies, cases, margins)
    return figures, overview(definition, tallies, margins)


def _write_worst(campaign: MonteCarlo, case: int, tally: Tally) -> list[dict[str, Any]]:
    """Write the scenarios of the worst aircraft, and return them with the commands to fly them."""
    definition = campaign.definition
    again = []
    for aircraft in tally.worst[:RERUN]:
        path = _path(campaign, case, str(aircraft.number))
        write_file(path, scenario_yaml(definition.aircraft_scenario(aircraft.number, case)))
        again.append(
            {"number": aircraft.number, "score": aircraft.score, "command": _command(path)}
        )
    return again


def _influence(campaign: MonteCarlo, case: int, tally: Tally) -> dict[str, Any]:
    """Return how strongly the drawn entries correlate with the score of a case, by ranks.

    If the case has a worst corner, its airframe and its scenario are written too.
    """
    definition = campaign.definition
    ranked = campaign.influence(case, tally.worst[0].number)
    corner = {
        entry["entry"]: entry["worst_corner"]
        for entry in ranked["entries"]
        if entry["worst_corner"]
    }
    if not corner:
        return ranked | {"command": None}
    scenario = definition.scenario(case)
    path = _path(campaign, case, "corner")
    airframe = path.with_name(
        "corner_airframe.yaml" if definition.sweep is None else f"corner_airframe_{case}.yaml"
    ).absolute()
    references = equipment.references(scenario, definition.entries)
    equipment_parts = {
        name: references[name] * (1.0 + part) for name, part in corner.items() if name in references
    }
    matrix_parts = {name: part for name, part in corner.items() if name not in references}
    write_file(
        airframe,
        as_yaml(
            with_entries(load_airframe(scenario.aircraft.airframe), matrix_parts, definition.wind)
        ),
    )
    learn = getattr(scenario.controller, "learn", None)
    # The learner knows the airframe of the scenario, although the aircraft of the corner flies.
    if learn is not None and (learn.prior is None or learn.prior.file is None):
        scenario = scenario.vary(
            controller={"learn": {"prior": {"file": scenario.aircraft.airframe}}}
        )
    cornered = equipment.scenario_with_equipment(scenario, equipment_parts).vary(
        aircraft={"airframe": str(airframe)}
    )
    write_file(path, scenario_yaml(cornered))
    return ranked | {"command": _command(path)}


def _path(campaign: MonteCarlo, case: int, word: str) -> Path:
    """Return the path for a scenario of a case."""
    definition = campaign.definition
    suffix = "" if definition.sweep is None else f"_{definition.factor(case):g}"
    return campaign.folder / f"{definition.name}{suffix}_{word}.yaml"


def _command(path: Path) -> str:
    return f"rise-di fly {shlex.quote(display_path(path))} --in-process"


def write_page(
    path: Path,
    definition: Definition,
    tallies: Sequence[Tally],
    cases: Sequence[Mapping[str, Any]],
    margins: Sequence[LoopMargins | None],
) -> None:
    """Write the report of a campaign.

    For each case, the arguments have its tally, its part of the summary, and its loop's margins.
    """
    scenario = definition.scenario()
    units = QUANTITY_UNITS | display_units(scenario)
    labels = _labels(definition)
    title = f"Campaign {definition.name}"
    text = (
        f"{tallies[0].flights} aircraft, every entry of A and B within"
        f" ±{100 * definition.uncertainty:g} % of the airframe{_spread_of_entries(definition)}, "
        f"seed {definition.seed}; the same wind and noise for all, the effect of wind on x_dot "
        f"{WIND_EFFECTS[definition.wind]}; true errors at the controller's ticks."
        f" Score: {score_meaning(scenario, definition.score_units)}; loss of track: a score "
        f"above {LOSS_OF_TRACK_SCORE:g}."
    )
    # The tables of all cases come first, and then those of each case.
    tables = [overview(definition, tallies, margins), _ends(labels, cases)]
    if any(case["guarantee"] for case in cases):
        tables.append(_guarantees(labels, cases))
    if scenario.has_learner():
        tables.append(_without_model(labels, tallies))
    tables += [_figures(label, tally, units) for label, tally in zip(labels, tallies, strict=True)]
    tables.append(_worst(labels, cases))
    tables += [
        influence_table(label, case)
        for label, case in zip(labels, cases, strict=True)
        if case["influence"]["entries"]
    ]
    sections = [
        Section(
            "Score",
            "share of the aircraft by score",
            _spread(labels, tallies, ["score"], {}),
            is_over_time=False,
        ),
        Section(
            "Errors",
            "share of the aircraft by rms of the true error",
            _spread(
                labels,
                tallies,
                [name for name in tallies[0].figures if name.startswith("rms.")],
                units,
            ),
            is_over_time=False,
        ),
        Section("Sweep", "score over the factor", _sweep(definition, tallies), is_over_time=False),
    ]
    page = Page(
        title=title,
        lines=[text],
        blocks=[Figures(groups=[TableGroup(tables)], title="Figures"), *sections],
    )
    write_file(path, page_html(page))


def _guarantees(labels: Sequence[str], cases: Sequence[Mapping[str, Any]]) -> MetricTable:
    """Return a table of the guarantees that were computed for the loops of the cases."""
    rows = []
    for label, case in zip(labels, cases, strict=True):
        guarantee = case["guarantee"]
        first = None if guarantee is None else guarantee["unstable"]
        cells = [None if guarantee is None else guarantee["stable"]]
        cells.append(None if first is None else first["deviation"])
        rows.append([label, *(NO_VALUE if x is None else f"{100.0 * x:.1f}" for x in cells)])
    heads = ("stable for every aircraft within, %", "first unstable aircraft found, %")
    columns = [Column(group="", head=head) for head in heads]
    return MetricTable("Guarantee of the linear loop", columns, rows, GUARANTEE_LEGEND)


def overview(
    definition: Definition, tallies: Sequence[Tally], margins: Sequence[LoopMargins | None]
) -> MetricTable:
    """Return a table of scores, lost aircraft and margins, with a column for each case."""
    columns = []
    for tally, loop_margins in zip(tallies, margins, strict=True):
        score = tally.figures.get("score", FigureStatistics())
        failures = tally.lost + tally.diverged
        worst = "diverged" if tally.diverged else f"{score.largest:.3g}"
        columns.append(
            [
                f"{score.mean:.3g}",
                worst,
                f"{100.0 * failures / max(tally.flights, 1):.3g}",
                *least_margins(loop_margins),
            ]
        )
    names = ("score, mean", "score, worst", "lost or diverged, %", *LEAST_MARGINS)
    rows = [[name, *cells] for name, *cells in zip(names, *columns, strict=True)]
    return MetricTable(
        "Score and margins",
        [Column(group="", head=label) for label in _labels(definition)],
        rows,
        OVERVIEW_LEGEND,
    )


def _spread_of_entries(definition: Definition) -> str:
    """Write the uncertainties by entry, and the distribution if it is not uniform."""
    parts = [f"{name} ±{100 * part:g} %" for name, part in definition.entries.items()]
    if definition.distribution != "uniform":
        parts.append(definition.distribution)
    return "".join(f", {part}" for part in parts)


def score_meaning(scenario: Scenario, score_units: Mapping[str, float] | None = None) -> str:
    """Say what a campaign's score measures.

    `score_units` has the units that replace the usual ones, by output, SI.
    """
    if scenario.guidance is not None:
        half = CAPTURE_TIME * scenario.guidance.speed
        return (
            f"the largest cross-track error on the route in {half:g} m, {CAPTURE_TIME:g} s "
            "of flight at the trim speed"
        )
    units = display_units(scenario)
    unit_texts = [
        f"{name} {unit * units[name].factor:.3g} {units[name].unit}"
        for name, unit in (score_units or {}).items()
    ]
    usual, of_p = np.rad2deg([SCORE_UNIT[ANGULAR_RATE], SCORE_UNIT_OF["p"]])
    unit_texts.append(f"{usual:.3g} deg/s (p: {of_p:.3g}) and {SCORE_UNIT[SPEED]:g} m/s")
    return f"the sum over the channels of rms error in {', '.join(unit_texts)}"


def _labels(definition: Definition) -> list[str]:
    return [definition.label(case) for case in range(definition.cases)]


def _ends(labels: Sequence[str], cases: Sequence[Mapping[str, Any]]) -> MetricTable:
    columns = [
        Column(group=group, head=head)
        for group, head in product(
            ("diverged", "loss of track"), ("aircraft", "%", "95 % interval")
        )
    ]
    rows = []
    for label, case in zip(labels, cases, strict=True):
        row = [label]
        for word in ("diverged", "lost"):
            outcome = case[word]
            row += [
                str(outcome["count"]),
                f"{100 * outcome['share']:.3g}",
                f"{100 * outcome['low']:.2g} to {100 * outcome['high']:.2g}",
            ]
        rows.append(row)
    return MetricTable("Outcomes", columns, rows)


def _without_model(labels: Sequence[str], tallies: Sequence[Tally]) -> MetricTable:
    rows = [
        [label, str(tally.without_model()), str(tally.flights)]
        for label, tally in zip(labels, tallies, strict=True)
    ]
    return MetricTable(
        "Aircraft that learn",
        [Column(group="", head="without a model"), Column(group="", head="of")],
        rows,
        LEARNER_LEGEND,
    )


def _figures(label: str, tally: Tally, units: Mapping[str, DisplayUnit]) -> MetricTable:
    columns = [Column(group="", head=head) for head in FIGURE_HEADINGS]
    return MetricTable(
        label,
        columns,
        figure_rows(tally, units),
        "of flights that did not diverge; slew: mean abs(u_dot)",
    )


def figure_rows(tally: Tally, units: Mapping[str, DisplayUnit]) -> list[list[str]]:
    """Return a row for each metric of a tally.

    A row has the label with its unit, and then the values named by FIGURE_HEADINGS.
    """
    rows = []
    for name, figure in tally.figures.items():
        label, factor = _label(name, units)
        values = (
            figure.mean,
            *(figure.quantile(share) for share in SPREAD.values()),
            figure.largest,
        )
        rows.append(
            [label, *(f"{value * factor:.3g}" if figure.count else NO_VALUE for value in values)]
        )
    return rows


def _label(name: str, units: Mapping[str, DisplayUnit]) -> tuple[str, float]:
    """Return the name of a metric with its unit, and the factor that converts SI to this unit."""
    kind, _, channel = name.partition(".")
    if not channel:
        return OF_LEARNER.get(name, name), 1.0
    unit = units.get(channel, NO_UNIT)
    return f"{kind} {channel} ({unit.unit}{'/s' * (kind == 'slew')})", unit.factor


def _worst(labels: Sequence[str], cases: Sequence[Mapping[str, Any]]) -> MetricTable:
    columns = [Column(group="", head=head) for head in ("aircraft", "score", "fly it again")]
    rows = []
    for label, case in zip(labels, cases, strict=True):
        for flight in case["fly_again"]:
            score = "diverged" if flight["score"] is None else f"{flight['score']:.3g}"
            rows.append([label, str(flight["number"]), score, flight["command"]])
    return MetricTable(
        "Worst flights",
        columns,
        rows,
        "--lockstep in place of --in-process flies it over ROS 2 topics",
    )


def influence_table(label: str, case: Mapping[str, Any]) -> MetricTable:
    """Return a table of a case's drawn entries whose size correlates most with the score."""
    ranked = case["influence"]
    rows = [
        [
            entry["entry"],
            f"{entry['rank_correlation']:+.2f}",
            f"{100 * entry['worst_aircraft']:+.0f} %",
            _corner(entry["worst_corner"]),
        ]
        for entry in ranked["entries"][:ENTRIES_SHOWN]
    ]
    legend = (
        f"rank correlation (Spearman, {ranked['aircraft']} aircraft) of the size of the entry "
        "with the score: above 0 larger"
        " entries fly worse. Worst corner: the limits on the side of the higher score"
    )
    if ranked["chance"] is not None:
        legend += f"; below {ranked['chance']:.2f} it may be chance"
    if ranked["command"] is not None:
        legend += f". The worst corner flies by {ranked['command']}"
    columns = [
        Column(group="", head=head)
        for head in ("rank correlation", "worst aircraft", "worst corner")
    ]
    return MetricTable(f"Drawn entries: {label}", columns, rows, legend)


def _corner(value: float) -> str:
    return f"{100 * value:+.0f} %" if value else NO_VALUE


def _spread(
    labels: Sequence[str],
    tallies: Sequence[Tally],
    names: Sequence[str],
    units: Mapping[str, DisplayUnit],
) -> plotting.Figure:
    figure = plotting.Figure(len(names), min(len(names), 2), 190, spacing=0.2)
    for place, name in enumerate(names):
        label_, factor = _label(name, units)
        for label, tally, colour in zip(labels, tallies, COLOURS * len(labels), strict=False):
            x, y = _density(tally.figures.get(name, FigureStatistics()))
            style: dict[str, Any] = {
                "legendgroup": label,
                "fill": "tozeroy",
                "line": {"color": colour, "width": 1.4, "shape": "hvh"},
                "showlegend": place == 0 and len(labels) > 1,
                "hovertemplate": "%{y:.3g} % around %{x:.3g}",
            }
            figure.add_scatter(label, x * factor, 100.0 * y, place, **style)
        figure.x[place] |= {"title": {"text": label_}, "type": "log"}
        figure.y[place] |= {"title": {"text": "%"}, "rangemode": "tozero"}
    return set_layout(figure, below=44)


def _density(figure: FigureStatistics) -> tuple[FloatArray, FloatArray]:
    """Return the centres of coarse bins, and the share of the flights in each bin."""
    if not figure.count:
        return np.zeros(0), np.zeros(0)
    places = np.array(list(figure.bins)) // COARSE
    first = int(places.min()) - 1
    last = int(places.max()) + 1
    counts = np.zeros(last - first + 1)
    np.add.at(counts, places - first, list(figure.bins.values()))
    exponents = (np.arange(first, last + 1) + 0.5) * COARSE
    return EDGES[0] * 10.0 ** (exponents / PER_DECADE), counts / figure.count


def _sweep(definition: Definition, tallies: Sequence[Tally]) -> plotting.Figure | None:
    if definition.sweep is None:
        return None
    figure = plotting.Figure(1, 1, 260)
    scores = [tally.figures["score"] for tally in tallies]
    curves = {"mean": [score.mean for score in scores]}
    for label, share in SPREAD.items():
        curves[label] = [score.quantile(share) for score in scores]
    curves["worst"] = [score.largest for score in scores]
    for (label, values), colour in zip(curves.items(), COLOURS, strict=True):
        factors = np.array(definition.sweep.factors)
        line = {"color": colour}
        figure.add_scatter(label, factors, np.array(values), mode="lines+markers", line=line)
    figure.x[0] |= {"title": {"text": f"{definition.sweep.parameter} times"}, "type": "log"}
    figure.y[0] |= {"title": {"text": "score"}, "rangemode": "tozero"}
    return set_layout(figure, below=44)
