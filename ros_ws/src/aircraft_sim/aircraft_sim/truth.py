# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What the aircraft really does: the full state, f(x, t), gusts, actuators and the sensors' errors, for the log alone."""

import numpy as np

from aircraft_sim.airframe import Airframe
from aircraft_sim.disturbance import one_minus_cosine
from aircraft_sim.dynamics import Aircraft, f
from aircraft_sim.params import AircraftParameters
from aircraft_sim.plant import AircraftState
from flight_core.rates import seconds
from flight_core.vectors import FloatArray


def names(airframe: Airframe, params: AircraftParameters) -> tuple[str, ...]:
    """Channel names of `truth`: "t" (flight time, s), then group by group.

    "x.state", "f.state" (the part of x_dot), "gust.name" (m/s), "actuator.input" (the position that has acted up to now) and
    "noise.output" (the error in y, also of a sample that is lost).
    """
    groups = {
        "x": tuple(airframe.states),
        "f": tuple(airframe.states),
        "gust": tuple(params.gusts),
        "actuator": tuple(airframe.inputs),
        "noise": airframe.outputs,
    }
    return ("t", *(f"{group}.{name}" for group, members in groups.items() for name in members))


def values(t_ns: int, state: AircraftState, noise: FloatArray, aircraft: Aircraft) -> FloatArray:
    """Values of `truth` in the order of `names`."""
    t = seconds(t_ns)
    gusts = one_minus_cosine(t, aircraft.gusts, aircraft.speed)
    return np.concatenate([[t], state.x, f(t, state.x, aircraft), gusts, state.position, noise])
