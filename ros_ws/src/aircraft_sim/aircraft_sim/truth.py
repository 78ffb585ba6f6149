# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Collect the ground truth for the log: state, f(x, t), wind and actuator positions.

No controller receives the ground truth.
"""

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.atmosphere import turbulence
from aircraft_sim.plant import dynamics
from aircraft_sim.plant.plant import AircraftState, PlantParams
from flight_core.vectors import FloatArray


def names(airframe: Airframe) -> tuple[str, ...]:
    """Return the names of the channels of `truth`, group by group.

    - "x.state": the states of the airframe.
    - "f.state": f of equation (1), with the disturbances.
    - "gust.axis": the wind along the axes of the airframe's gusts, m/s. It is the sum of 1-cosine
      gusts, turbulence, and the wind at the present place minus the wind at the start.
    - "actuator.input": the present position of the actuator.
    """
    groups = (
        ("x", airframe.states),
        ("f", airframe.states),
        ("gust", airframe.gusts),
        ("actuator", airframe.inputs),
    )
    channels: list[str] = []
    for group, members in groups:
        channels += [f"{group}.{name}" for name in members]
    return tuple(channels)


def values(
    state: AircraftState, wind: FloatArray, rate: FloatArray, plant: PlantParams
) -> FloatArray:
    """Return the values of `truth` in the order of `names`.

    The values of f and gust are those that act in the next step, because turbulence is constant
    over a step. `wind` (G,) and `rate` (n,) are the `dynamics.Forcing` of this instant.
    """
    f = dynamics.f_state(state.x, plant.aircraft) + rate
    if plant.aircraft.trim is not None:
        f = f + plant.aircraft.trim
    if plant.turbulence is not None:
        turbulent = turbulence.wind(state.turbulence, plant.turbulence)
        wind = wind + turbulent
        f = f + plant.aircraft.gust_direction @ turbulent
    return np.concatenate([state.x, f, wind, state.position])
