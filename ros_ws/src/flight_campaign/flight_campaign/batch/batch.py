# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Vectorised Monte Carlo simulation: N uncertain aircraft fly one course under any law.

The course is the reference, the wind, the sensor errors and the feedforward that all aircraft
share. The closed loop is the same as in the simulation in a single process. The last axis of every
array is the aircraft, so one line of a law or of the actuators acts on all aircraft.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp
from numpy.typing import NDArray

from aircraft_sim.plant.actuators import Actuators
from aircraft_sim.plant.dynamics import Aircraft, Coupling
from flight_analysis.closed_loop.scenario import Scenario
from flight_campaign import equipment
from flight_campaign.batch import batch_allocation, batch_loop
from flight_campaign.batch.batch_loop import (
    FleetResult,
    LoopSample,
    LoopState,
    Timing,
    Vehicle,
    figures,
)
from flight_campaign.batch.batch_matrices import FleetMatrices, remainder_rows
from flight_campaign.batch.batch_schedule import Schedule
from flight_campaign.batch.campaign_course import Course, Segments, require_flyable
from flight_campaign.batch.device import schedule_of_device
from flight_core.rates import seconds
from flight_core.vectors import Array, FloatArray
from rise_di_controller.law.control_law import ControlLaw
from rise_di_controller.law.saturation import Limits

jax.config.update("jax_enable_x64", True)  # float64 as everywhere else in the stack


def vehicle(scenario: Scenario) -> Vehicle:
    """Return the properties that all aircraft share. Raises as `require_flyable` does."""
    require_flyable(scenario)
    plant = scenario.aircraft.plant()
    channels = scenario.aircraft.channels()
    aircraft = plant.aircraft
    errors = scenario.aircraft.sensor_arrays()
    order = [list(channels.outputs).index(name) for name in scenario.controller.outputs]
    quantum = None if errors.quantum is None else errors.quantum[order]
    guard = scenario.controller.guard()
    states, remainder = _reduced(aircraft)
    effectors = list(channels.inputs)
    return Vehicle(
        outputs=tuple(np.argmax(aircraft.C[order], axis=1).tolist()),
        inputs=tuple(effectors.index(name) for name in scenario.controller.effectors),
        remainder_states=tuple(states.tolist()),
        vanes=tuple(scenario.aircraft.load()[0].index(name) for name in scenario.controller.vanes),
        remainder=remainder,
        actuators=Actuators(
            *(None if values is None else values[:, None] for values in plant.actuators)
        ),
        limits=Limits(*(values[:, None] for values in guard.limits)),
        quantum=None if quantum is None else quantum[:, None],
        dt=seconds(plant.step_ns),
        allocation=None
        if guard.allocation is None
        else batch_allocation.with_column_limits(guard.allocation),
    )


def shared(params: Any) -> Any:
    """Convert the parameters of a law for one aircraft, (m,), to the shape (m, 1) for a fleet.

    Matrices stay as they are, because all aircraft share them.
    """
    return jax.tree.map(
        lambda value: np.asarray(value)[:, None] if np.ndim(value) == 1 else np.asarray(value),
        params,
    )


def with_equipment(
    vehicle: Vehicle, scenario: Scenario, values: Mapping[str, FloatArray]
) -> Vehicle:
    """Return the vehicle with the lags and the noise of N aircraft.

    `values` has the lags and noises by the names of `equipment.drawn`, (N,) each. If one is
    missing, the value of the scenario holds for all aircraft.
    """
    channels = scenario.aircraft.channels()
    aircraft = scenario.aircraft
    if any(name.startswith("lag[") for name in values):
        lag = equipment.in_order(values, "lag", tuple(channels.inputs), aircraft.actuators.lag)
        vehicle = replace(vehicle, actuators=vehicle.actuators._replace(lag=_rows(lag)))
    if any(name.startswith("noise[") for name in values):
        noise = aircraft.sensors.noise
        noises = equipment.in_order(values, "noise", tuple(channels.outputs), noise)
        more = [
            value / nominal - 1.0 if nominal else 0.0
            for value, nominal in zip(noises, noise, strict=True)
        ]
        by_name = dict(zip(channels.outputs, more, strict=True))
        noisier = _rows([by_name[name] for name in scenario.controller.outputs])
        vehicle = replace(vehicle, noisier=noisier)
    return vehicle


def _rows(values: Sequence[Any]) -> Array:
    """Stack numbers and arrays of shape (N,) as the rows of an array."""
    return jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, values)))


def _reduced(aircraft: Aircraft) -> tuple[NDArray[np.int64], Aircraft]:
    """Keep of an aircraft only the states and rows that its nonlinear remainder needs.

    The remainder, `remainder_of`, is the part of f_state that is not linear in the state. Returns
    the indices of the states on which the remainder depends, and the aircraft with only these
    states and the rows `remainder_rows`.
    """
    rows = remainder_rows(aircraft)
    coupling = aircraft.coupling
    kinematics = aircraft.kinematics
    in_remainder = aircraft.gravity.any(axis=0)
    if coupling is not None:
        in_remainder[[*coupling.first, *coupling.second]] = True
    if kinematics is not None:
        in_remainder = in_remainder | kinematics.select.any(axis=0) | kinematics.linear.any(axis=0)
    states = np.flatnonzero(in_remainder)
    if coupling is not None:
        first, second = (
            np.searchsorted(states, place) for place in (coupling.first, coupling.second)
        )
        coupling = Coupling(coupling.gain[rows], first, second)
    if kinematics is not None:
        kinematics = kinematics._replace(
            select=kinematics.select[:, states],
            into=kinematics.into[rows],
            linear=kinematics.linear[:, states],
        )
    gravity = aircraft.gravity[np.ix_(rows, states)]
    return states, aircraft._replace(gravity=gravity, coupling=coupling, kinematics=kinematics)


def fly(
    fleet: FleetMatrices,
    vehicle: Vehicle,
    course: Course,
    control_law: ControlLaw,
    params: Any,
    schedule: Schedule | None = None,
) -> FleetResult:
    """Fly N aircraft through the course under one law, from trim at rest.

    Each tick has four parts. The first is the sensors. The second is a step of the law, its
    engagement, or a missed sample, depending on the phase of the course. The third moves the
    actuators in K steps up to the next tick, and the fourth moves the aircraft. The nonlinear
    remainder s is taken in the middle between two ticks, extrapolated from its values at this tick
    and at the previous one.

    `params` of the law have shape (m, 1) or (m, N). If all aircraft have the same parameters, (m,),
    `shared` converts them. `schedule` divides the ticks into compiled loops. None selects the
    schedule that is fastest on the device. The schedule does not change the result.
    """
    timing = _timing(fleet, course)
    constants = batch_loop.Constants(fleet._replace(blocks=()), vehicle, params)
    segments = jax.tree.map(jnp.asarray, course.segments)
    compiled: dict[str, Any] = {"control_law": control_law, "timing": timing}
    first = jax.tree.map(lambda values: values[0], segments)
    state = batch_loop.begin(constants, first, **compiled)
    k = 0
    for run in (schedule or schedule_of_device())(course):
        # The branches of an allocation are not unrolled, because they would then compile for
        # minutes.
        looped = run if vehicle.allocation is None else run._replace(patterns_per_step=1)
        state = batch_loop.fly_run(state, constants, segments, k, run=looped, **compiled)
        k += run.length
    return figures(state, k, course.period)


def on_host(result: FleetResult) -> FleetResult:
    """Copy the metrics of the flights from the device to NumPy arrays."""
    return jax.tree.map(np.asarray, result)


def _timing(fleet: FleetMatrices, course: Course) -> Timing:
    late = int(np.max(np.asarray(fleet.late)))
    return Timing(fleet.blocks, course.steps, course.late, late)


class FleetStepper:
    """Steps the flights of `fly` tick by tick, with u from outside.

    Call `sense` and then `advance` for each tick of the course.
    """

    def __init__(self, fleet: FleetMatrices, vehicle: Vehicle, course: Course) -> None:
        self.ticks = len(course.segments.t)
        self._course = course
        self._k = 0
        self._timing = _timing(fleet, course)
        self._fleet, self._vehicle, self._segments = jax.device_put(
            (fleet._replace(blocks=()), vehicle, course.segments)
        )
        self._state = self._begin = batch_loop.in_trim(fleet, vehicle, self._timing)

    @property
    def t(self) -> float:
        """Time of the present tick, s."""
        return self._k * self._course.period

    @property
    def bounded(self) -> NDArray[np.bool_]:
        """Mask of the aircraft that have not diverged, (N,)."""
        return np.asarray(self._state.bounded)

    def sense(self) -> tuple[FloatArray, FloatArray]:
        """Return y and y_m of the present tick, each (m, N), in the law's order."""
        self._state, sample = _sense_once(self._state, self._segments, self._k, self._vehicle)
        y = np.asarray(sample.y)
        return y, np.broadcast_to(np.asarray(sample.y_m), y.shape)

    def advance(self, u: FloatArray) -> None:
        """Advance to the next tick with the command u, (p, N).

        u is in the order of the controller's effectors.
        """
        self._state = _advance_once(
            self._state,
            u,
            self._segments,
            self._k,
            self._fleet,
            self._vehicle,
            self._timing,
        )
        self._k += 1

    def restart(self, which: NDArray[np.bool_]) -> None:
        """Put the aircraft in the mask `which`, (N,), into trim now. Their metrics begin anew."""
        self._state = jax.tree.map(partial(jnp.where, which), self._begin, self._state)

    def result(self) -> FleetResult:
        """Return the metrics of the flights, after the last tick."""
        return figures(self._state, self.ticks, self._course.period)


@jax.jit
def _sense_once(
    now: LoopState, segments: Segments, k: int, vehicle: Vehicle
) -> tuple[LoopState, LoopSample]:
    return batch_loop.sense(now, jax.tree.map(lambda values: values[k], segments), vehicle)


@partial(jax.jit, static_argnames=("timing",))
def _advance_once(
    now: LoopState,
    command: Array,
    segments: Segments,
    k: int,
    fleet: FleetMatrices,
    vehicle: Vehicle,
    timing: Timing,
) -> LoopState:
    return batch_loop.advance(
        now,
        command,
        jax.tree.map(lambda values: values[k], segments),
        fleet,
        vehicle,
        timing,
    )
