# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Guided flights off the design point: trimmed at each point of a grid of speeds and altitudes, gains of the design point.

Part of `python -m benchmarks.guidance`: with `--grid`. Each flight turns by 40 deg, climbs 50 m, and goes back.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from aircraft_sim.actuators import Actuators
from aircraft_sim.disturbance import AXES, Gusts
from aircraft_sim.jsbsim_aircraft import INPUTS, FlightCondition, Trim, WindModel
from aircraft_sim.jsbsim_model import JsbsimModel
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.outcome import COMPLETED, FlightEnded
from flight_core.parameters import ParameterError
from flight_core.rates import nanoseconds
from flight_design.identification.step_identification import slowest_trim

GRIDS: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "c172p": ((300.0, 1219.2, 2500.0, 4000.0), (30.0, 36.0, 46.3, 55.0, 62.0)),
    "737": ((1500.0, 6096.0, 9000.0, 11500.0), (110.0, 130.0, 154.0, 190.0, 220.0, 245.0)),
    "f16": ((500.0, 3048.0, 6000.0, 9000.0, 12000.0), (80.0, 100.0, 125.0, 154.0, 200.0, 250.0, 300.0)),
}
"""Altitudes, m, and true airspeeds, m/s."""

TURN, CLIMB = math.radians(40.0), 50.0  # rad, m
START, BACK, END = 5.0, 65.0, 155.0  # s
ALTITUDE_OFF, HEADING_OFF = 10.0, math.radians(5.0)  # at the end


class Point(NamedTuple):
    """A flight of a grid. `result`: "ok", "lost", "refused" by guidance, or "no trim"."""

    aircraft: str
    altitude: float  # m
    speed: float  # m/s
    result: str
    reason: str = ""


@cache
def slowest(name: str, altitude: float, fast: float, step_ns: int) -> float:
    """The stall speed for guidance at an altitude, m/s."""
    return slowest_trim(FlightCondition(name, fast, altitude, step_ns))


def moved(scenario: Scenario, trim: Trim, speed: float, altitude: float, stall: float) -> Scenario:
    """The scenario trimmed elsewhere: the stops of the actuators stay where they are, so their distance from trim changes."""
    controller = scenario.controller
    order = [list(INPUTS).index(name) for name in controller.inputs]
    lower, upper = trim.lower.tolist(), trim.upper.tolist()
    section = {
        "stall_speed": stall,
        "program": {
            "heading": {"start": [START, BACK], "value": [TURN, 0.0]},
            "altitude": {"start": [START, BACK], "value": [altitude + CLIMB, altitude]},
        },
    }
    unguided = replace(scenario, guidance=None).vary(
        flight={"duration": END},
        aircraft={"speed": speed, "altitude": altitude, "actuators": {"lower": lower, "upper": upper}},
        reference_model={"live": {"speed": speed}},
        controller={"lower": [lower[k] for k in order], "upper": [upper[k] for k in order]},
    )
    return unguided.vary(guidance=section)


def point(name: str, scenario: Scenario, place: tuple[float, float]) -> Point:
    """Fly a point: altitude, m, and airspeed, m/s."""
    altitude, speed = place
    step_ns, none = nanoseconds(scenario.aircraft.step), np.zeros(len(AXES))
    condition = FlightCondition(name, speed, altitude, step_ns)
    try:
        trim = JsbsimModel(condition, Actuators(), WindModel(Gusts(none, none, none + 1.0), None)).trim
        stall = slowest(name, altitude, GRIDS[name][1][-1], step_ns)
    except FlightEnded as error:
        return Point(name, altitude, speed, "no trim", str(error))
    try:
        tape = simulate(moved(scenario, trim, speed, altitude, stall))
    except ParameterError as error:
        return Point(name, altitude, speed, "refused", str(error))
    if tape.outcome != COMPLETED:
        return Point(name, altitude, speed, "lost", tape.outcome)
    log = tape["guidance"]
    off = abs(float(log["pose.altitude"][-1]) - altitude), abs(float(log["pose.psi"][-1]))
    sentence = f"altitude off by {off[0]:.1f} m, heading by {math.degrees(off[1]):.1f} deg"
    return Point(name, altitude, speed, "ok" if off[0] <= ALTITUDE_OFF and off[1] <= HEADING_OFF else "lost", sentence)


def places(name: str) -> list[tuple[float, float]]:
    """The points of the grid of an aircraft: altitude, m, and airspeed, m/s."""
    altitudes, speeds = GRIDS[name]
    return [(altitude, speed) for altitude in altitudes for speed in speeds]
