# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The aircraft, equation (1): x_dot = A x + f(x, t) + B u, y = C x, in deviations from trim.

f is a sum of what depends on the state and of what depends on time: `x_dot` takes both at one instant, `plant.advance` the
second at all instants of its steps together.
"""

from typing import Any, NamedTuple

from aircraft_sim.disturbance import Bias, Gusts, Sines, bias, one_minus_cosine, sines
from flight_core.vectors import Array, array_namespace


class Coupling(NamedTuple):
    """Products of two states, P of them: f += gain @ (x[first] x[second])."""

    gain: Array  # (n, P)
    first: Array  # (P,) places in x
    second: Array  # (P,)


class Aircraft(NamedTuple):
    """Matrices of equation (1) and what makes up f, SI and radians, as arrays. What is None is absent."""

    A: Array  # (n, n)
    B: Array  # (n, m)
    C: Array  # (m, n)
    gravity: Array  # (n, n), gravity @ sin(x)
    gust_direction: Array  # (n, G), what one m/s of wind along each axis adds to x_dot
    gusts: Gusts
    speed: Array  # () trim speed V0, m/s
    coupling: Coupling | None = None
    bias: Bias | None = None
    sines: Sines | None = None


def f(t: Any, x: Array, params: Aircraft, turbulence: Array | None = None) -> Array:
    """Uncertain part of equation (1), shape (n,):

        f = gravity @ sin(x) + gain @ (x[first] x[second]) + gust_direction @ (w(t) + turbulence) + bias(t) + sines(t)

    `turbulence` is its wind along the G axes, shape (G,), m/s, none where it is left out. Works on states in columns, (n, N).
    """  # noqa: D400, D415 - what follows is an equation
    return f_state(x, params) + f_time(t, wind(t, params, turbulence), params)


def x_dot(t: Any, x: Array, u: Array, params: Aircraft, turbulence: Array | None = None) -> Array:
    """Equation (1): A x + f(x, t) + B u, shape (n,)."""
    return x_dot_forced(x, f_time(t, wind(t, params, turbulence), params) + params.B @ u, params)


def x_dot_forced(x: Array, rest: Array, params: Aircraft) -> Array:
    """A x + f_state(x) + rest, shape (n,): equation (1) where `rest` is f_time + B u."""
    return params.A @ x + f_state(x, params) + rest


def f_state(x: Array, params: Aircraft) -> Array:
    """The part of f that depends on the state: gravity @ sin(x) + gain @ (x[first] x[second]), shape (n,)."""
    gravity = params.gravity @ array_namespace(x).sin(x)
    if params.coupling is None:
        return gravity
    gain, first, second = params.coupling
    return gravity + gain @ (x[first] * x[second])


def f_time(t: Any, wind: Array, params: Aircraft) -> Array:
    """The part of f that depends on time: gust_direction @ wind + bias(t) + sines(t), shape (n,); wind of shape (G,), m/s."""
    total = params.gust_direction @ wind
    if params.bias is not None:
        total = total + bias(t, params.bias)
    if params.sines is not None:
        total = total + sines(t, params.sines)
    return total


def wind(t: Any, params: Aircraft, turbulence: Array | None = None) -> Array:
    """The wind along the G axes, shape (G,), m/s: gusts w(t) + turbulence."""
    gusts = one_minus_cosine(t, params.gusts, params.speed)
    return gusts if turbulence is None else gusts + turbulence


class Forcing(NamedTuple):
    """What depends on time alone, at T instants."""

    wind: Array  # (T, G) of the gusts along the G axes, m/s
    rate: Array  # (T, n) f_time in it


def at_times(t: Array, params: Aircraft) -> Forcing:
    """The gusts and f_time in them at T instants at once, t of shape (T,)."""

    def column(of: Any) -> Any:
        return None if of is None else type(of)(*(one[:, None] for one in of))

    columns = params._replace(gusts=column(params.gusts), bias=column(params.bias), sines=column(params.sines))
    gusts = wind(t, columns)
    return Forcing(gusts.T, f_time(t, gusts, columns).T)


def y(x: Array, params: Aircraft) -> Array:
    """Measured output y = C x, shape (m,)."""
    return params.C @ x
