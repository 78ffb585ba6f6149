# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Sample uncertain aircraft for Monte Carlo campaigns, repeatable by seed.

A and B are sampled around the matrices of a published airframe.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np

from aircraft_sim import random_streams
from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.atmosphere.disturbance import AIR_STATE
from flight_core.files import dump_yaml
from flight_core.parameters import require
from flight_core.units import ANGLE, ANGLE_SIZE, DIMENSIONLESS, quantity, unit_sizes
from flight_core.vectors import FloatArray

KINEMATIC = ("theta", "phi", "psi")
"""States whose derivatives are known exactly, so that their rows stay as published in uncertain
airframes."""

WindEffect = Literal["air_relative", "published"]
"""How wind acts on x_dot of an uncertain aircraft: through the A of this aircraft, or as on the
published airframe. See `wind_factors`."""

AIR_RELATIVE: WindEffect = "air_relative"

Distribution = Literal["uniform", "normal", "corners"]
"""Distribution of the relative deviations d within +-uncertainty: uniform; normal, cut at three
standard deviations; or the two limits, with equal probability."""


ANGLE_AXES = ("lateral", "vertical")
"""Axes along which wind changes an angle relative to the air."""


class Spread(NamedTuple):
    """The distribution from which the entries of A and B are drawn."""

    # largest relative deviation of an entry, by its name in `drawn_entries`
    entries: Mapping[str, float] = MappingProxyType({})
    distribution: Distribution = "uniform"
    # largest value of an entry that is published as 0, as a fraction of the value in `row_sizes`
    zeros: float = 0.0


UNIFORM = Spread()

# Size of an input that is a thrust, as a fraction of the thrust in trim. If trim needs half of the
# throttle, this is a tenth of the throttle.
THRUST_SIZE = 0.2


def nominal_and_sampled(
    airframe: Airframe, uncertainty: float, samples: int, seed: int, spread: Spread = UNIFORM
) -> tuple[FloatArray, FloatArray]:
    """Return A and B, shapes (1 + samples, n, n) and (1 + samples, n, m), SI.

    The first matrices are the published ones. The aircraft with the numbers 0, 1, ... of the seed
    follow. Raises as `sampled_matrices` does.
    """
    A, B = sampled_matrices(
        airframe,
        part_A=uncertainty,
        part_B=uncertainty,
        seed=seed,
        first=0,
        count=samples,
        spread=spread,
    )
    return np.concatenate([airframe.matrix_a()[None], A]), np.concatenate(
        [airframe.matrix_b()[None], B]
    )


def sample_airframe(
    airframe: Airframe,
    part_A: float,
    part_B: float,
    seed: int,
    number: int = 0,
    wind: WindEffect = AIR_RELATIVE,
    spread: Spread = UNIFORM,
) -> Airframe:
    """Sample the uncertain airframe `number` of a seed, with uncertainties `part_A` and `part_B`.

    If both uncertainties are 0 and `spread` names no entry, the result is the published airframe.
    The effect of wind follows from `wind_factors`, and the rest of f stays as published. Raises as
    `sampled_matrices` does.
    """
    A, B = sampled_matrices(
        airframe, part_A=part_A, part_B=part_B, seed=seed, first=number, count=1, spread=spread
    )
    if part_A == part_B == 0.0 and not spread.entries:
        return airframe
    return airframe.with_matrices(A[0], B[0], wind_factors(airframe, A, wind)[0])


def wind_factors(airframe: Airframe, A: FloatArray, wind: WindEffect) -> FloatArray:
    """Compute the factors on the published effect of wind, shape (N, n, G), of N aircraft.

    A has the matrices of the N aircraft, shape (N, n, n), SI. Wind w along an axis changes the
    state j of AIR_STATE relative to the air, so its effect is minus column j of A:

        air_relative    factor_i = A_ij / published A_ij
            1 where the published A_ij is 0 or the airframe has no state j
        published       factor_i = 1

    The published effect is the effect of w / V0 or of w, as the file says. If a file
    has minus column j of its own A as this effect, each aircraft gets minus column j of its A.
    """
    nominal = airframe.matrix_a()
    factors = np.ones((len(A), len(airframe.states), len(airframe.gusts)))
    for k, axis in enumerate(airframe.gusts):
        if wind == AIR_RELATIVE and AIR_STATE[axis] in airframe.states:
            j = airframe.index(AIR_STATE[axis])
            np.divide(A[:, :, j], nominal[:, j], out=factors[:, :, k], where=nominal[:, j] != 0.0)
    return factors


def gust_directions(airframe: Airframe, A: FloatArray, wind: WindEffect) -> FloatArray:
    """Compute the change of x_dot by 1 m/s of wind along each axis, shape (N, n, G).

    A has the matrices of N aircraft, see `wind_factors`.
    """
    return wind_factors(airframe, A, wind) * airframe.matrix_gusts()


def coupled_gust_directions(airframe: Airframe, A: FloatArray) -> FloatArray:
    """Compute `gust_directions`, but let wind also act through entries that are published as 0.

    An aircraft is moved by its motion relative to the air. So the effect of wind through such an
    entry is minus the entry, per w / V0 for an angle and per w otherwise.
    """
    directions = gust_directions(airframe, A, AIR_RELATIVE)
    coupled = np.where(airframe.matrix_a() == 0.0, A, 0.0)
    for k, axis in enumerate(airframe.gusts):
        if AIR_STATE[axis] in airframe.states:
            unit = airframe.speed if axis in ANGLE_AXES else 1.0
            directions[..., k] -= coupled[..., airframe.index(AIR_STATE[axis])] / unit
    return directions


def sampled_matrices(
    airframe: Airframe,
    part_A: float,
    part_B: float,
    seed: int,
    first: int,
    count: int,
    spread: Spread = UNIFORM,
) -> tuple[FloatArray, FloatArray]:
    """Draw A and B of the aircraft first, first + 1, ... of a seed, SI.

    The shapes are (count, n, n) and (count, n, m). Every entry is multiplied by 1 + d, with an
    independent d within +-uncertainty and the distribution of `spread`. The rows of angles do not
    change. An entry that is 0 becomes d times its `row_sizes`, with d within +-zeros. An aircraft
    depends only on seed and number, and not on `count`. Raises ParameterError for an uncertainty
    outside [0, 1), and for an unknown entry.
    """
    sizes = row_sizes(airframe)
    parts = {
        "A": np.where(sizes["A"] > 0.0, spread.zeros, part_A),
        "B": np.where(sizes["B"] > 0.0, spread.zeros, part_B),
    }
    places = drawn_places(airframe, zeros=spread.zeros > 0.0)
    for name, part in spread.entries.items():
        require(
            name in places,
            "entry",
            name,
            f"an entry of the airframe: {', '.join(places)}",
        )
        matrix, i, j = places[name]
        parts[matrix][i, j] = part
    for part in (part_A, part_B, *spread.entries.values()):
        require(
            0.0 <= part < 1.0, "uncertainty", part, "a part of each entry, 0 <= uncertainty < 1"
        )
    require(0.0 <= spread.zeros < 1.0, "zeros", spread.zeros, "a part of each row, 0 <= zeros < 1")
    A = airframe.matrix_a()
    B = airframe.matrix_b()
    uniform = random_streams.uniform(first, count, A.size + B.size, random_streams.AIRFRAME, seed)
    is_free = np.array([[float(state not in KINEMATIC)] for state in airframe.states])

    def drawn(matrix: FloatArray, name: str, numbers: FloatArray) -> FloatArray:
        d = deviations(numbers.reshape(count, *matrix.shape), spread.distribution)
        part = parts[name]
        return np.asarray(matrix * (1.0 + is_free * part * d) + sizes[name] * part * d)

    return drawn(A, "A", uniform[:, : A.size]), drawn(B, "B", uniform[:, A.size :])


def deviations(uniform: FloatArray, distribution: Distribution) -> FloatArray:
    """Convert uniform numbers in [0, 1) to deviations in [-1, 1] with a distribution."""
    if distribution == "uniform":
        return 2.0 * uniform - 1.0
    if distribution == "corners":
        return np.where(uniform < 0.5, -1.0, 1.0)
    from scipy.special import ndtri  # noqa: PLC0415 - a tenth of a second, only for this

    return np.asarray(np.clip(ndtri(uniform) / 3.0, -1.0, 1.0))


def drawn_entries(airframe: Airframe, A: FloatArray, B: FloatArray) -> dict[str, FloatArray]:
    """Return the entries that `sampled_matrices` draws, by names such as A[q,alpha].

    Each of them has shape (N,), SI. A, (N, n, n), and B, (N, n, m), are the matrices of N aircraft.
    Entries that are 0 as published, and the rows of angles, are not drawn.
    """
    matrices = {"A": A, "B": B}
    return {
        name: matrices[matrix][:, i, j] for name, (matrix, i, j) in drawn_places(airframe).items()
    }


def drawn_places(airframe: Airframe, *, zeros: bool = False) -> dict[str, tuple[str, int, int]]:
    """Return where each entry that `sampled_matrices` draws is: matrix, row and column, by name.

    With `zeros`, the entries that are 0 follow, if `row_sizes` has a size for them.
    """
    rows = [*airframe.states]
    columns = {"A": rows, "B": [*airframe.inputs]}
    is_free = np.array([[state not in KINEMATIC] for state in rows])
    drawn = [{"A": airframe.matrix_a() * is_free, "B": airframe.matrix_b() * is_free}]
    if zeros:
        drawn.append(row_sizes(airframe))
    places = {}
    for matrices in drawn:
        for name, matrix in matrices.items():
            for i, j in np.argwhere(matrix).tolist():
                places[f"{name}[{rows[i]},{columns[name][j]}]"] = (name, i, j)
    return places


def row_sizes(airframe: Airframe) -> dict[str, FloatArray]:
    """Compute a reference value for each entry that is published as 0, from its row, SI.

        row_i / size_j,   row_i = max over A and B of abs(A_ik) size_k, abs(B_ik) size_k

    With this value, the entry would change x_dot_i as much as the largest entry in its row does. In
    this comparison each state and each input deviates by its size. The sizes are 1 m/s, 0.1 rad
    (/s), a tenth of a throttle, and THRUST_SIZE of the thrust in trim.

    The result is 0 for entries that are not 0, and for entries that stay 0 in every aircraft. The
    latter are in rows of angles, and in columns of angles, because gravity is the only force that
    depends on an angle. Entries of inputs without a known size stay 0 as well.
    """
    is_free = np.array([state not in KINEMATIC for state in airframe.states])
    matrices = {"A": airframe.matrix_a(), "B": airframe.matrix_b()}
    units = {"A": unit_sizes(airframe.states.values()), "B": input_sizes(airframe)}
    moved = np.hstack([np.abs(matrices[name]) * units[name] for name in matrices])
    row = np.max(moved, axis=1, keepdims=True) * is_free[:, None]
    inverse = {
        name: np.divide(1.0, unit, out=0.0 * unit, where=unit > 0.0) for name, unit in units.items()
    }
    inverse["A"] = inverse["A"] * is_free
    return {
        name: np.where(matrix == 0.0, row * inverse[name], 0.0) for name, matrix in matrices.items()
    }


def input_sizes(airframe: Airframe) -> FloatArray:
    """Return by how much each input deviates in `row_sizes`, (p,), SI, or 0 if it is not known."""
    trim = np.abs(np.nan_to_num(airframe.no_thrust()))
    dimensions = [quantity(channel.unit).dimension for channel in airframe.inputs.values()]
    has_range = [dimension in {ANGLE, DIMENSIONLESS} for dimension in dimensions]
    return np.where(has_range, ANGLE_SIZE, THRUST_SIZE * trim)


def with_entries(
    airframe: Airframe, deviations: Mapping[str, float], wind: WindEffect = AIR_RELATIVE
) -> Airframe:
    """Multiply entries of an airframe by 1 + deviation, and return the new airframe.

    `deviations` has the deviations by the names of `drawn_entries`. An entry that is 0 becomes the
    deviation times its `row_sizes`. The effect of the wind follows from `wind_factors`.
    """
    matrices = {"A": airframe.matrix_a().copy(), "B": airframe.matrix_b().copy()}
    places = drawn_places(airframe, zeros=True)
    sizes = row_sizes(airframe)
    for name, deviation in deviations.items():
        matrix, i, j = places[name]
        entry = matrices[matrix][i, j]
        matrices[matrix][i, j] = entry * (1.0 + deviation) + sizes[matrix][i, j] * deviation
    return airframe.with_matrices(
        matrices["A"], matrices["B"], wind_factors(airframe, matrices["A"][None], wind)[0]
    )


def as_yaml(airframe: Airframe) -> str:
    """Write an airframe as the text of an airframe file.

    Reading the text gives the same numbers, to the last bit.
    """
    return dump_yaml(airframe.model_dump(mode="json", exclude_defaults=True))
