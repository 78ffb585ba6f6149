# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Show on the linear airplane of PX4's simulator what bounds the error of a tuned module.

    python -m benchmarks.tune_bounds > docs/evidence/tables/export-tune-bounds.csv

The airplane has the inertias INERTIAS. It flies in calm air with the noise of the simulator's gyro.
In a bank gravity moves beta, and the reference of r is that of a coordinated turn, as an autopilot
sets it. The controller is that of examples/px4_airplane/rates.yaml with a feedforward of this
airplane. One thing of it varies at a time: the loop gain of q and p, the effect of the rudder in
the feedforward, or, in a feedforward without the bank angle, the loop gain of r. The last row has
PX4's form with gains of a search on this airplane. The columns have the rms of y - y_m over 1.7 s
around a doublet, of q, p and r in their own doublets and of r in the doublet of p, and the margins
of the loop that the rudder closes.
"""

import csv
import math
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

import rise_di
from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.uncertainty import as_yaml
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from flight_design.gains.feedforward_model import with_feedforward, with_states_of
from flight_design.identification.own_loop import own_loop
from flight_design.identification.rates_model import banking

SCENARIO = "examples/px4_airplane/rates.yaml"
INERTIAS = {"p": 1.3, "q": 0.9, "r": 1.5}  # times those of the simulator's airplane
GRAVITY = 9.81  # m/s^2
NOISE = (0.07, 0.15, 0.032)  # rad/s rms of q, p and r at 250 Hz, measured in a log of the simulator
SEEDS = (1, 2, 3, 4)
SPAN = 1.7  # s, from 0.1 s before a doublet
STEP = 0.1  # s, of the reference of r in a bank
OUTPUTS = ("q", "p", "r")
GAINS = {"R": (0.208, 0.0729, 3.75), "P": (0.326, 0.0772, 1.923), "Y": (0.268, 0.5567, 10.0)}
"""FF, P and I in PX4's form, by a search on this airplane with the noise, but without margins.

The integrals are at most LIMIT.
"""
LIMIT = 0.4
LATE = 0.004  # s; with the lag of the scenario's actuators it stands for the filter of the gyro


class Variation(NamedTuple):
    """A controller that differs from the one of the scenario."""

    name: str
    loop_gain: tuple[float, float, float] = (1.0, 1.0, 1.0)  # over the scenario's, by output
    rudder: float = 1.0  # effect of the rudder in the feedforward over that of the airplane
    has_bank: bool = True  # whether the feedforward knows the bank angle


def variations() -> Iterator[Variation]:
    """Yield the scenario's controller, and those with one change."""
    yield Variation("as in the scenario")
    for factor in (0.65, 0.4):
        yield Variation(f"loop gain of q and p times {factor:g}", (factor, factor, 1.0))
    for less in (0.05, 0.1, 0.15):
        name = f"feedforward with {100 * less:.0f} % too little effect of the rudder"
        yield Variation(name, rudder=1.0 - less)
    for factor in (1.0, 1.6, 2.2, 3.0):
        name = f"feedforward without the bank, loop gain of r times {factor:g}"
        yield Variation(name, (1.0, 1.0, factor), has_bank=False)


def write_airplanes(
    rates: Path, with_bank: Path, inertias: Mapping[str, float] = INERTIAS
) -> Airframe:
    """Write the airplane without and with the bank angle as a state, and return the first.

    `inertias` has factors on the inertias of the simulator's airplane, by rate.
    """
    nominal = load_airframe(rise_di.find_scenario(SCENARIO).aircraft.airframe)
    A, B = nominal.matrix_a(), nominal.matrix_b()
    for name, factor in inertias.items():
        A[nominal.index(name)] /= factor
        B[nominal.index(name)] /= factor
    airplane = nominal.with_matrices(A, B, np.ones((len(A), len(nominal.gusts))))
    rates.write_text(as_yaml(airplane), "utf-8")
    with_bank.write_text(as_yaml(banking(airplane)), "utf-8")
    return airplane


def coordinated(pulses: dict[str, Any], speed: float) -> dict[str, Any]:
    """Return the pulses of r with those of a turn at the bank angle that the pulses of p ask for.

    r_c = g / V phi,  phi_dot = p_c
    """
    p, r = pulses["p"], pulses["r"]
    edges = np.arange(min(p["start"]), max(p["stop"]) - STEP / 2, STEP)
    flown = np.clip(edges[:, None] + STEP / 2 - p["start"], 0.0, np.subtract(p["stop"], p["start"]))
    return {
        "start": [*edges.tolist(), *r["start"]],
        "stop": [*(edges + STEP).tolist(), *r["stop"]],
        "value": [*(GRAVITY / speed * flown @ np.array(p["value"])).tolist(), *r["value"]],
    }


def around_doublets(stamps_s: FloatArray, error: FloatArray, begins: list[float]) -> FloatArray:
    """Return the mean squares of the error, (N, m), around each doublet, (doublets, m)."""
    spans = [(stamps_s > begin - 0.1) & (stamps_s < begin - 0.1 + SPAN) for begin in begins]
    return np.array([np.mean(np.square(error[span]), axis=0) for span in spans])


def reference(tape: Tape, stamps_ns: Any) -> FloatArray:
    """Return y_m at the stamps, (N, m)."""
    y_m = tape["y_m"]
    return np.column_stack([np.interp(stamps_ns, y_m.stamp_ns, y_m[name]) for name in OUTPUTS])


def squares(scenario: Scenario, seed: int, begins: list[float]) -> FloatArray:
    """Fly the scenario, and return the mean squares of y - y_m, (doublets, m)."""
    tape = rise_di.simulate(
        scenario.vary(aircraft={"sensors": {"noise": NOISE, "delay": LATE, "seed": seed}})
    )
    truth = tape["truth"]
    y = np.column_stack([truth[f"x.{name}"] for name in OUTPUTS])
    error = y - reference(tape, truth.stamp_ns)
    stamps_s = np.asarray(1e-9 * (truth.stamp_ns - tape.start_ns), dtype=np.float64)
    return around_doublets(stamps_s, error, begins)


def row(name: str, mean_squares: FloatArray, scenario: Scenario) -> list[str]:
    """Return a row of the table, with the margins of the scenario's loop."""
    rms = 1e3 * np.sqrt(mean_squares)
    margins = rise_di.margins(scenario).nominal
    figures = [*np.diag(rms), rms[1, 2], math.degrees(margins.phase[2])]
    return [
        name,
        *(f"{figure:.1f}" for figure in figures),
        f"{20.0 * math.log10(margins.gain_increase[2]):.1f}",
    ]


def row_of_search(original: Scenario, plane: Airframe, begins: list[float]) -> list[str]:
    """Fly PX4's form with the searched gains, and return its row of the table."""
    parameters = {f"FW_{axis}R_IMAX": LIMIT for axis in GAINS}
    for axis, gains in GAINS.items():
        for name, gain in zip(("FF", "P", "I"), gains, strict=True):
            parameters[f"FW_{axis}R_{name}"] = gain
    own = own_loop(parameters, original, "px4")
    if own is None:
        raise RuntimeError(f"PX4's rate loop lacks a parameter in {sorted(parameters)}")
    tape = rise_di.simulate(original)
    stamps_s = np.arange(0.0, original.flight.duration, 1.0 / original.controller.rate)
    y_m = reference(tape, tape.start_ns + 1e9 * stamps_s)
    calm = np.zeros((len(y_m), len(plane.states)))
    error = own.flown(original, plane, y_m, np.array(NOISE), calm)
    mean_squares = around_doublets(stamps_s, error, begins)
    return row("PX4's form, gains of a search", mean_squares, own.in_place(original))


def main() -> None:
    """Print the table."""
    out = csv.writer(sys.stdout, lineterminator="\n")
    names = ["q (mrad/s)", "p (mrad/s)", "r (mrad/s)", "r beside p (mrad/s)"]
    out.writerow(["controller", *names, "phase margin of r (deg)", "gain margin of r (dB)"])
    pulses = yaml.safe_load(Path(SCENARIO).read_text("utf-8"))
    pulses = pulses["/**/reference_model"]["ros__parameters"]["pulses"]
    begins = [min(pulses[name]["start"]) for name in OUTPUTS]
    with tempfile.TemporaryDirectory() as folder:
        rates, with_bank = Path(folder) / "rates.yaml", Path(folder) / "with_bank.yaml"
        airplane = write_airplanes(rates, with_bank)
        original = rise_di.find_scenario(SCENARIO).vary(
            flight={"duration": 12.0},
            aircraft={"airframe": str(rates)},
            reference_model={"pulses": pulses | {"r": coordinated(pulses, airplane.speed)}},
        )
        law = original.rise_di()
        for variation in variations():
            B = airplane.matrix_b()
            B[airplane.index("r"), list(airplane.inputs).index("rudder")] *= variation.rudder
            known = airplane.with_matrices(
                airplane.matrix_a(), B, np.ones((len(B), len(airplane.gusts)))
            )
            # Late samples of y do not count for the lead, which is that of the lag and of a sample.
            bare = law.model_copy(update={"delay": 0.0})
            if variation.has_bank and law.feedforward is not None:
                known = with_states_of(known, law.feedforward)
            scale = np.multiply(law.input_scale, variation.loop_gain)
            scenario = original.vary(controller=with_feedforward(bare, known)).vary(
                controller={"input_scale": scale, "delay": law.delay}
            )
            flying = scenario.vary(aircraft={"airframe": str(with_bank)})
            found = np.mean([squares(flying, seed, begins) for seed in SEEDS], axis=0)
            out.writerow(row(variation.name, found, scenario))
            sys.stdout.flush()
        out.writerow(row_of_search(original, load_airframe(str(with_bank)), begins))


if __name__ == "__main__":
    main()
