# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The aircraft in time: equation (1) behind its actuators, in fixed steps, and what its sensors see."""

from typing import NamedTuple

from array_api_compat import array_namespace

from aircraft_sim import dynamics
from aircraft_sim.actuators import Actuators
from aircraft_sim.actuators import step as move
from aircraft_sim.dynamics import Aircraft, x_dot
from aircraft_sim.sensors import Sensors, arrives, noise
from flight_core.integrators import rk4
from flight_core.rates import divide, seconds
from flight_core.vectors import Array

LARGEST = 1e6
"""SI. No state of an aircraft comes near it; a diverged loop passes it on its way to infinity."""


class Plant(NamedTuple):
    """What flies."""

    aircraft: Aircraft
    actuators: Actuators
    sensors: Sensors
    step_ns: int  # of the integration


class AircraftState(NamedTuple):
    """What the aircraft carries in time, deviations from trim, SI."""

    x: Array  # (n,)
    position: Array  # (m,) of the actuators: the input that acts


class Measured(NamedTuple):
    """What the sensors make of one instant."""

    y: Array | None  # (m,) C x + noise, None where the sample is lost
    noise: Array  # (m,)


def start(plant: Plant) -> AircraftState:
    """The state in trim: x = 0 and the actuators at 0."""
    xp = array_namespace(plant.aircraft.A)
    return AircraftState(xp.zeros_like(plant.aircraft.A[0, :]), xp.zeros_like(plant.aircraft.B[0, :]))


def advance(t_ns: int, state: AircraftState, u: Array, duration_ns: int, plant: Plant) -> AircraftState:
    """State at t + duration from that at t, with the command u held (zero-order hold).

    Each step dt is

        position+ = actuators.step(position, u, dt)
        x+        = Runge-Kutta step of equation (1) with the input position+

    The position at the end of the step acts during all of it: an ideal actuator then passes u on without a delay, to the last
    bit, and a real one leads its continuous model by dt / 2. Time is counted in ns so that steps add up exactly. Raises
    ParameterError where the step does not divide the duration.
    """
    x, position = state
    dt = seconds(plant.step_ns)
    for k in range(divide(duration_ns, plant.step_ns, "step", "the duration")):
        position = move(position, u, dt, plant.actuators)
        x = rk4(x_dot, seconds(t_ns + k * plant.step_ns), x, position, plant.aircraft, dt)
    return AircraftState(x, position)


def diverged(state: AircraftState) -> bool:
    """Whether a state is beyond anything that flies: not finite, or above LARGEST in any component."""
    xp = array_namespace(state.x)
    return not bool(xp.all(xp.abs(state.x) < LARGEST))  # False for NaN too


def measure(number: int, state: AircraftState, plant: Plant) -> Measured:
    """What the sensors make of the state at sample `number` >= 0: y = C x + noise, or nothing where the sample is lost."""
    error = noise(number, plant.sensors)
    y = dynamics.y(state.x, plant.aircraft) + error
    return Measured(y if arrives(number, plant.sensors) else None, error)
