# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identify and fly aircraft of JSBSim by the procedure of `rise-di identify`, and print the tables of docs/experiments.md.

.venv/bin/python benchmarks/jsbsim_fleet.py               the aircraft of FLEET, some ten seconds each
.venv/bin/python benchmarks/jsbsim_fleet.py f16 c172p     the named aircraft
.venv/bin/python benchmarks/jsbsim_fleet.py --all         every aircraft of JSBSim, with the reason where one does not fly
"""

import sys
from typing import NamedTuple

import numpy as np

from aircraft_sim.jsbsim_aircraft import INPUTS, OUTPUTS, aircraft_names
from flight_analysis.design.identification import IdentifiedAircraft, ManoeuvreResult, fly_all, identify, without_beta
from flight_core.outcome import COMPLETED, FlightEnded
from flight_core.parameters import ParameterError

KNOT, FOOT = 1852.0 / 3600.0, 0.3048  # m/s, m; exact


class Condition(NamedTuple):
    """Flight condition of an aircraft."""

    speed: float  # true airspeed, kt
    altitude: float  # ft


FLEET = {
    "c172p": Condition(90, 4000),
    "c172x": Condition(90, 4000),
    "J3Cub": Condition(60, 2000),
    "DHC6": Condition(130, 6000),
    "T37": Condition(200, 8000),
    "F80C": Condition(260, 12000),
    "A4": Condition(300, 15000),
    "T38": Condition(300, 12000),
    "f16": Condition(300, 10000),
    "global5000": Condition(330, 25000),
    "737": Condition(300, 20000),
    "B747": Condition(350, 25000),
}
"""Light and utility aircraft, trainers, fighters, business jet, airliners, each at a usual speed and altitude."""

OTHERS = {
    "787-8": Condition(350, 25000),
    "A320": Condition(300, 20000),
    "B17": Condition(130, 5000),
    "Boeing314": Condition(120, 5000),
    "C130": Condition(200, 10000),
    "Camel": Condition(80, 2000),
    "Concorde": Condition(350, 20000),
    "F4N": Condition(350, 15000),
    "L410": Condition(150, 8000),
    "MD11": Condition(350, 25000),
    "OV10": Condition(160, 6000),
    "Short_S23": Condition(120, 4000),
    "Submarine_Scout": Condition(30, 1000),
    "X15": Condition(600, 40000),
    "XB-70": Condition(450, 15000),
    "ZLT-NT": Condition(30, 1500),
    "c172r": Condition(90, 4000),
    "c182": Condition(110, 4000),
    "c310": Condition(150, 6000),
    "f104": Condition(350, 15000),
    "f15": Condition(350, 15000),
    "f22": Condition(350, 15000),
    "fokker100": Condition(280, 15000),
    "fokker50": Condition(200, 10000),
    "p51d": Condition(200, 8000),
    "pc7": Condition(150, 6000),
    "pogo-jsbsim": Condition(120, 3000),
    "t6texan2": Condition(180, 8000),
    "wrightFlyer1903": Condition(30, 50),
    "x24b": Condition(250, 20000),
}
DEFAULT = Condition(100, 3000)


def main() -> None:
    """Print the tables of the selected aircraft."""
    arguments = sys.argv[1:]
    names = list(aircraft_names()) if arguments == ["--all"] else arguments or list(FLEET)
    rows, reasons = [], []
    for number, name in enumerate(names, 1):
        print(f"{number} of {len(names)}: {name}", file=sys.stderr)
        condition = (FLEET | OTHERS).get(name, DEFAULT)
        try:
            aircraft = identify(name, condition.speed * KNOT, condition.altitude * FOOT)
        except (FlightEnded, ParameterError) as error:
            reasons.append(f"| {name} | {condition.speed:g} kt, {condition.altitude:g} ft | {error} |")
            continue
        rows.append(_row(name, condition, aircraft))
        if aircraft.failure:
            reasons.append(f"| {name} | {condition.speed:g} kt, {condition.altitude:g} ft | {aircraft.failure} |")
    flights = [f"{title}{law}" for title in ("calm", "gust", "turbulence") for law in ("", ", PI")]
    headings = ("aircraft", "Omega_ii", "D", "lag (s)", "zero (1/s)", *flights, "largest u")
    print(f"| {' | '.join(headings)} |\n|{'---|' * len(headings)}")
    print("\n".join(rows))
    print("\n| aircraft | at | why it does not fly |\n|---|---|---|")
    print("\n".join(reasons))


def _row(name: str, condition: Condition, aircraft: IdentifiedAircraft) -> str:
    steps = aircraft.responses
    pi = fly_all(without_beta(aircraft.scenario()))
    return " | ".join(
        (
            f"| {name}, {condition.speed:g} kt, {condition.altitude:g} ft",
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
