# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the SDU decomposition Omega = C B = S D U, equations (10)-(11).

D is all that the law has to know of the aircraft.

D depends on the order of the channels, on the pairs of inputs and outputs, and on the signs of the
inputs, so it is validated together with the channels. U measures the quality of the pairing,
because the beta and K that channel i needs grow with abs(U_ij), j > i.
"""

import math
from collections.abc import Iterable
from itertools import groupby, permutations, product
from operator import ne
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flight_core.parameters import ParameterError
from flight_core.vectors import FloatArray, as_array

NEARLY_ZERO = 1e-9
"""Minor k is nearly zero if a change of every entry of Omega by this fraction of the entry's size
could turn the sign of Delta_k / Delta_(k-1), to first order. Rounding is 2e-16 times the growth of
the elimination, so a growth of 1e6 is allowed. Published and identified values are six orders of
magnitude coarser."""

MANY = 5
"""Up to this number of channels all orders are tried: the (5!)^2 = 14,400 of five channels take a
second, those of six a minute, and those of eight do not fit into memory."""

# Each round halves the spread of the exponents, so 10 rounds reduce 1e300 to less than a factor of
# 2.
_EQUILIBRATIONS = 10


Order = tuple[tuple[int, ...], tuple[int, ...]]
"""Rows and columns of Omega by channel."""


class DecompositionError(ParameterError):
    """Raised if a matrix has no S D U.

    `minor` is the number of the first leading minor that is zero or nearly so, or None if the
    matrix is not square.
    """

    def __init__(self, sentence: str, minor: int | None = None) -> None:
        super().__init__(sentence)
        self.minor = minor


class SDU(NamedTuple):
    """Factors of Omega = S diag(D) U, equations (10)-(11)."""

    S: FloatArray  # symmetric positive definite, units of y_dot, (m, m)
    D: FloatArray  # diagonal of D, +1 or -1, (m,)
    U: FloatArray  # upper triangular with a diagonal of ones, (m, m)


class Pairing(NamedTuple):
    """A choice of channels that makes D = I: Omega[outputs][:, inputs] * signs.

    Channel k of the law is row k and column k.
    """

    outputs: tuple[int, ...]  # row of Omega for each channel
    inputs: tuple[int, ...]  # column of Omega for each channel
    signs: tuple[int, ...]  # for each channel, -1 if the sign of its input changes, else +1
    U: FloatArray  # U of the reordered matrix in inputs of unit response, (m, m)


def decompose(Omega: ArrayLike) -> SDU:
    """Compute the unique S, D and U of Omega, shape (m, m), by elimination without pivoting.

        Omega = L diag(p) W,  p_k = Delta_k / Delta_(k-1),  Delta_k the leading minors, Delta_0 = 1
        S = L diag(abs(p)) L',  D = sign(p),  U = D L^-T D W

    Source: equations (10)-(11) of Tanyer, Tatlicioglu, Zergeroglu. For the existence, see A. S.
    Morse, "A Gain Matrix Decomposition and Some of Its Applications", Systems & Control Letters 21,
    1993.

    Args:
        Omega: Matrix C B, shape (m, m), units of y_dot per unit of u.

    Returns:
        `S` (m, m), the diagonal `D` (m,) of signs, and `U` (m, m).

    Raises:
        DecompositionError: Omega is not square or not finite, or a leading minor is zero or
            nearly so.

    Examples:
        >>> rise_di.decompose([[2.0, 1.0], [0.0, -1.0]]).D.tolist()
        [1.0, -1.0]
    """
    L, p, W, L_inverse = _eliminate(Omega)
    D = np.sign(p)
    S = (L * np.abs(p)) @ L.T
    return SDU((S + S.T) / 2.0, D, (D[:, None] * L_inverse.T * D) @ W + 0.0)  # no -0.0


def signs(Omega: FloatArray) -> FloatArray:
    """Compute D of Omega, shape (m,): D_k = sign(Delta_k / Delta_(k-1)).

    Raises DecompositionError as `decompose` does.
    """
    return np.sign(_eliminate(Omega)[1])


def leading_minors(Omega: FloatArray) -> FloatArray:
    """Compute the determinants Delta_k of the first k rows and columns, k = 1 .. m, shape (m,).

    Minors may be zero. Raises DecompositionError if Omega is not square or not finite.
    """
    matrix = _square(Omega)
    return np.array([np.linalg.det(matrix[:k, :k]) for k in range(1, len(matrix) + 1)])


def unit_diagonal(Omega: FloatArray) -> FloatArray:
    """Scale each input of Omega so that its own output responds by 1, shape (m, m).

    The scaled inputs are v_i = abs(Omega_ii) u_i, so each entry becomes Omega_ij / abs(Omega_jj).

    Raises DecompositionError if Omega is not square or not finite, or if an output does not respond
    to the input that it is paired with.
    """
    matrix = _square(Omega)
    diagonal = np.abs(np.diag(matrix))
    if not diagonal.all():
        i = int(np.flatnonzero(diagonal == 0.0)[0])
        raise DecompositionError(
            f"Omega: found Omega_{i + 1}{i + 1} = 0, expected outputs that respond to their own "
            "inputs"
        )
    return matrix / diagonal


def coupling(Omega: FloatArray) -> float:
    """Compute max abs(U - I) of `unit_diagonal(Omega)`, which is large for a bad pairing.

    The coupling is infinite if an output does not respond to the input that it is paired with. It
    depends on the units of y, but not on the units or signs of u. Raises DecompositionError as
    `decompose` does.
    """
    signs(Omega)
    return _excess(decompose(unit_diagonal(Omega)).U) if np.diag(Omega).all() else math.inf


def search(Omega: FloatArray, largest_U: float = math.inf) -> Pairing | None:
    """Find the smallest change of the channels that makes D = I.

    Returns None if none of the orders that are tried gives D = I.

    Up to MANY channels, every order of the outputs is combined with every order of the inputs,
    which is (m!)^2 cases. With more channels only the three orders of `_likely_orders` are tried. A
    smaller change may then exist, even if None is returned. The signs of the inputs need no search:
    an input k is reversed where D_k = -1, because its sign changes only D_k. Orders with a zero on
    the diagonal, or with max abs(U - I) above `largest_U`, are excluded. Of the others, the best
    one is chosen by these criteria. Each decides among the orders that are equal by the criteria
    before it:

    - the largest number of outputs that keep their input,
    - the largest number of outputs that keep their place,
    - the largest number of inputs that keep their sign,
    - the smallest max abs(U - I), for inputs that are scaled so that abs(Omega_ii) = 1.

    Raises DecompositionError if Omega is not square or not finite.
    """
    matrix = _square(Omega)
    places = range(len(matrix))

    def change(order: Order) -> tuple[int, int]:
        outputs, inputs = order
        return sum(map(ne, outputs, inputs)), sum(map(ne, outputs, places))

    every: Iterable[Order]
    if len(matrix) <= MANY:
        every = product(permutations(places), permutations(places))
    else:
        every = _likely_orders(matrix)
    for _, group in groupby(sorted(every, key=change), key=change):
        pairings = (_pairing(matrix, *order) for order in group)
        accepted = [
            pairing
            for pairing in pairings
            if pairing is not None and _excess(pairing.U) <= largest_U
        ]
        if accepted:
            return min(accepted, key=lambda pairing: (pairing.signs.count(-1), _excess(pairing.U)))
    return None


def _likely_orders(matrix: FloatArray) -> Iterable[Order]:
    """List three orders of the channels that are likely to give D = I.

    They are the order that is given, the order that pairs inputs and outputs so that the product of
    the responses is largest, and the order in which an elimination with complete pivoting takes the
    channels.
    """
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 - takes 0.17 s, needed only above MANY channels

    rows, columns = _sizes(matrix)
    remainder = matrix / rows[:, None] / columns
    m = len(matrix)
    places = tuple(range(m))
    assigned = linear_sum_assignment(
        np.log(np.maximum(np.abs(remainder), np.finfo(float).tiny)), maximize=True
    )[1]
    orders = {(places, places), (places, tuple(assigned.tolist()))}
    outputs = list[int]()
    inputs = list[int]()
    while remainder.any():
        i, j = (
            int(place) for place in np.unravel_index(np.argmax(np.abs(remainder)), remainder.shape)
        )
        remainder = remainder - np.outer(remainder[:, j], remainder[i] / remainder[i, j])
        remainder[i] = 0.0
        remainder[:, j] = 0.0
        outputs.append(i)
        inputs.append(j)
    return orders | {(tuple(outputs), tuple(inputs))} if len(outputs) == m else orders


def _pairing(
    matrix: FloatArray, outputs: tuple[int, ...], inputs: tuple[int, ...]
) -> Pairing | None:
    try:
        factors = decompose(unit_diagonal(matrix[np.ix_(outputs, inputs)]))
    except DecompositionError:
        return None
    U = factors.D[:, None] * factors.U * factors.D + 0.0  # Omega D = S D U D = S I (D U D)
    return Pairing(outputs, inputs, tuple(int(sign) for sign in factors.D), U)


def _excess(U: FloatArray) -> float:
    return float(np.max(np.abs(U - np.eye(len(U)))))


def _square(Omega: ArrayLike) -> FloatArray:
    matrix = np.array(as_array(Omega, "Omega", "a matrix of numbers, (m, m)"))
    if matrix.ndim != 2 or len(set(matrix.shape)) != 1 or matrix.size == 0:
        raise DecompositionError(
            f"Omega: found shape {matrix.shape}, expected as many outputs as inputs, (m, m)"
        )
    if not np.isfinite(matrix).all():
        raise DecompositionError(f"Omega: found {matrix.tolist()}, expected finite values")
    return matrix


def _sizes(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute scales of the rows and of the columns of a matrix, (m,) each, which balance it.

    With these scales, the largest abs(Omega_ij) / (rows_i columns_j) is 1 in every row and column.
    The scales follow the units of the channels, so a comparison with the scales does not depend on
    units. A row or column of zeros keeps the scale 1. Source: D. Ruiz, "A Scaling Algorithm to
    Equilibrate Both Rows and Columns Norms in Matrices", RAL-TR-2001-034.
    """
    rows = np.ones(len(matrix))
    columns = np.ones(len(matrix))
    for _ in range(_EQUILIBRATIONS):
        sizes = np.abs(matrix) / rows[:, None] / columns
        row = sizes.max(axis=1)
        column = sizes.max(axis=0)
        rows *= np.sqrt(np.where(row > 0.0, row, 1.0))
        columns *= np.sqrt(np.where(column > 0.0, column, 1.0))
    return rows, columns


def _eliminate(Omega: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return L, p, W and L^-1 of Omega = L diag(p) W, without pivoting.

    L is unit lower and W unit upper triangular. The sign of p_k is taken as certain if p_k is large
    enough compared with the terms of the sum p_k = (L^-1)_k Omega (W^-1)_k.
    """
    remainder = _square(Omega)
    m = len(remainder)
    rows, columns = _sizes(remainder)
    L = np.eye(m)
    W = np.eye(m)
    L_inverse = np.eye(m)
    W_inverse = np.eye(m)
    p = np.zeros(m)
    for k in range(m):
        p[k] = remainder[k, k]
        largest = (np.abs(L_inverse[k]) @ rows) * (columns @ np.abs(W_inverse[:, k]))
        if abs(p[k]) <= NEARLY_ZERO * largest:
            raise DecompositionError(
                f"Omega: found leading minor {k + 1} zero or nearly so (pivot {p[k]:.3g} beside "
                f"{largest:.3g}), expected "
                "leading minors away from zero: another order or pairing of the channels may "
                "have them",
                minor=k + 1,
            )
        L[k + 1 :, k] = remainder[k + 1 :, k] / p[k]
        W[k, k + 1 :] = remainder[k, k + 1 :] / p[k]
        remainder[k + 1 :, k + 1 :] -= np.outer(L[k + 1 :, k], remainder[k, k + 1 :])
        L_inverse[k + 1 :] -= np.outer(L[k + 1 :, k], L_inverse[k])
        W_inverse[:, k + 1 :] -= np.outer(W_inverse[:, k], W[k, k + 1 :])
    return L, p, W, L_inverse
