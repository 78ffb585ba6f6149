# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Campaign of aircraft that learn: processor seconds an aircraft, and the share within 10 % of the
true model.

python -m benchmarks.campaign_learning  # 10 aircraft of osprey_learn for 64 s, three minutes

The rows are written to docs/evidence/tables/campaign-devices.csv.
"""

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
from flight_campaign.campaign import define
from flight_campaign.definition import Definition
from flight_campaign.learning_flights import side_by_side
from flight_campaign.statistics import score, score_units
from flight_core.parameters import ParameterError
from flight_core.vectors import FloatArray
from flight_design.gains.gain_design import observed
from flight_design.learning.scenario_learner import quick_learner
from rise_di_controller.rise_di_config import RiseDiConfig

SCENARIO, DURATION = "osprey_learn", 64.0  # s
LEARNED = 34.0  # s, from when on the model of a whole window of 30 s flies
WITHIN = 1.1  # a score within 10 % of that of the true model
CORES, MANY = 2, 1000  # of the scaled row


class _Knowing:
    """A learner that proposes the true model at the first tick."""

    def __init__(self, scenario: Scenario, start: RiseDiConfig) -> None:
        assert start.observer is not None  # noqa: S101 - a controller that learns has one
        plain = start.model_copy(update={"learn": None})
        true = scenario.aircraft.sampled_airframe()
        try:
            design = observed(plain, scenario, true, start.observer.margin, uncertain=False)[0]
        except ParameterError as error:
            self._next = LearnerResult(None, str(error))
        else:
            proposed = design.model_dump() | {"learn": start.model_dump()["learn"]}
            known = RiseDiConfig.validate_mapping(proposed, "proposal")
            self._next = LearnerResult(known, "the true model")

    def take(self, *_: object) -> None:
        """Nothing is left to learn."""

    def propose(self, *_: object) -> LearnerResult:
        """The true model, once."""
        now = self._next
        self._next = LearnerResult(None, "")
        return now


def knowing(scenario: Scenario) -> Learn:
    """What makes a learner that knows the true model."""
    return lambda start: _Knowing(scenario, start)


def scores(definition: Definition, learn: list[Learn]) -> FloatArray:
    """Score from LEARNED on of the aircraft, (N,); NaN for a flight that left the compiled loop."""
    scenario = definition.scenario()
    fleet = side_by_side(definition, 0, 0, learn, (round(LEARNED * scenario.controller.rate),))
    assert fleet is not None  # noqa: S101 - the scenario flies in the compiled loop
    result, outcomes = fleet.fly()
    assert result.windows is not None  # noqa: S101 - there are two
    outputs = scenario.controller.outputs
    units = score_units(outputs, scenario.aircraft.channels().outputs, {})
    left = np.array([outcome.left_loop for outcome in outcomes])
    return np.where(left, np.nan, score(np.asarray(result.windows)[-1], units))


def main(
    aircraft: Annotated[int, typer.Option(min=1, help="Aircraft that learn.")] = 10,
) -> None:
    """Print and write the figures."""
    begun = origin("python -m benchmarks.campaign_learning")
    definition = define(find_scenario(SCENARIO, DURATION), aircraft, UNCERTAINTY, SEED, aircraft)
    flown = [definition.aircraft_scenario(number) for number in range(aircraft)]
    true = scores(definition, [knowing(each) for each in flown])  # compiles the loop, too
    make = quick_learner(flown[0])
    assert make is not None  # noqa: S101 - the scenario learns
    begin = time.process_time()
    learned = scores(definition, [make] * aircraft)
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
