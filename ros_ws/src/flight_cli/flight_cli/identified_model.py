# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Print, write and fly a model that `rise-di identify log` has found."""

from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics.time_spans import mask_spans
from flight_analysis.report.display_units import DisplayUnit, display_unit
from flight_analysis.report.figures import ERROR, PLANT
from flight_analysis.report.intervals import GUST
from flight_analysis.report.page import Page, Section, page_html
from flight_analysis.report.plotting import (
    Curve,
    Interval,
    PlotContext,
    SampleStore,
    time_series_figure,
)
from flight_cli.output import (
    entries_as_json,
    entry_table,
    new_table,
    print_table,
    say,
    write_text,
)
from flight_core.files import display_path
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_design.gains.gain_design import selected_observer
from flight_design.identification.manoeuvre import manoeuvre_result
from flight_design.identification.model_identification import Identification, model_yaml


def write_model(console: Console, identification: Identification, log: Path, path: Path) -> None:
    """Write the airframe file, and the page of the innovations."""
    write_text("--write", path, model_yaml(identification, str(log)))
    page = path.with_suffix(".html")
    write_text("--write", page, page_html(_innovation_page(identification, log.name)))
    say(console, f"model: {display_path(path)}, innovations: {display_path(page)}")


@dataclass(frozen=True, kw_only=True)
class Reflight:
    """Rms errors by output, SI, of a recorded flight and of a simulation with another model.

    The simulation has the feedforward and the observer of this model.
    """

    origin: str  # source of the observer's gains
    recorded: dict[str, float]
    again: dict[str, float]
    outcome: str


def fly_again(scenario: Scenario, tape: Tape, model: Airframe, margin: float) -> Reflight:
    """Simulate a log's scenario in this process, with the feedforward and observer of a model."""
    selected = selected_observer(scenario.rise_di(), scenario, model, margin)
    again = simulate(replace(scenario, controller=selected.controller))
    return Reflight(
        origin=selected.origin,
        recorded=manoeuvre_result(tape).rms,
        again=manoeuvre_result(again).rms,
        outcome=str(again.outcome),
    )


def show_flights_of_model(
    console: Console, again: Reflight, identification: Identification
) -> None:
    """Print the rms errors of the recorded flight, and of the simulated flight with the model."""
    units = _units(identification)
    headings = ["flight", *(f"{name}\n{unit.unit}" for name, unit in units.items())]
    table = new_table("\nRms of the error", headings)
    for title, rms in (("recorded", again.recorded), ("with the model", again.again)):
        table.add_row(title, *(f"{rms[name] * unit.factor:.3g}" for name, unit in units.items()))
    print_table(console, table)
    say(console, f"{again.origin}; outcome: {again.outcome}")


def show_model(console: Console, identification: Identification) -> None:
    """Print the entries of A and B, and the innovations of the held-out samples."""
    print_table(
        console, entry_table(f"A and B of {identification.airframe.name}", identification.entries)
    )
    headings = ("output", "nominal\nrms", "\nwhiteness", "identified\nrms", "\nwhiteness")
    table = new_table("\nInnovations of the held-out samples, one of three seconds", headings)
    for i, (name, unit) in enumerate(_units(identification).items()):
        figures = [
            (model.rms[i] * unit.factor, model.whiteness[i])
            for model in (identification.before, identification.after)
        ]
        table.add_row(
            f"{name} ({unit.unit})", *(f"{figure:.3g}" for figure in chain.from_iterable(figures))
        )
    print_table(console, table)
    gain = identification.after.log_likelihood - identification.before.log_likelihood
    say(
        console,
        f"whiteness: 1 for white noise; change of the log-likelihood of a sample: {gain:+.3g}",
    )


def _units(identification: Identification) -> dict[str, DisplayUnit]:
    units = identification.airframe.units_of_outputs()
    return {name: display_unit(unit) for name, unit in units.items()}


def _innovation_page(identification: Identification, name: str) -> Page:
    """Return a page with the innovations of the nominal and of the identified model.

    The innovations are drawn over the time of the flight. The seconds that the identification did
    not use are shaded.
    """
    t = identification.recorded.t - identification.recorded.t[0]
    before, after = (
        Signal(np.round(t * NANOSECONDS).astype(np.int64), identification.airframe.outputs, r)
        for r in identification.innovations
    )
    held_out = [
        Interval(label="held out", start=start, stop=stop, colour=GUST, is_labelled=False)
        for start, stop in mask_spans(t, identification.held_out)
    ]
    context = PlotContext(
        runs={},
        units=_units(identification),
        intervals=held_out,
        end=float(t[-1]),
        samples=SampleStore(),
    )
    curves = {
        "nominal": Curve(before, ERROR, start_ns=0),
        "identified": Curve(after, PLANT, start_ns=0),
    }
    figure = time_series_figure(context, curves)
    section = Section(
        "Innovations",
        "y minus its prediction from the samples before; shaded: not used in the fit",
        figure,
    )
    likelihoods = (
        f"{identification.before.log_likelihood:.4g} nominal, "
        f"{identification.after.log_likelihood:.4g} identified"
    )
    return Page(
        title=f"Model of {identification.airframe.name} from {name}",
        lines=[f"log-likelihood of a held-out sample: {likelihoods}"],
        blocks=[section],
        samples=context.samples,
    )


def model_as_json(
    identification: Identification, path: Path | None, again: Reflight | None
) -> dict[str, Any]:
    """Return the model, its file, and the flight with it, if any, as a dict for JSON, in SI."""
    outputs = identification.airframe.outputs
    return {
        "airframe": identification.airframe.name,
        "entries": entries_as_json(identification.entries),
        "held_out": {
            model: {
                "rms": dict(zip(outputs, innovations.rms.tolist(), strict=True)),
                "whiteness": dict(zip(outputs, innovations.whiteness.tolist(), strict=True)),
                "log_likelihood": innovations.log_likelihood,
            }
            for model, innovations in (
                ("nominal", identification.before),
                ("identified", identification.after),
            )
        },
        "model": None if path is None else str(path),
        **({} if again is None else {"refly": asdict(again)}),
    }
