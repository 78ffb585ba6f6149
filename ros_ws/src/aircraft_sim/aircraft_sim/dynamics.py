# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The aircraft, equation (1): x_dot = A x + f(x, t) + B u, y = C x, in deviations from trim."""

from typing import Any, NamedTuple

from array_api_compat import array_namespace

from aircraft_sim.disturbance import Gusts, one_minus_cosine
from flight_core.vectors import Array


class Aircraft(NamedTuple):
    """Matrices of equation (1) and what makes up f, SI and radians, as arrays."""

    A: Array  # (n, n)
    B: Array  # (n, m)
    C: Array  # (m, n)
    gravity: Array  # (n, n), gravity @ sin(x)
    gust_direction: Array  # (n, G), what one m/s of each gust adds to x_dot
    gusts: Gusts
    speed: Array  # () trim speed V0, m/s


def f(t: Any, x: Array, params: Aircraft) -> Array:
    """Uncertain part of equation (1): gravity @ sin(x) + gust_direction @ w(t), shape (n,)."""
    xp = array_namespace(x)
    return params.gravity @ xp.sin(x) + params.gust_direction @ one_minus_cosine(t, params.gusts, params.speed)


def x_dot(t: Any, x: Array, u: Array, params: Aircraft) -> Array:
    """Equation (1): A x + f(x, t) + B u, shape (n,)."""
    return params.A @ x + f(t, x, params) + params.B @ u


def y(x: Array, params: Aircraft) -> Array:
    """Measured output y = C x, shape (m,)."""
    return params.C @ x
