# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Solve linear-quadratic designs for many models and sets of weights at once.

The discrete Riccati equation is solved by doubling.

In each function the leading axes of the arguments are broadcast together.
"""

import numpy as np

from flight_core.vectors import FloatArray

MAX_DOUBLINGS = 40  # 2^40 steps are enough for a mode that decays within 1e9 steps


def riccati(F: FloatArray, G: FloatArray, Q: FloatArray, R: FloatArray) -> FloatArray:
    """Find the stabilising P = F'P F - F'P G (R + G'P G)^-1 G'P F + Q, shape (.., s, s).

    Each iteration doubles the horizon. T is `transition`, S is `gramian`, and W = I + S P:

        P+ = P + T'P W^-1 T,  S+ = S + T W^-1 S T',  T+ = T W^-1 T
            beginning with P = Q,  S = G R^-1 G',  T = F

    scipy.linalg.solve_discrete_are solves a single equation at a time and is eight times slower.
    F and Q have the shape (.., s, s), G has (.., s, m), and R has (.., m, m). Source: E. K.-W. Chu,
    H.-Y. Fan, W.-W. Lin, C.-S. Wang, Int. J. Control 77(8), 2004.
    """
    batch = np.broadcast_shapes(*(matrix.shape[:-2] for matrix in (F, G, Q, R)))
    F, G, P, R = (np.broadcast_to(matrix, (*batch, *matrix.shape[-2:])) for matrix in (F, G, Q, R))
    s = F.shape[-1]
    eye = np.eye(s)
    transition = F
    gramian = G @ np.linalg.solve(R, transpose(G))
    for _ in range(MAX_DOUBLINGS):
        solved = np.linalg.solve(eye + gramian @ P, np.concatenate([transition, gramian], axis=-1))
        step = solved[..., :s]
        reach = solved[..., s:]
        more = transpose(transition) @ P @ step
        gramian = gramian + transition @ reach @ transpose(transition)
        transition = transition @ step
        P = P + (more + transpose(more)) / 2.0
        if (np.abs(more) <= 1e-13 * np.abs(P).max(axis=(-1, -2), keepdims=True)).all():
            break
    return np.asarray(P)


def transpose(matrix: FloatArray) -> FloatArray:
    """Transpose matrices (.., n, m). The result has the shape (.., m, n)."""
    return np.swapaxes(matrix, -1, -2)


def diagonal(values: FloatArray) -> FloatArray:
    """Return diagonal matrices, (.., s, s), with the diagonals `values`, (.., s)."""
    return np.asarray(values[..., :, None] * np.eye(values.shape[-1]))


def gain_of(F: FloatArray, G: FloatArray, Q: FloatArray, R: FloatArray) -> FloatArray:
    """Compute the gain (R + G'P G)^-1 G'P F of u = -gain z, shape (.., m, s).

    This u minimises the sum of z'Q z + u'R u for z+ = F z + G u.
    """
    P = riccati(F, G, Q, R)
    return np.asarray(np.linalg.solve(R + transpose(G) @ P @ G, transpose(G) @ P @ F))


def correction_of(
    F: FloatArray, H: FloatArray, process: FloatArray, noise: FloatArray
) -> FloatArray:
    """Compute the gain S H'(H S H' + noise)^-1 of the stationary Kalman filter, (.., s, m).

    The filter is z + gain (y - H z), and S is the covariance of the predicted state. `process` is
    the covariance of the process noise in a step, (.., s, s), and `noise` the covariance of the
    noise of y, (.., m, m). H has shape (.., m, s). Source: B. D. O. Anderson, J. B. Moore, "Optimal
    Filtering", 4.4.
    """
    S = riccati(transpose(F), transpose(H), process, noise)
    return transpose(np.asarray(np.linalg.solve(H @ S @ transpose(H) + noise, H @ S)))


def corrections_near(
    F: FloatArray, H: FloatArray, process: FloatArray, noise: FloatArray
) -> FloatArray:
    """Compute the gains of `correction_of` for models that are close to the first model.

    The gains are exact to first order in the difference from the first model.

    With the gain K of the first model and A = F (I - K H), the covariance of a model with F_i is S
    + dS,

        dS = A dS A' + F_i (I - K H) S (I - K H)'F_i' + F_i K noise K'F_i' + process_i - S

    This holds to first order. S is the minimum over all gains, so a change of the gain has only an
    effect of second order. F and `process` have the models in their first axis. Source: D. L.
    Kleinman, IEEE TAC 13(1), 1968.
    """
    S = riccati(transpose(F[:1]), transpose(H), process[:1], noise)
    K = transpose(np.asarray(np.linalg.solve(H @ S @ transpose(H) + noise, H @ S)))
    uncorrected = np.eye(F.shape[-1]) - K @ H
    change = (
        F @ (uncorrected @ S @ transpose(uncorrected) + K @ noise @ transpose(K)) @ transpose(F)
        + process
        - S
    )
    A = F[:1] @ uncorrected
    for _ in range(MAX_DOUBLINGS):
        more = A @ change @ transpose(A)
        change = change + more
        A = A @ A
        if np.all(np.abs(more) <= 1e-10 * np.max(np.abs(change), axis=(-1, -2), keepdims=True)):
            break
    S = S + change
    return transpose(np.asarray(np.linalg.solve(H @ S @ transpose(H) + noise, H @ S)))
