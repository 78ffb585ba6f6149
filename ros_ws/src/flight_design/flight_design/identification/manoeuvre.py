# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly an identified aircraft in calm air, with a gust and in turbulence."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.atmosphere.turbulence import HIGH, LOW, LOWEST, MODERATE_SIGMA, MODERATE_WIND
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics.controller_log import saturation_shares
from flight_analysis.metrics.errors import best_error, error_metrics
from flight_core.tape import Tape

HEIGHTS = {"q": 0.05, "V": 2.0, "p": 0.15, "r": 0.05}
"""Heights of the pulses of the outputs, SI. `IdentifiedAircraft.coupling` is relative to these
heights. For an output without a pulse, an aircraft only counts as flying if the rms error in calm
air is below the height."""
GUST_SPEED = 5.0  # m/s, downwards
GUST_LENGTH = 30.48  # m, 100 ft to the peak; FAR/CS 25.341 has 30 to 350 ft
# With guidance, this turn and this climb are commanded in place of the pulses.
TURN = math.pi / 2.0  # rad
CLIMB = 100.0  # m
# s, instants at which the turn and the climb begin
TURN_START = 2.0
CLIMB_START = 30.0


def moderate_turbulence(altitude: float) -> dict[str, Any]:
    """Return the parameters of moderate turbulence at an altitude, m.

    At low altitude the turbulence follows from the wind near the ground. At high altitude the rms
    of the turbulence is 10 ft/s. Between LOW and HIGH the result has both. Altitudes below LOWEST
    count as LOWEST.
    """
    values: dict[str, Any] = {"altitude": max(altitude, LOWEST), "seed": 1}
    if altitude < HIGH:
        values["wind"] = MODERATE_WIND
    if altitude > LOW:
        values["sigma"] = MODERATE_SIGMA
    return values


LEAST_SHARE = 0.01
"""Share of the ticks from which an input counts as at its limit. It is 0.6 s of a flight of a
minute, so an input that is at its limit only at the beginning of a step does not count."""


class ManoeuvreResult(NamedTuple):
    """The result of a simulation of the manoeuvre in one process."""

    outcome: str
    rms: dict[str, float]  # rms of the error by output, SI
    largest: dict[str, float]  # largest abs(u) by input
    # share of the ticks in which an input was at its limit, by input, if it is LEAST_SHARE or more
    at_limit: dict[str, float]

    @property
    def text(self) -> str:
        """How the flight ended, and which inputs were at their limits, in words."""
        return ", ".join(
            [
                self.outcome,
                *(f"{name} at its limit {share:.0%}" for name, share in self.at_limit.items()),
            ]
        )


def fly_all(
    scenario: Scenario, progress: Callable[[str], None] = lambda _: None
) -> dict[str, ManoeuvreResult]:
    """Fly a scenario of `identify` three times.

    The flights are in "calm" air, with the "gust" of the scenario, and in moderate "turbulence"
    without the gust.
    """
    turbulence = moderate_turbulence(scenario.aircraft.flight_condition().altitude)
    flights = {}
    for title, changes in (
        ("calm", {"gusts": {}}),
        ("gust", {}),
        ("turbulence", {"gusts": {}, "turbulence": turbulence}),
    ):
        progress(f"flight: {title}")
        flights[title] = manoeuvre_result(simulate(scenario.vary(aircraft=changes)))
    return flights


def manoeuvre_result(tape: Tape) -> ManoeuvreResult:
    """Return the rms errors, the largest commands and the inputs at their limits in a tape."""
    _, error = best_error(tape)
    rms = {name: error_metrics(error[name]).rms for name in error.names}
    largest = {
        name: float(np.max(np.abs(tape["u"][name]), initial=0.0)) for name in tape["u"].names
    }
    shares = {name: kinds["magnitude"] for name, kinds in saturation_shares(tape).items()}
    at_limit = {name: share for name, share in shares.items() if share >= LEAST_SHARE}
    return ManoeuvreResult(str(tape.outcome), rms, largest, at_limit)
