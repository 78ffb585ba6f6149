# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a phase margin costs in flight: score, worst and lost aircraft under RISE-DI and PI at four margins.

    python -m benchmarks.margins [--aircraft 200]

RISE-DI has the gains of `rise-di gains osprey --phase-margin`. PI has the linear loop of the same gains: the slope of the
softened sign is a part of the integral.
"""

from dataclasses import replace

import numpy as np
import typer

from aircraft_sim.airframe import load_airframe
from flight_analysis.closed_loop.margins import margins
from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup.scenarios import find_scenario
from flight_campaign import law_comparison, registered_laws
from flight_campaign.tuning import GUST, build_benchmark
from rise_di.gain_design import select_gains
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di import RiseDiConfig

PHASE_MARGINS = (30.0, 40.0, 45.0, 60.0)  # deg
LEVELS, SEED = (0.3, 0.5), 1
LATE = 2  # ticks: 20 ms
HEAD = "| law, phase margin asked | found | +-30 % | +-50 % | lost, u 20 ms late: +-30 % | +-50 % |\n|---|---|---|---|---|---|"


def as_pi(controller: RiseDiConfig) -> ControllerConfig:
    """PI with the linear loop of RISE-DI inside the softened sign."""
    params = controller.law_params()
    integral = params.Lambda + params.beta / params.eps / params.K
    common = {key: getattr(controller, key) for key in ControllerConfig.model_fields if key != "law"}
    gains = {"law": "pi", "Lambda": integral.tolist()}
    gains |= {"D": controller.D, "input_scale": controller.input_scale, "K": params.K.tolist()}
    values = {key: value for key, value in (common | gains).items() if value is not None}
    return AnyLaw.validate_mapping(values, "controller")


def scenarios(servo: Scenario) -> dict[str, Scenario]:
    """osprey_servo by law and margin."""
    airframe, chosen = load_airframe("osprey"), {}
    for phase_margin in PHASE_MARGINS:
        gains = select_gains(airframe, servo, samples=20, phase_margin=phase_margin, accept=True).chosen
        chosen[f"RISE-DI, {phase_margin:g} deg"] = replace(servo, controller=gains)
        chosen[f"PI, {phase_margin:g} deg"] = replace(servo, controller=as_pi(gains))
    return chosen


def main(aircraft: int = 200) -> None:
    """Print the table."""
    servo = find_scenario("osprey_servo")
    flown = scenarios(servo)
    controllers = registered_laws.find_laws(flown, servo, flown)
    entries = registered_laws.entries(controllers)
    benchmark = registered_laws.with_courses(build_benchmark(servo, law_comparison.TURBULENCE_SEED), controllers)
    tuned = {name: {"own": registered_laws.as_tuned(own)} for name, own in controllers.items() if own is not None}
    runs = [
        list(law_comparison.compare(benchmark, tuned, aircraft, levels, SEED, (LATE,), laws=entries))
        for levels in (LEVELS, LEVELS[1:])
    ]
    print(HEAD)
    for result, wide in zip(*runs, strict=True):
        found = np.degrees(margins(flown[result.law]).nominal.phase.min())
        scores = (level.scores[GUST] for level in result.levels)
        late = (next(iter(of.lost_late.values())) for of in (result, wide))
        cells = [f"{score.mean:.2f} ({score.worst:.2f})" for score in scores] + [f"{100.0 * share:.3g} %" for share in late]
        print(f"| {result.law} | {found:.0f} deg | {' | '.join(cells)} |")


if __name__ == "__main__":
    typer.run(main)
