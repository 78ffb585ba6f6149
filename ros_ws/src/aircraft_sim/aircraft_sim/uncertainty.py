# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Uncertain aircraft for Monte Carlo campaigns: A and B sampled around a published airframe, repeatable by seed."""

import numpy as np
import yaml

from aircraft_sim import random_streams
from aircraft_sim.airframe import Airframe
from flight_core.parameters import require
from flight_core.vectors import FloatArray

KINEMATIC = ("theta", "phi", "psi")
"""States whose derivatives are known exactly: their rows stay as published in uncertain airframes."""


def nominal_and_sampled(airframe: Airframe, uncertainty: float, samples: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """A and B, shapes (1 + samples, n, n) and (1 + samples, n, m), SI: the published ones, then numbers 0, 1, ... of the seed.

    Raises ParameterError for an uncertainty outside [0, 1).
    """
    A, B = sampled_matrices(airframe, uncertainty, uncertainty, seed, 0, samples)
    return np.concatenate([airframe.matrix_a()[None], A]), np.concatenate([airframe.matrix_b()[None], B])


def sample_airframe(airframe: Airframe, of_A: float, of_B: float, seed: int, number: int = 0) -> Airframe:
    """Uncertain airframe `number` of a seed, with an uncertainty of A and one of B. 0 and 0 give the published airframe.

    f, with the effect of gusts, stays as published. Raises ParameterError for an uncertainty outside [0, 1).
    """
    A, B = sampled_matrices(airframe, of_A, of_B, seed, number, 1)
    return airframe if of_A == of_B == 0.0 else airframe.with_matrices(A[0], B[0])


def sampled_matrices(
    airframe: Airframe, of_A: float, of_B: float, seed: int, first: int, count: int
) -> tuple[FloatArray, FloatArray]:
    """A and B of the aircraft first, first + 1, ... of a seed, shapes (count, n, n) and (count, n, m), SI.

    Every entry is multiplied by 1 + d, d uniform in +-uncertainty and independent. The rows of angles stay. An aircraft
    depends on its seed and number alone, not on `count`. Raises ParameterError for an uncertainty outside [0, 1).
    """
    for part in (of_A, of_B):
        require(0.0 <= part < 1.0, "uncertainty", part, "a part of each entry, 0 <= uncertainty < 1")
    A, B = airframe.matrix_a(), airframe.matrix_b()
    uniform = random_streams.uniform(first, count, A.size + B.size, random_streams.AIRFRAME, seed)
    known = np.array([[float(state not in KINEMATIC)] for state in airframe.states])

    def spread(matrix: FloatArray, uncertainty: float, numbers: FloatArray) -> FloatArray:
        return np.asarray(matrix * (1.0 + known * uncertainty * (2.0 * numbers.reshape(count, *matrix.shape) - 1.0)))

    return spread(A, of_A, uniform[:, : A.size]), spread(B, of_B, uniform[:, A.size :])


def as_yaml(airframe: Airframe) -> str:
    """An airframe as the text of an airframe file, whose numbers read back as they are to the last bit."""
    return yaml.safe_dump(airframe.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=128)
