# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification from one flight's log: errors of the entries of A and B, and innovations, of uncertain aircraft in every air.

python -m benchmarks.model_identification                   # 18 flights of osprey_servo, some four minutes
python -m benchmarks.model_identification --aircraft 200    # 400 aircraft with observers of identified models: an hour
"""

import multiprocessing
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from itertools import product
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from aircraft_sim.airframe import load_airframe
from aircraft_sim.turbulence import MODERATE
from aircraft_sim.uncertainty import AIR_RELATIVE, gust_directions, sampled_matrices
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_campaign import batch
from flight_campaign.benchmark_course import Course, build_course
from flight_campaign.statistics import score, score_units
from flight_core.parameters import ParameterError
from flight_design.gains.gain_design import observed
from flight_design.identification.innovation_filters import Actuation, recording
from flight_design.identification.model_identification import Identification, identify
from rise_di_controller.linear_loop import LinearPlant, Loop, delay_margin, linear_law
from rise_di_controller.params import ControllerConfig

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


MARGINS = (0.03, 0.02)  # s, of the loop of the identified model
FLIGHT_SEED = 77  # of the aircraft of `re_flight`


@cache
def _gust_flight() -> tuple[Course, batch.Vehicle]:
    scenario = find_scenario("osprey_observer")
    return build_course(scenario), batch.vehicle(scenario)


def gust_flight(controller: ControllerConfig, uncertainty: float, number: int) -> tuple[float, float]:
    """Score of an uncertain aircraft in gusts under a controller, and the delay margin of its linear loop, ms."""
    scenario, nominal = find_scenario("osprey_observer"), load_airframe("osprey")
    (course, vehicle), law = _gust_flight(), controller.tuned_law()
    A, B = sampled_matrices(nominal, uncertainty, uncertainty, FLIGHT_SEED, number, 1)
    directions = gust_directions(nominal, A, AIR_RELATIVE)
    plant = scenario.aircraft.plant()
    aircraft = batch.assemble(A, B, plant, course, gust_directions=directions)
    flown = batch.fly(aircraft, vehicle, course, law.control_law, batch.shared(law.params))
    columns = [list(nominal.inputs).index(name) for name in controller.inputs]
    C = nominal.matrix_c()[[nominal.outputs.index(name) for name in controller.outputs]]
    loop = Loop(np.array(controller.lag), 0.0, 1.0 / controller.rate)
    linear = LinearPlant(A[0] + plant.aircraft.gravity, B[0][:, columns], C)
    margin = delay_margin(linear, linear_law(law, len(C), loop.period), loop)
    units = score_units(controller.outputs, scenario.aircraft.channels().outputs)
    return float(score(np.asarray(flown.rms), units)[0]), 1e3 * margin


def re_flight(uncertainty: float, number: int) -> Mapping[str, tuple[float, float]]:
    """Scores and margins of an aircraft with the observer of the nominal model, and with that of a model from a flight without.

    A model that is refused is not flown: the nominal one flies again.
    """
    scenario, nominal = find_scenario("osprey_observer"), load_airframe("osprey")
    sampled = {"A": uncertainty, "B": uncertainty, "seed": FLIGHT_SEED, "number": number}
    alone = find_scenario("osprey_servo").vary(aircraft={"uncertainty": sampled})
    found = identify(recording(simulate(alone), nominal), nominal, ACTUATORS)
    rows = {"nominal": gust_flight(scenario.controller, uncertainty, number)}
    for margin in MARGINS:
        name = f"identified, {1e3 * margin:.0f} ms"
        try:
            controller, _ = observed(alone.rise_di(), scenario, found.airframe, margin)
        except ParameterError:
            controller = scenario.rise_di()
        rows[name] = rows["nominal"] if found.refusal else gust_flight(controller, uncertainty, number)
    return rows


def re_flights(aircraft: int) -> Table:
    """Gust scores of uncertain aircraft with the observer of the nominal and of the identified model."""
    table = Table(title=f"{aircraft} aircraft of seed {FLIGHT_SEED} in gusts", box=box.SIMPLE_HEAD, title_justify="left")
    for heading in ("model", "score", "worst", "delay margin of the true loop: mean", "least, ms"):
        table.add_column(heading, justify="left" if heading == "model" else "right")
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        for uncertainty in UNCERTAINTIES:
            flights = pool.map(partial(re_flight, uncertainty), range(aircraft))
            rows = list(track(flights, f"+-{100.0 * uncertainty:g} %", total=aircraft))
            for name in rows[0]:
                scores, margins = np.array([row[name] for row in rows]).T
                figures = (f"{scores.mean():.2f}", f"{scores.max():.2f}", f"{margins.mean():.0f}", f"{margins.min():.0f}")
                table.add_row(f"{name}, +-{100.0 * uncertainty:g} %", *figures)
    return table


def main(
    aircraft: Annotated[int, typer.Option(min=0, help="Fly this many aircraft a level with their identified models.")] = 0,
) -> None:
    """Print one row for each air and uncertainty, or for each model."""
    Console(width=150).print(re_flights(aircraft) if aircraft else errors_of_entries())


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
    typer.run(main)
