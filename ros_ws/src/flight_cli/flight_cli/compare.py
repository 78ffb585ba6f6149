# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di compare`: RISE-DI and other control laws on the same aircraft, each tuned by the same procedure."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from control_laws.catalogue import LAWS
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.summary import display_units, finite_or_null
from flight_bringup.scenarios import find_scenario
from flight_campaign import law_comparison
from flight_campaign import tuning as gain_tuning
from flight_campaign.law_comparison import LawResult
from flight_cli.output import COUNT_COLUMNS, new_table, parse_numbers, progress_bar, write_text
from flight_core.parameters import require

SEEDS = (1, 2, 3)
NOTES = """
{titles}
sees: measurements beside y_m. y alone is gyros and airspeed; a full state is y and the other states without error;
  vanes give alpha and beta relative to the air without error. No real sensor is as good
score: sum of rms of the true error over {unit}; mean (worst) of {aircraft} aircraft a level,
  every entry of A and B off by up to the level, rows of angles known, seed {seed}; a few % are noise of the tuning
lost: loss of track, a score above 10, in % at each level; a diverged aircraft is lost and makes the mean infinite
rms, slew: of the true error and mean abs(u_dot), nominal aircraft, in the units of the airframe and mrad/s
delay: the largest delay of u in whole ticks at which the score stays below three times that without delay
"""
WIDTH = 160  # characters, the least width of the table


def compare(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario, or path of a scenario file (.yaml).")] = "osprey_servo",
    aircraft: Annotated[int, typer.Option(min=1, help="Uncertain aircraft at each level.")] = 200,
    uncertainty: Annotated[str, typer.Option(help="Largest relative deviations of A and B, as in 0.3,0.5")] = "0.3,0.5",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the uncertain aircraft.")] = 1,
    laws: Annotated[str | None, typer.Option(help="Laws to compare, by name: rise,pi,l1; all by default.")] = None,
    tuning: Annotated[
        str,
        typer.Option(help="What the gains were tuned on: nominal, uncertain, late (uncertain, inputs late on all of them)."),
    ] = "nominal,uncertain",
    tune: Annotated[
        bool, typer.Option("--tune", help="First tune the laws that have no gains for this scenario: minutes a law.")
    ] = False,
    gains: Annotated[Path | None, typer.Option(help="File of tuned gains; by default the one of the stack.")] = None,
    to_json: Annotated[Path | None, typer.Option("--json", help="File to write the figures to, SI.")] = None,
) -> None:
    """Fly RISE-DI and other laws side by side: same aircraft, reference, gusts, noise, limits, uncertainty, tuning procedure.

    Exit status: 0, or 2 bad input.
    """
    names = list(LAWS) if laws is None else laws.split(",")
    gain_tuning.require_laws(names)
    aims = tuning.split(",")
    for aim in aims:
        require(aim in gain_tuning.OBJECTIVES, "--tuning", repr(aim), ", ".join(gain_tuning.OBJECTIVES))
    levels = parse_numbers(uncertainty)
    fits = bool(levels) and all(0.0 <= level < 1.0 for level in levels)
    require(fits, "--uncertainty", repr(uncertainty), "parts of each entry, each at least 0 and below 1: 0.3,0.5")
    chosen = find_scenario(scenario)
    benchmark, path = gain_tuning.build_benchmark(chosen), gains or gain_tuning.tuned_file(chosen)
    known = gain_tuning.load(path)
    results = []
    with progress_bar(*COUNT_COLUMNS) as bar:
        wanted = [(name, aim) for name in names for aim in aims if aim not in known.get(name, {})]
        for name, aim in wanted if tune else ():
            task = bar.add_task("", total=gain_tuning.generation_count(LAWS[name], benchmark))

            def show_cost(generation: int, least: float, task: Any = task, shown: str = f"tuning {name}, {aim}") -> None:
                bar.update(task, completed=generation, description=f"{shown}: cost {least:.3f}")

            known.setdefault(name, {})[aim] = gain_tuning.tune(LAWS[name], aim, benchmark, SEEDS, progress=show_cost)
            gain_tuning.save(path, known, f"rise-di compare {scenario} --tune --tuning {tuning}")
        tuned = {name: {aim: known[name][aim] for aim in aims if aim in known[name]} for name in names if name in known}
        require(any(tuned.values()), "--laws", "tuned gains for none of them", f"gains in {path}, or --tune, which finds them")
        task = bar.add_task("comparing", total=sum(len(by_aim) for by_aim in tuned.values()))
        for one in law_comparison.compare(benchmark, tuned, aircraft, levels, seed):
            results.append(one)
            bar.advance(task)
    console, units = Console(), display_units(chosen)
    console.width = max(console.width, WIDTH)
    for aim in aims:
        console.print(_table(gain_tuning.OBJECTIVES[aim], [one for one in results if one.objective == aim], chosen))
    titles = "\n".join(f"{name}: {LAWS[name].title}; knows {LAWS[name].model_data or 'no model'}" for name in tuned)
    counted = zip(chosen.controller.outputs, benchmark.unit, strict=True)
    unit = ", ".join(f"{one * units[name].factor:g} {units[name].unit} of {name}" for name, one in counted)
    console.print(NOTES.strip().format(titles=titles, unit=unit, aircraft=aircraft, seed=seed), style="dim", highlight=False)
    if wanted and not tune:
        missing = ", ".join(f"{name} ({aim})" for name, aim in wanted)
        console.print(f"without tuned gains (--tune finds them): {missing}")
    if to_json is not None:
        rows = [_as_json(one, chosen) for one in results]
        figures = {"scenario": chosen.name, "aircraft": aircraft, "seed": seed, "laws": rows}
        write_text("--json", to_json, json.dumps(figures, indent=1) + "\n")


def _table(tuned_on: str, found: Sequence[LawResult], scenario: Scenario) -> Table:
    units, channels, of = display_units(scenario), scenario.aircraft.channels(), " / ".join
    levels = [f"+-{100.0 * level.uncertainty:g} %" for level in found[0].levels] if found else []
    inputs = "slew\n" + of(name[:4] for name in channels.inputs)
    heads = ("law", "sees", "nominal", *levels, "lost\n%", f"rms\n{of(channels.outputs)}", inputs, "delay\nms")
    table = new_table(f"{scenario.name}, each law tuned on {tuned_on}", heads, left=("law", "sees"))
    for one in found:
        rms, slew = _by_name(one, scenario)
        table.add_row(
            one.law,
            LAWS[one.law].measurements,
            f"{one.score:.2f}",
            *(f"{level.mean:.2f} ({level.worst:.2f})" for level in one.levels),
            of(f"{100.0 * level.lost:g}" for level in one.levels),
            of(f"{rms[name] * units[name].factor:.2g}" for name in channels.outputs),
            of(f"{slew[name] * units[name].factor:.0f}" for name in channels.inputs),
            f"{1e3 * one.delay:.0f}",
        )
    return table


def _by_name(one: LawResult, scenario: Scenario) -> tuple[dict[str, float], dict[str, float]]:
    """Errors by output and slew by input, SI."""
    controller = scenario.controller
    rms = dict(zip(controller.outputs, one.rms.tolist(), strict=True))
    return rms, dict(zip(controller.inputs, one.slew.tolist(), strict=True))


def _as_json(one: LawResult, scenario: Scenario) -> dict[str, Any]:
    """Figures of a law for JSON: SI, null for an infinite figure."""
    rms, slew = _by_name(one, scenario)
    sees, levels = LAWS[one.law].measurements, [level._asdict() for level in one.levels]
    row = {"law": one.law, "sees": sees, "tuned_on": one.objective, "score": one.score, "levels": levels}
    return {**finite_or_null(row), "rms": rms, "slew": slew, "delay": one.delay}
