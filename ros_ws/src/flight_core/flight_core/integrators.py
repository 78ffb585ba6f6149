# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Integrate with a fixed step, because a variable step could miss a gust."""

from collections.abc import Callable
from typing import Any

from flight_core.vectors import Array


def rk4(
    x_dot: Callable[[Any, Array, Array, Any], Array],
    t: Any,
    x: Array,
    u: Array,
    params: Any,
    dt: Any,
) -> Array:
    """Take a step of the classical fourth-order Runge-Kutta method, with u held over the step.

    x(t + dt) = x + dt/6 (k1 + 2 k2 + 2 k3 + k4), with a local error O(dt^5). x and u can be arrays
    of any type.
    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, table 1.2.
    """
    k1 = x_dot(t, x, u, params)
    k2 = x_dot(t + dt / 2, x + dt / 2 * k1, u, params)
    k3 = x_dot(t + dt / 2, x + dt / 2 * k2, u, params)
    k4 = x_dot(t + dt, x + dt * k3, u, params)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
