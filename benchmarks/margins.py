# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a phase margin costs in flight: scores and lost aircraft of laws that are tuned alike within four margins.

    python -m benchmarks.margins [--aircraft 200] [--json FILE]

Each law of LAWS_TUNED has the gains that a search finds from those of `rise-di compare` with the same cost, within the phase
margin, 6 dB, a sensitivity of 2 and a damping of 0.4. Beside them: the gains of `rise-di gains`, and the scenarios that ship.
"""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from aircraft_sim.airframe import load_airframe
from control_laws.catalogue import LAWS, Law
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_campaign import law_comparison, registered_laws
from flight_campaign.tuning import GUST, OBJECTIVES, as_gains, build_benchmark, tune
from flight_design.gains.gain_design import select_gains
from flight_design.gains.requirement import requirement
from flight_design.gains.tuned_gains import TuningResult, load, tuned_file

LAWS_TUNED = ("rise", "pi", "l1", "lqg", "rise_observer")
PHASE_MARGINS = (30.0, 40.0, 45.0, 60.0)  # deg
TUNED_ON = "gust_turbulence"
GENERATIONS, TUNING_SEED = 40, 1  # of each search: it begins at the gains that ship, or at those of a smaller margin
LEVELS, SEED = (0.3, 0.5), 1
LATE = 2  # ticks: 20 ms
OWN = "own"  # in place of the phase margin asked
SHIPPED = ("osprey_servo", "osprey_observer")
HEAD = (
    "| law | phase margin asked, deg | found | score +-30 % | +-50 % | lost, %, u 20 ms late: +-30 % | +-50 % |\n"
    + "|---" * 7
    + "|"
)


def searched(servo: Scenario) -> Iterator[tuple[str, str, TuningResult]]:
    """Law, phase margin asked, and the gains of the search within it."""
    benchmark, known = build_benchmark(servo), load(tuned_file(servo))
    for name in LAWS_TUNED:
        result = known[name][TUNED_ON]
        for phase_margin in PHASE_MARGINS:
            begin = LAWS[name]._replace(initial=as_gains(result))
            objective = OBJECTIVES[TUNED_ON]._replace(requirement=requirement(phase_margin, accept=True))
            result = tune(begin, objective, benchmark, (TUNING_SEED,), GENERATIONS)
            yield name, f"{phase_margin:g}", result


def flown(servo: Scenario, aircraft: int) -> Iterator[dict[str, Any]]:
    """A row for each law and phase margin; shares of lost aircraft from 0 to 1, phase margins in deg."""
    airframe = load_airframe("osprey")
    scenarios = {name: find_scenario(name) for name in SHIPPED}
    for phase_margin in PHASE_MARGINS:
        gains = select_gains(airframe, servo, samples=20, phase_margin=phase_margin, accept=True).chosen
        scenarios[f"{phase_margin:g}"] = replace(servo, controller=gains)
    controllers = registered_laws.find_laws(scenarios, servo, scenarios)
    laws: dict[str, Law] = LAWS | registered_laws.entries(controllers)
    tuned = {name: {OWN: registered_laws.as_tuned(own)} for name, own in controllers.items() if own is not None}
    for name, asked, result in searched(servo):
        tuned.setdefault(name, {})[asked] = result
    benchmark = registered_laws.with_courses(build_benchmark(servo, law_comparison.TURBULENCE_SEED), controllers)
    runs = [
        list(law_comparison.compare(benchmark, tuned, aircraft, levels, SEED, (LATE,), laws=laws))
        for levels in (LEVELS, LEVELS[1:])  # lost late is that of the first level
    ]
    for result, wide in zip(*runs, strict=True):
        scores = {f"{level.uncertainty:g}": level.scores[GUST] for level in result.levels}
        late = {f"{of.levels[0].uncertainty:g}": next(iter(of.lost_late.values())) for of in (result, wide)}
        of_gains = result.objective == OWN and result.law not in SHIPPED
        yield {
            "law": "rise_di by gains" if of_gains else result.law,
            "asked": result.law if of_gains else "-" if result.objective == OWN else result.objective,
            "found": None if result.margins is None else float(np.degrees(result.margins.phase.min())),
            "score": {level: {"mean": score.mean, "worst": score.worst} for level, score in scores.items()},
            "lost_late": late,
        }


def main(
    aircraft: Annotated[int, typer.Option(min=1, help="Uncertain aircraft at each level.")] = 200,
    to_json: Annotated[Path | None, typer.Option("--json", help="File to write the figures to.")] = None,
) -> None:
    """Print the table."""
    rows = list(flown(find_scenario("osprey_servo"), aircraft))
    print(HEAD)
    for row in rows:
        scores = [f"{score['mean']:.2f} ({score['worst']:.2f})" for score in row["score"].values()]
        late = [f"{100.0 * share:.3g}" for share in row["lost_late"].values()]
        print(f"| {row['law']} | {row['asked']} | {row['found']:.0f} | {' | '.join((*scores, *late))} |")
    if to_json is not None:
        to_json.write_text(json.dumps({"aircraft": aircraft, "seed": SEED, "rows": rows}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
