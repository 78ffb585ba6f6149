# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What the aircraft really does: the full state, f(x, t) and the gusts, for the log alone."""

import numpy as np

from aircraft_sim.airframe import Airframe
from aircraft_sim.disturbance import one_minus_cosine
from aircraft_sim.dynamics import Aircraft, f
from aircraft_sim.params import AircraftParameters
from flight_core.rates import seconds
from flight_core.vectors import FloatArray


def names(airframe: Airframe, params: AircraftParameters) -> tuple[str, ...]:
    """Channel names of `truth`: "x.state", "f.state" (the part of x_dot), "gust.name" (m/s)."""
    groups = {"x": tuple(airframe.states), "f": tuple(airframe.states), "gust": tuple(params.gusts)}
    return tuple(f"{group}.{name}" for group, members in groups.items() for name in members)


def values(t_ns: int, x: FloatArray, aircraft: Aircraft) -> FloatArray:
    """Values of `truth` in the order of `names`."""
    t = seconds(t_ns)
    return np.concatenate([x, f(t, x, aircraft), one_minus_cosine(t, aircraft.gusts, aircraft.speed)])
