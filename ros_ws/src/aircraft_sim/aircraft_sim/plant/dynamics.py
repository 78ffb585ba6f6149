# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Evaluate the aircraft, equation (1): x_dot = A x + f(x, t) + B u, y = C x.

x, u and y are deviations from trim. f(x, t) is the sum of f_state(x) and f_time(t). `x_dot`
computes the sum at one instant, while `plant.advance` computes f_time once for all instants of the
steps.
"""

from typing import Any, NamedTuple

from aircraft_sim.atmosphere.disturbance import Bias, Gusts, Sines, bias, one_minus_cosine, sines
from flight_core.vectors import Array, array_namespace


class Coupling(NamedTuple):
    """P products of two states: f += gain @ (x[first] x[second])."""

    gain: Array  # (n, P) effect of each product on x_dot
    first: Array  # (P,) indices in x
    second: Array  # (P,) indices in x


class EulerKinematics(NamedTuple):
    """Nonlinear kinematics that replace the linear kinematics of A.

    The angles are relative to the stability axes, so they are 0 in trim.
    """

    select: Array  # (5, n), picks phi, theta, p, q, r
    into: Array  # (n, 3), adds the terms to alpha_dot, phi_dot, theta_dot
    # (3, n), rows of A that are replaced: none for alpha_dot, the rows of phi_dot and theta_dot
    linear: Array
    turn_rate: Array  # () g/V0, 1/s


class Aircraft(NamedTuple):
    """Matrices of equation (1) and the terms of f as arrays, SI and radians.

    A term that is None is absent.
    """

    A: Array  # (n, n)
    B: Array  # (n, m)
    C: Array  # (m, n)
    gravity: Array  # (n, n), the sine terms are gravity @ sin(x)
    gust_direction: Array  # (n, G), change of x_dot for 1 m/s of wind along each axis
    gusts: Gusts
    speed: Array  # () trim speed V0, m/s
    coupling: Coupling | None = None
    bias: Bias | None = None
    sines: Sines | None = None
    kinematics: EulerKinematics | None = None
    # (n,) constant term of x_dot, for matrices at another airspeed than the trim speed
    trim: Array | None = None


def f(t: Any, x: Array, params: Aircraft, turbulence: Array | None = None) -> Array:
    """Compute the uncertain part of equation (1), shape (n,).

        f = gravity @ sin(x) + gain @ (x[first] x[second]) + gust_direction @ (w(t) + turbulence)
            + bias(t) + sines(t) + kinematics(x)

    `turbulence` is a wind along the axes of `gust_direction`, shape (G,), m/s; None means no
    turbulence. x can hold N states in columns, (n, N).
    """
    return f_state(x, params) + f_time(t, wind(t, params, turbulence), params)


def x_dot(t: Any, x: Array, u: Array, params: Aircraft, turbulence: Array | None = None) -> Array:
    """Evaluate equation (1): A x + f(x, t) + B u, shape (n,)."""
    return x_dot_forced(x, f_time(t, wind(t, params, turbulence), params) + params.B @ u, params)


def x_dot_forced(x: Array, forced: Array, params: Aircraft) -> Array:
    """Compute A x + f_state(x) + forced, shape (n,): equation (1) with forced = f_time + B u."""
    # For a few states, `dot` takes a third of the time of @, with the same result to the last bit.
    return params.A.dot(x) + f_state(x, params) + forced


def f_state(x: Array, params: Aircraft) -> Array:
    """Compute the state-dependent part of f, shape (n,).

    gravity @ sin(x) + gain @ (x[first] x[second]) + kinematics(x)
    """
    total = params.gravity.dot(array_namespace(x).sin(x))
    if params.coupling is not None:
        gain, first, second = params.coupling
        total = total + gain @ (x[first] * x[second])
    return total if params.kinematics is None else total + kinematics(x, params.kinematics)


def kinematics(x: Array, params: EulerKinematics) -> Array:
    """Compute the nonlinear minus the linear kinematics, shape (n,).

        alpha_dot += g/V0 (cos phi cos theta - 1)
        phi_dot    = p + tan theta (q sin phi + r cos phi)
        theta_dot  = q cos phi - r sin phi

    The first term is the loss of vertical lift in a bank. Source: B. L. Stevens, F. L. Lewis,
    Aircraft Control and Simulation, 2nd ed. (2003), eqs. (1.3-22), (2.4-5).
    """
    xp = array_namespace(x)
    phi, theta, p, q, r = params.select.dot(x)
    sine = xp.sin(phi)
    cosine = xp.cos(phi)
    rates = [
        params.turn_rate * (cosine * xp.cos(theta) - 1.0),
        p + xp.tan(theta) * (q * sine + r * cosine),
        q * cosine - r * sine,
    ]
    # For a single aircraft, `asarray` takes a fifth of the time of `stack`.
    return params.into.dot(xp.asarray(rates) - params.linear.dot(x))


def f_time(t: Any, wind: Array, params: Aircraft) -> Array:
    """Compute the time-dependent part of f, shape (n,).

    gust_direction @ wind + bias(t) + sines(t),  wind in m/s, shape (G,)
    """
    total = params.gust_direction @ wind
    if params.bias is not None:
        total = total + bias(t, params.bias)
    if params.sines is not None:
        total = total + sines(t, params.sines)
    return total


def wind(t: Any, params: Aircraft, turbulence: Array | None = None) -> Array:
    """Compute the wind along the G axes, gusts plus turbulence, shape (G,), m/s."""
    gusts = one_minus_cosine(t, params.gusts, params.speed)
    return gusts if turbulence is None else gusts + turbulence


class Forcing(NamedTuple):
    """Wind and f_time at T instants, computed in advance."""

    wind: Array  # (T, G) speed of the gusts along the G axes, m/s
    rate: Array  # (T, n) f_time in this wind


def at_times(t: Array, params: Aircraft) -> Forcing:
    """Compute the forcing by gusts, biases and sines at T instants, t of shape (T,)."""

    def column(term: Any) -> Any:
        if term is None:
            return None
        return type(term)(*(None if values is None else values[:, None] for values in term))

    columns = params._replace(
        gusts=column(params.gusts), bias=column(params.bias), sines=column(params.sines)
    )
    gusts = wind(t, columns)
    return Forcing(gusts.T, f_time(t, gusts, columns).T)


def y(x: Array, params: Aircraft) -> Array:
    """Compute the measured output y = C x, shape (m,)."""
    return params.C.dot(x)
