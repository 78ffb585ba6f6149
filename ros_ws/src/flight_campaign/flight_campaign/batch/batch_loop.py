# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Step the closed loop of N aircraft, compiled: sensors, law, actuators, aircraft.

Between two ticks of the controller, an aircraft is linear except for a small remainder. So all
steps of its integration are a single matrix product.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from numpy.typing import NDArray

from aircraft_sim import sensors
from aircraft_sim.plant import actuators, dynamics
from aircraft_sim.plant.actuators import Actuators
from aircraft_sim.plant.dynamics import Aircraft
from aircraft_sim.plant.plant import DIVERGENCE_LIMIT
from flight_campaign.batch.batch_allocation import allocate
from flight_campaign.batch.batch_matrices import FleetMatrices, StateBlock, at
from flight_campaign.batch.batch_schedule import UNKNOWN, TickKind, TickRun
from flight_campaign.batch.campaign_course import Segments
from flight_core.arithmetic import product
from flight_core.vectors import Array
from rise_di_controller.extensions.allocation import Allocation, limits_of_effectors
from rise_di_controller.law.control_law import ControlLaw, Measurements
from rise_di_controller.law.saturation import Limits, saturate


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("remainder", "actuators", "limits", "quantum", "noisier", "dt", "allocation"),
    meta_fields=("outputs", "inputs", "remainder_states", "vanes"),
)
@dataclass(frozen=True)
class Vehicle:
    """The properties that all aircraft of a fleet share."""

    # These are constants of the compiled loop, so that the device does not read indices in flight.
    outputs: tuple[int, ...]  # (m,) indices of the outputs in the state, in the law's order
    inputs: tuple[int, ...]  # (p,) indices of the effectors in the airframe's order
    remainder_states: tuple[int, ...]  # (c,) indices of the states in the nonlinear remainder
    vanes: tuple[int, ...]  # indices of the states that the vanes measure
    # the aircraft with only the states and rows that the remainder needs: its f_state takes
    # x[remainder_states] and gives the rows `remainder_rows`
    remainder: Aircraft
    actuators: Actuators  # (p, 1), in the airframe's order
    limits: Limits  # (m, 1), in the law's order: limits of u in the controller
    quantum: Array | None  # (m, 1), in the law's order: steps of the quantisation of y
    dt: float  # s, a step of the integration
    allocation: Allocation | None  # None if the inputs of the law are the effectors
    # (m, N), in the law's order: by which fraction the noise of an aircraft exceeds that of the
    # course; None if no aircraft has other noise
    noisier: Array | None = None


class FleetResult(NamedTuple):
    """Metrics of N flights, by channel in the law's order, over the controller's ticks.

    Errors are the true ones, C x - y_m.
    """

    rms: Array  # (m, N) rms errors
    max: Array  # (m, N) largest errors
    slew: Array  # (p, N) mean abs(u_dot) by effector, units of u / s
    # (N,) bool: whether the state exceeded DIVERGENCE_LIMIT, which makes the other figures invalid
    diverged: Array


def rows_of(array: Array, places: Sequence[int] | NDArray[np.int64]) -> Array:
    """Return the rows with constant indices.

    Each row is taken as a slice, because a GPU compiler can fuse slices with other operations.
    """
    if not len(places):
        return array[:0]
    return jnp.stack([jax.lax.index_in_dim(array, int(k), keepdims=False) for k in places])


def remainder_of(states: Array, aircraft: Aircraft) -> Array:
    """Return the nonlinear part of f_state, the remainder, (q, N).

    gravity @ (sin(x) - x) + gain @ (x[first] x[second]) + kinematics(x)
    """
    return dynamics.f_state(states, aircraft) - aircraft.gravity @ states


class Timing(NamedTuple):
    """Constants of the compiled loop. The tuple is hashable."""

    blocks: tuple[StateBlock, ...]
    steps: int  # steps of the integration in each tick
    y_late: int  # delay of y, ticks
    u_late: int  # largest delay of u over all aircraft, ticks


class LoopSample(NamedTuple):
    """The sample that a law takes at a tick, (m, N) or (m, 1)."""

    y: Array
    y_m: Array  # reference at the stamp of y, in the law's order
    y_m_dot: Array


class LoopState(NamedTuple):
    """State of the closed loop from tick to tick."""

    x: Array  # (n, N)
    position: Array  # (p, N) airframe's order
    remainder: Array  # (q, N) remainder at the previous tick
    law: Any
    u: Array  # (m, N) law's order
    command: Array  # (p, N) command of the effectors; without an allocation it equals u
    y_before: Array  # (y_late, m, N) previous samples of y, the newest first
    command_before: Array  # (u_late, p, N) previous commands
    squares: Array  # (m, N) sums of squared errors over the ticks
    max: Array
    travel: Array  # (p, N) sum of abs(command - previous command)
    bounded: Array  # (N,) whether the state stayed below DIVERGENCE_LIMIT


class Constants(NamedTuple):
    """Inputs of the compiled loop that stay the same in all ticks.

    They are arguments of the loop, because the compiler would use constants to compute results in
    advance.
    """

    fleet: FleetMatrices  # matrices of the fleet without its blocks
    vehicle: Vehicle
    params: Any  # parameters of the law


@partial(jax.jit, static_argnames=("control_law", "timing"))
def begin(
    constants: Constants, first: Segments, *, control_law: ControlLaw, timing: Timing
) -> LoopState:
    """Return the state before the first tick, in trim, with the law not yet engaged."""
    fleet, vehicle, params = constants
    start = in_trim(fleet, vehicle, timing)
    none = 0.0 * start.u

    def stepped() -> Any:
        measurements = _measured(start, first, LoopSample(none, none, none), fleet, vehicle)
        law = control_law.engage(measurements, params)
        return control_law.limited(law, measurements, first.dt, params, vehicle.limits)[0]

    law = jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), jax.eval_shape(stepped))
    return start._replace(law=law)


@partial(jax.jit, static_argnames=("run", "control_law", "timing"), donate_argnames=("state",))
def fly_run(
    state: LoopState,
    constants: Constants,
    segments: Segments,
    first: int,
    *,
    run: TickRun,
    control_law: ControlLaw,
    timing: Timing,
) -> LoopState:
    """Fly the ticks of a run, beginning with the tick `first`, and return the state after them."""
    size = len(run.pattern)

    def patterns(values: Array) -> Array:
        values_of_run = jax.lax.dynamic_slice_in_dim(jnp.asarray(values), first, run.length)
        return values_of_run.reshape(run.length // size, size, *values.shape[1:])

    def pattern(now: LoopState, ticks: Any) -> tuple[LoopState, None]:
        for k, kind in enumerate(run.pattern):
            at_tick = jax.tree.map(lambda values, k=k: values[k], ticks)
            now = tick(now, at_tick, kind, constants, control_law, timing)
        return now, None

    grouped = jax.tree.map(patterns, segments)
    return jax.lax.scan(pattern, state, grouped, unroll=run.patterns_per_step)[0]


def _chosen(
    constant: int | None, value: Array, branches: Sequence[Callable[..., Any]], *arguments: Any
) -> Any:
    """Run the branch with the number `constant`, or if that is None, with the number `value`.

    `constant` is known when the loop is compiled, so it needs no branch on the device.
    """
    if constant is None:
        return jax.lax.switch(value, branches, *arguments)
    return branches[constant](*arguments)


def tick(
    now: LoopState,
    segment: Segments,
    kind: TickKind,
    constants: Constants,
    control_law: ControlLaw,
    timing: Timing,
) -> LoopState:
    """Compute the state at the next tick."""
    fleet, vehicle, params = constants
    measure = partial(_measured, fleet=fleet, vehicle=vehicle)

    # Each branch calls `measure`, so that the compiler can remove measurements which its law does
    # not use.
    def engage(now: LoopState, *measured: Any) -> tuple[Any, Array, Array]:
        started = control_law.engage(measure(now, *measured), params)
        law = jax.tree.map(
            lambda value, like: jnp.broadcast_to(value, like.shape).astype(like.dtype),
            started,
            now.law,
        )
        return law, now.u, now.command

    def step(now: LoopState, segment: Segments, sample: LoopSample) -> tuple[Any, Array, Array]:
        measurements = measure(now, segment, sample)
        limits = vehicle.limits
        allocation = vehicle.allocation
        if allocation is None:
            law, _, u = control_law.limited(now.law, measurements, segment.dt, params, limits)
            return law, u, u
        # As in the guard, the law gets limits that say which u the effectors can give, for its
        # anti-windup.
        _, u_free = control_law.step(now.law, measurements, segment.dt, params)
        _, reachable = allocate(
            saturate(u_free, now.u, segment.dt, limits), now.command, segment.dt, allocation
        )
        law, _, u = control_law.limited(
            now.law, measurements, segment.dt, params, limits_of_effectors(u_free, reachable)
        )
        command, u = allocate(u, now.command, segment.dt, allocation)
        return law, u, command

    def hold(now: LoopState, *measured: Any) -> tuple[Any, Array, Array]:
        return control_law.missed(now.law, measure(now, *measured), params), now.u, now.command

    sensed, sample = sense(now, segment, vehicle)
    law, u, command = _chosen(kind.phase, segment.phase, (hold, engage, step), now, segment, sample)
    state_with_u = sensed._replace(law=law, u=u)
    return advance(state_with_u, command, segment, fleet, vehicle, timing, kind)


def _measured(
    now: LoopState, segment: Segments, sample: LoopSample, fleet: FleetMatrices, vehicle: Vehicle
) -> Measurements:
    """Collect the measurements that a law takes at a tick."""
    y, y_m, y_m_dot = sample
    by_output = dict(zip(vehicle.outputs, y, strict=True))
    x = jnp.stack([by_output.get(k, row) for k, row in enumerate(now.x)])
    matrices = at(segment.t, fleet)
    x_dot_now = _product(
        matrices.rate, [*now.x, *actuators.effect(segment.t, now.position, vehicle.actuators)]
    )
    moving = x_dot_now + fleet.wind * _product(matrices.forced_rate, segment.forcing_now)
    u_trim = segment.u_ff[:, None] + 0.0 * y
    x_air = x - fleet.wind * segment.air[:, None]
    vane = vane_m = None
    if vehicle.vanes:
        vane = jnp.stack([x_air[place] for place in vehicle.vanes]) + segment.vane_error[:, None]
        vane_m = segment.vane_m[:, None] + 0.0 * vane
    position = rows_of(now.position, vehicle.inputs)
    if vehicle.allocation is not None:
        position = product(vehicle.allocation.effect, position)
    return Measurements(
        y=y,
        y_m=y_m,
        y_m_dot=y_m_dot,
        u_trim=u_trim,
        u_before=now.u,
        position=position,
        x=x,
        x_air=x_air,
        y_dot=moving,
        vane=vane,
        vane_m=vane_m,
    )


def sense(now: LoopState, segment: Segments, vehicle: Vehicle) -> tuple[LoopState, LoopSample]:
    """Return the state after the measurement of a tick, and the sample that the law gets.

    The true error of the tick is added to the state's sums for the metrics.
    """
    true = rows_of(now.x, vehicle.outputs)
    e = true - segment.y_m[:, None]
    y = true + segment.error[:, None]
    if vehicle.noisier is not None:
        y = y + vehicle.noisier * segment.noise[:, None]
    if vehicle.quantum is not None:
        y = sensors.quantised(y, vehicle.quantum)
    arriving = jnp.concatenate([y[None], now.y_before])
    y = arriving[-1]
    y_before = arriving[:-1]
    sensed = now._replace(
        y_before=y_before,
        squares=now.squares + e * e,
        max=jnp.maximum(now.max, jnp.abs(e)),
        bounded=now.bounded
        & (jnp.max(jnp.abs(now.x), axis=0) < DIVERGENCE_LIMIT),  # also False for NaN
    )
    return sensed, LoopSample(y, segment.sampled_y_m[:, None], segment.sampled_y_m_dot[:, None])


def advance(
    now: LoopState,
    command: Array,
    segment: Segments,
    fleet: FleetMatrices,
    vehicle: Vehicle,
    timing: Timing,
    kind: TickKind = UNKNOWN,
) -> LoopState:
    """Advance to the next tick with the command of the present tick."""
    blocks = timing.blocks
    u_late = timing.u_late
    # Index of each state among the rows of all blocks, one block after the other.
    places = np.argsort([*chain.from_iterable(block.rows for block in blocks)])
    history = jnp.concatenate([command[None], now.command_before])
    if not u_late:
        acting = command
    else:
        acting = jnp.sum(
            jnp.where(jnp.arange(u_late + 1)[:, None, None] == fleet.late, history, 0.0), 0
        )
    times = segment.t + np.arange(timing.steps) * vehicle.dt
    position, means = _actuated(now.position, acting, times, vehicle, unroll=kind is not UNKNOWN)
    remainder = remainder_of(rows_of(now.x, vehicle.remainder_states), vehicle.remainder)
    moves = [*now.x, *chain(*means), *(1.5 * remainder - 0.5 * now.remainder)]
    matrices = at(segment.t, fleet)
    parts = []
    for matrix, block in zip(matrices.tick, blocks, strict=True):
        parts.append(_product(matrix, [moves[j] for j in block.columns]))
    x = rows_of(jnp.concatenate(parts), places)
    x = _chosen(
        kind.is_forced,
        jnp.any(segment.forcing != 0.0).astype(int),
        (lambda x: x, lambda x: x + fleet.wind * _product(matrices.forced, segment.forcing)),
        x,
    )
    return now._replace(
        x=x,
        position=position,
        remainder=remainder,
        command=command,
        command_before=history[:u_late],
        travel=now.travel + jnp.abs(command - now.command),
    )


def _actuated(
    position: Array, command: Array, times: Array, vehicle: Vehicle, *, unroll: bool
) -> tuple[Array, Array]:
    """Move the actuators in steps of the integration, which begin at `times`, s.

    Returns their positions after the last step, and their mean positions in each step.
    """
    ordered_command = rows_of(command, np.argsort(vehicle.inputs))

    def move(before: Array, t: Array) -> tuple[Array, Array]:
        return actuators.move(t, before, ordered_command, vehicle.dt, vehicle.actuators)

    # This is a separate loop. Otherwise the compiler for a CPU would compute all mean positions
    # again for each state on which they act.
    return jax.lax.scan(move, position, times, unroll=unroll)


@partial(jax.jit, static_argnames=("ticks",))
def figures(end: LoopState, ticks: int, period: Array) -> FleetResult:
    """Compute the metrics of the flights from the sums that were collected up to their end."""
    return FleetResult(
        jnp.sqrt(end.squares / ticks),
        end.max,
        end.travel / ((ticks - 1) * period),
        ~end.bounded,
    )


def in_trim(fleet: FleetMatrices, vehicle: Vehicle, timing: Timing) -> LoopState:
    """Return the state of the closed loop before the first tick, without the state of the law."""
    n = len(fleet.forced)
    count = len(fleet.wind)
    m = len(vehicle.outputs)
    p = len(vehicle.inputs)
    none = jnp.zeros((m, count))
    command = jnp.zeros((p, count))
    return LoopState(
        x=jnp.zeros((n, count)),
        position=command,
        remainder=jnp.zeros((len(vehicle.remainder.gravity), count)),
        law=None,
        u=none,
        command=command,
        y_before=jnp.zeros((timing.y_late, m, count)),
        command_before=jnp.zeros((timing.u_late, p, count)),
        squares=none,
        max=none,
        travel=command,
        bounded=jnp.ones(count, dtype=bool),
    )


def _product(matrices: Array, vector: Any) -> Array:
    """Multiply each aircraft's matrix by its vector, compiled to one loop.

    If the matrices have no column, the product is 0.
    """
    if matrices.shape[1]:
        return product(matrices, vector)
    return jnp.zeros((matrices.shape[0], matrices.shape[-1]))
