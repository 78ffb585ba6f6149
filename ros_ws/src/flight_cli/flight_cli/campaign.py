# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di campaign`: a Monte Carlo campaign, a scenario flown by thousands of uncertain aircraft."""

import json
import math
import shlex
import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from aircraft_sim.uncertainty import WindEffect
from flight_analysis.closed_loop.scenario import scenario_yaml
from flight_analysis.report.margins import margins_as_json
from flight_analysis.report.run_folder import REPORT, SUMMARY, new_run
from flight_analysis.report.summary import QUANTITY_UNITS, display_units, finite_or_null
from flight_analysis.report.tables import Table
from flight_bringup.scenarios import find_scenario
from flight_campaign import engines
from flight_campaign.campaign import Campaign, Definition, Sweep, define
from flight_campaign.campaign_report import (
    FIGURE_HEADINGS,
    WIND_EFFECTS,
    figure_rows,
    overview,
    write_page,
)
from flight_campaign.statistics import LOSS_OF_TRACK_SCORE, Tally
from flight_cli.output import (
    COUNT_COLUMNS,
    INTERRUPTED,
    SHOWN_COLUMN,
    display_path,
    new_table,
    parse_numbers,
    print_json,
    progress_bar,
)
from flight_core.files import write_file, writing
from flight_core.installation import require_package
from flight_core.parameters import require

CHUNK = 1000  # aircraft computed at once
OF_DEFINITION = ("aircraft", "uncertainty", "wind", "seed", "sweep", "duration", "chunk", "runs")  # options of a new campaign
RERUN = 3  # scenarios are written for so many of the worst aircraft of a case


class EngineName(StrEnum):
    """Where chunks are computed."""

    THREADS = "threads"
    DASK = "dask"


def campaign(
    context: typer.Context,
    scenario: Annotated[
        str | None, typer.Argument(help="Name of a scenario, or path of a scenario file (.yaml); none with --resume.")
    ] = None,
    aircraft: Annotated[int, typer.Option(min=1, help="How many uncertain aircraft.")] = 1000,
    uncertainty: Annotated[float, typer.Option(help="Largest relative deviation of each entry of A and B, 0 to 1.")] = 0.3,
    wind: Annotated[
        WindEffect | None,
        typer.Option(help="Effect of wind: by each aircraft's own A, or that of the airframe; by default the scenario's."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the aircraft.")] = 1,
    sweep: Annotated[
        str | None, typer.Option(help="A controller parameter and factors to multiply it by, as in beta=0.5,1,2.")
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Seconds to fly, in place of the scenario's.")] = None,
    chunk: Annotated[
        int | None,
        typer.Option(min=1, help="Aircraft computed at once. Use more on a GPU."),
    ] = None,
    engine: Annotated[EngineName, typer.Option(help="Threads of this process, or processes and hosts of dask.")] = (
        EngineName.THREADS
    ),
    workers: Annotated[int | None, typer.Option(min=1, help="Threads or processes; by default one a core.")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a dask scheduler, as in tcp://host:8786.")] = None,
    runs: Annotated[Path, typer.Option(help="Folder that the campaign's folder is made in.")] = Path("runs"),
    resume: Annotated[Path | None, typer.Option(help="Folder of an interrupted campaign to continue.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON, nothing else.")] = False,
) -> None:
    """Fly a Monte Carlo campaign: thousands of uncertain aircraft around the airframe of a scenario, many at once.

    Exit status: 0 all flown, 2 bad input, 130 interrupted; --resume continues it.
    """
    require_package("jax")
    require((scenario is None) == (resume is not None), "SCENARIO", scenario, "one of a scenario and --resume")
    require(scheduler is None or engine is EngineName.DASK, "--scheduler", scheduler, "--engine dask with it")
    if resume is not None:
        for name in OF_DEFINITION:
            given = context.get_parameter_source(name)
            own = given is None or given.name != "COMMANDLINE"
            require(own, f"--{name}", "it beside --resume", "none: the folder of a campaign holds its definition")
        monte_carlo = Campaign.resume(resume)
    else:
        chosen = find_scenario(str(scenario), duration)
        size = chunk or CHUNK
        definition = define(chosen, aircraft, uncertainty, seed, size, None if sweep is None else _parse_sweep(sweep), wind)
        monte_carlo = Campaign.begin(new_run(chosen, runs, "campaign-"), definition)
    flies = engines.threads(workers) if engine is EngineName.THREADS else engines.dask(workers, scheduler)
    speed = _fly_missing(monte_carlo, flies, quiet=as_json)
    with writing("", monte_carlo.folder, "a folder and a disk that can"):
        figures, results = _write_results(monte_carlo)
    if as_json:
        print_json(figures)
        return
    console = Console()
    for case in range(monte_carlo.definition.cases):
        _show(console, monte_carlo.definition, case, monte_carlo.tally(case), figures["cases"][case])
    table = new_table(f"\n{results.caption}", ("figure", *(column.head for column in results.columns)), left=("figure",))
    for row in results.rows:
        table.add_row(*row)
    console.print(table)
    console.print(results.legend, style="dim", highlight=False, soft_wrap=True)
    if speed is not None:
        print(f"flown:   {speed:,.0f} aircraft-seconds per second")
    print(f"folder:  {display_path(monte_carlo.folder)}\nreport:  {display_path(monte_carlo.folder / REPORT)}")


def _parse_sweep(text: str) -> Sweep:
    name, _, values = text.partition("=")
    factors = parse_numbers(values)
    fits = bool(factors) and all(map(math.isfinite, factors))
    require(fits, "--sweep", repr(text), "a parameter and factors, as in beta=0.5,1,2")
    return Sweep(parameter=name.removeprefix("controller."), factors=tuple(factors))


def _fly_missing(monte_carlo: Campaign, engine: engines.Engine, *, quiet: bool) -> float | None:
    """Fly the chunks that are missing; aircraft-seconds per second, None if none is."""
    definition = monte_carlo.definition
    total, missing = definition.aircraft * definition.cases, monte_carlo.missing()
    there = total - sum(definition.size(job) for job in missing)
    if not missing:
        return None
    seconds, begin, done = definition.scenario().flight.duration, time.monotonic(), 0
    try:
        with progress_bar(*COUNT_COLUMNS, SHOWN_COLUMN, quiet=quiet) as bar:
            task = bar.add_task("aircraft", total=total, completed=there, shown="compiling")
            for flights in monte_carlo.fly(engine):
                done += flights
                speed = done * seconds / (time.monotonic() - begin)
                bar.update(task, completed=there + done, shown=f"{speed:,.0f} aircraft-seconds per second")
    except KeyboardInterrupt:
        print(
            f"interrupted after {there + done} of {total}; continue with:"
            f" rise-di campaign --resume {shlex.quote(display_path(monte_carlo.folder))}"
        )
        raise typer.Exit(INTERRUPTED) from None
    return done * seconds / (time.monotonic() - begin)


def _write_results(monte_carlo: Campaign) -> tuple[dict[str, Any], Table]:
    """Write the summary, the report and the scenarios of the worst aircraft; returns the summary and the overview."""
    definition = monte_carlo.definition
    tallies = [monte_carlo.tally(case) for case in range(definition.cases)]
    margins = [monte_carlo.margins(case) for case in range(definition.cases)]
    cases = [
        {"factor": definition.factor(case), **tally.summary(), "fly_again": _write_worst(monte_carlo, case, tally)}
        | {"margins": None if of_loop is None else margins_as_json(of_loop)}
        for case, (tally, of_loop) in enumerate(zip(tallies, margins, strict=True))
    ]
    figures = {
        "scenario": definition.name,
        "aircraft": definition.aircraft,
        "uncertainty": definition.uncertainty,
        "wind": definition.wind,
        "seed": definition.seed,
        "sweep": None if definition.sweep is None else definition.sweep.parameter,
        "cases": cases,
    }
    figures = finite_or_null(figures)
    write_file(monte_carlo.folder / SUMMARY, json.dumps(figures, indent=1))
    write_page(monte_carlo.folder / REPORT, definition, tallies, cases, margins)
    return figures, overview(definition, tallies, margins)


def _write_worst(monte_carlo: Campaign, case: int, tally: Tally) -> list[dict[str, Any]]:
    """Write the scenarios of the worst aircraft; returns them with the command that flies each."""
    again = []
    for flight in tally.worst[:RERUN]:
        suffix = "" if monte_carlo.definition.sweep is None else f"_{monte_carlo.definition.factor(case):g}"
        path = monte_carlo.folder / f"{monte_carlo.definition.name}{suffix}_{flight.number}.yaml"
        write_file(path, scenario_yaml(monte_carlo.definition.aircraft_scenario(flight.number, case)))
        command = f"rise-di fly {shlex.quote(display_path(path))} --in-process"
        again.append({"number": flight.number, "score": flight.score, "command": command})
    return again


def _show(console: Console, definition: Definition, case: int, tally: Tally, figures: dict[str, Any]) -> None:
    units = QUANTITY_UNITS | display_units(definition.scenario(case))
    title = f"\n{definition.name}: {tally.flights} aircraft within +-{100 * definition.uncertainty:g} %, seed {definition.seed}"
    title += f", effect of wind {WIND_EFFECTS[definition.wind]}"
    if definition.sweep is not None:
        title += f", {definition.sweep.parameter} times {definition.factor(case):g}"
    table = new_table(title, ("figure", *FIGURE_HEADINGS), left=("figure",))
    for row in figure_rows(tally, units):
        table.add_row(*row)
    console.print(table)
    for word, count in (("diverged", tally.diverged), (f"lost track (score above {LOSS_OF_TRACK_SCORE:g})", tally.lost)):
        share, low, high = tally.share(count)
        console.print(f"{word}: {count} of {tally.flights}, {100 * share:.3g} % (95 %: {100 * low:.2g} to {100 * high:.2g})")
    for flight in figures["fly_again"]:
        score = "diverged" if flight["score"] is None else f"score {flight['score']:.3g}"
        console.print(
            f"worst: aircraft {flight['number']}, {score}; again: {flight['command']} (or --lockstep, over topics)",
            soft_wrap=True,
            highlight=False,
        )
