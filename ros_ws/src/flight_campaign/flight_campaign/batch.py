# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Vectorised Monte Carlo simulation: N uncertain aircraft through one course under any law, as in
the single-process loop.

The last axis of every array is the aircraft, so that one line of a law or of the actuators acts on
all of them. Between two ticks of the controller an aircraft is linear up to a small remainder: all
steps of its integration are one matrix product.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from numpy.typing import NDArray

from aircraft_sim import actuators, dynamics, sensors
from aircraft_sim.actuators import Actuators
from aircraft_sim.dynamics import Aircraft, Coupling
from aircraft_sim.plant import DIVERGENCE_LIMIT
from flight_analysis.closed_loop.scenario import Scenario
from flight_campaign import batch_allocation, equipment, missions
from flight_campaign.batch_allocation import allocate
from flight_campaign.batch_matrices import Fleet, StateBlock, at, remainder_rows
from flight_campaign.benchmark_course import Course, Segments
from flight_campaign.missions import Mission
from flight_core.arithmetic import product
from flight_core.rates import seconds
from flight_core.vectors import Array, FloatArray
from rise_di_controller.allocation import Allocation, reached
from rise_di_controller.control_law import ControlLaw, Measurements
from rise_di_controller.saturation import Limits, saturate

jax.config.update("jax_enable_x64", True)  # float64 as everywhere else in the stack


class Vehicle(NamedTuple):
    """Properties that all aircraft of a fleet share."""

    outputs: Array  # (m,) indices of the outputs in the state, in the law's order
    inputs: Array  # (p,) indices of the effectors in the airframe's order
    remainder_states: Array  # (c,) indices of the states in the nonlinear remainder
    # reduced to the remainder: f_state of x[remainder_states] gives the rows `remainder_rows`
    remainder: Aircraft
    actuators: Actuators  # (p, 1), airframe's order
    limits: Limits  # (m, 1), law's order: of u, as the controller has them
    quantum: Array | None  # (m, 1), law's order
    noisier: (
        Array | None
    )  # (m, N), law's order: noise in parts of the noise of the course, less 1; None: 0
    dt: float  # s, of a step of the integration
    vanes: tuple[int, ...] = ()  # indices in the state of what the vanes read
    allocation: Allocation | None = None  # None: the inputs of the law are the effectors


def vehicle(scenario: Scenario) -> Vehicle:
    """The shared properties of all aircraft of a scenario."""
    plant = scenario.aircraft.plant()
    channels = scenario.aircraft.channels()
    aircraft = plant.aircraft
    errors = scenario.aircraft.sensor_arrays()
    order = [list(channels.outputs).index(name) for name in scenario.controller.outputs]
    quantum = None if errors.quantum is None else errors.quantum[order]
    guard = scenario.controller.guard()
    return Vehicle(
        np.argmax(aircraft.C[order], axis=1),
        np.array([list(channels.inputs).index(name) for name in scenario.controller.effectors]),
        *_reduced(aircraft),
        Actuators(*(None if values is None else values[:, None] for values in plant.actuators)),
        Limits(*(values[:, None] for values in guard.limits)),
        None if quantum is None else quantum[:, None],
        None,
        seconds(plant.step_ns),
        tuple(scenario.aircraft.load()[0].index(name) for name in scenario.controller.vanes),
        None if guard.allocation is None else batch_allocation.with_column_limits(guard.allocation),
    )


def shared(params: Any) -> Any:
    """Parameters of a law for one aircraft, (m,), as those of a fleet, (m, 1); matrices stay, which
    all aircraft share.
    """
    return jax.tree.map(
        lambda value: np.asarray(value)[:, None] if np.ndim(value) == 1 else np.asarray(value),
        params,
    )


def with_equipment(
    vehicle: Vehicle, scenario: Scenario, values: Mapping[str, FloatArray]
) -> Vehicle:
    """The vehicle with the lags and the noise of N aircraft, by name as from `equipment.drawn`."""
    channels = scenario.aircraft.channels()
    aircraft = scenario.aircraft
    if any(name.startswith("lag[") for name in values):
        lag = equipment.in_order(values, "lag", tuple(channels.inputs), aircraft.actuators.lag)
        vehicle = vehicle._replace(actuators=vehicle.actuators._replace(lag=_rows(lag)))
    if any(name.startswith("noise[") for name in values):
        noise = aircraft.sensors.noise
        drawn = equipment.in_order(values, "noise", tuple(channels.outputs), noise)
        more = [
            value / published - 1.0 if published else 0.0
            for value, published in zip(drawn, noise, strict=True)
        ]
        by_name = dict(zip(channels.outputs, more, strict=True))
        vehicle = vehicle._replace(
            noisier=_rows([by_name[name] for name in scenario.controller.outputs])
        )
    return vehicle


def _rows(values: Sequence[Any]) -> Array:
    """Numbers, and arrays of shape (N,), as rows."""
    return jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, values)))


class FleetResult(NamedTuple):
    """Metrics of N flights, by channel in the law's order, over the controller's ticks. Errors are
    the true ones, C x - y_m.
    """

    rms: Array  # (m, N)
    max: Array  # (m, N)
    slew: Array  # (p, N) mean abs(u_dot) by effector, units of u / s
    diverged: Array  # (N,) bool: the state exceeded DIVERGENCE_LIMIT, the other figures are invalid
    mission: dict[str, Array] | None = None  # of `missions.figures`; None without guidance
    windows: Array | None = None  # (W, m, N) rms by window


def remainder_of(states: Array, aircraft: Aircraft) -> Array:
    """Nonlinear remainder of f_state, (q, N): gravity @ (sin(x) - x) + gain @ (x[first] x[second])
    + kinematics(x).
    """
    return dynamics.f_state(states, aircraft) - aircraft.gravity @ states


def _reduced(aircraft: Aircraft) -> tuple[NDArray[np.int64], Aircraft]:
    """Indices of the states in the remainder, and the aircraft reduced to them and to
    `remainder_rows`.
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
    fleet: Fleet,
    vehicle: Vehicle,
    course: Course,
    control_law: ControlLaw,
    params: Any,
    mission: Mission | None = None,
    windows: tuple[int, ...] = (),
) -> FleetResult:
    """Fly N aircraft through the course under one law, from trim at rest; on a mission guidance
    commands the reference.

    At each tick: sensors, step of the law (or engagement, or a missed sample, by the course's
    phase), actuators over the K steps to the next tick, aircraft. The remainder s at the middle of
    a tick is extrapolated from this tick and the previous. Arguments: `params` of the law, (m, 1)
    or (m, N); of one aircraft, (m,), where all fly the same, as `shared` makes them. `windows` has
    the ticks at which a window of the figures ends and the next begins.
    """
    timing = Timing(
        fleet.blocks, course.steps, course.late, int(np.max(np.asarray(fleet.late))), windows
    )
    arrays = fleet._replace(blocks=())
    segments = jax.tree.map(jnp.asarray, course.segments)
    return _fly(
        arrays,
        vehicle,
        segments,
        params,
        course.period,
        mission,
        control_law=control_law,
        timing=timing,
    )


class Timing(NamedTuple):
    """Constants of the compiled loop. Hashable."""

    blocks: tuple[StateBlock, ...]
    steps: int  # of the integration in a tick
    y_late: int  # ticks
    u_late: int  # ticks, the largest
    windows: tuple[int, ...]  # ticks at which a window of the figures ends and the next begins


class Sample(NamedTuple):
    """What a law takes at a tick, (m, N) or (m, 1)."""

    y: Array
    y_m: Array  # at the stamp of y
    y_m_dot: Array


class LoopState(NamedTuple):
    """State of the closed loop from tick to tick."""

    x: Array  # (n, N)
    position: Array  # (p, N) airframe's order
    remainder: Array  # (q, N) of the previous tick
    law: Any
    u: Array  # (m, N) law's order
    command: Array  # (p, N) the effectors; u without an allocation
    y_before: Array  # (y_late, m, N) newest first
    command_before: Array  # (u_late, p, N)
    squares: Array  # (W, m, N) sums over the ticks of a window
    max: Array
    travel: Array  # (p, N) sum of abs(command - previous command)
    bounded: Array  # (N,) whether the state stayed below DIVERGENCE_LIMIT
    mission: Any  # MissionState; None without guidance


@partial(jax.jit, static_argnames=("control_law", "timing"))
def _fly(
    fleet: Fleet,
    vehicle: Vehicle,
    segments: Segments,
    params: Any,
    period: Array,
    mission: Mission | None,
    *,
    control_law: ControlLaw,
    timing: Timing,
) -> FleetResult:
    measure = partial(_measured, fleet=fleet, vehicle=vehicle)

    # Each branch calls `measure`: the compiler then removes the measurements that its law does not
    # use.
    def engage(now: LoopState, *measured: Any) -> tuple[Any, Array, Array]:
        started = control_law.engage(measure(now, *measured), params)
        law = jax.tree.map(
            lambda value, like: jnp.broadcast_to(value, like.shape).astype(like.dtype),
            started,
            now.law,
        )
        return law, now.u, now.command

    def step(now: LoopState, segment: Segments, sample: Sample) -> tuple[Any, Array, Array]:
        measured = measure(now, segment, sample)
        limits = vehicle.limits
        allocation = vehicle.allocation
        if allocation is None:
            law, _, u = control_law.limited(now.law, measured, segment.dt, params, limits)
            return law, u, u
        # As the guard: what the effectors give limits the law.
        _, u_free = control_law.step(now.law, measured, segment.dt, params)
        _, reachable = allocate(
            saturate(u_free, now.u, segment.dt, limits), now.command, segment.dt, allocation
        )
        law, _, u = control_law.limited(
            now.law, measured, segment.dt, params, reached(u_free, reachable)
        )
        command, u = allocate(u, now.command, segment.dt, allocation)
        return law, u, command

    def hold(now: LoopState, *measured: Any) -> tuple[Any, Array, Array]:
        return control_law.missed(now.law, measure(now, *measured), params), now.u, now.command

    def tick(
        now: LoopState, at_tick: tuple[Segments, Array | None, Array]
    ) -> tuple[LoopState, None]:
        segment, action, window = at_tick
        sensed, sample = _sense(now, segment, action, window, vehicle, mission)
        law, u, command = jax.lax.switch(segment.phase, (hold, engage, step), now, segment, sample)
        return _advance(
            sensed._replace(law=law, u=u), command, segment, fleet, vehicle, mission, timing
        ), None

    first = jax.tree.map(lambda segment: segment[0], segments)
    begin = _in_trim(fleet, vehicle, mission, timing)
    none = 0.0 * begin.u
    measured = measure(begin, first, Sample(none, none, none))
    states = jax.eval_shape(
        lambda: control_law.limited(
            control_law.engage(measured, params), measured, first.dt, params, vehicle.limits
        )[0]
    )
    begin = begin._replace(law=jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), states))
    ticks = len(segments.t)
    window = window_of(np.arange(ticks), timing.windows)
    end, _ = jax.lax.scan(
        tick, begin, (segments, None if mission is None else mission.action, window)
    )
    return _result(end, ticks, period, mission, timing)


def _measured(
    now: LoopState, segment: Segments, sample: Sample, fleet: Fleet, vehicle: Vehicle
) -> Measurements:
    """What a law takes at a tick."""
    y, y_m, y_m_dot = sample
    x = now.x.at[vehicle.outputs].set(y)
    matrices = at(segment.t, fleet)
    acting = _product(
        matrices.rate, [*now.x, *actuators.effect(segment.t, now.position, vehicle.actuators)]
    )
    moving = acting + fleet.wind * _product(matrices.forced_rate, segment.forcing_now)
    u_trim = segment.u_ff[:, None] + 0.0 * y
    x_air = x - fleet.wind * segment.air[:, None]
    vane = vane_m = None
    if vehicle.vanes:
        vane = jnp.stack([x_air[place] for place in vehicle.vanes]) + segment.vane_error[:, None]
        vane_m = segment.vane_m[:, None] + 0.0 * vane
    position = now.position[vehicle.inputs]
    if vehicle.allocation is not None:
        position = product(vehicle.allocation.effect, position)
    return Measurements(y, y_m, y_m_dot, u_trim, now.u, position, x, x_air, moving, vane, vane_m)


def window_of(ticks: Array, windows: tuple[int, ...]) -> Array:
    """Number of the window of each tick, from 0."""
    return np.searchsorted(np.array(windows, dtype=np.int64), ticks, side="right")


def _sense(
    now: LoopState,
    segment: Segments,
    action: Array | None,
    window: Array,
    vehicle: Vehicle,
    mission: Mission | None,
) -> tuple[LoopState, Sample]:
    """The sample of a tick for the law; guidance steps, and the figures take the true error."""
    true = now.x[vehicle.outputs]
    flown = now.mission
    if mission is None:
        y_m, *reference = (
            values[:, None]
            for values in (segment.y_m, segment.sampled_y_m, segment.sampled_y_m_dot)
        )
    else:
        flown, y_m, *reference = missions.reference(flown, mission)
    e = true - y_m
    y = true + segment.error[:, None]
    if vehicle.noisier is not None:
        y = y + vehicle.noisier * segment.noise[:, None]
    if vehicle.quantum is not None:
        y = sensors.quantised(y, vehicle.quantum)
    arriving = jnp.concatenate([y[None], now.y_before])
    y = arriving[-1]
    y_before = arriving[:-1]
    if mission is not None:
        assert action is not None  # noqa: S101 - for the type checker: a mission has the actions of its guidance
        flown = missions.guide(flown, now.x, y, segment, action, mission)
    sensed = now._replace(
        y_before=y_before,
        squares=now.squares.at[window].add(e * e),
        max=jnp.maximum(now.max, jnp.abs(e)),
        bounded=now.bounded
        & (jnp.max(jnp.abs(now.x), axis=0) < DIVERGENCE_LIMIT),  # False for NaN too
        mission=flown,
    )
    return sensed, Sample(y, *reference)


def _advance(
    now: LoopState,
    command: Array,
    segment: Segments,
    fleet: Fleet,
    vehicle: Vehicle,
    mission: Mission | None,
    timing: Timing,
) -> LoopState:
    """The state at the next tick, with the command of this one."""
    blocks = timing.blocks
    u_late = timing.u_late
    flown = now.mission
    places = np.argsort(
        [*chain.from_iterable(block.rows for block in blocks)]
    )  # of the states in the order of the blocks
    history = jnp.concatenate([command[None], now.command_before])
    acting = (
        command
        if not u_late
        else jnp.sum(
            jnp.where(jnp.arange(u_late + 1)[:, None, None] == fleet.late, history, 0.0), 0
        )
    )
    commanded = acting[jnp.argsort(vehicle.inputs)]

    def move(position: Array, t: Array) -> tuple[Array, Array]:
        return actuators.move(t, position, commanded, vehicle.dt, vehicle.actuators)

    # A loop of its own: without one the compiler computes all mean positions again for each state
    # that they act on.
    position, means = jax.lax.scan(
        move, now.position, segment.t + np.arange(timing.steps) * vehicle.dt
    )
    remainder = remainder_of(now.x[vehicle.remainder_states], vehicle.remainder)
    moves = [*now.x, *chain(*means), *(1.5 * remainder - 0.5 * now.remainder)]
    matrices = at(segment.t, fleet)
    parts = []
    for matrix, block in zip(matrices.tick, blocks, strict=True):
        parts.append(_product(matrix, [moves[j] for j in block.columns]))
    x = jnp.concatenate(parts)[places]
    x = jax.lax.cond(
        jnp.any(segment.forcing != 0.0),
        lambda x: x + fleet.wind * _product(matrices.forced, segment.forcing),
        lambda x: x,
        x,
    )
    if mission is not None:
        flown = missions.advance(flown, x, mission)
    return now._replace(
        x=x,
        position=position,
        remainder=remainder,
        command=command,
        command_before=history[:u_late],
        travel=now.travel + jnp.abs(command - now.command),
        mission=flown,
    )


def _result(
    end: LoopState, ticks: int, period: Array, mission: Mission | None, timing: Timing
) -> FleetResult:
    """The figures of flights at their end."""
    mission_figures = None if mission is None else missions.figures(end.mission, mission)
    lengths = np.diff([0, *timing.windows, ticks])[:, None, None]
    return FleetResult(
        jnp.sqrt(jnp.sum(end.squares, axis=0) / ticks),
        end.max,
        end.travel / ((ticks - 1) * period),
        ~end.bounded,
        mission_figures,
        jnp.sqrt(end.squares / lengths),
    )


class Stepper:
    """The flights of `fly` tick by tick, with u from outside: `sense`, then `advance`, for each
    tick of the course.
    """

    def __init__(
        self,
        fleet: Fleet,
        vehicle: Vehicle,
        course: Course,
        mission: Mission | None = None,
        windows: tuple[int, ...] = (),
    ) -> None:
        self.ticks = len(course.segments.t)
        self._course = course
        self._mission = mission
        self._k = 0
        self._timing = Timing(
            fleet.blocks, course.steps, course.late, int(np.max(np.asarray(fleet.late))), windows
        )
        self._fleet, self._vehicle, self._segments = jax.device_put(
            (fleet._replace(blocks=()), vehicle, course.segments)
        )
        self._windows = window_of(np.arange(self.ticks), windows)
        self._state = self._begin = _in_trim(fleet, vehicle, mission, self._timing)

    @property
    def t(self) -> float:
        """Time of the present tick, s."""
        return self._k * self._course.period

    @property
    def bounded(self) -> NDArray[np.bool_]:
        """Which aircraft have not diverged, (N,)."""
        return np.asarray(self._state.bounded)

    def sense(self) -> tuple[FloatArray, FloatArray]:
        """The y and y_m of the present tick, each (m, N), in the law's order."""
        action = None if self._mission is None else np.asarray(self._mission.action)[self._k]
        self._state, sample = _sense_once(
            self._state,
            self._segments,
            self._k,
            action,
            self._windows[self._k],
            self._vehicle,
            self._mission,
        )
        y = np.asarray(sample.y)
        return y, np.broadcast_to(np.asarray(sample.y_m), y.shape)

    def advance(self, u: FloatArray) -> None:
        """To the next tick with the command u, (p, N), in the order of the controller's
        effectors.
        """
        self._state = _advance_once(
            self._state,
            u,
            self._segments,
            self._k,
            self._fleet,
            self._vehicle,
            self._mission,
            self._timing,
        )
        self._k += 1

    def restart(self, which: NDArray[np.bool_]) -> None:
        """Set some aircraft, (N,), into trim at the present tick. Their figures begin again."""
        self._state = jax.tree.map(partial(jnp.where, which), self._begin, self._state)

    def result(self) -> FleetResult:
        """The figures after the last tick."""
        return _result(
            self._state, self.ticks, np.float64(self._course.period), self._mission, self._timing
        )


@jax.jit
def _sense_once(
    now: LoopState, segments: Segments, k: int, *others: Any
) -> tuple[LoopState, Sample]:
    return _sense(now, jax.tree.map(lambda values: values[k], segments), *others)


@partial(jax.jit, static_argnames=("timing",))
def _advance_once(
    now: LoopState,
    command: Array,
    segments: Segments,
    k: int,
    fleet: Fleet,
    vehicle: Vehicle,
    mission: Mission | None,
    timing: Timing,
) -> LoopState:
    return _advance(
        now,
        command,
        jax.tree.map(lambda values: values[k], segments),
        fleet,
        vehicle,
        mission,
        timing,
    )


def _in_trim(fleet: Fleet, vehicle: Vehicle, mission: Mission | None, timing: Timing) -> LoopState:
    """The state of the closed loop before the first tick, without that of the law."""
    n = len(fleet.forced)
    count = len(fleet.wind)
    m = len(vehicle.outputs)
    p = len(vehicle.inputs)
    none = jnp.zeros((m, count))
    command = jnp.zeros((p, count))
    return LoopState(
        jnp.zeros((n, count)),
        command,
        jnp.zeros((len(vehicle.remainder.gravity), count)),
        None,
        none,
        command,
        jnp.zeros((timing.y_late, m, count)),
        jnp.zeros((timing.u_late, p, count)),
        jnp.zeros((len(timing.windows) + 1, m, count)),
        none,
        command,
        jnp.ones(count, dtype=bool),
        None if mission is None else missions.initial_state(count, timing.y_late, mission),
    )


def _product(matrices: Array, vector: Any) -> Array:
    """The matrix-vector product of each aircraft, compiled to one loop; 0 for matrices without a
    column.
    """
    return (
        product(matrices, vector)
        if matrices.shape[1]
        else jnp.zeros((matrices.shape[0], matrices.shape[-1]))
    )
