# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Uncertain aircraft for Monte Carlo campaigns: A and B sampled around a published airframe, repeatable by seed."""

from collections.abc import Mapping
from typing import Literal

import numpy as np

from aircraft_sim import random_streams
from aircraft_sim.airframe import Airframe
from aircraft_sim.disturbance import AIR_STATE
from flight_core.files import dump_yaml
from flight_core.parameters import require
from flight_core.vectors import FloatArray

KINEMATIC = ("theta", "phi", "psi")
"""States whose derivatives are known exactly: their rows stay as published in uncertain airframes."""

WindEffect = Literal["air_relative", "published"]
"""Effect of wind on the x_dot of an uncertain aircraft: by its own A, or that of the published airframe. See `wind_factors`."""

AIR_RELATIVE: WindEffect = "air_relative"


def nominal_and_sampled(airframe: Airframe, uncertainty: float, samples: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """A and B, shapes (1 + samples, n, n) and (1 + samples, n, m), SI: as published, then numbers 0, 1, ... of the seed.

    Raises ParameterError for an uncertainty outside [0, 1).
    """
    A, B = sampled_matrices(airframe, uncertainty, uncertainty, seed, 0, samples)
    return np.concatenate([airframe.matrix_a()[None], A]), np.concatenate([airframe.matrix_b()[None], B])


def sample_airframe(
    airframe: Airframe, of_A: float, of_B: float, seed: int, number: int = 0, wind: WindEffect = AIR_RELATIVE
) -> Airframe:
    """Uncertain airframe `number` of a seed, with uncertainties of A and of B. 0 and 0 give the published airframe.

    The effect of wind comes from `wind_factors`; the rest of f stays as published. Raises ParameterError for an uncertainty
    outside [0, 1).
    """
    A, B = sampled_matrices(airframe, of_A, of_B, seed, number, 1)
    return airframe if of_A == of_B == 0.0 else airframe.with_matrices(A[0], B[0], wind_factors(airframe, A, wind)[0])


def wind_factors(airframe: Airframe, A: FloatArray, wind: WindEffect) -> FloatArray:
    """Factors on the published effect of wind, shape (N, n, G), of N aircraft with the matrices A, shape (N, n, n), SI.

    Wind w along an axis changes the state j of AIR_STATE relative to the air, so the wind acts as minus column j of A:

        air_relative    factor_i = A_ij / published A_ij    1 where the published A_ij is 0 or the airframe has no state j
        published       factor_i = 1

    A published effect equal to minus the published column, per w / V0 or w, then equals minus the aircraft's own column.
    """
    published, factors = airframe.matrix_a(), np.ones((len(A), len(airframe.states), len(airframe.gusts)))
    for k, axis in enumerate(airframe.gusts):
        if wind == AIR_RELATIVE and AIR_STATE[axis] in airframe.states:
            j = airframe.index(AIR_STATE[axis])
            np.divide(A[:, :, j], published[:, j], out=factors[:, :, k], where=published[:, j] != 0.0)
    return factors


def gust_directions(airframe: Airframe, A: FloatArray, wind: WindEffect) -> FloatArray:
    """Change of x_dot for 1 m/s of wind along the axes, shape (N, n, G), of N aircraft with the matrices A; `wind_factors`."""
    return wind_factors(airframe, A, wind) * airframe.matrix_gusts()


def sampled_matrices(
    airframe: Airframe, of_A: float, of_B: float, seed: int, first: int, count: int
) -> tuple[FloatArray, FloatArray]:
    """A and B of the aircraft first, first + 1, ... of a seed, shapes (count, n, n) and (count, n, m), SI.

    Every entry is multiplied by 1 + d, d uniform in +-uncertainty and independent. The rows of angles stay. An aircraft
    depends on seed and number alone, not on `count`. Raises ParameterError for an uncertainty outside [0, 1).
    """
    for part in (of_A, of_B):
        require(0.0 <= part < 1.0, "uncertainty", part, "a part of each entry, 0 <= uncertainty < 1")
    A, B = airframe.matrix_a(), airframe.matrix_b()
    uniform = random_streams.uniform(first, count, A.size + B.size, random_streams.AIRFRAME, seed)
    known = np.array([[float(state not in KINEMATIC)] for state in airframe.states])

    def spread(matrix: FloatArray, uncertainty: float, numbers: FloatArray) -> FloatArray:
        return np.asarray(matrix * (1.0 + known * uncertainty * (2.0 * numbers.reshape(count, *matrix.shape) - 1.0)))

    return spread(A, of_A, uniform[:, : A.size]), spread(B, of_B, uniform[:, A.size :])


def drawn_entries(airframe: Airframe, A: FloatArray, B: FloatArray) -> dict[str, FloatArray]:
    """The entries that `sampled_matrices` draws, by name as A[q,alpha] and B[V,thrust], each of shape (N,), SI.

    A, of shape (N, n, n), and B, of shape (N, n, m), are those of N aircraft. Entries that are 0 as published, and the rows of
    angles, are not drawn.
    """
    matrices = {"A": A, "B": B}
    return {name: matrices[matrix][:, i, j] for name, (matrix, i, j) in _drawn_places(airframe).items()}


def _drawn_places(airframe: Airframe) -> dict[str, tuple[str, int, int]]:
    """The entries that `sampled_matrices` draws: matrix, row and column by name."""
    named = {"A": (airframe.matrix_a(), [*airframe.states]), "B": (airframe.matrix_b(), [*airframe.inputs])}
    return {
        f"{matrix}[{state},{column}]": (matrix, i, j)
        for matrix, (published, columns) in named.items()
        for i, state in enumerate(airframe.states)
        for j, column in enumerate(columns)
        if published[i, j] != 0.0 and state not in KINEMATIC
    }


def with_entries(airframe: Airframe, deviations: Mapping[str, float], wind: WindEffect = AIR_RELATIVE) -> Airframe:
    """The airframe with entries multiplied by 1 + deviation, named as in `drawn_entries`; wind as in `wind_factors`."""
    matrices, places = {"A": airframe.matrix_a().copy(), "B": airframe.matrix_b().copy()}, _drawn_places(airframe)
    for name, deviation in deviations.items():
        matrix, i, j = places[name]
        matrices[matrix][i, j] *= 1.0 + deviation
    return airframe.with_matrices(matrices["A"], matrices["B"], wind_factors(airframe, matrices["A"][None], wind)[0])


def as_yaml(airframe: Airframe) -> str:
    """An airframe as the text of an airframe file, whose numbers read back as they are to the last bit."""
    return dump_yaml(airframe.model_dump(mode="json", exclude_defaults=True))
