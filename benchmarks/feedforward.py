# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Effect of the feedforward with the same gains: osprey_servo on the published airframe and on uncertain ones.

python -m benchmarks.feedforward --aircraft 200    # ten seconds
"""

from typing import Annotated

import numpy as np
import typer
from benchmarks.sampling import cells, new_table, wide_console

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.summary import display_units
from flight_campaign.campaign import define, fly_chunk_figures
from flight_campaign.statistics import Tally
from flight_design.gains.gain_selection import with_feedforward

LEVELS = (0.3, 0.5)


def both(scenario: Scenario) -> tuple[Scenario, Scenario]:
    """The scenario without feedforward, and with that of its airframe as published."""
    airframe, _ = scenario.aircraft.load()
    chosen = with_feedforward(scenario.controller, airframe)
    return scenario.vary(controller={"feedforward": None}), scenario.vary(controller=chosen.model_dump())


def fly_tally(scenario: Scenario, level: float, aircraft: int, seed: int) -> Tally:
    """Statistics of so many uncertain aircraft; the feedforward's model is the airframe as published."""
    chunk = fly_chunk_figures(define(scenario, aircraft, level, seed, aircraft).model_dump_json(), (0, 0))
    return Tally.of(chunk.first, chunk.diverged, chunk.figures)


def main(
    aircraft: Annotated[int, typer.Option(min=1, help="Uncertain aircraft at each level.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the uncertain aircraft.")] = 1,
) -> None:
    """Print scores and activity of u with and without feedforward, for the same gains and aircraft."""
    scenario = find_scenario("osprey_servo")
    channels, units = scenario.aircraft.channels(), display_units(scenario)
    sets = {"nominal, calm air": (scenario.vary(aircraft={"gusts": {}}), 0.0, 1), "nominal": (scenario, 0.0, 1)}
    sets |= {f"+-{100 * level:g} %": (scenario, level, aircraft) for level in LEVELS}
    table = new_table(
        f"osprey_servo, {aircraft} aircraft a level, seed {seed}: sum of rms errors q / V / p / r in 10 mrad/s, 0.1 m/s, 20 and"
        "\n10 mrad/s; mean rms in mrad/s and mm/s; mean slew of elevator / thrust / aileron / rudder in deg/s and %/s",
        ("aircraft", "feedforward", "score", "worst", "rms", "slew"),
        texts=2,
    )
    for name, (base, level, count) in sets.items():
        for label, variant in zip(("without", "with"), both(base), strict=True):
            tally = fly_tally(variant, level, count, seed)
            rms = np.array([tally.figures[f"rms.{channel}"].mean for channel in channels.outputs])
            slew = np.array([tally.figures[f"slew.{key}"].mean * units[key].factor for key in channels.inputs])
            score = tally.figures["score"]
            table.add_row(name, label, f"{score.mean:.2f}", f"{score.largest:.2f}", cells(rms, 1e3), cells(slew))
    wide_console().print(table)


if __name__ == "__main__":
    typer.run(main)
