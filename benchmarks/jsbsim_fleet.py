# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identify and fly aircraft of JSBSim by the procedure of `rise-di identify`, and print the tables
of docs/experiments.md.

.venv/bin/python -m benchmarks.jsbsim_fleet  the aircraft of FLEET, some ten seconds each
.venv/bin/python -m benchmarks.jsbsim_fleet f16 c172p     the named aircraft
"""

import sys

import numpy as np

from aircraft_sim.jsbsim_aircraft import INPUTS, OUTPUTS
from flight_core.outcome import COMPLETED, FlightEnded
from flight_core.parameters import ParameterError
from flight_design.identification.manoeuvre import ManoeuvreResult, fly_all
from flight_design.identification.step_identification import (
    IdentifiedAircraft,
    identify,
    without_beta,
)

KNOT = 1852.0 / 3600.0
FOOT = 0.3048  # m/s, m; exact


# fmt: off
FLEET = {
    "c172p": (90, 4000), "c172x": (90, 4000), "J3Cub": (60, 2000), "DHC6": (130, 6000),
    "T37": (200, 8000),
    "F80C": (260, 12000), "A4": (300, 15000), "T38": (300, 12000), "f16": (300, 10000),
    "global5000": (330, 25000), "737": (300, 20000), "B747": (350, 25000),
}
"""Light and utility aircraft, trainers, fighters, business jet, airliners: a usual true airspeed,
kt, and altitude, ft."""

# fmt: on
DEFAULT = (100, 3000)

# s: the model of the window that ends at 30 s flies; the next one flies at 64 s
LEARNED, LEARN_DURATION = (34.0, 94.0)


def main() -> None:
    """Print the tables of the selected aircraft."""
    arguments = sys.argv[1:]
    names = arguments or list(FLEET)
    rows = []
    reasons = []
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
            *(
                _errors(flight)
                for title in aircraft.flights
                for flight in (aircraft.flights[title], pi[title])
            ),
            " / ".join(f"{aircraft.flights['turbulence'].largest[name]:.2g}" for name in INPUTS)
            + " |",
        )
    )


def _errors(flight: ManoeuvreResult) -> str:
    if flight.outcome != COMPLETED:
        return flight.outcome
    return " / ".join(f"{flight.rms[name] * (1.0 if name == 'V' else 1e3):.2g}" for name in OUTPUTS)


if __name__ == "__main__":
    main()
