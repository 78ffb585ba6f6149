# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Divide innovations by the covariance that the filters expect."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.vectors import FloatArray


class Normalised(NamedTuple):
    """Innovations of N models over a recording, with their normalised values."""

    r: FloatArray  # (N, T, m) in units of y, NaN where y is lost
    e: FloatArray  # (N, T, m) innovations whose covariance is I if the model is right
    half_log_det: FloatArray  # (N, T) half the logarithm of the determinant of the covariance of r


def normalised(r: FloatArray, covariance: FloatArray, place: NDArray[np.int64]) -> Normalised:
    """Normalise innovations r, (N, T, m), by covariances (N, levels, m, m).

    `place`, (T,), is the index of each sample's level in the covariances.
    """
    root = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(root)
    half_log_det = np.sum(np.log(np.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
    e = np.empty_like(r)
    for k in np.unique(place).tolist():
        e[:, place == k] = r[:, place == k] @ np.swapaxes(inverse[:, k], -1, -2)
    return Normalised(r, e, half_log_det[:, place])
