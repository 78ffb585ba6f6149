# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""An extension of the paper, off by default: the input that a nominal model needs along the reference, beside the law.

It takes y_m alone, no state of the aircraft, and leaves the law as it is: see docs/theory.md.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.integrators import rk4
from flight_core.vectors import Array, array_namespace

ORIGIN = 1e-6
"""1/s. Real parts below it are zero: rounding leaves 1e-14, and a mode this slow takes 11 days."""


class Nominal(NamedTuple):
    """What is believed of the aircraft: x_dot = A x + f(x) + B u, y = C x, in deviations from trim, SI and radians."""

    A: Array  # (n, n)
    B: Array  # (n, m)
    C: Array  # (m, n), picks the outputs
    gravity: Array  # (n, n), f(x) = gravity @ sin(x)
    inverse: Array  # (m, m), that of Omega = C B
    lead: Array  # (m,) from a tick to the instant its input acts at: half a period of hold, delay, lag of the actuator; s


class FeedforwardState(NamedTuple):
    """What the feedforward carries from tick to tick."""

    x: Array  # (n,) state of the nominal model, C x = y_m
    u: Array  # (m,) input of the last tick, in its middle
    dt: Array  # () length of that tick, s
    ticks: Array  # () how many there were since engagement
    u_0: Array  # (m,) u_ff at engagement


def initial_state(y_m: Array, nominal: Nominal) -> FeedforwardState:
    """State at engagement: the outputs on y_m, shape (m,), the other states at 0, where the aircraft is trimmed."""
    xp = array_namespace(y_m)
    none, zero = xp.zeros_like(y_m), xp.zeros_like(y_m[0])
    return FeedforwardState(nominal.C.T @ y_m, none, zero, zero, none)


def ideal(x: Array, y_m_dot: Array, nominal: Nominal) -> Array:
    """Input that moves the outputs of the nominal model by y_m_dot: Omega^-1 (y_m_dot - C (A x + f(x))), shape (m,)."""
    return nominal.inverse @ (y_m_dot - nominal.C @ _drift(x, nominal))


def x_dot(t: Array, x: Array, y_m_dot: Array, nominal: Nominal) -> Array:
    """Nominal model under its ideal input, shape (n,): A x + f(x) + B ideal(x, y_m_dot), so that C x_dot = y_m_dot."""
    return _drift(x, nominal) + nominal.B @ ideal(x, y_m_dot, nominal)


def _drift(x: Array, nominal: Nominal) -> Array:
    xp = array_namespace(x)
    return nominal.A @ x + nominal.gravity @ xp.sin(x)


def step(state: FeedforwardState, y_m: Array, dt: Array, nominal: Nominal) -> tuple[FeedforwardState, Array]:
    """One tick: (state, y_m, dt) -> (state, what is added to the law's u).

    Over the last tick y_m is taken for a straight line; the nominal model is led along it, its other states (the zero
    dynamics) integrated with the input that this takes:

        y_m_dot = (y_m - C x_p) / dt                       C x_p = y_m one tick ago
        x       = Runge-Kutta step of x_dot from x_p       C x = y_m
        u       = ideal((x + x_p) / 2, y_m_dot)            in the middle of the tick, dt / 2 ago
        u_ff    = u + (dt / 2 + lead) (u - u_p) / ((dt + dt_p) / 2)

    the straight line through the last two u, at the instant when this tick's input acts: behind an actuator of first order
    u + lag u_dot is what makes it move by u. The two first ticks after engagement make the line known and add nothing;
    u_ff of the second is u_0 and u_ff - u_0 is added from then on, so that nothing jumps. dt > 0.

    Shapes: y_m, u_ff (m,), dt (). Units: SI and radians; u in the units of B. Source: this project, after the feedforward
    of model inversion; see docs/theory.md.
    """
    xp = array_namespace(y_m)
    y_m_dot = (y_m - nominal.C @ state.x) / dt
    x = rk4(x_dot, 0.0, state.x, y_m_dot, nominal, dt)
    u = ideal((x + state.x) / 2.0, y_m_dot, nominal)
    u_ff = u + (dt + 2.0 * nominal.lead) * (u - state.u) / (dt + state.dt)
    u_0 = xp.where(state.ticks < 2.0, u_ff, state.u_0)
    return FeedforwardState(x, u, dt, state.ticks + 1.0, u_0), u_ff - u_0


def zero_dynamics(nominal: Nominal) -> NDArray[np.complex128]:
    """Eigenvalues of the states behind the outputs held at 0, shape (n - m,), 1/s: those of the nominal model's zeros.

    H' (I - B Omega^-1 C) (A + gravity) H, H the columns of I that are not outputs; sin(x) by x. Takes NumPy arrays.
    """
    hidden = ~np.asarray(nominal.C).any(axis=0)
    led = nominal.A + nominal.gravity
    matrix = led - nominal.B @ nominal.inverse @ nominal.C @ led
    return np.linalg.eigvals(matrix[np.ix_(hidden, hidden)]).astype(np.complex128)
