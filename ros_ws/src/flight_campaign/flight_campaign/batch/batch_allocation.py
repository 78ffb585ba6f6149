# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the `allocate` of rise_di_controller for N aircraft at once, compiled."""

from collections.abc import Callable
from typing import NamedTuple

import jax
from jax import numpy as jnp

from flight_core.arithmetic import product
from flight_core.vectors import Array
from rise_di_controller.extensions.allocation import HALVINGS, RELAXATION, SMALL, SWEEPS, Allocation
from rise_di_controller.law.saturation import Limits, bounds


def with_column_limits(params: Allocation) -> Allocation:
    """Return the parameters with limits of shape (p, 1)."""
    return params._replace(limits=Limits(*(values[:, None] for values in params.limits)))


class _Range(NamedTuple):
    """The least and the largest u of each effector, (p, N)."""

    low: Array
    high: Array

    def clip(self, u: Array) -> Array:
        return jnp.minimum(jnp.maximum(u, self.low), self.high)

    def is_inside(self, u: Array) -> Array:
        """Return which aircraft have a u inside the range, (N,)."""
        return jnp.all((u >= self.low) & (u <= self.high), axis=0)


def allocate(v: Array, u_before: Array, dt: Array, params: Allocation) -> tuple[Array, Array]:
    """Return u, (p, N), within its limits for a demanded v, (m, N), and the v that u gives."""
    rate_range = _Range(*bounds(u_before, dt, params.limits))
    stops = _Range(*(0.0 * u_before + end for end in (params.limits.lower, params.limits.upper)))
    u = product(params.T, v)
    free = rate_range.is_inside(u)

    def at_limits() -> tuple[Array, Array]:
        u_passed = _exchanged(u, stops, params)
        target = _where_not(
            stops.is_inside(u_passed) | free,
            u_passed,
            lambda: _by_priority(jnp.zeros_like(u), v, stops, params),
        )

        def at_rate() -> Array:
            start = rate_range.clip(u_before)
            move = _by_priority(start, product(params.effect, target - start), rate_range, params)
            return _towards(move, product(params.exchange, target - move), rate_range, params)

        limited_u = jnp.where(
            free, u, _where_not(rate_range.is_inside(target) | free, target, at_rate)
        )
        return limited_u, jnp.where(free, v, product(params.effect, limited_u))

    return jax.lax.cond(jnp.all(free), lambda: (u, v), at_limits)


def _where_not(final: Array, value: Array, otherwise: Callable[[], Array]) -> Array:
    """Return `value` where the mask `final` is true, and the result of `otherwise` elsewhere."""
    return jax.lax.cond(jnp.all(final), lambda: value, lambda: jnp.where(final, value, otherwise()))


def _by_priority(start: Array, v: Array, limits: _Range, params: Allocation) -> Array:
    """Add the inputs v of the law to u one by one, in order of priority.

    Returns u, which begins at `start`. Each input moves it as far as the limits allow, from where
    the input before left it.
    """
    order = jnp.array(params.order)
    moves = params.T.T[order][:, :, None] * v[order][:, None]
    return jax.lax.scan(lambda u, move: (_towards(u, move, limits, params), None), start, moves)[0]


def _towards(u: Array, move: Array, limits: _Range, params: Allocation) -> Array:
    """Move u, which is within the limits, by `move` or as far as the limits allow."""
    destination = _exchanged(u + move, limits, params)
    arrives = limits.is_inside(destination)

    def partly() -> Array:
        def halve(
            _: int, now: tuple[Array, Array, Array, Array]
        ) -> tuple[Array, Array, Array, Array]:
            reached, target, part, size = now
            halfway = _exchanged(u + (part + 0.5 * size) * move, limits, params)
            fits = limits.is_inside(halfway)
            return (
                jnp.where(fits, halfway, reached),
                jnp.where(fits, target, halfway),
                jnp.where(fits, part + 0.5 * size, part),
                0.5 * size,
            )

        none = 0.0 * u[0]
        reached, target, _, _ = jax.lax.fori_loop(
            0, HALVINGS, halve, (u, destination, none, none + 1.0)
        )
        step = target - reached
        room = jnp.where(step > 0.0, limits.high - reached, limits.low - reached)
        passes = jnp.abs(step) > jnp.abs(room)
        last = jnp.min(
            jnp.where(passes, room, 1.0) / jnp.where(passes, step, 1.0), axis=0, initial=1.0
        )
        return limits.clip(reached + last * step)

    return _where_not(arrives, destination, partly)


def _exchanged(u: Array, limits: _Range, params: Allocation) -> Array:
    """Exchange effectors for others so that u is within its limits and has the same effect.

    If the sweeps do not find such a u, the result is not within its limits.
    """
    exchange = params.exchange

    def sweep(now: tuple[int, Array]) -> tuple[int, Array]:
        number, moved = now
        for j in range(len(exchange)):
            excess = moved[j] - jnp.minimum(jnp.maximum(moved[j], limits.low[j]), limits.high[j])
            part = jnp.where(
                jnp.abs(exchange[j, j]) > SMALL, RELAXATION * excess / exchange[j, j], 0.0
            )
            moved = moved - exchange[:, j][:, None] * part
        return number + 1, moved

    return jax.lax.while_loop(
        lambda now: (now[0] < SWEEPS) & ~jnp.all(limits.is_inside(now[1])), sweep, (0, u)
    )[1]
