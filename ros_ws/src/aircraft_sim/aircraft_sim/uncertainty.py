# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Uncertain aircraft around a published one: A and B drawn at random, repeatably."""

import numpy as np
import yaml

from aircraft_sim.airframe import Airframe
from flight_core.parameters import require
from flight_core.vectors import FloatArray

KINEMATIC = ("theta", "phi", "psi")
"""States whose derivatives are known exactly: their rows stay as published in uncertain airframes."""


def uncertain(airframe: Airframe, uncertainty: float, samples: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """A and B, shapes (1 + samples, n, n) and (1 + samples, n, m), SI: as published first, then uncertain ones.

    Every entry is multiplied by 1 + d, d uniform in +-uncertainty and independent; the rows of angles stay. Raises
    ParameterError for an uncertainty outside [0, 1).
    """
    return _spread(airframe, uncertainty, uncertainty, samples, seed)


def draw(airframe: Airframe, of_A: float, of_B: float, seed: int) -> Airframe:
    """The first uncertain airframe of `uncertain`, with an uncertainty of A and one of B; 0 and 0 leave it as published.

    Its f, the gusts in it, is the published one. Raises ParameterError for an uncertainty outside [0, 1).
    """
    A, B = _spread(airframe, of_A, of_B, 1, seed)
    return airframe if of_A == of_B == 0.0 else airframe.with_matrices(A[1], B[1])


def as_yaml(airframe: Airframe) -> str:
    """An airframe as the text of an airframe file, whose numbers read back as they are to the last bit."""
    return yaml.safe_dump(airframe.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=128)


def _spread(airframe: Airframe, of_A: float, of_B: float, samples: int, seed: int) -> tuple[FloatArray, FloatArray]:
    for part in (of_A, of_B):
        require(0.0 <= part < 1.0, "uncertainty", part, "a part of each entry, 0 <= uncertainty < 1")
    generator = np.random.default_rng(seed)
    known = np.array([[float(state not in KINEMATIC)] for state in airframe.states])

    def spread(matrix: FloatArray, uncertainty: float) -> FloatArray:
        part = uncertainty * generator.uniform(-1.0, 1.0, (1 + samples, *matrix.shape))
        part[0] = 0.0
        return np.asarray(matrix * (1.0 + known * part))

    return spread(airframe.matrix_a(), of_A), spread(airframe.matrix_b(), of_B)
