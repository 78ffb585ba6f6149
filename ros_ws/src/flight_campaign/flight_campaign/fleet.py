# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Many uncertain aircraft through one course at once, under any law: what the loop in one process flies, N at a time.

Every array holds the aircraft in its last axis, so that one line of the law or of the actuators moves all of them. Between two
ticks of the controller an aircraft is linear but for a small rest: all steps of its integration are one product of matrices.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from aircraft_sim import actuators, dynamics, sensors
from aircraft_sim.actuators import Actuators
from aircraft_sim.dynamics import Aircraft, Coupling
from aircraft_sim.plant import DIVERGENCE_LIMIT, PlantParams
from flight_analysis.closed_loop.scenario import Scenario
from flight_campaign.benchmark_course import Course
from flight_core.integrators import rk4
from flight_core.rates import seconds
from flight_core.vectors import Array, FloatArray
from rise_di_controller.control_law import ControlLaw, Measurements

jax.config.update("jax_enable_x64", True)  # float64 as everywhere else in the stack


class StateBlock(NamedTuple):
    """States that move each other and what moves them, as places in x and in [x, p_1, ..., p_K, s]. Hashable."""

    rows: tuple[int, ...]
    columns: tuple[int, ...]


class Fleet(NamedTuple):
    """N aircraft over one tick of the controller, in K steps of the integration; q rates of the rest, r of the course.

    With p_k the actuators' positions at the end of step k, the rest s and the course's forcing w_k over step k, over one tick

        x+ = tick @ [x, p_1, ..., p_K, s] + wind forced @ [w_1, ..., w_K]
    """

    blocks: tuple[StateBlock, ...]
    tick: tuple[Array, ...]  # (n, n + K m + q, N), block by block: what is 0 in all aircraft is left out
    forced: Array  # (n, K r, N)
    rate: Array  # (m, n + m, N): C x_dot = rate @ [x, p] + wind forced_rate @ w_1, but for the rest
    forced_rate: Array  # (m, r)
    wind: Array  # (N,) share of the course's gusts and turbulence that each meets
    late: Array  # (N,) whole ticks by which its u is late


class Vehicle(NamedTuple):
    """What all aircraft of a fleet share."""

    outputs: Array  # (m,) places of the outputs in the state, in the law's order
    inputs: Array  # (m,) places of the law's inputs in the airframe's order
    felt: Array  # (c,) places of the states that make the rest
    rest: Aircraft  # what of it makes the rest: f_state takes x[felt], gives what acts on `acting` states
    actuators: Actuators  # (m, 1), airframe's order
    quantum: Array | None  # (m, 1), law's order
    dt: float  # s, of a step of the integration


def vehicle(scenario: Scenario) -> Vehicle:
    """What all aircraft of a scenario share."""
    plant, channels = scenario.aircraft.plant(), scenario.aircraft.channels()
    aircraft, errors = plant.aircraft, scenario.aircraft.sensor_arrays()
    order = [list(channels.outputs).index(name) for name in scenario.controller.outputs]
    quantum = None if errors.quantum is None else errors.quantum[order]
    return Vehicle(
        np.argmax(aircraft.C[order], axis=1),
        np.array([list(channels.inputs).index(name) for name in scenario.controller.inputs]),
        *_rest(aircraft),
        Actuators(*(None if one is None else one[:, None] for one in plant.actuators)),
        None if quantum is None else quantum[:, None],
        seconds(plant.step_ns),
    )


class FleetResult(NamedTuple):
    """How N flights went, by channel in the law's order; seen at the controller's ticks. Errors are true ones, C x - y_m."""

    rms: Array  # (m, N)
    max: Array  # (m, N)
    slew: Array  # (m, N) mean abs(u_dot), units of u / s
    diverged: Array  # (N,) bool: the state went beyond DIVERGENCE_LIMIT, the other figures mean nothing


def assemble(A: FloatArray, B: FloatArray, plant: PlantParams, course: Course, wind: Array = 1.0, late: Array = 0) -> Fleet:
    """The matrices of N aircraft, A of shape (N, n, n) and B of (N, n, m).

    With L = A + gravity, Phi and Gamma the matrices of one Runge-Kutta step of x_dot = L x + u with u held,

        tick = [Phi^K, Phi^(K-1) Gamma B, ..., Gamma B, (Phi^(K-1) + ... + 1) Gamma rest]
        forced = [Phi^(K-1) Gamma basis, ..., Gamma basis]

    The steps, and the actuators' positions in them, are those of `plant.advance`; the rest, which it follows through each step,
    is held over a tick, and the forcing over a step. `wind` and `late` are those of Fleet, one value for all or one each.
    """
    dt, aircraft = seconds(plant.step_ns), plant.aircraft
    K, count = course.steps, len(A)
    L = A + aircraft.gravity
    eye = np.broadcast_to(np.eye(A.shape[1]), A.shape)
    Phi, Gamma = (rk4(_linear, 0.0, x, u, L, dt) for x, u in ((eye, 0.0 * eye), (0.0 * eye, eye)))
    powers = [eye]
    for _ in range(K):
        powers.append(Phi @ powers[-1])
    held = [powers[K - 1 - k] @ Gamma for k in range(K)]
    tick = [powers[K], *(of_step @ B for of_step in held), sum(held)[..., acting(aircraft)]]
    rate = np.concatenate([A + aircraft.gravity, B], axis=2)
    C = aircraft.C[course.order]

    def last(array: FloatArray) -> Array:
        return jnp.asarray(np.moveaxis(array, 0, -1))

    whole = np.concatenate(tick, axis=2)
    blocks = _blocks((whole != 0.0).any(axis=0))
    return Fleet(
        blocks,
        tuple(last(whole[:, block.rows][:, :, block.columns]) for block in blocks),
        last(np.concatenate([of_step @ course.basis for of_step in held], axis=2)),
        last(C @ rate),
        jnp.asarray(C @ course.basis),
        jnp.broadcast_to(jnp.asarray(wind, dtype=np.float64), (count,)),
        jnp.broadcast_to(jnp.asarray(late), (count,)),
    )


def acting(aircraft: Aircraft) -> NDArray[np.int64]:
    """Places of the states that f_state acts on, (q,)."""
    acts = aircraft.gravity.any(axis=1)
    if aircraft.coupling is not None:
        acts = acts | aircraft.coupling.gain.any(axis=1)
    return np.flatnonzero(acts)


def of_rest(felt: Array, rest: Aircraft) -> Array:
    """What f_state has beyond its linear part, (q, N): gravity @ (sin(x) - x) + gain @ (x[first] x[second])."""
    return dynamics.f_state(felt, rest) - rest.gravity @ felt


def _rest(aircraft: Aircraft) -> tuple[NDArray[np.int64], Aircraft]:
    """Places of the states that make the rest, and the aircraft reduced to them and to `acting`."""
    rows, coupling = acting(aircraft), aircraft.coupling
    makes = aircraft.gravity.any(axis=0)
    if coupling is not None:
        makes[[*coupling.first, *coupling.second]] = True
    felt = np.flatnonzero(makes)
    if coupling is not None:
        first, second = (np.searchsorted(felt, place) for place in (coupling.first, coupling.second))
        coupling = Coupling(coupling.gain[rows], first, second)
    return felt, aircraft._replace(gravity=aircraft.gravity[np.ix_(rows, felt)], coupling=coupling)


def _blocks(moves: NDArray[np.bool_]) -> tuple[StateBlock, ...]:
    """The connected parts of the states, `moves` of shape (n, columns); longitudinal and lateral motion, as a rule."""
    number, part = connected_components(moves[:, : len(moves)], directed=False)
    rows = [np.flatnonzero(part == k) for k in range(number)]
    return tuple(StateBlock(tuple(row.tolist()), tuple(np.flatnonzero(moves[row].any(axis=0)).tolist())) for row in rows)


def _linear(t: Any, x: Array, u: Array, L: Array) -> Array:
    return L @ x + u


def fly(fleet: Fleet, vehicle: Vehicle, course: Course, control_law: ControlLaw, params: Any) -> FleetResult:
    """Fly N aircraft through the course under one law, from trim at rest.

    At each tick: the sensors, the law's step (or engagement, or nothing, as the course has it), the actuators through the K
    steps to the next tick, the aircraft there. The rest s is taken at the middle of a tick, from this tick's and the last.
    Arguments: `params` of the law, (m, 1) or (m, N).
    """
    segments = Segments(*(jnp.asarray(getattr(course, name)) for name in Segments._fields))
    late = int(np.max(np.asarray(fleet.late)))
    arrays = fleet._replace(blocks=())
    return _fly(
        arrays,
        vehicle,
        segments,
        params,
        course.period,
        control_law=control_law,
        blocks=fleet.blocks,
        steps=course.steps,
        y_late=course.late,
        u_late=late,
    )


class Segments(NamedTuple):
    """The parts of a course that change from tick to tick."""

    t: Array
    phase: Array
    dt: Array
    y_m: Array
    seen_y_m: Array
    seen_y_m_dot: Array
    u_ff: Array
    error: Array
    forcing: Array
    forcing_now: Array
    air: Array


class LoopState(NamedTuple):
    """What is carried from tick to tick."""

    x: Array  # (n, N)
    position: Array  # (m, N) airframe's order
    rest: Array  # (q, N) of the tick before
    law: Any
    u: Array  # (m, N) law's order
    y_before: Array  # (y_late, m, N) newest first
    u_before: Array  # (u_late, m, N)
    squares: Array  # (m, N) sums over the ticks
    max: Array
    moved: Array
    flies: Array  # (N,)


@partial(jax.jit, static_argnames=("control_law", "blocks", "steps", "y_late", "u_late"))
def _fly(
    fleet: Fleet,
    vehicle: Vehicle,
    segments: Segments,
    params: Any,
    period: Array,
    *,
    control_law: ControlLaw,
    blocks: tuple[StateBlock, ...],
    steps: int,
    y_late: int,
    u_late: int,
) -> FleetResult:
    n, count, m = len(fleet.forced), len(fleet.wind), len(vehicle.outputs)
    places = np.argsort([row for block in blocks for row in block.rows])  # of the states among those of the blocks

    def seen(now: LoopState, y: Array, segment: Segments) -> Measurements:
        measured = now.x.at[vehicle.outputs].set(y)
        forced = _product(fleet.forced_rate[..., None], segment.forcing_now)
        moving = _product(fleet.rate, [*now.x, *now.position]) + fleet.wind * forced
        position = now.position[vehicle.inputs]
        reference = (segment.seen_y_m[:, None], segment.seen_y_m_dot[:, None], segment.u_ff[:, None])
        return Measurements(y, *reference, now.u, position, measured, measured - fleet.wind * segment.air[:, None], moving)

    # A branch looks for itself: what its law does not look at is then not worked out.
    def engage(now: LoopState, y: Array, segment: Segments) -> tuple[Any, Array]:
        started = control_law.start(seen(now, y, segment), params)
        return jax.tree.map(lambda one, like: jnp.broadcast_to(one, like.shape).astype(like.dtype), started, now.law), now.u

    def step(now: LoopState, y: Array, segment: Segments) -> tuple[Any, Array]:
        return control_law.step(now.law, seen(now, y, segment), segment.dt, params)

    def hold(now: LoopState, y: Array, segment: Segments) -> tuple[Any, Array]:
        return now.law, now.u

    def tick(now: LoopState, segment: Segments) -> tuple[LoopState, None]:
        true = now.x[vehicle.outputs]
        e = true - segment.y_m[:, None]
        y = true + segment.error[:, None]
        if vehicle.quantum is not None:
            y = sensors.quantised(y, vehicle.quantum)
        y, y_before = _delayed(y, now.y_before, y_late)
        law, u = jax.lax.switch(segment.phase, (hold, engage, step), now, y, segment)
        history = jnp.concatenate([u[None], now.u_before])
        acting = u if not u_late else jnp.sum(jnp.where(jnp.arange(u_late + 1)[:, None, None] == fleet.late, history, 0.0), 0)
        command, position, positions = acting[jnp.argsort(vehicle.inputs)], now.position, []
        for k in range(steps):
            moved = actuators.step(position, command, vehicle.dt, vehicle.actuators)
            position = actuators.apply_faults(segment.t + k * vehicle.dt, position, moved, vehicle.actuators)
            positions.extend(position)
        rest = of_rest(now.x[vehicle.felt], vehicle.rest)
        moves = [*now.x, *positions, *(1.5 * rest - 0.5 * now.rest)]
        parts = [_product(part, [moves[j] for j in block.columns]) for part, block in zip(fleet.tick, blocks, strict=True)]
        x = jnp.concatenate(parts)[places]
        x = jax.lax.cond(
            jnp.any(segment.forcing != 0.0),
            lambda x: x + fleet.wind * _product(fleet.forced, segment.forcing),
            lambda x: x,
            x,
        )
        after = LoopState(
            x,
            position,
            rest,
            law,
            u,
            y_before,
            history[:u_late],
            now.squares + e * e,
            jnp.maximum(now.max, jnp.abs(e)),
            now.moved + jnp.abs(u - now.u),
            now.flies & (jnp.max(jnp.abs(now.x), axis=0) < DIVERGENCE_LIMIT),  # False for NaN too
        )
        return after, None

    none = jnp.zeros((m, count))
    first = jax.tree.map(lambda segment: segment[0], segments)
    begin = LoopState(
        jnp.zeros((n, count)),
        none,
        jnp.zeros((len(vehicle.rest.gravity), count)),
        None,
        none,
        jnp.zeros((y_late, m, count)),
        jnp.zeros((u_late, m, count)),
        none,
        none,
        none,
        jnp.ones(count, dtype=bool),
    )
    looked = seen(begin, none, first)
    states = jax.eval_shape(lambda: control_law.step(control_law.start(looked, params), looked, first.dt, params)[0])
    begin = begin._replace(law=jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), states))
    end, _ = jax.lax.scan(tick, begin, segments)
    ticks = len(segments.t)
    return FleetResult(jnp.sqrt(end.squares / ticks), end.max, end.moved / ((ticks - 1) * period), ~end.flies)


def _product(matrices: Array, vector: Any) -> Array:
    """Sum over j of matrices[:, j] vector[j]: a product of small matrices, an aircraft each, that compiles to one loop."""
    total = 0.0 * matrices[:, 0] if matrices.shape[1] else jnp.zeros((matrices.shape[0], matrices.shape[-1]))
    for j in range(matrices.shape[1]):
        total = total + matrices[:, j] * vector[j]
    return total


def _delayed(value: Array, before: Array, late: int) -> tuple[Array, Array]:
    """The value of so many ticks ago, and the queue after this tick, newest first."""
    if not late:
        return value, before
    return before[-1], jnp.concatenate([value[None], before[:-1]])
