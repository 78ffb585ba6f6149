# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure a campaign of aircraft that learn.

The figures are the processor seconds for each aircraft, and the share of the aircraft within 10 %
of the true model.

python -m benchmarks.campaign_learning  # 10 aircraft of osprey_learn for 64 s, five minutes

The rows are written to docs/evidence/tables/campaign-devices.csv.
"""

import math
import time
from typing import Annotated

import numpy as np
import typer
from benchmarks.campaign import SEED, UNCERTAINTY, write_rows
from benchmarks.evidence import origin
from benchmarks.tables import new_table
from rich.console import Console

from flight_analysis.closed_loop.learning_loop import Learn, LearnerResult
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics.errors import true_error
from flight_campaign.campaign import define
from flight_campaign.statistics import score, score_units
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS, period_ns
from flight_design.gains.gain_design import selected_observer
from flight_design.learning.scenario_learner import quick_learner
from rise_di_controller.learning.proposals import Event, EventKind
from rise_di_controller.rise_di_config import RiseDiConfig

SCENARIO, DURATION = "osprey_learn", 64.0  # s
# instant from which the score counts, s: from here on a model of a whole window of 30 s flies
LEARNED = 34.0
WITHIN = 1.1  # largest ratio to the score of the true model that counts as near it
CORES, MANY = 2, 1000  # cores and aircraft to which one row scales the processor time


class _Knowing:
    """A learner that proposes the true model at the first tick."""

    def __init__(self, scenario: Scenario, start: RiseDiConfig) -> None:
        assert start.observer is not None  # noqa: S101 - a controller that learns has one
        plain = start.model_copy(update={"learn": None})
        true = scenario.aircraft.sampled_airframe()
        try:
            margin = start.observer.margin
            design = selected_observer(plain, scenario, true, margin, uncertain=False).controller
        except ParameterError as error:
            self._next = LearnerResult(None, str(error))
        else:
            proposed = design.model_dump() | {"learn": start.model_dump()["learn"]}
            known = RiseDiConfig.validate_mapping(proposed, "proposal")
            self._next = LearnerResult(known, "the true model")

    def take(self, *_: object) -> None:
        """Do nothing, because nothing is left to learn."""

    def propose(self, *_: object) -> LearnerResult:
        """Propose the true model, once."""
        now = self._next
        self._next = LearnerResult(None, "")
        return now


def knowing(scenario: Scenario) -> Learn:
    """Return a function that makes a learner which knows the true model of the scenario."""
    return lambda start: _Knowing(scenario, start)


def score_of(scenario: Scenario, learn: Learn) -> float:
    """Fly an aircraft that learns, and return its score from LEARNED on.

    The score is NaN if the flight falls back to the initial law, or restarts there.
    """
    events: list[Event] = []
    tape = simulate(scenario, learn=learn, announce=events.append)
    if any(event.kind in {EventKind.FALLBACK, EventKind.RESTART} for event in events):
        return math.nan
    error = true_error(tape)
    assert error is not None  # noqa: S101 - a simulated flight has the truth
    period = period_ns(scenario.controller.rate, "controller.rate")
    late = (error.stamp_ns % period == 0) & (error.stamp_ns >= LEARNED * NANOSECONDS)
    outputs = scenario.controller.outputs
    rms = np.array([[np.sqrt(np.mean(error[name][late] ** 2))] for name in outputs])
    units = score_units(outputs, scenario.aircraft.channels().outputs, {})
    return float(score(rms, units)[0])


def main(
    aircraft: Annotated[int, typer.Option(min=1, help="Aircraft that learn.")] = 10,
) -> None:
    """Print and write the figures."""
    begun = origin("python -m benchmarks.campaign_learning")
    definition = define(
        find_scenario(SCENARIO, DURATION),
        aircraft=aircraft,
        uncertainty=UNCERTAINTY,
        seed=SEED,
        chunk=aircraft,
    )
    flown = [definition.aircraft_scenario(number) for number in range(aircraft)]
    true = np.array([score_of(each, knowing(each)) for each in flown])
    make = quick_learner(flown[0])
    assert make is not None  # noqa: S101 - the scenario learns
    begin = time.process_time()
    learned = np.array([score_of(each, make) for each in flown])
    took = (time.process_time() - begin) / aircraft
    known = np.isfinite(true)
    rows = {
        "processor an aircraft": (took, "s"),
        f"{MANY:,} aircraft on {CORES} cores, scaled": (MANY * took / CORES / 60.0, "min"),
        "share within 10 % of the true model": (
            float(np.mean((learned <= WITHIN * true)[known])),
            "",
        ),
        "score over that of the true model, median": (float(np.nanmedian(learned / true)), ""),
    }
    label = f"{SCENARIO}, {aircraft} learning aircraft of {DURATION:g} s: "
    table = new_table(label, ("figure", "value", "unit"), texts=1)
    for name, (value, unit) in rows.items():
        table.add_row(name, f"{value:,.4g}", unit)
    Console().print(table)
    write_rows(label, rows, begun)


if __name__ == "__main__":
    typer.run(main)
