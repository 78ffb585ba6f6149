# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Saturate u by magnitude and rate limits, with the anti-windup of an integral."""

from typing import NamedTuple

from flight_core.vectors import Array, array_namespace

LEAST_DIVISOR = 2.0**-126
"""The least normal float32. A division by a smaller number could overflow."""


class Limits(NamedTuple):
    """Saturation limits, as deviations from trim in units of u.

    If there is no limit, the value is infinite.

    Attributes:
        lower: Least u, shape (m,).
        upper: Largest u, shape (m,).
        rate: Largest change of u, shape (m,), per s.

    Examples:
        >>> rise_di.Limits(np.array([-0.3]), np.array([0.3]), np.array([np.inf])).upper.tolist()
        [0.3]
    """

    lower: Array
    upper: Array
    rate: Array


def saturate(u: Array, u_before: Array, dt: Array, limits: Limits) -> Array:
    """Saturate u, shape (m,): clip it to [lower, upper] and to u_before +- rate dt.

    A u inside both ranges is returned without a change of any bit. If u_before lies outside new
    limits, u moves towards them at the rate.

    Args:
        u: Command, shape (m,).
        u_before: Command of the previous tick, shape (m,), in the units of u.
        dt: Time since the previous tick, s.
        limits: Limits, fields (m,).

    Returns:
        The command within the limits, shape (m,).

    Examples:
        >>> limits = rise_di.Limits(np.array([-0.3]), np.array([0.3]), np.array([2.0]))
        >>> rise_di.saturate(np.array([0.5]), np.array([0.28]), 0.01, limits).tolist()
        [0.3]
    """
    xp = array_namespace(u)
    low, high = bounds(u_before, dt, limits)
    return xp.minimum(xp.maximum(u, low), high)


def bounds(u_before: Array, dt: Array, limits: Limits) -> tuple[Array, Array]:
    """Return the least and the largest u that `saturate` allows, each with the shape (m,)."""
    xp = array_namespace(u_before)
    reach = limits.rate * dt
    low = xp.maximum(xp.minimum(limits.lower, u_before + reach), u_before - reach)
    high = xp.minimum(xp.maximum(limits.upper, u_before - reach), u_before + reach)
    return low, high


def limited_integral(before: Array, after: Array, change: Array, beyond: Array) -> Array:
    """Advance an integral by a tick with anti-windup, shape (m,).

    If the increment pushes u further beyond a limit, only a part of the increment is taken:

        before + max(1 - beyond / change, 0) (after - before)

    u then ends at the limit, or moves at the rate if a rate limit acts. The increment pushes u
    further out if `change` and `beyond` have the same sign. Otherwise the result is `after`, to the
    last bit.

    Source: conditional integration, K. J. Astrom, T. Hagglund, "Advanced PID Control", 3.5. This
    project takes a part of the increment, where the book takes none.

    Args:
        before: Integral before the tick, shape (m,).
        after: Integral after the tick without limits, shape (m,).
        change: Change of u by the increment, shape (m,), in the units of u.
        beyond: u with the increment, minus u after saturation, shape (m,), in the units of u.

    Returns:
        The integral after the tick, shape (m,), in the units of `before`.

    Examples:
        >>> zero, unit = np.zeros(1), np.ones(1)
        >>> rise_di.limited_integral(zero, unit, change=unit, beyond=0.25 * unit).tolist()
        [0.75]
    """
    xp = array_namespace(before)
    outward = change * beyond > 0.0
    share = xp.maximum(
        1.0 - beyond / xp.where(outward, change, xp.ones_like(change)), xp.zeros_like(change)
    )
    return xp.where(outward, before + share * (after - before), after)
