# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute law, observer and feedforward with a fixed order of arithmetic operations.

Every operation is rounded once to float64. u therefore does not depend on the BLAS or the libm of a
host, and C code without libraries gives the same bits. NumPy keeps this order to the bit. XLA, the
compiler of JAX, can contract a product and a sum into a fused multiply-add with a single rounding,
so JAX only comes close.
"""

import math

import numpy as np

from flight_core.vectors import Array, FloatArray, Scalar, array_namespace

ARITHMETIC = "1"
"""Version number of this arithmetic in the provenance of a log."""

MAX_ANGLE = 1e6
"""Largest angle of `sine`, rad. A larger angle counts as MAX_ANGLE."""

# the first 30 bits of pi, so that the product with an integer below 2^23 is exact
PI_HIGH = math.floor(math.pi * 2.0**28) / 2.0**28
PI_LOW = 1.984187159361081e-09  # pi - PI_HIGH
INVERSE_PI = 1.0 / math.pi
SINE_COEFFICIENTS = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(9, 0, -1))
"""Coefficients of r^19, r^17, ..., r^3 in the Taylor series of sin(r)."""

ROUNDING = 1.5 * 2.0**52
"""x + ROUNDING - ROUNDING is the integer nearest to x, half to even, for abs(x) < 2^51."""


def product(matrix: Array, vector: Array) -> Array:
    """Sum matrix[:, j] vector[j] over the columns j = 0, 1, ..., in this order.

    The shapes are (k, s) for a matrix and (s,) or (s, N) for one or N vectors. N matrices have the
    shape (k, s, N). s must be positive. The result has the shape (k,) or (k, N).
    """
    if matrix.ndim == 2 and isinstance(vector, np.ndarray) and vector.ndim == 1:
        return np.add.accumulate(matrix * vector, axis=1)[:, -1]
    if matrix.ndim == vector[0].ndim + 1:
        matrix = matrix[:, :, None]
    total = matrix[:, 0] * vector[0]
    for j in range(1, matrix.shape[1]):
        total = total + matrix[:, j] * vector[j]
    return total


def sine(x: Scalar) -> Scalar:
    """Compute the sine of an angle in rad, with an error below 5e-16 up to MAX_ANGLE.

    The angle is reduced to r = x - k pi, where k is the integer nearest to x / pi, and PI_HIGH +
    PI_LOW is pi to 82 bits. sin(x) is sin(r) for even k, and -sin(r) for odd k. sin(r) is the
    Taylor series up to r^19, whose remainder is at most (pi / 2)^21 / 21! = 2.6e-16.
    """
    xp = array_namespace(x)
    x = xp.minimum(xp.maximum(x, -MAX_ANGLE), MAX_ANGLE)
    k = _rounded(x * INVERSE_PI)
    odd = k - 2.0 * _rounded(0.5 * k)  # 0 for even k, -1 or 1 for odd k
    r = (x - k * PI_HIGH) - k * PI_LOW
    z = r * r
    series = SINE_COEFFICIENTS[0]
    for coefficient in SINE_COEFFICIENTS[1:]:
        series = series * z + coefficient
    return (1.0 - 2.0 * abs(odd)) * (r + r * z * series)


def _rounded(x: Scalar) -> Scalar:
    """Round to the nearest integer, and a half to the even one.

    A float is rounded by adding and subtracting ROUNDING. An array is rounded by its method
    `round`, because XLA would simplify the two operations to x.
    """
    return (x + ROUNDING) - ROUNDING if isinstance(x, float) else array_namespace(x).round(x)


def inverse(matrix: FloatArray) -> FloatArray:
    """Invert a regular matrix (m, m) by Gauss-Jordan elimination.

    The pivot of a column is its entry with the largest magnitude.
    """
    m = len(matrix)
    rows = np.hstack([matrix, np.eye(m)])
    for j in range(m):
        pivot = j + int(np.argmax(np.abs(rows[j:, j])))
        rows[[j, pivot]] = rows[[pivot, j]]
        rows[j] = rows[j] / rows[j, j]
        for i in range(m):
            if i != j:
                rows[i] = rows[i] - rows[i, j] * rows[j]
    return rows[:, m:]
