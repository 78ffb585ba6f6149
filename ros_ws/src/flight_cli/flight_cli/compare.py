# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di compare`: RISE-DI beside other laws, each tuned by the same procedure, on the same aircraft and course."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from control_laws.catalogue import LAWS
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.summary import display_units
from flight_bringup.scenarios import find_scenario
from flight_core.parameters import ParameterError, require

if TYPE_CHECKING:
    from flight_campaign.law_comparison import Compared

SEEDS = (1, 2, 3)
NOTES = """
{titles}
sees: of the flying aircraft, beside y_m. y alone is gyros and airspeed; a full state is y and the other states without error,
  vanes give alpha and beta relative to the air: no real sensor is as good, and laws that see y alone need none of them
score: sum of rms of the true error over {unit}; mean (worst) of {aircraft} aircraft a level,
  every entry of A and B off by up to the level, rows of angles known, seed {seed}; a few % are the tuning's noise
lost: aircraft with a score above 10, in % at each level; diverged ones are among them and make the mean infinite
rms, slew: of the true error and mean abs(u_dot), nominal aircraft, in the units of the airframe and mrad/s
delay: the most whole ticks by which u may come late with a score below three times that without
"""
WIDTH = 160  # characters, the least that the table takes, also into a file


def compare(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario, or path of a scenario file (.yaml).")] = "osprey_servo",
    aircraft: Annotated[int, typer.Option(min=1, help="Uncertain aircraft at each level.")] = 200,
    uncertainty: Annotated[str, typer.Option(help="Parts by which every entry of A and B may be off: 0.3,0.5")] = "0.3,0.5",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the uncertain aircraft.")] = 1,
    laws: Annotated[str | None, typer.Option(help="Laws to compare, by name: rise,pi,l1; all where left out.")] = None,
    tuning: Annotated[
        str,
        typer.Option(help="What the gains were tuned on: nominal, uncertain, late (uncertain, inputs late on all of them)."),
    ] = "nominal,uncertain",
    tune: Annotated[
        bool, typer.Option("--tune", help="First tune what has no gains for this scenario yet: minutes a law.")
    ] = False,
    gains: Annotated[Path | None, typer.Option(help="File of tuned gains, in place of the one that ships.")] = None,
    to_json: Annotated[Path | None, typer.Option("--json", help="File to write the figures to, SI.")] = None,
) -> None:
    """Fly RISE-DI and other laws side by side: same aircraft, reference, gusts, noise, limits, uncertainty, tuning procedure.

    Exit status: 0, or 2 bad input.
    """
    # here, for they take JAX along, half a second that no other command needs
    from flight_campaign import law_comparison as side_by_side  # noqa: PLC0415
    from flight_campaign import tuning as procedure  # noqa: PLC0415

    names = list(LAWS) if laws is None else laws.split(",")
    procedure.require_laws(names)
    aims = tuning.split(",")
    for aim in aims:
        require(aim in procedure.OBJECTIVES, "--tuning", repr(aim), ", ".join(procedure.OBJECTIVES))
    levels, chosen = _levels(uncertainty), find_scenario(scenario)
    here, path = procedure.benchmark(chosen), gains or procedure.file_of(chosen)
    known = procedure.load(path)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    found = []
    with Progress(*columns, console=Console(stderr=True)) as bar:
        wanted = [(name, aim) for name in names for aim in aims if aim not in known.get(name, {})]
        for name, aim in wanted if tune else ():
            task = bar.add_task("", total=procedure.length(LAWS[name], here))

            def told(generation: int, least: float, task: Any = task, shown: str = f"tuning {name}, {aim}") -> None:
                bar.update(task, completed=generation, description=f"{shown}: cost {least:.3f}")

            known.setdefault(name, {})[aim] = procedure.tune(LAWS[name], aim, here, SEEDS, progress=told)
            procedure.save(path, known, f"rise-di compare {scenario} --tune --tuning {tuning}")
        tuned = {name: {aim: known[name][aim] for aim in aims if aim in known[name]} for name in names if name in known}
        require(any(tuned.values()), "--laws", "tuned gains for none of them", f"gains in {path}, or --tune, which finds them")
        task = bar.add_task("comparing", total=sum(len(by_aim) for by_aim in tuned.values()))
        for one in side_by_side.compare(here, tuned, aircraft, levels, seed):
            found.append(one)
            bar.advance(task)
    console, units = Console(), display_units(chosen)
    console.width = max(console.width, WIDTH)
    for aim in aims:
        console.print(_table(procedure.OBJECTIVES[aim], [one for one in found if one.aims == aim], chosen))
    titles = "\n".join(f"{name}: {LAWS[name].title}; knows {LAWS[name].model or 'no model'}" for name in tuned)
    counted = zip(chosen.controller.outputs, here.unit, strict=True)
    unit = ", ".join(f"{one * units[name].factor:g} {units[name].unit} of {name}" for name, one in counted)
    console.print(NOTES.strip().format(titles=titles, unit=unit, aircraft=aircraft, seed=seed), style="dim", highlight=False)
    if wanted and not tune:
        missing = ", ".join(f"{name} ({aim})" for name, aim in wanted)
        console.print(f"left out, for there are no gains yet (--tune finds them): {missing}")
    if to_json is not None:
        rows = [_row(one, chosen) for one in found]
        _write(to_json, json.dumps({"scenario": chosen.name, "aircraft": aircraft, "seed": seed, "laws": rows}, indent=1))


def _levels(text: str) -> list[float]:
    try:
        levels = [float(part) for part in text.split(",")]
    except ValueError:
        levels = []
    fits = bool(levels) and all(0.0 <= level < 1.0 for level in levels)
    require(fits, "--uncertainty", repr(text), "parts of each entry, each at least 0 and below 1: 0.3,0.5")
    return levels


def _table(tuned_on: str, found: Sequence["Compared"], scenario: Scenario) -> Table:
    units, channels, of = display_units(scenario), scenario.aircraft.channels(), " / ".join
    table = Table(title=f"{scenario.name}, each law tuned on {tuned_on}", title_justify="left", box=box.SIMPLE_HEAD)
    levels = [f"+-{100.0 * level.uncertainty:g} %" for level in found[0].levels] if found else []
    inputs = "slew\n" + of(name[:4] for name in channels.inputs)
    heads = ("law", "sees", "nominal", *levels, "lost\n%", f"rms\n{of(channels.outputs)}", inputs, "delay\nms")
    for head in heads:
        table.add_column(head, justify="left" if head in {"law", "sees"} else "right", no_wrap=True)
    for one in found:
        rms, slew = _by_name(one, scenario)
        table.add_row(
            one.law,
            LAWS[one.law].sees,
            f"{one.score:.2f}",
            *(f"{level.mean:.2f} ({level.worst:.2f})" for level in one.levels),
            of(f"{100.0 * level.lost:g}" for level in one.levels),
            of(f"{rms[name] * units[name].factor:.2g}" for name in channels.outputs),
            of(f"{slew[name] * units[name].factor:.0f}" for name in channels.inputs),
            f"{1e3 * one.delay:.0f}",
        )
    return table


def _by_name(one: "Compared", scenario: Scenario) -> tuple[dict[str, float], dict[str, float]]:
    """Errors by output and slew by input, SI."""
    controller = scenario.controller
    rms = dict(zip(controller.outputs, one.rms.tolist(), strict=True))
    return rms, dict(zip(controller.inputs, one.slew.tolist(), strict=True))


def _row(one: "Compared", scenario: Scenario) -> dict[str, Any]:
    """Figures of a law as JSON has them: SI, null for what is infinite."""
    rms, slew = _by_name(one, scenario)

    def finite(value: float) -> float | None:
        return value if math.isfinite(value) else None

    levels = [
        {key: finite(value) if isinstance(value, float) else value for key, value in level._asdict().items()}
        for level in one.levels
    ]
    row = {"law": one.law, "sees": LAWS[one.law].sees, "tuned_on": one.aims, "score": finite(one.score), "levels": levels}
    return row | {"rms": rms, "slew": slew, "delay": one.delay}


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise ParameterError(
            f"--json: {path} cannot be written ({error.strerror or error}), expected the path of a file"
        ) from None
