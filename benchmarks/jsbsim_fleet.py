# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identify and fly aircraft of JSBSim by the procedure of `rise-di identify`, and print the tables of docs/experiments.md.

.venv/bin/python -m benchmarks.jsbsim_fleet               the aircraft of FLEET, some ten seconds each
.venv/bin/python -m benchmarks.jsbsim_fleet f16 c172p     the named aircraft
.venv/bin/python -m benchmarks.jsbsim_fleet --learn       the table of docs/learning.md, of LEARNERS, a minute each
"""

import sys
from dataclasses import replace

import numpy as np

from aircraft_sim.jsbsim_aircraft import INPUTS, OUTPUTS
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import best_error
from flight_core.outcome import COMPLETED, FlightEnded
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_design.identification.step_identification import (
    IdentifiedAircraft,
    ManoeuvreResult,
    fly_all,
    identify,
    with_observer,
    without_beta,
)
from flight_design.learning.scenario_learner import learner
from rise_di_controller.proposals import Event

KNOT, FOOT = 1852.0 / 3600.0, 0.3048  # m/s, m; exact


# fmt: off
FLEET = {
    "c172p": (90, 4000), "c172x": (90, 4000), "J3Cub": (60, 2000), "DHC6": (130, 6000), "T37": (200, 8000),
    "F80C": (260, 12000), "A4": (300, 15000), "T38": (300, 12000), "f16": (300, 10000),
    "global5000": (330, 25000), "737": (300, 20000), "B747": (350, 25000),
}
"""Light and utility aircraft, trainers, fighters, business jet, airliners: a usual true airspeed, kt, and altitude, ft."""

# fmt: on
DEFAULT = (100, 3000)
LEARNERS = (*FLEET, "c182", "pc7", "t6texan2", "OV10")  # the last four had no part in the factors of the sketch

MARGIN = 0.015  # s, delay margin of the designs of both observers
LEARNED, LEARN_DURATION = 34.0, 94.0  # s: the model of the window that ends at 30 s flies; the next one flies at 64 s


def main() -> None:
    """Print the tables of the selected aircraft."""
    arguments = sys.argv[1:]
    if arguments[:1] == ["--learn"]:
        _learn(arguments[1:] or list(LEARNERS))
        return
    names = arguments or list(FLEET)
    rows, reasons = [], []
    for number, name in enumerate(names, 1):
        print(f"{number} of {len(names)}: {name}", file=sys.stderr)
        speed, altitude = FLEET.get(name, DEFAULT)
        condition = f"{speed} kt, {altitude} ft"
        try:
            aircraft = identify(name, speed * KNOT, altitude * FOOT)
        except (FlightEnded, ParameterError) as error:
            reasons.append(f"| {name} | {condition} | {error} |")
            continue
        rows.append(_row(f"{name}, {condition}", aircraft))
        if aircraft.failure:
            reasons.append(f"| {name} | {condition} | {aircraft.failure} |")
    flights = [f"{title}{law}" for title in ("calm", "gust", "turbulence") for law in ("", ", PI")]
    headings = ("aircraft", "Omega_ii", "D", "lag (s)", "zero (1/s)", *flights, "largest u")
    print(f"| {' | '.join(headings)} |\n|{'---|' * len(headings)}")
    print("\n".join(rows))
    print("\n| aircraft | at | why it does not fly |\n|---|---|---|")
    print("\n".join(reasons))


def _learn(names: list[str]) -> None:
    """Fly aircraft in moderate turbulence with the gains alone, with an extended-state observer and with a learner."""
    print("| aircraft | the gains alone | extended-state observer | learner | first model | parts that learned |")
    print("|---|---|---|---|---|---|", flush=True)
    for name in names:
        speed, altitude = FLEET.get(name, DEFAULT)
        condition = f"{name}, {speed} kt, {altitude} ft"
        try:
            aircraft = identify(name, speed * KNOT, altitude * FOOT, observer_margin=MARGIN, learns=True)
        except (FlightEnded, ParameterError) as error:
            print(f"| {condition} | {error} |", flush=True)
            continue
        scenario = aircraft.scenario().vary(flight={"duration": LEARN_DURATION})
        alone = replace(scenario, controller=aircraft.selection.chosen)
        try:
            observed = with_observer(aircraft.selection, aircraft.responses.Omega, MARGIN).chosen
            beside = _rates(simulate(replace(scenario, controller=observed)))
        except ParameterError as error:
            beside = str(error)
        events = list[Event]()
        learned = simulate(scenario, learn=learner(scenario), announce=events.append)
        flown = [event for event in events if event.change]
        accepted = " ".join(event.sentence.split("refused")[0] for event in flown)
        parts = [output for output in OUTPUTS if f"[{output}, " in accepted]
        first = f"{flown[0].stamp_ns / NANOSECONDS:.0f} s" if flown else "none"
        cells = (condition, _rates(simulate(alone)), beside, _rates(learned), first, ", ".join(parts) or events[-1].sentence)
        print(f"| {' | '.join(cells)} |", flush=True)


def _rates(tape: Tape) -> str:
    """Rms of the true error of the body rates from LEARNED on, mrad/s."""
    if tape.outcome != COMPLETED:
        return tape.outcome
    _, error = best_error(tape)
    late = error.stamp_ns >= LEARNED * NANOSECONDS
    return " / ".join(f"{1e3 * np.sqrt(np.mean(error[name][late] ** 2)):.2f}" for name in ("q", "p", "r"))


def _row(title: str, aircraft: IdentifiedAircraft) -> str:
    steps = aircraft.responses
    pi = fly_all(without_beta(aircraft.scenario()))
    return " | ".join(
        (
            f"| {title}",
            " / ".join(f"{value:.3g}" for value in np.diag(steps.Omega)),
            " ".join(f"{sign:+d}"[0] for sign in aircraft.D),
            " / ".join(f"{lag:.2g}" for lag in steps.lag),
            f"{aircraft.sideslip_zero:.2g}",
            *(_errors(flight) for title in aircraft.flights for flight in (aircraft.flights[title], pi[title])),
            " / ".join(f"{aircraft.flights['turbulence'].largest[name]:.2g}" for name in INPUTS) + " |",
        )
    )


def _errors(flight: ManoeuvreResult) -> str:
    if flight.outcome != COMPLETED:
        return flight.outcome
    return " / ".join(f"{flight.rms[name] * (1.0 if name == 'V' else 1e3):.2g}" for name in OUTPUTS)


if __name__ == "__main__":
    main()
