# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulate the plant: equation (1) behind actuators, with zero-order hold of u.

The plant is integrated in fixed steps.
"""

from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.atmosphere import turbulence
from aircraft_sim.atmosphere.turbulence import Turbulence
from aircraft_sim.plant import actuators, dynamics
from aircraft_sim.plant.actuators import Actuators
from aircraft_sim.plant.dynamics import Aircraft, Forcing
from flight_core.integrators import rk4
from flight_core.rates import divide, seconds
from flight_core.vectors import Array, array_namespace

# A state whose magnitude exceeds this limit, SI, counts as diverged. No state of an aircraft in
# flight comes near this limit.
DIVERGENCE_LIMIT = 1e6

SHORTEST_DRIFT = 1e-9  # s, in place of a duration of 0, so that nothing is divided by 0


class Drift(NamedTuple):
    """A change of A, B and the effect of wind in flight.

    `A`, `B` and `wind` are factors on the entries. From the start of the drift on, the factors in
    force change linearly from 1, and reach these values after `duration`.
    """

    start: float  # s of flight time
    duration: float  # s, 0 for a sudden change
    A: Array  # (n, n)
    B: Array  # (n, m)
    wind: Array  # (n, G)


def share(t: Array, start: Any, duration: Any) -> Array:
    """Compute how far a drift has gone at t: 0 before its start, 1 after its duration."""
    xp = array_namespace(t)
    part = xp.minimum((t - start) / xp.maximum(duration, SHORTEST_DRIFT), 1.0)
    return xp.where(t >= start, xp.where(duration > 0.0, part, 1.0), 0.0)


class OverAirspeed(NamedTuple):
    """Powers by which A and B follow the airspeed V0 + V, and the trims at some airspeeds.

    Entries are multiplied by powers of the airspeed divided by V0. The exponents are in `A`, `B`,
    `gravity` and `wind`. The trim is given at K ratios.
    """

    speed: float  # V0, m/s
    place: int  # index of V in x
    A: Array  # (n, n) exponents of the entries
    B: Array  # (n, m)
    gravity: Array  # (n, n)
    wind: Array  # (n, G)
    ratio: Array  # (K,) rising ratios of airspeed to V0
    x: Array  # (K, n) states of the trims, deviations from the trim at V0
    u: Array  # (K, m) inputs of the trims, deviations from the trim at V0


class PlantParams(NamedTuple):
    """Parameters of the plant.

    They describe the aircraft, the actuators, the integration step, turbulence and drift, and the
    change with airspeed.
    """

    aircraft: Aircraft
    actuators: Actuators
    step_ns: int  # integration step
    turbulence: Turbulence | None = None  # filters for one step; None without turbulence
    drift: Drift | None = None
    over_airspeed: OverAirspeed | None = None  # if None, A and B stay those of the trim speed


def aircraft_at(t_ns: int, plant: PlantParams, x: Array | None = None) -> Aircraft:
    """Return the aircraft at t in the state x, (n,), or in trim if x is None.

    The drift multiplies A, B and the effect of wind by 1 + share (factor - 1). If the plant follows
    the airspeed, which it cannot do beside a drift, the entries are instead multiplied by powers of
    r = 1 + V / V0. Deviations are then taken from the trim at r, (x_r, u_r):

        x_dot = A x + gravity sin(x) + B u + trim,  trim = -(A x_r + gravity sin(x_r) + B u_r)
    """
    if plant.over_airspeed is not None and x is not None:
        return _at_airspeed(x, plant.aircraft, plant.over_airspeed)
    aircraft = plant.aircraft
    drift = plant.drift
    if drift is None:
        return aircraft
    part = share(np.array(seconds(t_ns)), drift.start, drift.duration)
    A, B, wind = (1.0 + part * (factor - 1.0) for factor in (drift.A, drift.B, drift.wind))
    return aircraft._replace(
        A=aircraft.A * A, B=aircraft.B * B, gust_direction=aircraft.gust_direction * wind
    )


def _at_airspeed(x: Array, aircraft: Aircraft, over: OverAirspeed) -> Aircraft:
    """Return the aircraft at the airspeed of the state x.

    The airspeed is limited to the range from the lowest to the highest airspeed that has a trim.
    """
    least, most = over.ratio[[0, -1]].tolist()
    r = min(max(1.0 + x[over.place].item() / over.speed, least), most)
    A, B, gravity = (
        matrix * r**powers
        for matrix, powers in (
            (aircraft.A, over.A),
            (aircraft.B, over.B),
            (aircraft.gravity, over.gravity),
        )
    )
    x_r = np.array([np.interp(r, over.ratio, column) for column in over.x.T])
    u_r = np.array([np.interp(r, over.ratio, column) for column in over.u.T])
    trim = -(A @ x_r + gravity @ np.sin(x_r) + B @ u_r)
    wind = aircraft.gust_direction * r**over.wind
    return aircraft._replace(A=A, B=B, gravity=gravity, gust_direction=wind, trim=trim)


class AircraftState(NamedTuple):
    """State of the plant, deviations from trim, SI."""

    x: Array  # (n,)
    position: Array  # (m,) positions of the actuators
    # (s,) state of the turbulence filters, or None without turbulence
    turbulence: Array | None = None


def initial_state(plant: PlantParams) -> AircraftState:
    """Return the state in trim, with x = 0 and all actuators at 0.

    The turbulence filters start from a sample of their stationary distribution.
    """
    xp = array_namespace(plant.aircraft.A)
    z = None if plant.turbulence is None else turbulence.initial_state(plant.turbulence)
    return AircraftState(
        xp.zeros_like(plant.aircraft.A[0, :]), xp.zeros_like(plant.aircraft.B[0, :]), z
    )


def forcing(t_ns: int, steps: int, plant: PlantParams, x: Array | None = None) -> Forcing:
    """Compute the forcing at the beginnings, middles and ends of steps that begin at t.

    For n steps there are 2 n + 1 instants. The aircraft is the same at all of them, namely the
    aircraft at t in the state x, or in trim if x is None.
    """
    halves = array_namespace(plant.aircraft.A).arange(2 * steps + 1, dtype=plant.aircraft.A.dtype)
    return dynamics.at_times(
        seconds(t_ns) + seconds(plant.step_ns) / 2.0 * halves, aircraft_at(t_ns, plant, x)
    )


def advance(
    t_ns: int,
    state: AircraftState,
    u: Array,
    duration_ns: int,
    plant: PlantParams,
    forced: Forcing | None = None,
) -> AircraftState:
    """Integrate from the state at t to t + duration, with the command u held (zero-order hold).

    A step of length dt that begins at t_k is

        position+, mean = actuators.move(t_k, position, u, dt)
        x+  = Runge-Kutta step of equation (1) with the input `mean` and the turbulence at t_k
        z+              = turbulence.step(z, n_k)

    The mean position over the step acts during the whole step. So the error relative to a
    continuous actuator is of second order in dt, and an ideal actuator passes u on exactly and
    without delay. The turbulence at the beginning of the step acts during the whole step. So its
    spectrum is exact at the steps, with a hold in between. Time is counted in ns, so that steps add
    up exactly.

    A and B are taken at t for the whole duration. The normal numbers n_k follow from the seed. If
    the caller has already computed the `forcing` of these steps, it can be given as `forced`.
    Raises ParameterError if the step does not divide the duration.
    """
    x, position, z = state
    aircraft = aircraft_at(t_ns, plant, x)
    filters = plant.turbulence
    steps = divide(duration_ns, plant.step_ns, "step", "the duration")
    dt = seconds(plant.step_ns)
    normals = () if filters is None else turbulence.normals(t_ns // plant.step_ns, steps, filters)

    def x_dot(since: float, x: Array, forced: Array, params: Aircraft) -> Array:
        return dynamics.x_dot_forced(x, forced[round(2.0 * since / dt)], params)

    rate = (forcing(t_ns, steps, plant, x) if forced is None else forced).rate
    for k in range(steps):
        position, mean = actuators.move(
            seconds(t_ns + k * plant.step_ns), position, u, dt, plant.actuators
        )
        input_now = (
            aircraft.B.dot(mean) if aircraft.trim is None else aircraft.B.dot(mean) + aircraft.trim
        )
        if filters is not None:
            input_now = input_now + aircraft.gust_direction @ turbulence.wind(z, filters)
            z = turbulence.step(z, normals[k], filters)
        x = rk4(x_dot, 0.0, x, rate[2 * k : 2 * k + 3] + input_now, aircraft, dt)
    return AircraftState(x, position, z)


def has_diverged(state: AircraftState) -> bool:
    """Return whether a state is not finite, or has a component above DIVERGENCE_LIMIT."""
    # The comparison is also false for NaN.
    return not all(abs(x) < DIVERGENCE_LIMIT for x in state.x.tolist())


def output(state: AircraftState, plant: PlantParams) -> Array:
    """Compute the outputs y = C x without the errors of sensors, shape (m,)."""
    return dynamics.y(state.x, plant.aircraft)
