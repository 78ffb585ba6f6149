# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identify and fly aircraft of JSBSim by the procedure of `rise-di identify`, and print the tables
of docs/experiments.md.

.venv/bin/python -m benchmarks.jsbsim_fleet  the aircraft of jsbsim_gains.yaml, half a minute each
.venv/bin/python -m benchmarks.jsbsim_fleet f16 c172p     the named aircraft
"""

import sys

import numpy as np
from benchmarks.jsbsim_gains import CONDITIONS

from aircraft_sim.jsbsim_aircraft import INPUTS, OUTPUTS
from flight_core.outcome import COMPLETED, FlightEnded
from flight_core.parameters import ParameterError
from flight_design.identification.jsbsim_identification import (
    IdentifiedAircraft,
    identify,
    without_beta,
)
from flight_design.identification.manoeuvre import ManoeuvreResult, fly_all


def main() -> None:
    """Print the tables of the selected aircraft."""
    names = sys.argv[1:] or list(CONDITIONS)
    rows = []
    reasons = []
    for number, name in enumerate(names, 1):
        print(f"{number} of {len(names)}: {name}", file=sys.stderr)
        speed, altitude = CONDITIONS[name][0]
        condition = f"{speed:g} m/s, {altitude:g} m"
        try:
            aircraft = identify(name, speed, altitude)
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
    linear = aircraft.linear
    pi = fly_all(without_beta(aircraft.scenario()))
    return " | ".join(
        (
            f"| {title}",
            " / ".join(f"{value:.3g}" for value in np.diag(linear.Omega)),
            " ".join(f"{sign:+d}"[0] for sign in aircraft.D),
            " / ".join(f"{lag:.2g}" for lag in linear.lag),
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
    if flight.outcome != str(COMPLETED):
        return flight.outcome
    return " / ".join(f"{flight.rms[name] * (1.0 if name == 'V' else 1e3):.2g}" for name in OUTPUTS)


if __name__ == "__main__":
    main()
