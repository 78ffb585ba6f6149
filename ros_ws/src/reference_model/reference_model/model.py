# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the reference model, equation (2): x_m_dot = A_m x_m + B_m u_m, y_m = C x_m."""

from typing import Any, NamedTuple

import numpy as np

from flight_core.arithmetic import product
from flight_core.integrators import rk4
from flight_core.vectors import Array, FloatArray


class ReferenceMatrices(NamedTuple):
    """Matrices of equation (2): A_m (n, n) Hurwitz, B_m (n, m), C (m, n)."""

    A_m: Array
    B_m: Array
    C: Array


def x_m_dot(t: Any, x_m: Array, u_m: Array, params: ReferenceMatrices) -> Array:
    """Evaluate equation (2): A_m x_m + B_m u_m, shape (n,)."""
    return params.A_m @ x_m + params.B_m @ u_m


def output(x_m: Array, params: ReferenceMatrices) -> Array:
    """Compute the reference output y_m = C x_m, shape (m,)."""
    return product(params.C, x_m)


class Stepper(NamedTuple):
    """Matrices of a Runge-Kutta step of the linear equation (2)."""

    Phi: Array  # (n, n)
    Gamma: Array  # (n, 3m), for u_m at t, t + dt/2 and t + dt


def stepper(dt: float, params: ReferenceMatrices) -> Stepper:
    """Return the matrices of x_m(t + dt) = Phi x_m(t) + Gamma [u_m(t), u_m(t + dt/2), u_m(t + dt)].

    The columns of Phi and Gamma are Runge-Kutta steps that start from unit vectors. Up to rounding,
    the products with the matrices equal a Runge-Kutta step, and take a quarter of its time.
    """
    n, m = params.B_m.shape
    x = np.eye(n, n + 3 * m)
    u: FloatArray = np.eye(3 * m, n + 3 * m, n).reshape(3, m, n + 3 * m)

    def driven(t: Any, x: Array, u: Array, params: ReferenceMatrices) -> Array:
        return dt * x_m_dot(t, x, u[round(2.0 * t)], params)  # t = 0, 1/2, 1 of a step of length 1

    columns = rk4(driven, 0.0, x, u, params, 1.0)
    return Stepper(columns[:, :n], columns[:, n:])


def step(x_m: Array, u_m: Array, matrices: Stepper) -> Array:
    """Advance x_m, shape (n,), by a step.

    `u_m`, shape (3m,), holds u_m at t, t + dt/2 and t + dt. The sums have a fixed order, so that
    exported C code gives the same bits.
    """
    return product(matrices.Phi, x_m) + product(matrices.Gamma, u_m)


def second_order(natural_frequency: FloatArray, damping: FloatArray) -> ReferenceMatrices:
    """Return the matrices of a second-order filter for each channel, with n = 2m states.

        y_m,i'' + 2 damping_i w_i y_m,i' + w_i^2 y_m,i = w_i^2 u_m,i

    The states are [y_m,1, y_m,1', y_m,2, ...]. C selects the outputs, as (2) requires. The
    arguments have the shape (m,). The frequency is in rad/s, and the damping has no unit.
    """
    m = len(natural_frequency)
    model = ReferenceMatrices(np.zeros((2 * m, 2 * m)), np.zeros((2 * m, m)), np.zeros((m, 2 * m)))
    for i, (omega, zeta) in enumerate(zip(natural_frequency, damping, strict=True)):
        block = slice(2 * i, 2 * i + 2)
        model.A_m[block, block] = [[0.0, 1.0], [-(omega**2), -2.0 * zeta * omega]]
        model.B_m[2 * i + 1, i] = omega**2
        model.C[i, 2 * i] = 1.0
    return model
