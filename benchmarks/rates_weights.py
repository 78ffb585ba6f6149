# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Show which errors and margins the weights of a file give the rate loops of PX4's airplane.

    python -m benchmarks.rates_weights examples/px4_airplane/rates_weights.yaml \
        > docs/evidence/tables/export-weights.csv

For airplanes whose inertias are those of the simulator's airplane times INERTIAS, gains beside an
observer are selected by the weights. The errors are the rms of the true rates of the linear loop,
with the airplane's bank, in the gusts of the flights and with the noise of the gyro. They follow
from the covariance of the loop's state, so no flight and no seed is behind them.
"""

import csv
import math
import sys
import tempfile
from pathlib import Path

import numpy as np
from benchmarks.tune_bounds import SCENARIO, write_airplanes

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.loop_margins import margins, scenario_loop
from flight_core.vectors import FloatArray
from flight_design.gains.gain_design import check_gains, select_gains
from flight_design.gains.linear_error import TURBULENT, Air, air_response
from flight_log.px4_parameters import low_pass_delay
from rise_di_controller.law.linear_loop import LinearPlant

INERTIAS = (
    {"p": 1.0, "q": 1.0, "r": 1.0},
    {"p": 1.3, "q": 0.9, "r": 1.5},
    {"p": 0.8, "q": 1.2, "r": 0.9},
    {"p": 1.6, "q": 1.4, "r": 1.3},
    {"p": 1.4, "q": 1.3, "r": 1.4},
    {"p": 0.85, "q": 0.8, "r": 0.8},
)
GUST = (
    0.5,
    0.5,
    0.5,
)  # rms of the wind along w and v, m/s, and of the rotation about the roll axis
GUST_TIME = (0.5, 0.5, 0.2)  # s, their time constants
NOISE = (0.07, 0.14, 0.028)  # rad/s, of q, p and r, as in rates_observer.yaml
CUTOFF = 40.0  # Hz, of the gyro's filter in PX4
DELAY_MARGIN = 0.01  # s, as in rates_observer.yaml
LEAST = 0.05  # relative deviation of each entry of the uncertain aircraft, as in `rise-di tune`
SAMPLES = 60


def wind_effects(A: FloatArray, states: list[str], speed: float) -> FloatArray:
    """Return the effects of w and v, 1 m/s, and of rolling air, 1 rad/s, on x_dot, (n, 3).

    An airplane is moved by its motion relative to the air. The rotation acts on the moments alone.
    """
    alpha, beta, p = (A[:, states.index(name)] for name in ("alpha", "beta", "p"))
    is_rate = np.array([name in {"p", "q", "r"} for name in states])
    return np.asarray(-np.column_stack([alpha / speed, beta / speed, p * is_rate]))


def errors(scenario: Scenario, aircraft: Path, speed: float) -> dict[str, float]:
    """Return the rms of the outputs in gusts and with the noise of the gyro, mrad/s."""
    flown = scenario.vary(aircraft={"airframe": str(aircraft)})
    linear = scenario_loop(flown, flown.controller)
    A, B = (np.asarray(matrices)[0] for matrices in (linear.plant.A, linear.plant.B))
    count = len(linear.outputs)
    air = Air(
        wind=wind_effects(A, list(linear.states), speed),
        reading=np.zeros((count, len(GUST))),
        time=np.array(GUST_TIME),
        sigma=np.array(GUST),
        noise=np.array(NOISE),
        gust=np.zeros(len(GUST)),
        gust_duration=1.0,
    )
    response = air_response(LinearPlant(A, B, linear.plant.C), linear.law, linear.loop, air)
    rms = 1e3 * response.error / TURBULENT
    return {name: float(value) for name, value in zip(linear.outputs, rms, strict=True)}


def row(inertias: dict[str, float], weights: Path, folder: Path) -> list[str]:
    """Return a row of the table."""
    shipped = find_scenario(SCENARIO)
    path, banked = folder / "airplane.yaml", folder / "with_bank.yaml"
    frame = write_airplanes(path, banked, inertias)
    controller = shipped.rise_di()
    no_lag = [0.0] * len(controller.inputs)
    scenario = shipped.vary(
        aircraft={
            "airframe": str(path),
            "actuators": shipped.aircraft.actuators.model_dump() | {"lag": no_lag},
            "sensors": {"noise": NOISE},
        },
        controller={"lag": no_lag, "delay": low_pass_delay(CUTOFF) + 1.0 / controller.rate},
    )
    chosen = select_gains(
        frame,
        scenario,
        uncertainty=LEAST,
        samples=SAMPLES,
        feedforward=True,
        observer=True,
        margin=DELAY_MARGIN,
        weights=weights,
        accept=True,
    ).chosen
    tuned = scenario.vary(controller=chosen)
    rms = errors(tuned, banked, frame.speed)
    phase = margins(tuned).nominal.phase
    answer = check_gains(frame, tuned, uncertainty=LEAST, samples=SAMPLES, as_told=True)
    return [
        ", ".join(f"{inertias[name]:g}" for name in ("p", "q", "r")),
        *(f"{rms[name]:.1f}" for name in ("p", "q", "r")),
        *(f"{math.degrees(phase[chosen.outputs.index(name)]):.0f}" for name in ("p", "q", "r")),
        "; ".join(condition.sentence(chosen.outputs) for condition in answer.unmet),
    ]


def main() -> None:
    """Print the table."""
    writer = csv.writer(sys.stdout, lineterminator="\n")
    headings = ["inertias of roll, pitch, yaw (times the example's)"]
    headings += [f"{name} in gusts (mrad/s)" for name in ("p", "q", "r")]
    headings += [f"phase margin of {name} (deg)" for name in ("p", "q", "r")]
    writer.writerow([*headings, "margins that fall short"])
    with tempfile.TemporaryDirectory() as folder:
        for inertias in INERTIAS:
            writer.writerow(row(inertias, Path(sys.argv[1]).resolve(), Path(folder)))
            sys.stdout.flush()


if __name__ == "__main__":
    main()
