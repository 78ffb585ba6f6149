# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Uncertain aircraft: how far they are from the published one, and that a seed is an aircraft."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

from aircraft_sim.airframe import LIBRARY, Airframe, load_airframe
from aircraft_sim.params import AircraftParameters
from aircraft_sim.uncertainty import as_yaml, nominal_and_sampled, sample_airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.parameters import ParameterError
from flight_core.vectors import FloatArray

OSPREY = load_airframe("osprey")


def parts(drawn: FloatArray, published: FloatArray) -> FloatArray:
    """D of each entry that is not zero."""
    return np.asarray(drawn[published != 0.0] / published[published != 0.0] - 1.0)


def test_entries_are_spread_evenly_and_independently() -> None:
    # Of 2000 draws of A's entry q, q: uniform on +-0.3. The Kolmogorov-Smirnov test refuses one seed in a hundred.
    A, B = nominal_and_sampled(OSPREY, 0.3, 2000, seed=3)
    q = OSPREY.index("q")
    d = A[1:, q, q] / A[0, q, q] - 1.0
    assert kstest(d, "uniform", args=(-0.3, 0.6)).pvalue > 0.01
    others = (A[1:, q, 1] / A[0, q, 1] - 1.0, B[1:, q, 0] / B[0, q, 0] - 1.0)
    for other in others:  # a correlation of independent samples scatters by 1/sqrt(2000) = 0.022; four of them
        assert abs(np.corrcoef(d, other)[0, 1]) < 0.09


def test_a_draw_keeps_zeros_angles_and_everything_but_a_and_b() -> None:
    drawn = sample_airframe(OSPREY, 0.3, 0.2, seed=7)
    A, B = OSPREY.matrix_a(), OSPREY.matrix_b()
    for angle in ("theta", "phi"):
        assert drawn.A[drawn.index(angle)] == OSPREY.A[drawn.index(angle)]
    assert ((drawn.matrix_a() == 0.0) == (A == 0.0)).all()
    assert ((drawn.matrix_b() == 0.0) == (B == 0.0)).all()
    rows = [OSPREY.index(state) for state in OSPREY.states if state not in {"theta", "phi"}]
    assert 0.2 < np.abs(parts(drawn.matrix_a()[rows], A[rows])).max() < 0.3
    assert 0.1 < np.abs(parts(drawn.matrix_b()[rows], B[rows])).max() < 0.2
    kept = OSPREY.model_dump(exclude={"A", "B"})
    assert drawn.model_dump(exclude={"A", "B"}) == kept


def test_one_uncertainty_leaves_the_other_matrix_as_published() -> None:
    assert sample_airframe(OSPREY, 0.0, 0.2, seed=7).matrix_a() == pytest.approx(OSPREY.matrix_a(), rel=1e-15)
    assert sample_airframe(OSPREY, 0.2, 0.0, seed=7).matrix_b() == pytest.approx(OSPREY.matrix_b(), rel=1e-15)
    assert sample_airframe(OSPREY, 0.0, 0.0, seed=7) is OSPREY


def test_a_seed_is_an_aircraft() -> None:
    assert sample_airframe(OSPREY, 0.3, 0.3, seed=7) == sample_airframe(OSPREY, 0.3, 0.3, seed=7) != sample_airframe(OSPREY, 0.3, 0.3, seed=8)
    A, B = nominal_and_sampled(OSPREY, 0.3, 1, seed=7)
    drawn = sample_airframe(OSPREY, 0.3, 0.3, seed=7)
    assert drawn.matrix_a() == pytest.approx(A[1], rel=1e-15)  # but for the way through the file's units
    assert drawn.matrix_b() == pytest.approx(B[1], rel=1e-15)


@pytest.mark.parametrize("name", sorted(file.stem for file in LIBRARY.glob("*.yaml")))
def test_the_text_of_an_airframe_is_its_file_to_the_last_bit(name: str, tmp_path: Path) -> None:
    for airframe in (load_airframe(name), sample_airframe(load_airframe(name), 0.3, 0.3, seed=1)):
        path = tmp_path / f"{name}.yaml"
        path.write_text(as_yaml(airframe), encoding="utf-8")
        again = load_airframe(str(path))
        assert again == airframe
        assert again.matrix_a().tobytes() == airframe.matrix_a().tobytes()


def parameters(**section: Any) -> AircraftParameters:
    values = {"airframe": "osprey", "rate": 100.0, "step": 0.002, "uncertainty": section}
    return AircraftParameters.validate_mapping(values, "aircraft")


def test_the_aircraft_drawn_is_the_aircraft_flown(osprey_gust: Scenario, tmp_path: Path) -> None:
    # Flown from its own text, as the log holds it, it is the same flight to the last bit.
    short = osprey_gust.vary(flight={"duration": 3.0})
    drawn = short.vary(aircraft={"uncertainty": {"A": 0.3, "B": 0.3, "seed": 7}})
    path = tmp_path / "drawn.yaml"
    path.write_text(as_yaml(drawn.aircraft.sampled_airframe()), encoding="utf-8")
    flights = [simulate(one)["y"].values for one in (drawn, short.vary(aircraft={"airframe": str(path)}), short)]
    assert flights[0].tobytes() == flights[1].tobytes()
    assert flights[0].tobytes() != flights[2].tobytes()


def test_without_the_section_the_published_airframe_flies() -> None:
    assert parameters().sampled_airframe() == OSPREY
    assert isinstance(parameters(A=0.1).sampled_airframe(), Airframe)


@pytest.mark.parametrize(
    ("section", "sentence"),
    [
        ({"A": 1.0}, "aircraft.uncertainty.A: found 1.0, expected less than 1"),
        ({"B": -0.1}, "aircraft.uncertainty.B: found -0.1, expected greater than or equal to 0"),
        ({"seed": -1}, "aircraft.uncertainty.seed: found -1, expected greater than or equal to 0"),
        ({"C": 0.1}, "aircraft.uncertainty.C: unknown key, expected one of A, B, number, seed"),
    ],
)
def test_uncertainty_that_does_not_fit_is_refused_by_name(section: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError, match=f"^{sentence}"):
        parameters(**section)
