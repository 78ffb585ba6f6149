# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Saturation of u: magnitude and rate limits."""

from typing import NamedTuple

from flight_core.vectors import Array, array_namespace


class Limits(NamedTuple):
    """Saturation limits, as deviations from trim in units of u; infinite where there is no limit."""

    lower: Array  # (m,)
    upper: Array  # (m,)
    rate: Array  # (m,) per s


def saturate(u: Array, u_before: Array, dt: Array, limits: Limits) -> Array:
    """Saturation of u, shape (m,): clipped to [lower, upper] and to u_before +- rate dt. Inside, u returns to the last bit."""
    xp = array_namespace(u)
    reach = limits.rate * dt
    low = xp.minimum(xp.maximum(limits.lower, u_before - reach), limits.upper)
    high = xp.maximum(xp.minimum(limits.upper, u_before + reach), limits.lower)
    return xp.minimum(xp.maximum(u, low), high)
