# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the uncertain aircraft of Monte Carlo campaigns.

The tests cover the distribution around the published airframe, and repeatability by seed.
"""

from pathlib import Path

import numpy as np
import pytest
from pytest import approx
from scipy.stats import kstest

from aircraft_sim.airframes.airframe import LIBRARY, load_airframe
from aircraft_sim.uncertainty import (
    Spread,
    as_yaml,
    gust_directions,
    nominal_and_sampled,
    sample_airframe,
)
from flight_core.vectors import FloatArray

pytestmark = pytest.mark.slow

OSPREY = load_airframe("osprey")


def relative_change(sampled: FloatArray, published: FloatArray) -> FloatArray:
    """Return the factor d of each entry that is not zero."""
    return np.asarray(sampled[published != 0.0] / published[published != 0.0] - 1.0)


def test_entries_are_uniform_and_independent() -> None:
    # 2000 samples of A[q, q] are uniform on +-0.3. The Kolmogorov-Smirnov test rejects one seed in
    # a hundred.
    A, B = nominal_and_sampled(OSPREY, 0.3, 2000, seed=3)
    q = OSPREY.index("q")
    d = A[1:, q, q] / A[0, q, q] - 1.0
    assert kstest(d, "uniform", args=(-0.3, 0.6)).pvalue > 0.01
    others = (A[1:, q, 1] / A[0, q, 1] - 1.0, B[1:, q, 0] / B[0, q, 0] - 1.0)
    # 1/sqrt(2000) = 0.022 is the standard deviation for independent samples; the limit is four of
    # them
    for entry in others:
        assert abs(np.corrcoef(d, entry)[0, 1]) < 0.09


def test_normal_deviations_have_limit_at_three_standard_deviations() -> None:
    """With 2000 samples, the standard deviation is known to 1/sqrt(4000) = 1.6 %.

    The limit is four times this.
    """
    A, _ = nominal_and_sampled(OSPREY, 0.3, 2000, seed=3, spread=Spread(distribution="normal"))
    q = OSPREY.index("q")
    d = A[1:, q, q] / A[0, q, q] - 1.0
    assert np.std(d) == approx(0.1, rel=0.065)
    assert np.abs(d).max() <= 0.3 + 1e-12
    assert kstest(d, "norm", args=(0.0, 0.1)).pvalue > 0.01


def test_sampled_airframe_keeps_zeros_angles_and_everything_but_and_b() -> None:
    sampled = sample_airframe(OSPREY, 0.3, 0.2, seed=7)
    A = OSPREY.matrix_a()
    B = OSPREY.matrix_b()
    for angle in ("theta", "phi"):
        assert sampled.A[sampled.index(angle)] == OSPREY.A[sampled.index(angle)]
    assert ((sampled.matrix_a() == 0.0) == (A == 0.0)).all()
    assert ((sampled.matrix_b() == 0.0) == (B == 0.0)).all()
    rows = [OSPREY.index(state) for state in OSPREY.states if state not in {"theta", "phi"}]
    assert 0.2 < np.abs(relative_change(sampled.matrix_a()[rows], A[rows])).max() < 0.3
    assert 0.1 < np.abs(relative_change(sampled.matrix_b()[rows], B[rows])).max() < 0.2
    assert sampled.model_dump(exclude={"A", "B", "gusts", "identities"}) == OSPREY.model_dump(
        exclude={"A", "B", "gusts", "identities"}
    )


def test_aircraft_that_drift_with_wind_do_not_notice_it() -> None:
    # An aircraft with alpha = w / V0, beta = v / V0 or V = u has no velocity relative to steady air
    # of that wind: A x and the effect of the wind cancel. The airframe file rounds its effect of
    # wind to two or three digits: 3e-3 at most.
    sampled = sample_airframe(OSPREY, 0.5, 0.0, seed=7)
    A = sampled.matrix_a()
    effect = sampled.matrix_gusts()
    for axis, state, drift in (
        ("vertical", "alpha", 1.0 / 25.0),
        ("lateral", "beta", 1.0 / 25.0),
        ("longitudinal", "V", 1.0),
    ):
        by_state = A[:, OSPREY.index(state)] * drift
        by_wind = effect[:, list(OSPREY.gusts).index(axis)]
        assert by_wind == approx(-by_state, rel=5e-3, abs=0.0), axis
        published = OSPREY.matrix_gusts()[:, list(OSPREY.gusts).index(axis)]
        # What it would feel otherwise.
        assert np.abs(published + by_state).max() > 0.1 * np.abs(published).max(), axis


def test_effect_of_wind_of_published_airframe_is_published_one_to_last_bit() -> None:
    for wind in ("air_relative", "published"):
        assert (
            gust_directions(OSPREY, OSPREY.matrix_a()[None], wind)[0] == OSPREY.matrix_gusts()
        ).all()
        assert (
            sample_airframe(OSPREY, 0.0, 0.3, seed=7, wind=wind).matrix_gusts()
            == OSPREY.matrix_gusts()
        ).all()


def test_a_seed_determines_the_aircraft() -> None:
    sampled, again, other = (sample_airframe(OSPREY, 0.3, 0.3, seed) for seed in (7, 7, 8))
    assert sampled == again != other
    A, B = nominal_and_sampled(OSPREY, 0.3, 1, seed=7)
    # Rounding of the conversion to the file's units.
    assert sampled.matrix_a() == approx(A[1], rel=1e-15)
    assert sampled.matrix_b() == approx(B[1], rel=1e-15)


@pytest.mark.parametrize("name", sorted(file.stem for file in LIBRARY.glob("*.yaml")))
def test_yaml_text_of_airframe_reads_back_to_last_bit(name: str, tmp_path: Path) -> None:
    for airframe in (load_airframe(name), sample_airframe(load_airframe(name), 0.3, 0.3, seed=1)):
        path = tmp_path / f"{name}.yaml"
        path.write_text(as_yaml(airframe))
        again = load_airframe(str(path))
        assert again == airframe
        assert again.matrix_a().tobytes() == airframe.matrix_a().tobytes()
