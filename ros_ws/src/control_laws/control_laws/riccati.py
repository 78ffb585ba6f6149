# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Linear-quadratic design for many sets of weights at once: zero-order hold, and the discrete Riccati equation by doubling."""

import numpy as np
from scipy.linalg import expm

from flight_core.vectors import FloatArray

MAX_DOUBLINGS = 40  # 2^40 steps of a finite horizon: enough for a mode that decays within 1e9 of them


def zero_order_hold(A: FloatArray, B: FloatArray, period: float) -> tuple[FloatArray, FloatArray]:
    """exp(A period) and integral_0^period exp(A s) ds B (C. Van Loan, IEEE TAC 23(3), 1978): u held over a period."""
    n, m = B.shape
    exponential = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * period)
    return exponential[:n, :n], exponential[:n, n:]


def riccati(F: FloatArray, G: FloatArray, Q: FloatArray, R: FloatArray) -> FloatArray:
    """The stabilising P = F'P F - F'P G (R + G'P G)^-1 G'P F + Q, shape (.., s, s), for weights (.., s, s) and (.., m, m).

    Each doubling squares the horizon's transition: with W = I + G_k P_k,

        P+ = P + F'P W^-1 F,  G+ = G + F W^-1 G F',  F+ = F W^-1 F,  from G R^-1 G', Q and F

    scipy.linalg.solve_discrete_are solves one at a time and is eight times slower. Source: E. K.-W. Chu, H.-Y. Fan, W.-W. Lin,
    C.-S. Wang, Int. J. Control 77(8), 2004.
    """
    eye = np.eye(len(F))
    P, gramian, transition = Q, G @ np.linalg.solve(R, np.broadcast_to(G.T, (*R.shape[:-2], *G.T.shape))), F
    for _ in range(MAX_DOUBLINGS):
        both = np.concatenate([np.broadcast_to(transition, P.shape), gramian], axis=-1)
        solved = np.linalg.solve(eye + gramian @ P, both)
        moved, reached = np.split(solved, 2, axis=-1)
        transposed = np.swapaxes(transition, -1, -2)
        more = transposed @ P @ moved
        gramian = gramian + transition @ reached @ transposed
        transition = transition @ moved
        P = P + (more + np.swapaxes(more, -1, -2)) / 2.0
        if np.all(np.abs(more) <= 1e-13 * np.max(np.abs(P), axis=(-1, -2), keepdims=True)):
            break
    return np.asarray(P)


def diagonals(values: FloatArray) -> FloatArray:
    """Diagonal matrices, (N, s, s), of diagonals in columns, (s, N)."""
    return np.asarray(values.T[:, :, None] * np.eye(len(values)))


def gain_of(F: FloatArray, G: FloatArray, Q: FloatArray, R: FloatArray) -> FloatArray:
    """The gain (R + G'P G)^-1 G'P F of u = -gain z that minimises the sum of z'Q z + u'R u, shape (.., m, s)."""
    P = riccati(F, G, Q, R)
    return np.asarray(np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F))
