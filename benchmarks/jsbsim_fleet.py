# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identify and fly aircraft of JSBSim by the procedure of `rise-di identify`, and print the tables of docs/experiments.md.

.venv/bin/python -m benchmarks.jsbsim_fleet               the aircraft of FLEET, some ten seconds each
.venv/bin/python -m benchmarks.jsbsim_fleet f16 c172p     the named aircraft
.venv/bin/python -m benchmarks.jsbsim_fleet --all         every aircraft of JSBSim, with the reason where one does not fly
"""

import sys

import numpy as np

from aircraft_sim.jsbsim_aircraft import INPUTS, OUTPUTS, aircraft_names
from flight_analysis.design.identification import IdentifiedAircraft, ManoeuvreResult, fly_all, identify, without_beta
from flight_core.outcome import COMPLETED, FlightEnded
from flight_core.parameters import ParameterError

KNOT, FOOT = 1852.0 / 3600.0, 0.3048  # m/s, m; exact


# fmt: off
FLEET = {
    "c172p": (90, 4000), "c172x": (90, 4000), "J3Cub": (60, 2000), "DHC6": (130, 6000), "T37": (200, 8000),
    "F80C": (260, 12000), "A4": (300, 15000), "T38": (300, 12000), "f16": (300, 10000),
    "global5000": (330, 25000), "737": (300, 20000), "B747": (350, 25000),
}
"""Light and utility aircraft, trainers, fighters, business jet, airliners: a usual true airspeed, kt, and altitude, ft."""

OTHERS = {
    "787-8": (350, 25000), "A320": (300, 20000), "B17": (130, 5000), "Boeing314": (120, 5000),
    "C130": (200, 10000), "Camel": (80, 2000), "Concorde": (350, 20000), "F4N": (350, 15000),
    "L410": (150, 8000), "MD11": (350, 25000), "OV10": (160, 6000), "Short_S23": (120, 4000),
    "Submarine_Scout": (30, 1000), "X15": (600, 40000), "XB-70": (450, 15000), "ZLT-NT": (30, 1500),
    "c172r": (90, 4000), "c182": (110, 4000), "c310": (150, 6000), "f104": (350, 15000), "f15": (350, 15000),
    "f22": (350, 15000), "fokker100": (280, 15000), "fokker50": (200, 10000), "p51d": (200, 8000),
    "pc7": (150, 6000), "pogo-jsbsim": (120, 3000), "t6texan2": (180, 8000), "wrightFlyer1903": (30, 50),
    "x24b": (250, 20000),
}
# fmt: on
DEFAULT = (100, 3000)


def main() -> None:
    """Print the tables of the selected aircraft."""
    arguments = sys.argv[1:]
    names = list(aircraft_names()) if arguments == ["--all"] else arguments or list(FLEET)
    rows, reasons = [], []
    for number, name in enumerate(names, 1):
        print(f"{number} of {len(names)}: {name}", file=sys.stderr)
        speed, altitude = (FLEET | OTHERS).get(name, DEFAULT)
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
