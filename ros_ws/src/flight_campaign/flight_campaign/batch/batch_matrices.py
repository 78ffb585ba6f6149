# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Assemble the matrices of N aircraft over one tick of the controller."""

from functools import partial
from itertools import accumulate, repeat
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from aircraft_sim.plant.dynamics import Aircraft
from aircraft_sim.plant.plant import PlantParams, share
from flight_campaign.batch.campaign_course import Course
from flight_campaign.batch.device import is_cpu
from flight_core.integrators import rk4
from flight_core.rates import seconds
from flight_core.vectors import Array, FloatArray, array_namespace


class StateBlock(NamedTuple):
    """Coupled states and the signals that act on them. The tuple is hashable.

    The states are indices in x, and the signals are indices in [x, p_1, ..., p_K, s].
    """

    rows: tuple[int, ...]
    columns: tuple[int, ...]


class DriftMatrices(NamedTuple):
    """A drift of N aircraft, as changes of the matrices of their fleet.

    The changes begin at `start`, are linear in time, and are complete after `duration`.
    """

    start: float  # s
    duration: float  # s
    tick: tuple[Array, ...]
    forced: Array
    rate: Array
    forced_rate: Array


class FleetMatrices(NamedTuple):
    """The matrices of N aircraft over one tick of the controller, with K steps of the integration.

    p_k are the mean positions of the actuators in step k. s is the remainder, the nonlinear part of
    f_state, with q rows. w_k is the forcing of the course in step k, with r rows. One tick is

        x+ = tick @ [x, p_1, ..., p_K, s] + wind forced @ [w_1, ..., w_K]
    """

    blocks: tuple[StateBlock, ...]
    # (n, n + K p + q, N) matrix `tick` in blocks, without the entries that are 0 in all aircraft
    tick: tuple[Array, ...]
    forced: Array  # (n, K r, N)
    # (m, n + p, N): C x_dot = rate @ [x, p] + wind forced_rate @ w_1, without the remainder
    rate: Array
    forced_rate: Array  # (m, r, N)
    wind: Array  # (N,) factor on the gusts and turbulence of the course
    late: Array  # (N,) delay of u in whole ticks
    change: DriftMatrices | None = None


def assemble(
    A: FloatArray,
    B: FloatArray,
    plant: PlantParams,
    course: Course,
    wind: Array = 1.0,
    late: Array = 0,
    gust_directions: FloatArray | None = None,
) -> FleetMatrices:
    """Assemble the matrices of N aircraft from A, (N, n, n), and B, (N, n, p).

    With L = A + gravity, and Phi and Gamma the matrices of one Runge-Kutta step of x_dot = L x + u
    while u is held,

        tick = [Phi^K, Phi^(K-1) Gamma B, ..., Gamma B, (Phi^(K-1) + ... + 1) Gamma remainder]
        forced = [Phi^(K-1) Gamma F, ..., Gamma F],
            F = [gust_directions[course.axes], course.basis]

    The steps, and the mean positions of the actuators, equal those of `plant.advance`. The
    remainder is held over a tick, and the forcing over a step.

    `wind` and `late` have one value for all aircraft or N values. `late` is added to the delay of
    the course. `gust_directions`, (N, n, G), are the effects of wind on x_dot, as in
    `uncertainty.gust_directions`. If it is None, all aircraft have the effects of the plant. A
    drift of the plant multiplies the entries of all aircraft by the same factors, and the matrices
    are interpolated.
    """
    aircraft = plant.aircraft
    directions = aircraft.gust_direction if gust_directions is None else gust_directions
    axes = tuple(course.axes.tolist())
    rows = tuple(remainder_rows(aircraft).tolist())
    matrices_of = partial(
        _matrices if is_cpu() else _compiled_matrices,
        gravity=aircraft.gravity,
        C=aircraft.C[course.order],
        basis=course.basis,
        dt=seconds(plant.step_ns),
        places=_Places(course.steps, axes, rows),
    )
    tick, forced, rate, forced_rate = begin = matrices_of(A, B, directions)
    blocks = _blocks(np.asarray((tick != 0.0).any(axis=0)))

    def by_block(matrices: Array) -> tuple[Array, ...]:
        parts = (matrices[:, list(block.rows)][:, :, list(block.columns)] for block in blocks)
        return tuple(map(_last, parts))

    change = None
    count = len(A)
    if (drift := plant.drift) is not None:
        end = matrices_of(A * drift.A, B * drift.B, directions * drift.wind)
        moved, *others = (after - before for before, after in zip(begin, end, strict=True))
        change = DriftMatrices(drift.start, drift.duration, by_block(moved), *map(_last, others))
    return FleetMatrices(
        blocks=blocks,
        tick=by_block(tick),
        forced=_last(forced),
        rate=_last(rate),
        forced_rate=_last(forced_rate),
        wind=jnp.broadcast_to(jnp.asarray(wind, dtype=np.float64), (count,)),
        late=jnp.broadcast_to(jnp.asarray(late) + course.u_late, (count,)),
        change=change,
    )


def _last(array: Array) -> Array:
    """Move the aircraft to the last axis."""
    return jnp.asarray(array_namespace(array).moveaxis(array, 0, -1))


class _Places(NamedTuple):
    """Constants of the compiled matrices. The tuple is hashable."""

    steps: int  # K, steps of the integration in a tick
    axes: tuple[int, ...]  # indices of the axes of gusts along which there is wind
    rows: tuple[int, ...]  # indices of the rows of the remainder


def _matrices(
    A: Array,
    B: Array,
    directions: Array,
    gravity: Array,
    C: Array,
    basis: Array,
    dt: float,
    places: _Places,
) -> tuple[Array, Array, Array, Array]:
    """Compute tick, forced, rate and forced_rate of `FleetMatrices`, but with N as the first axis.

    The rows of C are in the law's order.
    """
    xp = array_namespace(A)
    K = places.steps
    count = len(A)
    L = A + gravity
    eye = xp.broadcast_to(xp.eye(A.shape[1]), A.shape)
    pairs = ((eye, 0.0 * eye), (0.0 * eye, eye))
    Phi, Gamma = (rk4(lambda t, x, u, L: L @ x + u, 0.0, x, u, L, dt) for x, u in pairs)
    powers = list(accumulate(repeat(Phi, K), lambda power, step: step @ power, initial=eye))
    input_steps = [powers[K - 1 - k] @ Gamma for k in range(K)]
    tick = [
        powers[K],
        *(held_step @ B for held_step in input_steps),
        sum(input_steps)[..., list(places.rows)],
    ]
    parts = (directions[..., list(places.axes)], basis)
    forcing = xp.concatenate(
        [xp.broadcast_to(part, (count, *part.shape[-2:])) for part in parts], axis=2
    )
    forced = xp.concatenate([held_step @ forcing for held_step in input_steps], axis=2)
    return xp.concatenate(tick, axis=2), forced, C @ xp.concatenate([L, B], axis=2), C @ forcing


@partial(jax.jit, static_argnames=("places",))
def _compiled_matrices(*matrices: Any, **constants: Any) -> tuple[Array, Array, Array, Array]:
    """Compute `_matrices` on the device.

    NumPy on the host would take 17 s for 1,000,000 aircraft.
    """
    # A GPU may round the factors of a product to fewer bits.
    with jax.default_matmul_precision("highest"):
        return _matrices(*matrices, **constants)


def remainder_rows(aircraft: Aircraft) -> NDArray[np.int64]:
    """Return the indices of the states on whose derivatives f_state acts, (q,)."""
    acts = aircraft.gravity.any(axis=1)
    if aircraft.coupling is not None:
        acts = acts | aircraft.coupling.gain.any(axis=1)
    if aircraft.kinematics is not None:
        acts = acts | aircraft.kinematics.into.any(axis=1)
    return np.flatnonzero(acts)


def _blocks(moves: NDArray[np.bool_]) -> tuple[StateBlock, ...]:
    """Return the connected components of the states as blocks.

    `moves`, (n, columns), has the signals that act on each state. The blocks are usually the
    longitudinal and the lateral motion.
    """
    number, part = connected_components(moves[:, : len(moves)], directed=False)
    rows = [np.flatnonzero(part == k) for k in range(number)]
    return tuple(
        StateBlock(tuple(row.tolist()), tuple(np.flatnonzero(moves[row].any(axis=0)).tolist()))
        for row in rows
    )


def at(t: Array, fleet: FleetMatrices) -> FleetMatrices:
    """Return the matrices of a fleet at time t, s."""
    change = fleet.change
    if change is None:
        return fleet
    part = share(t, change.start, change.duration)
    keys = ("tick", "forced", "rate", "forced_rate")
    now = {
        key: jax.tree.map(
            lambda begin, full: begin + part * full, getattr(fleet, key), getattr(change, key)
        )
        for key in keys
    }
    return fleet._replace(**now)
