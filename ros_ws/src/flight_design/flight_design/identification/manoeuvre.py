# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The manoeuvre of an identified aircraft, one rule for all aircraft, and its flights."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.jsbsim_aircraft import (
    OUTPUTS,
)
from aircraft_sim.turbulence import HIGH, LOW, LOWEST, MODERATE_SIGMA, MODERATE_WIND
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import best_error, error_metrics, saturation_shares
from flight_core.tape import Tape
from flight_core.units import GRAVITY
from flight_design.gains.gain_selection import SOFTENING

# Hz, Hz, s: of y, of the law, of the integration
RATE = 200.0
PULSE_Q = 0.05  # rad/s
PULSE_P = 0.15  # rad/s
PULSE_V = 2.0  # m/s: heights of the pulses
# also the units of the outputs in the coupling
HEIGHTS = {"q": PULSE_Q, "V": PULSE_V, "p": PULSE_P, "r": PULSE_Q}
NATURAL_FREQUENCY = {"q": 4.0, "V": 1.2, "p": 5.0, "r": 4.0}  # rad/s, as in osprey_gust
DAMPING = {"q": 0.9, "V": 1.0, "p": 0.9, "r": 0.9}
# of the throttle's authority for the commanded V; the rest is for climbs, turns and gusts
AUTHORITY_FRACTION = 1.0 / 3.0
DURATION = 60.0  # s
# m/s down, and m to the peak: 100 ft, within the 30 to 350 ft of FAR/CS 25.341
GUST_SPEED = 5.0
GUST_LENGTH = 30.48
GUST_START = 50.0  # s
TURN = math.pi / 2.0  # rad
CLIMB = 100.0  # m: the targets of guidance in place of the pulses
# s
TURN_START = 2.0
CLIMB_START = 30.0


def reference_parameters(
    speed: float, authority: float, outputs: tuple[str, ...] = tuple(OUTPUTS)
) -> dict[str, Any]:
    """Parameters of the reference model for an aircraft of a trim speed (m/s) and an authority of
    the throttle (m/s^2).

        q
            0.05 rad/s, or 1 g / speed if that is less, up and down for 1 s each: each pair restores
            the flight path
        V
            2 m/s more for 20 s; its filter needs at most 2 m/s omega / e, a third of the authority,
            omega up to 1.2 rad/s
        p   0.15 rad/s right and left for 1 s each: banks of 9 degrees
        r   the coordinated turn g/V0 sin(bank), where `outputs` have r

    The rest is that of osprey_gust. Banks are short because q of a coordinated turn is not
    commanded: the nose drops in them.
    """
    q = min(PULSE_Q, GRAVITY / speed)
    p = PULSE_P
    turn = {"bank_rate": "p", "turn_rate": "r", "speed": speed}
    slow = min(NATURAL_FREQUENCY["V"], AUTHORITY_FRACTION * authority * math.e / PULSE_V)
    return {
        "rate": RATE,
        "outputs": list(outputs),
        "second_order": {
            "natural_frequency": [
                slow if name == "V" else NATURAL_FREQUENCY[name] for name in outputs
            ],
            "damping": [DAMPING[name] for name in outputs],
        },
        "rise": 0.1,
        "pulses": {
            "q": {
                "start": [2.0, 4.0, 40.0, 42.0],
                "stop": [3.0, 5.0, 41.0, 43.0],
                "value": [q, -q, -q, q],
            },
            "V": {"start": [10.0], "stop": [30.0], "value": [PULSE_V]},
            "p": {
                "start": [12.0, 14.0, 18.0, 20.0],
                "stop": [13.0, 15.0, 19.0, 21.0],
                "value": [p, -p, -p, p],
            },
        },
    } | ({"coordinated_turn": turn} if "r" in outputs else {})


def moderate_turbulence(altitude: float) -> dict[str, Any]:
    """Parameters of moderate turbulence at an altitude, m; at high altitude the intensity is 10
    ft/s.
    """
    values: dict[str, Any] = {"altitude": max(altitude, LOWEST), "seed": 1}
    if altitude < HIGH:
        values["wind"] = MODERATE_WIND
    if altitude > LOW:
        values["sigma"] = MODERATE_SIGMA
    return values


LEAST_SHARE = 0.01
"""Of the ticks: 0.6 s of a flight of a minute, more than the begin of a step takes."""


def unit_gains(lag: list[float], delay: float) -> dict[str, Any]:
    """The keys of a controller of channels with lags and a delay, s, whose gains, each 1, are to be
    selected.
    """
    ones = [1.0] * len(lag)
    return dict.fromkeys(("Lambda", "beta", "input_scale", "omega"), ones) | {
        "k_g": 1.0,
        "k_d": ones[1:],
        "D": [1] * len(lag),
        "sign": "auto",
        "softening": SOFTENING,
        "lag": lag,
        "delay": delay,
    }


class ManoeuvreResult(NamedTuple):
    """Result of a simulation of the manoeuvre in one process."""

    outcome: str
    rms: dict[str, float]  # of the error by output, SI
    largest: dict[str, float]  # abs(u) by input
    # by input, the share of the ticks with the input at its limit, from LEAST_SHARE on
    at_stop: dict[str, float]

    @property
    def text(self) -> str:
        """The outcome, and the inputs that were at their limits."""
        return ", ".join(
            [
                self.outcome,
                *(f"{name} at its stop {share:.0%}" for name, share in self.at_stop.items()),
            ]
        )


def fly_all(
    scenario: Scenario, progress: Callable[[str], None] = lambda _: None
) -> dict[str, ManoeuvreResult]:
    """Fly a scenario of `identify` three times: "calm", with its "gust", and in moderate
    "turbulence" without the gust.
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
    """Rms errors, the largest commands and the inputs at their limits of a tape."""
    _, error = best_error(tape)
    rms = {name: error_metrics(error[name]).rms for name in error.names}
    largest = {
        name: float(np.max(np.abs(tape["u"][name]), initial=0.0)) for name in tape["u"].names
    }
    shares = {name: kinds["magnitude"] for name, kinds in saturation_shares(tape).items()}
    at_stop = {name: share for name, share in shares.items() if share >= LEAST_SHARE}
    return ManoeuvreResult(str(tape.outcome), rms, largest, at_stop)
