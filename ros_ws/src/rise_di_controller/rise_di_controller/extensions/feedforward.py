# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute a feedforward by model inversion, an extension of the paper, off by default.

The feedforward is the input with which a nominal model of the aircraft would follow y_m.

It uses only y_m, not the state of the aircraft, and does not change the law. See docs/theory.md.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core import arithmetic
from flight_core.arithmetic import product, sine
from flight_core.integrators import rk4
from flight_core.vectors import Array, array_namespace

# A real part below this, 1/s, counts as zero. Rounding errors are about 1e-14, and a mode at 1e-6
# 1/s has a time constant of 11 days.
ZERO_REAL_PART = 1e-6


LONGEST_PART = 10
"""Largest number of periods in a Runge-Kutta step of the nominal model. A tick after many lost
samples takes several steps."""


class Nominal(NamedTuple):
    """Nominal model of the aircraft: x_dot = A x + f(x) + B u, y = C x.

    All variables are deviations from trim, in SI units and radians.
    """

    A: Array  # (n, n)
    B: Array  # (n, m)
    C: Array  # (m, n), selects the outputs
    gravity: Array  # (n, n), f(x) = gravity @ sin(x)
    inverse: Array  # inverse of Omega = C B, (m, m)
    # I - B Omega^-1 C, (n, n), which takes A x + f(x) to what remains of it under the ideal input
    path: Array
    path_A: Array  # (n, n), path A
    path_gravity: Array  # (n, n), path gravity
    # time from a tick until the input acts, s, (m,): half a period of hold, delay and actuator lag
    lead: Array
    sine_states: tuple[int, ...]  # indices of the states with a sine term
    # 1 for the inputs with a feedforward, else 0, (m,); None if all inputs have a feedforward
    acts: Array | None = None


def nominal_model(
    A: Array, B: Array, C: Array, gravity: Array, lead: Array, acts: Array | None = None
) -> Nominal:
    """Build the nominal model, with the matrix products that each tick needs.

    C B must be invertible.
    """
    inverse = arithmetic.inverse(product(C, B))
    path = np.eye(len(A)) - product(product(B, inverse), C)
    angles = tuple(np.flatnonzero(gravity.any(axis=0)).tolist())
    return Nominal(
        A=A,
        B=B,
        C=C,
        gravity=gravity,
        inverse=inverse,
        path=path,
        path_A=product(path, A),
        path_gravity=product(path, gravity),
        lead=lead,
        sine_states=angles,
        acts=acts,
    )


class FeedforwardState(NamedTuple):
    """State of the feedforward between two ticks."""

    x: Array  # state of the nominal model, with C x = y_m, (n,)
    u: Array  # input in the middle of the last tick, (m,)
    dt: Array  # length of the last tick, s, ()
    ticks: Array  # number of ticks since engagement, ()
    u_0: Array  # u_ff at engagement, (m,)


def initial_state(y_m: Array, nominal: Nominal) -> FeedforwardState:
    """Return the state at engagement, with outputs at y_m, (m,), and other states at trim, 0."""
    xp = array_namespace(y_m)
    zeros = xp.zeros_like(y_m)
    zero = xp.zeros_like(y_m[0])
    return FeedforwardState(x=product(nominal.C.T, y_m), u=zeros, dt=zero, ticks=zero, u_0=zeros)


def with_new_model(
    state: FeedforwardState | None, y_m: Array, y_m_dot: Array, dt: Array, nominal: Nominal
) -> FeedforwardState:
    """Return a state from which the feedforward continues its motion with a new model.

    If x has the same length in both models, x and u_0 stay. Otherwise they begin anew, with the
    outputs at y_m and u_0 = 0. u is computed with the new model, and u - u_0 is then the
    feedforward until the next tick. `y_m_dot` and `dt` belong to the last tick.
    """
    start = initial_state(y_m, nominal)
    if state is not None and state.x.shape == start.x.shape:
        start = start._replace(x=state.x, u_0=state.u_0)
    return start._replace(u=ideal_input(start.x, y_m_dot, nominal), dt=dt, ticks=start.ticks + 2.0)


def ideal_input(x: Array, y_m_dot: Array, nominal: Nominal) -> Array:
    """Compute the input with which the outputs of the nominal model move by y_m_dot, shape (m,).

    u = Omega^-1 (y_m_dot - C (A x + f(x)))
    """
    drift = product(nominal.A, x) + product(nominal.gravity, sines(x, nominal))
    return product(nominal.inverse, y_m_dot - product(nominal.C, drift))


def x_dot(t: Array, x: Array, forced: Array, nominal: Nominal) -> Array:
    """Compute x_dot of the nominal model under the ideal input, shape (n,).

    x_dot = A x + f(x) + B ideal_input(x, y_m_dot), so C x_dot = y_m_dot.

    It is evaluated as (I - B Omega^-1 C) (A x + f(x)) + forced, with forced = B Omega^-1 y_m_dot.
    """
    return product(nominal.path_A, x) + product(nominal.path_gravity, sines(x, nominal)) + forced


def sines(x: Array, nominal: Nominal) -> Array:
    """Return sin(x) for the states with a sine term, 0 for all others, shape (n,) or (n, N)."""
    if not isinstance(x, np.ndarray):
        rows = [sine(row) if j in nominal.sine_states else 0.0 * row for j, row in enumerate(x)]
        return array_namespace(x).stack(rows)
    values = np.zeros_like(x)
    for j in nominal.sine_states:
        # math.sin on a float takes a fifth of the time of an array
        values[j] = sine(x[j].item() if x.ndim == 1 else x[j])
    return values


def step_count(span_ns: int, period_ns: int) -> int:
    """Return into how many Runge-Kutta steps the time between two ticks is divided.

    A step is at most LONGEST_PART periods long.
    """
    return max(-(-span_ns // (LONGEST_PART * period_ns)), 1)


def step(
    state: FeedforwardState, y_m: Array, dt: Array, nominal: Nominal, parts: int = 1
) -> tuple[FeedforwardState, Array]:
    """Advance the feedforward by a tick, and return the state and u_ff - u_0.

    The law adds u_ff - u_0 to its u.

    y_m is taken as linear over the last tick. The outputs of the nominal model follow it, and the
    other states (the zero dynamics) are integrated under the input that this requires:

        y_m_dot = (y_m - C x_p) / dt                       C x_p = y_m a tick ago
        x       = Runge-Kutta steps of x_dot from x_p      C x = y_m, `parts` equal ones
        u       = ideal((x + x_p) / 2, y_m_dot)            in the middle of the tick, dt / 2 ago
        u_ff    = u + (dt / 2 + lead) (u - u_p) / ((dt + dt_p) / 2)

    u_ff extrapolates the last two u linearly to the instant at which this tick's input acts. This
    includes the lag, because a first-order actuator follows u if its command is u + lag u_dot. The
    first two ticks after engagement only determine the slope and add nothing. u_0 is u_ff of the
    second tick, so that u does not jump (bumpless transfer). dt > 0.

    y_m and u_ff have the shape (m,), and dt has (). The units are SI and radians, and u has the
    units of B. Source: this project, after the feedforward of model inversion (see docs/theory.md).
    """
    xp = array_namespace(y_m)
    y_m_dot = (y_m - product(nominal.C, state.x)) / dt
    forced = product(nominal.B, product(nominal.inverse, y_m_dot))
    x = state.x
    for _ in range(parts):
        x = rk4(x_dot, 0.0, x, forced, nominal, dt / parts)
    u = ideal_input((x + state.x) / 2.0, y_m_dot, nominal)
    u_ff = u + (dt + 2.0 * nominal.lead) * (u - state.u) / (dt + state.dt)
    u_0 = xp.where(state.ticks < 2.0, u_ff, state.u_0)
    return FeedforwardState(x=x, u=u, dt=dt, ticks=state.ticks + 1.0, u_0=u_0), of_active_inputs(
        u_ff - u_0, nominal
    )


def of_active_inputs(u: Array, nominal: Nominal) -> Array:
    """Keep u in the inputs that have a feedforward, and set it to 0 in the others, (m,)."""
    return u if nominal.acts is None else u * nominal.acts


def nominal_zeros(nominal: Nominal) -> NDArray[np.complex128]:
    """Compute the zeros of the nominal model, shape (n - m,), 1/s.

    The zeros are the eigenvalues of the zero dynamics, H' (I - B Omega^-1 C) (A + gravity) H. H has
    the columns of I for the states that are not outputs, and sin(x) is linearised to x. Only NumPy
    arrays are accepted.
    """
    hidden = ~np.asarray(nominal.C).any(axis=0)
    matrix = nominal.path @ (nominal.A + nominal.gravity)
    return np.linalg.eigvals(matrix[np.ix_(hidden, hidden)]).astype(np.complex128)
