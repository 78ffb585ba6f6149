# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di campaign`, which flies a Monte Carlo campaign.

In a campaign, thousands of uncertain aircraft fly one scenario.
"""

import math
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape

from aircraft_sim.uncertainty import Distribution, WindEffect
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.display_units import QUANTITY_UNITS, display_units
from flight_analysis.report.run_folder import REPORT, new_run
from flight_analysis.report.tables import MetricTable
from flight_campaign import engines
from flight_campaign.campaign import MonteCarlo, define
from flight_campaign.campaign_report import (
    FIGURE_HEADINGS,
    WIND_EFFECTS,
    figure_rows,
    influence_table,
    write_results,
)
from flight_campaign.definition import Definition, Sweep
from flight_campaign.single_flights import is_flown_alone
from flight_campaign.statistics import LOSS_OF_TRACK_SCORE, Tally
from flight_cli.output import (
    COUNT_COLUMNS,
    INTERRUPTED,
    SHOWN_COLUMN,
    named_numbers,
    new_table,
    parse_numbers,
    print_json,
    print_table,
    progress_bar,
    say,
    show_table,
)
from flight_cli.words import (
    argument,
    json_option,
    option,
    rare_option,
    require_unused,
    scenario_names,
)
from flight_core.files import display_path, writing
from flight_core.parameters import require
from flight_design.learning.scenario_learner import quick_learner

# Options that define a new campaign.
OF_DEFINITION = (
    "aircraft",
    "uncertainty",
    "entry",
    "distribution",
    "score",
    "wind",
    "seed",
    "sweep",
    "duration",
    "chunk",
    "runs",
)


class EngineName(StrEnum):
    """The engine that computes the chunks of a campaign."""

    THREADS = "threads"
    DASK = "dask"


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """Fly a Monte Carlo campaign: thousands of uncertain aircraft around an airframe.

    The scenario names the airframe, and many aircraft are computed at once. Aircraft with a route
    or a learner fly one by one: a core needs 7 s for each minute of flight, and up to 20 s if they
    learn.

    Exit status: 0 all flown, 2 bad input, 130 interrupted. To continue an interrupted campaign,
    give its folder.
    """

    context: typer.Context
    scenario: str = argument(
        "Name of a scenario, path of a scenario file (.yaml), or folder of an interrupted "
        "campaign to continue.",
        default="osprey_servo",
        autocompletion=scenario_names,
    )
    aircraft: int = option("How many uncertain aircraft.", default=1000, min=1)
    uncertainty: float = option(
        "Largest relative deviation of each entry of A and B, 0 to 1.", default=0.3
    )
    wind: WindEffect | None = rare_option(
        "Whose A the wind acts through: each aircraft's own, or the airframe's; by "
        "default as in the scenario."
    )
    entry: list[str] | None = rare_option(
        "An entry with a deviation of its own: 'B[V,thrust]=0.6', lag=0.5, noise=0.5, "
        "delay=0.02 (s); may be repeated."
    )
    distribution: Distribution | None = rare_option(
        "Distribution of the deviations: uniform, normal with three standard deviations at "
        "the limit, or only the two limits."
    )
    score: list[str] | None = rare_option(
        "Unit by which the score divides the rms error of an output, SI, as in q=0.02; once for "
        "each output."
    )
    seed: int = option("Seed of the aircraft.", default=1, min=0)
    sweep: str | None = option(
        "Repeat the campaign with a controller parameter, or its value in one channel, times "
        "each factor: beta=0.5,1,2 or 'beta[V]=0.5,1,2'."
    )
    duration: float | None = option("Duration of each flight, s; by default as in the scenario.")
    chunk: int | None = rare_option(
        "Aircraft computed at once; by default 1000, on a GPU as many as its memory holds, and 4 "
        "with a learner or a route.",
        min=1,
    )
    engine: EngineName | None = option(
        "Compute in threads of this process, or in processes and on hosts of dask; by default "
        "dask if there is a learner or a route."
    )
    workers: int | None = rare_option(
        "Number of threads or processes; by default one per core.", min=1
    )
    scheduler: str | None = rare_option("Address of a dask scheduler, as in tcp://host:8786.")
    runs: Path = rare_option(
        "Folder in which the folder of the campaign is made.", default=Path("runs")
    )
    rows: Path | None = option(
        "Parquet file to write, with one row for each aircraft: figures, outcome, drawn entries."
    )
    as_json: bool = json_option()

    def execute(self) -> None:
        """Begin or continue the campaign, fly the missing aircraft, and print the results."""
        engines.require_jax(shared=self.engine is EngineName.DASK)
        if self.engine is not EngineName.DASK:
            require_unused(self, ["scheduler"], "--engine dask with it")
        if self.rows is not None:
            expected = "a file in a folder that exists"
            require(self.rows.parent.is_dir(), "rows", self.rows, expected)
        monte_carlo = self._continued() if Path(self.scenario).is_dir() else self._begun()
        is_single = is_flown_alone(monte_carlo.definition.scenario())
        from flight_campaign.batch.device import device_name  # noqa: PLC0415 - JAX takes a second

        place = "" if is_single or self.scheduler is not None else f" on {device_name()}"
        speed = _fly_missing(
            monte_carlo, self._engine(is_single=is_single), place, quiet=self.as_json
        )
        figures, results = write_results(monte_carlo)
        if self.rows is not None:
            with writing("rows", self.rows, "the path of a file"):
                monte_carlo.write_rows(self.rows)
        if self.as_json:
            print_json(figures)
            return
        _show_cases(Console(), monte_carlo, figures["cases"], results)
        if speed is not None:
            print(f"flown:   {speed:,.0f} aircraft-seconds per second{place}")
        print(
            f"folder:  {display_path(monte_carlo.folder)}\nreport:  "
            f"{display_path(monte_carlo.folder / REPORT)}"
        )

    def _continued(self) -> MonteCarlo:
        """Load the campaign in a folder. Raises ParameterError if options define a new one."""
        for name in OF_DEFINITION:
            source = self.context.get_parameter_source(name)
            is_default = source is None or source.name != "COMMANDLINE"
            expected = "none: the folder of a campaign holds its definition"
            require(is_default, name, "the folder of a campaign beside it", expected)
        return MonteCarlo.resume(Path(self.scenario))

    def _begun(self) -> MonteCarlo:
        """Define a new campaign of the scenario."""
        scenario = find_scenario(self.scenario, self.duration)
        quick_learner(scenario)  # refuses a scenario with which the aircraft could not learn
        spread = scenario.aircraft.uncertainty.spread()
        if self.entry is not None:
            entries = named_numbers("entry", self.entry, "A[q,alpha]=0.6")
            spread = spread._replace(entries=entries)
        if self.distribution is not None:
            spread = spread._replace(distribution=self.distribution)
        definition = define(
            scenario,
            aircraft=self.aircraft,
            uncertainty=self.uncertainty,
            seed=self.seed,
            chunk=self.chunk,
            sweep=None if self.sweep is None else _parse_sweep(self.sweep),
            wind=self.wind,
            spread=spread,
            units=None if self.score is None else named_numbers("score", self.score, "q=0.02"),
        )
        return MonteCarlo.begin(new_run(scenario, self.runs, "campaign-"), definition)

    def _engine(self, *, is_single: bool) -> engines.Engine:
        """Return the engine that the user named, or dask if aircraft fly one by one."""
        engine_name = self.engine or (EngineName.DASK if is_single else EngineName.THREADS)
        if engine_name is EngineName.THREADS:
            return engines.threads(self.workers)
        return engines.dask(self.workers, self.scheduler, on_devices=not is_single)


def _show_cases(
    console: Console, monte_carlo: MonteCarlo, cases: Sequence[dict[str, Any]], results: MetricTable
) -> None:
    """Print the results and the influences of each case, and the table of all cases."""
    definition = monte_carlo.definition
    for case, figures in enumerate(cases):
        _show(console, definition, case, monte_carlo.tally(case), figures)
        if figures["influence"]["entries"]:
            show_table(console, influence_table(definition.label(case), figures))
    show_table(console, results)


def _parse_sweep(text: str) -> Sweep:
    name, _, values = text.partition("=")
    factors = parse_numbers(values)
    fits = bool(factors) and all(map(math.isfinite, factors))
    require(
        fits,
        "--sweep",
        repr(text),
        "a parameter and factors, as in beta=0.5,1,2 or beta[V]=0.5,1,2",
    )
    return Sweep.validate_mapping(
        {"parameter": name.removeprefix("controller."), "factors": factors}, "--sweep"
    )


def _fly_missing(
    monte_carlo: MonteCarlo, engine: engines.Engine, place: str, *, quiet: bool
) -> float | None:
    """Fly the missing chunks, and return the speed: flown seconds of all aircraft per second.

    Returns None if no chunk was missing. `place` is a text on where the campaign is computed, such
    as " on NVIDIA H200".
    """
    definition = monte_carlo.definition
    total = definition.aircraft * definition.cases
    missing = monte_carlo.missing()
    stored_count = total - sum(definition.size(job) for job in missing)
    if not missing:
        return None
    seconds = definition.scenario().flight.duration
    begin = time.monotonic()
    aircraft_count = 0
    try:
        with progress_bar(*COUNT_COLUMNS, SHOWN_COLUMN, quiet=quiet) as bar:
            task = bar.add_task(
                "aircraft", total=total, completed=stored_count, shown=f"starting{place}"
            )
            for flights in monte_carlo.fly(engine, quick_learner):
                aircraft_count += flights
                speed = aircraft_count * seconds / (time.monotonic() - begin)
                bar.update(
                    task,
                    completed=stored_count + aircraft_count,
                    shown=f"{speed:,.0f} aircraft-seconds per second{place}",
                )
    except KeyboardInterrupt:
        print(
            f"interrupted after {stored_count + aircraft_count} of {total}; continue with:"
            f" rise-di campaign {shlex.quote(display_path(monte_carlo.folder))}"
        )
        raise typer.Exit(INTERRUPTED) from None
    return aircraft_count * seconds / (time.monotonic() - begin)


def _show(
    console: Console, definition: Definition, case: int, tally: Tally, figures: dict[str, Any]
) -> None:
    units = QUANTITY_UNITS | display_units(definition.scenario(case))
    title = (
        f"\n{definition.name}: {tally.flights} aircraft within "
        f"+-{100 * definition.uncertainty:g} %, seed {definition.seed}"
    )
    title += f", effect of wind {WIND_EFFECTS[definition.wind]}"
    if definition.sweep is not None:
        title += f", {definition.sweep.parameter} times {definition.factor(case):g}"
    table = new_table(escape(title), ("figure", *FIGURE_HEADINGS))
    for row in figure_rows(tally, units):
        table.add_row(*row)
    print_table(console, table)
    for word, count in (
        ("diverged", tally.diverged),
        (f"lost track (score above {LOSS_OF_TRACK_SCORE:g})", tally.lost),
    ):
        share, low, high = tally.share(count)
        console.print(
            f"{word}: {count} of {tally.flights}, {100 * share:.3g} % (95 %: {100 * low:.2g} to "
            f"{100 * high:.2g})"
        )
    if (unmodelled := tally.without_model()) is not None:
        console.print(
            f"without a model: {unmodelled} of {tally.flights}; fallbacks: to the initial law"
        )
    for flight in figures["fly_again"]:
        score = "diverged" if flight["score"] is None else f"score {flight['score']:.3g}"
        say(
            console,
            f"worst: aircraft {flight['number']}, {score}; again: {flight['command']} (or "
            "--lockstep, over topics)",
        )
