# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What the aircraft really does: the full state, f(x, t), the wind and the actuators, for the log alone."""

import numpy as np

from aircraft_sim import dynamics, turbulence
from aircraft_sim.airframe import Airframe
from aircraft_sim.plant import AircraftState, Plant
from flight_core.rates import seconds
from flight_core.vectors import FloatArray


def names(airframe: Airframe) -> tuple[str, ...]:
    """Channels of `truth`, group by group.

    "x.state", "f.state" (the part of x_dot, all disturbances in it), "gust.axis" (the wind along each axis that the airframe
    knows, 1-cosine gust and turbulence together, m/s), "actuator.input" (the position that has acted up to now).
    """
    groups = {
        "x": tuple(airframe.states),
        "f": tuple(airframe.states),
        "gust": tuple(airframe.gusts),
        "actuator": tuple(airframe.inputs),
    }
    return tuple(f"{group}.{name}" for group, members in groups.items() for name in members)


def values(t_ns: int, state: AircraftState, plant: Plant) -> FloatArray:
    """Values of `truth` in the order of `names`; f and the wind are those that act from t on."""
    t, aircraft = seconds(t_ns), plant.aircraft
    air = None if plant.turbulence is None else turbulence.wind(state.turbulence, plant.turbulence)
    wind = dynamics.wind(t, aircraft, air)
    f = dynamics.of_state(state.x, aircraft) + dynamics.of_time(t, wind, aircraft)
    return np.concatenate([state.x, f, wind, state.position])
