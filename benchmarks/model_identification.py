# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification from one flight's log: errors of the entries of A and B, and innovations, of uncertain aircraft in every air.

python -m benchmarks.model_identification                   # 18 flights of osprey_servo, some four minutes
"""

import time
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from aircraft_sim.airframe import load_airframe
from aircraft_sim.turbulence import MODERATE
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_design.identification.innovation_filters import Actuation, recording
from flight_design.identification.model_identification import Identification, identify

AIR: dict[str, dict[str, Any]] = {
    "calm": {"gusts": {}},
    "two gusts": {},
    "turbulence": {"gusts": {}, "turbulence": MODERATE},
}
UNCERTAINTIES, AIRCRAFT, SEED = (0.3, 0.5), 3, 5
ENTRIES = ("B[V, thrust]", "B[q, elevator]", "A[p, p]", "B[p, aileron]", "A[r, beta]", "B[r, rudder]")
ACTUATORS = Actuation(np.array([0.02, 0.1, 0.02, 0.02]), 0.0)  # lags of osprey_servo in s; no delay in one process


class Case(NamedTuple):
    """One flight and its model."""

    found: Identification
    errors: dict[str, float]  # of each entry, in parts of the true one
    scaled: float  # rms over all entries of the error / standard deviation
    seconds: float


def case(air: str, uncertainty: float, number: int) -> Case:
    """Fly an uncertain aircraft and identify it."""
    sampled = {"A": uncertainty, "B": uncertainty, "seed": SEED, "number": number}
    aircraft = {"rate": 100.0, "step": 0.005, "uncertainty": sampled} | AIR[air]
    scenario = find_scenario("osprey_servo").vary(aircraft=aircraft, reference_model={"rate": 100.0})
    nominal, true = load_airframe("osprey"), scenario.aircraft.sampled_airframe()
    recorded = recording(simulate(scenario), nominal)
    start = time.process_time()
    found = identify(recorded, nominal, ACTUATORS)
    seconds = time.process_time() - start
    errors, scaled = {}, []
    for entry in found.entries:
        row, matrix = true.index(entry.row), true.matrix_a() if entry.matrix == "A" else true.matrix_b()
        value = matrix[row, true.index(entry.column) if entry.matrix == "A" else list(true.inputs).index(entry.column)]
        errors[entry.name] = float(entry.nominal * (1.0 + entry.error) / value - 1.0)
        scaled.append((entry.nominal * (1.0 + entry.error) - value) / entry.nominal / entry.deviation)
    return Case(found, errors, float(np.sqrt(np.mean(np.square(scaled)))), seconds)


def errors_of_entries() -> Table:
    """One row for each air and uncertainty."""
    table = Table(title="Largest error of an entry in %, over three aircraft", box=box.SIMPLE_HEAD, title_justify="left")
    for heading in ("air", *ENTRIES, "error / deviation", "whiteness before", "after", "refused", "s"):
        table.add_column(escape(heading), justify="left" if heading == "air" else "right")
    for air, uncertainty in track(list(product(AIR, UNCERTAINTIES)), "flights"):
        cases = [case(air, uncertainty, number) for number in range(AIRCRAFT)]
        largest = [f"{100.0 * max(abs(flight.errors[name]) for flight in cases):.1f}" for name in ENTRIES]
        whiteness = [np.mean([getattr(flight.found, when).whiteness for flight in cases]) for when in ("before", "after")]
        figures = f"{max(flight.scaled for flight in cases):.2f}", f"{whiteness[0]:.0f}", f"{whiteness[1]:.2f}"
        refused = str(sum(bool(flight.found.refusal) for flight in cases))
        seconds = f"{max(flight.seconds for flight in cases):.1f}"
        table.add_row(f"{air}, +-{100.0 * uncertainty:g} %", *largest, *figures, refused, seconds)
    return table


if __name__ == "__main__":
    Console(width=150).print(errors_of_entries())
