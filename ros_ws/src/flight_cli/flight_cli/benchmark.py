# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di benchmark`: the public benchmark, fixed sets of flights that any law can enter."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_campaign import engines
from flight_campaign.benchmark_entry import find_entry
from flight_campaign.benchmark_scores import SCORES, Flights, define, drawn_release
from flight_campaign.benchmark_scores import Benchmark as BenchmarkRun
from flight_campaign.benchmark_sets import RELEASE_LENGTH, SCENARIOS, VERSION, Sets
from flight_cli.output import (
    COUNT_COLUMNS,
    INTERRUPTED,
    new_table,
    print_json,
    print_table,
    progress_bar,
    say,
)
from flight_cli.words import REQUIRED, argument, json_option, option
from flight_core.files import display_path
from flight_core.parameters import require

FOLDER = "benchmark-"
DRAW = "draw"  # a release in place of a hash
LEGEND = (
    "score: sum of rms of the true error over the unit of a channel (10 mrad/s, p 20, V 0.1 "
    "m/s), of a mission the largest"
    " cross-track error in half seconds of flight; a lost aircraft counts 10"
)


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """Fly the public benchmark with a law, and write a file of scores. The same command continues
    an interrupted run.

    Exit status: 0 all flown, 2 bad input, 130 interrupted.
    """

    entry: list[str] = argument(
        "Scenarios whose controllers fly, one for each airframe; or a law of compare, "
        "as pi; or MODULE:FUNCTION.",
        default=REQUIRED,
    )
    aircraft: int = option(
        "Uncertain aircraft of a set; fewer to try an entry.", default=200, min=1
    )
    name: str | None = option("Name of the entry.")
    sees: str | None = option("What the law measures beside y_m, as in: y.")
    knows: str | None = option("What the law knows of the aircraft beside D, as in: Omega_ii.")
    release: str = option(
        "Hash of the commit of a release: fresh seeds; draw: hidden seeds, drawn now; by default "
        "the fixed seeds.",
        default="",
    )
    output: Path | None = option(
        "Folder of the run, which an interrupted run continues; by default in runs."
    )
    workers: int | None = option("Threads; by default one a core.", min=1)
    as_json: bool = json_option()

    def execute(self) -> None:
        """Fly what is missing, and show the scores."""
        engines.require_jax()
        fits = (
            self.release in ("", DRAW)
            or re.fullmatch(rf"[0-9a-f]{{{RELEASE_LENGTH}}}", self.release) is not None
        )
        expected = f"{DRAW}, or the hash of a commit, {RELEASE_LENGTH} hex digits"
        require(fits, "--release", self.release, expected)
        with Console(stderr=True, quiet=self.as_json).status("preparing"):
            known = {word: find_scenario(word) for word in SCENARIOS}
            entered = find_entry(
                self.entry, Sets(known), find_scenario, self.name, self.sees, self.knows
            )
            name = FOLDER + re.sub(r"[^\w.-]", "_", entered.name)
            folder = self.output or Path("runs") / name
            release = drawn_release(folder) if self.release == DRAW else self.release
            flights = Flights(entered, Sets(known, release))
            definition = define(flights, self.aircraft, version("rise-di"))
        run = BenchmarkRun(folder, definition, entered.sources)
        _fly(run, flights, engines.threads(self.workers), quiet=self.as_json)
        scores = run.scores()
        if self.as_json:
            print_json(scores)
            return
        _show(Console(), scores)
        print(f"scores: {display_path(run.folder / SCORES)}")


def _fly(run: BenchmarkRun, flights: Flights, engine: engines.Engine, *, quiet: bool) -> None:
    total = run.definition.flights
    missing = run.missing()
    completed = total - sum(map(run.definition.size, missing))
    try:
        with progress_bar(*COUNT_COLUMNS, quiet=quiet) as bar:
            task = bar.add_task("flights", total=total, completed=completed)
            for flown in run.fly(flights, engine):
                completed += flown
                bar.update(task, completed=completed)
    except KeyboardInterrupt:
        print(f"interrupted after {completed} of {total} flights; the same command continues")
        raise typer.Exit(INTERRUPTED) from None


def _show(console: Console, scores: Mapping[str, Any]) -> None:
    entry = scores["entry"]
    seeds = scores["benchmark"]["release"] or "fixed"
    title = (
        f"Benchmark {VERSION}, seeds {seeds}: {entry['name']} sees {entry['sees']}, knows "
        f"{entry['knows']}"
    )
    table = new_table(title, ("set", "flights", "score", "worst", "lost"), wrapped=("set",))
    for scored in scores["sets"].values():
        if "not_flown" not in scored:
            figures = (
                f"{scored['score']['mean']:.2f}",
                f"{scored['score']['worst']:.2f}",
                str(scored["lost"]),
            )
            table.add_row(scored["title"], str(scored["aircraft"]), *figures)
    print_table(console, table)
    for scored in scores["sets"].values():
        if "over_time" in scored:
            windows = ", ".join(
                f"{window} s {value:.2f}" for window, value in scored["over_time"].items()
            )
            say(console, f"over time, damage at 60 s: {windows}; recovery {scored['recovery']:.2f}")
    for scored in scores["sets"].values():
        if "not_flown" in scored:
            console.print(
                f"not flown: {scored['title']}: {scored['not_flown']}",
                highlight=False,
                markup=False,
            )
    say(console, LEGEND, style="dim")
