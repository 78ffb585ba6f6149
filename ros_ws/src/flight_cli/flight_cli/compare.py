# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di compare`, which compares RISE-DI with other laws on the same aircraft.

The same procedure tunes every law.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from aircraft_sim.uncertainty import WindEffect
from control_laws.catalogue import LAWS, Law
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.input_margins import Margins
from flight_analysis.linear_loop.loop_margins import loop_margins, scenario_loop
from flight_analysis.report.display_units import display_units
from flight_analysis.report.summary import finite_or_null
from flight_campaign import engines
from flight_campaign.campaign_report import WIND_EFFECTS
from flight_campaign.comparison import law_comparison, registered_laws, tuned_controller
from flight_campaign.comparison import tuning as gain_tuning
from flight_campaign.comparison.law_comparison import LawResult
from flight_campaign.comparison.tuning import Benchmark
from flight_cli.output import (
    COUNT_COLUMNS,
    LICENCE,
    new_table,
    parse_numbers,
    print_table,
    progress_bar,
    say,
    write_text,
)
from flight_cli.words import (
    argument,
    list_of,
    option,
    rare_option,
    scenario_names,
    values_of,
    write_option,
)
from flight_core.files import display_path
from flight_core.parameters import require
from flight_design.gains import tuned_gains
from flight_design.gains.gain_yaml import section_yaml
from flight_design.gains.tuned_gains import TuningResult
from rise_di_controller.params import ControllerConfig

SEEDS = (1, 2, 3)
NOTES = """
{titles}
sees: what the law measures, apart from y_m. y alone is gyros and airspeed; a full state is y and the other states without error;
  vanes give alpha and beta relative to the air without error. No real sensor is as good
knows: what the law knows of the nominal aircraft, apart from D; Omega_ii alone is the scale of the inputs
gust: the wind of the scenario. turbulence: Dryden at {altitude:g} m, {intensity}
score: sum of the rms of the true error over {unit}; mean (worst) of the aircraft of a level. Every entry of A and B is off by
  up to the level, except the rows of angles, which are known; differences of a few % are noise of the tuning
lost: share of the aircraft that lose track in gusts: their score is above 10. A diverged aircraft is lost and makes the mean infinite
slew: mean abs(u_dot) of the nominal aircraft in gusts, in the units of the airframe
margins: least phase margin, deg, and largest sensitivity of the linear loop on the nominal aircraft, with u in time and one input
  open; none if no linear loop leads from y alone to u
cost: the least of {seeds} seeds of the tuning, and the difference to the largest. It is the mean of score + slew over
  {slew}, of the nominal and {uncertain} uncertain aircraft at +-{level:g} %, once with u in time and once late:
{costs}
"""  # noqa: E501 - a text as it is written


Gains = dict[str, dict[str, TuningResult]]


class Contest(NamedTuple):
    """The laws to compare, and the file with their tuned gains."""

    scenario: Scenario
    names: Sequence[str]
    aims: Sequence[str]  # objectives for which the gains are tuned
    controllers: Mapping[str, ControllerConfig | None]  # None for a law that is tuned
    entries: Mapping[str, Law]
    path: Path

    def untuned(self) -> list[tuple[str, str]]:
        """Return the pairs of law and objective for which the file has no gains."""
        tunings = tuned_gains.load(self.path)
        pairs = product(self.names, self.aims)
        return [(name, aim) for name, aim in pairs if aim not in tunings.get(name, {})]

    def tune(self, command: str, bar: Progress) -> None:
        """Tune each law for each objective, and write the file after each law."""
        benchmark = self.benchmark()
        for name, aim in self.untuned():
            law = self.entries[name]
            task = bar.add_task("", total=gain_tuning.generation_count(law, benchmark))

            def show_cost(
                generation: int,
                least: float,
                task: Any = task,
                text: str = f"tuning {name}, {aim}",
            ) -> None:
                bar.update(task, completed=generation, description=f"{text}: cost {least:.3f}")

            objective = gain_tuning.OBJECTIVES[aim]
            result = gain_tuning.tune(law, objective, benchmark, SEEDS, progress=show_cost)
            tunings = tuned_gains.load(self.path)
            tunings.setdefault(name, {})[aim] = result
            tuned_gains.save(self.path, tunings, list(gain_tuning.OBJECTIVES), command)

    def benchmark(self, *seed: int) -> Benchmark:
        """Build the winds and the aircraft of the comparison.

        For the tuning, the turbulence has a fixed seed. `seed` replaces this seed.
        """
        build = gain_tuning.build_benchmark(self.scenario, *seed)
        return registered_laws.with_courses(build, self.controllers)

    def tuned(self) -> Gains:
        """Return the gains by law and objective.

        They come from the file. For a law without gains in the file, they come from the controller
        of the law. Raises ParameterError if no law has gains.
        """
        tunings = tuned_gains.load(self.path)
        gains: Gains = {}
        for name in self.names:
            law_tunings = tunings.get(name, {})
            gains[name] = {aim: law_tunings[aim] for aim in self.aims if aim in law_tunings}
            if (controller := self.controllers[name]) is not None:
                row = dict.fromkeys(self.aims, registered_laws.as_tuned(controller))
                gains[name] = row | gains[name]
        expected = f"gains in {self.path}, or --tune, which finds them"
        require(any(gains.values()), "--laws", "tuned gains for none of them", expected)
        return gains


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Fly RISE-DI and other laws side by side.

    The aircraft, the reference, the winds, the noise, the limits, the uncertainty and the tuning
    are the same for all. Exit status: 0, or 2 bad input.
    """

    scenario: str = argument(
        "Name of a scenario, or path of a scenario file (.yaml).",
        default="osprey_servo",
        autocompletion=scenario_names,
    )
    aircraft: int = option("Number of uncertain aircraft at each level.", default=200, min=1)
    uncertainty: str = option(
        "Levels: largest relative deviations of A and B, as in 0.3,0.5.", default="0.3,0.5"
    )
    seed: int = option("Seed of the uncertain aircraft.", default=1, min=0)
    wind: WindEffect | None = rare_option(
        "Whose A the wind acts through: each aircraft's own, or the airframe's; by "
        "default as in the scenario."
    )
    laws: str | None = option(
        "Names of the laws to compare, as in rise,pi,l1; by default all. A scenario file in place "
        "of a name stands for its controller.",
        autocompletion=list_of(LAWS),
    )
    tuning: str = option(
        f"What the gains were tuned on: {', '.join(gain_tuning.OBJECTIVES)}.",
        default="gust_turbulence",
    )
    tune: bool = option(
        "First tune the laws that have no gains for this scenario; each takes minutes.",
        default=False,
    )
    turbulence_seed: int = rare_option(
        "Seed of the turbulence; it must differ from the seed of the tuning.",
        default=law_comparison.TURBULENCE_SEED,
        min=0,
    )
    gains: Path | None = rare_option("File of tuned gains; by default the one that ships.")
    write: Path | None = write_option(
        "File for the gains of one law, as a section of a scenario that flies with the score shown."
    )
    to_json: Path | None = option("File to write the figures to, in SI.", "--json")

    def execute(self) -> None:
        """Tune laws without gains, fly every law, and print and write the results."""
        engines.require_jax()
        names = list(LAWS) if self.laws is None else self.laws.split(",")
        aims = self.tuning.split(",")
        levels = parse_numbers(self.uncertainty)
        _check_options(aims, levels, self.uncertainty, self.turbulence_seed)
        if self.write is not None:
            _require_one_law(names, aims)
        contest = self._contest(names, aims)
        gains: Gains
        with progress_bar(*COUNT_COLUMNS) as bar:
            if self.tune:
                contest.tune(self._command(), bar)
            gains = contest.tuned()
            benchmark = contest.benchmark(self.turbulence_seed)
            task = bar.add_task("comparing", total=sum(len(by_aim) for by_aim in gains.values()))
            results = []
            for result in law_comparison.compare(
                benchmark, gains, self.aircraft, levels, self.seed, laws=contest.entries
            ):
                results.append(result)
                bar.advance(task)
        console = Console()
        self._show(console, contest, results, benchmark, gains)
        if self.write is not None:
            law, aim = contest.names[0], aims[0]
            _write(self.write, law, aim, gains[law][aim], benchmark)
            console.print(f"controller: {display_path(self.write)}")
        if self.to_json is not None:
            write_text("--json", self.to_json, self._as_json(contest, results))

    def _contest(self, names: Sequence[str], aims: Sequence[str]) -> Contest:
        """Return the laws to compare. The law of a scenario file has the name of the file."""
        scenario = find_scenario(self.scenario)
        if self.wind is not None:
            uncertainty = scenario.aircraft.uncertainty.model_dump() | {"wind": self.wind}
            scenario = scenario.vary(aircraft={"uncertainty": uncertainty})
        files = {Path(name).stem: name for name in names if name.endswith(".yaml")}
        others = {stem: find_scenario(file) for stem, file in files.items()}
        laws = [Path(name).stem if name.endswith(".yaml") else name for name in names]
        controllers = registered_laws.find_laws(laws, scenario, others)
        entries = registered_laws.entries(controllers)
        path = self.gains or tuned_gains.tuned_file(scenario)
        return Contest(
            scenario=scenario,
            names=laws,
            aims=aims,
            controllers=controllers,
            entries=entries,
            path=path,
        )

    def _command(self) -> str:
        """Return the command that repeats the tuning, for a comment in the file of gains."""
        wind = "" if self.wind is None else f" --wind {self.wind}"
        return f"rise-di compare {self.scenario} --tune{wind}"

    def _show(
        self,
        console: Console,
        contest: Contest,
        results: Sequence[LawResult],
        benchmark: Benchmark,
        gains: Gains,
    ) -> None:
        """Print a table for each objective, and a text that explains the words of the tables."""
        scenario = contest.scenario
        for aim in contest.aims:
            if results_of_aim := [result for result in results if result.objective == aim]:
                title = gain_tuning.OBJECTIVES[aim].title
                print_table(console, _table(title, results_of_aim, contest.entries, scenario))
        laws = {name: contest.entries[name] for name in gains if gains[name]}
        effect = WIND_EFFECTS[scenario.aircraft.uncertainty.wind]
        say(
            console,
            f"{_notes(scenario, benchmark, laws, contest.aims)}\n"
            f"{self.aircraft} aircraft a level, seed {self.seed}; effect of wind on x_dot {effect}"
            f"; turbulence of seed {self.turbulence_seed}, the tuning had "
            f"{gain_tuning.TUNING_TURBULENCE_SEED}",
            style="dim",
        )
        lacking = [row for row in contest.untuned() if contest.controllers[row[0]] is None]
        if lacking:
            missing = ", ".join(f"{name} ({aim})" for name, aim in lacking)
            console.print(f"without tuned gains (--tune finds them): {missing}")

    def _as_json(self, contest: Contest, results: Sequence[LawResult]) -> str:
        """Return the results of all laws as JSON, SI."""
        scenario = contest.scenario
        figures = {
            "scenario": scenario.name,
            **values_of(self, "aircraft", "seed"),
            "wind": scenario.aircraft.uncertainty.wind,
            "turbulence_seed": self.turbulence_seed,
            "laws": [_as_json(row, contest.entries[row.law], scenario) for row in results],
        }
        return json.dumps(figures, indent=1) + "\n"


def _check_options(
    aims: Sequence[str], levels: Sequence[float], uncertainty: str, turbulence_seed: int
) -> None:
    for aim in aims:
        require(
            aim in gain_tuning.OBJECTIVES, "--tuning", repr(aim), ", ".join(gain_tuning.OBJECTIVES)
        )
    fits = bool(levels) and all(0.0 <= level < 1.0 for level in levels)
    require(
        fits,
        "--uncertainty",
        repr(uncertainty),
        "fractions, each at least 0 and below 1: 0.3,0.5",
    )
    differs = turbulence_seed != gain_tuning.TUNING_TURBULENCE_SEED
    require(differs, "--turbulence-seed", turbulence_seed, "another seed than the tuning has")


def _require_one_law(names: Sequence[str], aims: Sequence[str]) -> None:
    single = len(names) == 1 and len(aims) == 1
    require(
        single,
        "--write",
        f"{len(names)} laws, {len(aims)} tunings",
        "one of each: --laws pi --tuning margins",
    )
    tuned_controller.require_registered(names[0])


def _write(path: Path, name: str, aim: str, result: TuningResult, benchmark: Benchmark) -> None:
    """Write the gains of a law to a file, as a section of a scenario."""
    controller = tuned_controller.tuned_controller(name, result, benchmark)
    airframe, _ = benchmark.scenario.aircraft.load()
    origin = f"by rise-di compare: law {name}, tuned on {aim} in {benchmark.scenario.name}"
    if LAWS[name].has_margins:
        margins = loop_margins(scenario_loop(benchmark.scenario, controller, 1))
    else:
        margins = None
    comments = {"delay": "s, beyond sampling: topics have none in the benchmark"}
    write_text(
        "--write", path, LICENCE + section_yaml(controller, airframe, margins, origin, comments)
    )


def _table(
    tuned_on: str, results: Sequence[LawResult], entries: Mapping[str, Law], scenario: Scenario
) -> Table:
    units = display_units(scenario)
    join_names = " / ".join
    levels = ("nominal", *(f"+-{100.0 * level.uncertainty:g} %" for level in results[0].levels))
    delays = "/".join(f"{1e3 * delay:g}" for delay in (0.0, *results[0].lost_late))
    heads = (
        "law",
        "sees",
        "knows",
        *(f"{wind}\n{level}" for wind, level in product(results[0].scores, levels)),
        f"lost, %, at {levels[1]},\nu late by, ms:\n{delays}",
        "slew\n" + join_names(name[:4] for name in scenario.controller.inputs),
        "margins:\ndeg, S",
        "cost",
    )
    table = new_table(
        f"{scenario.name}, each law tuned on {tuned_on}",
        heads,
        left_aligned=("law", "sees", "knows"),
    )
    for result in results:
        law = entries[result.law]
        losses = (result.levels[0].scores[gain_tuning.GUST].lost, *result.lost_late.values())
        slew = zip(scenario.controller.inputs, result.slew.tolist(), strict=True)
        table.add_row(
            result.law,
            law.measurements,
            law.model_data,
            *law_comparison.score_cells(result),
            "/".join(f"{100.0 * share:.3g}" for share in losses),
            join_names(f"{value * units[name].factor:.0f}" for name, value in slew),
            "none" if result.margins is None else _format_margins(result.margins),
            f"{min(result.costs):.2f} +{max(result.costs) - min(result.costs):.2f}"
            if result.costs
            else "own gains",
        )
    return table


def _format_margins(margins: Margins) -> str:
    if not margins.stable:
        return "unstable"
    return f"{np.degrees(margins.phase.min()):.0f}, {margins.sensitivity.max():.2f}"


def _notes(
    scenario: Scenario, benchmark: Benchmark, laws: Mapping[str, Law], aims: Iterable[str]
) -> str:
    """Return a text that explains the words of the tables."""
    units = display_units(scenario)
    controller = scenario.controller
    errors = zip(controller.outputs, benchmark.unit.tolist(), strict=True)
    slews = zip(controller.inputs, benchmark.activity_unit.tolist(), strict=True)
    delay = 1e3 * benchmark.model.period * benchmark.delay
    air = gain_tuning.turbulence_of(scenario)
    parts = {"wind": "m/s of wind at 20 ft", "sigma": "m/s rms at high altitude"}
    costs = []
    for aim in aims:
        objective = gain_tuning.OBJECTIVES[aim]
        winds = " + ".join(f"{weight:g} x {wind}" for wind, weight in objective.weights.items())
        whose = "all of them" if objective.is_all_late else "the nominal one"
        costs.append(f"{aim}: {winds}; u late by {objective.delay * delay:g} ms on {whose}")
    return NOTES.strip().format(
        titles="\n".join(f"{name}: {law.title}" for name, law in laws.items()),
        unit=", ".join(
            f"{error * units[name].factor:.3g} {units[name].unit} of {name}"
            for name, error in errors
        ),
        slew=", ".join(
            f"{slew * units[name].factor:.3g} {units[name].unit}/s of {name}"
            for name, slew in slews
        ),
        costs="\n".join(f"  {cost}" for cost in costs),
        uncertain=gain_tuning.UNCERTAIN_AIRCRAFT,
        level=100.0 * gain_tuning.UNCERTAINTY,
        seeds=len(SEEDS),
        altitude=air["altitude"],
        intensity=", ".join(f"{air[key]:g} {text}" for key, text in parts.items() if key in air),
    )


def _as_json(result: LawResult, law: Law, scenario: Scenario) -> dict[str, Any]:
    """Return the results of a law as a dict that JSON can hold, in SI.

    An infinite value becomes null, and so does the cost of gains that do not come from a search.
    """
    controller = scenario.controller
    levels = []
    for level in result.levels:
        by_wind = {wind: scores._asdict() for wind, scores in level.scores.items()}
        levels.append({"uncertainty": level.uncertainty} | by_wind)
    row = {
        "law": result.law,
        "sees": law.measurements,
        "knows": law.model_data,
        "tuned_on": result.objective,
    }
    return row | {
        "cost": min(result.costs, default=None),
        "spread": max(result.costs) - min(result.costs) if result.costs else None,
        "score": finite_or_null(result.scores),
        "levels": finite_or_null(levels),
        "late": [{"delay": delay, "lost": lost} for delay, lost in result.lost_late.items()],
        "rms": dict(zip(controller.outputs, result.rms.tolist(), strict=True)),
        "slew": dict(zip(controller.inputs, result.slew.tolist(), strict=True)),
        "margins": None if result.margins is None else _margins_as_json(result.margins),
    }


def _margins_as_json(margins: Margins) -> dict[str, Any]:
    """Return the least margins of a stable loop in SI, with phase in rad and gain as a factor."""
    least = {
        "phase": margins.phase.min(),
        "gain": margins.gain.min(),
        "sensitivity": margins.sensitivity.max(),
    }
    least |= {"damping": margins.damping}
    values = {name: float(value) for name, value in least.items()}
    return {"stable": bool(margins.stable)} | dict(finite_or_null(values))
