# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the airframe library against published modes.

Remark 1 ("D = I for every model tried") is a table.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx

from aircraft_sim.airframes.airframe import LIBRARY, Airframe, load_airframe
from flight_core.units import si_per_unit
from flight_core.vectors import FloatArray
from flight_design.gains.airframe_properties import (
    ZeroDynamics,
    airframe_facts,
    invariant_zeros,
    is_controllable,
    library,
)
from rise_di_controller.law.decomposition import coupling

ALL = tuple(sorted(file.stem for file in LIBRARY.glob("*.yaml")))
# More inputs than outputs, and what was split.
SPLIT = {"osprey_twin": "osprey", "osprey_vtail": "osprey", "x8_elevons": ""}
NAMES = tuple(name for name in ALL if name not in SPLIT)


class Published(NamedTuple):
    """Properties with the signs and in the units of the source."""

    # A positive input may give a negative rate; outputs p, r or q, V (osprey q, V, p, r).
    D: tuple[float, ...]
    coupling: float


PUBLISHED = {
    # C_n_da = 0.06: the aileron yaws four times as strongly as the rudder.
    "aerosonde_first_edition_lateral": Published((1, -1), 13.6),
    "aerosonde_lateral": Published((1, -1), 0.03),
    "b747_lateral": Published((1, -1), 0.38),
    "b747_longitudinal": Published((-1, 1), 0.61),
    "f16_lateral": Published((-1, -1), 2.16),
    "f16_longitudinal": Published((-1, 1), 0.99),
    "navion_lateral": Published((1, -1), 0.55),
    "navion_longitudinal": Published((-1, 1), 0.0),
    "osprey": Published((1, 1, 1, 1), 0.06),
}
PUBLISHED_POLES: Mapping[str, tuple[complex, ...]] = {
    # MATLAB Control System Toolbox, "Yaw Damper Design for a 747 Jet Aircraft"
    "b747_lateral": (-0.5627, -0.0329 - 0.9467j, -0.0329 + 0.9467j, -0.0073),
    # S. Boyd, EE263, short period and phugoid
    "b747_longitudinal": (
        -0.3750 - 0.8818j,
        -0.3750 + 0.8818j,
        -0.0005 - 0.0674j,
        -0.0005 + 0.0674j,
    ),
    # Stevens & Lewis, Example 5.3-1: roll, Dutch roll, spiral
    "f16_lateral": (-3.6152, -0.4224 - 3.0634j, -0.4224 + 3.0634j, -0.0163),
    # Nelson, second edition, chapter 5: roll, Dutch roll, spiral
    "navion_lateral": (-8.435, -0.487 - 2.335j, -0.487 + 2.335j, -0.0089),
    # Nelson, second edition, chapter 4: short period, phugoid
    "navion_longitudinal": (-2.5 - 2.59j, -2.5 + 2.59j, -0.0171 - 0.213j, -0.0171 + 0.213j),
    # Computed from the matrices alone, independently of this code
    "osprey": (-12.92, -8.55 - 5.40j, -8.55 + 5.40j, -0.828 - 4.11j, -0.828 + 4.11j, -0.182, 0, 0),
}


@pytest.fixture(params=NAMES)
def airframe(request: pytest.FixtureRequest) -> Airframe:
    return load_airframe(request.param)


def test_library_is_nine_airframes_of_table() -> None:
    assert tuple(PUBLISHED) == NAMES
    assert tuple(facts.name for facts in library()) == ALL  # each file carries its own name


def test_every_airframe_states_source_and_signs(airframe: Airframe) -> None:
    assert "memory" in airframe.source or "computed" in airframe.source
    directions = {"nose up", "nose down", "nose left", "nose right", "roll left", "roll right"}
    for inputs in airframe.inputs.values():
        assert inputs.positive in directions or inputs.positive.startswith("more thrust")


@pytest.mark.parametrize("name", PUBLISHED_POLES)
def test_poles_are_the_published_ones(name: str) -> None:
    # Sources print poles to two to four digits, matrices to two or three. Tolerance: 2 % of the
    # pole, or the last digit.
    expected = np.sort_complex(np.array(PUBLISHED_POLES[name], dtype=np.complex128))
    result = np.sort_complex(airframe_facts(load_airframe(name)).poles)
    assert np.all(np.abs(result - expected) <= np.maximum(0.02 * np.abs(expected), 1e-3))


@pytest.mark.equation("Remark 1")
def test_d_of_published_signs_matches_table(airframe: Airframe) -> None:
    assert_array_equal(airframe_facts(airframe).D, PUBLISHED[airframe.name].D)


@pytest.mark.equation("Remark 1")
def test_flipping_inputs_alone_gives_every_airframe_d_equal_to_one(airframe: Airframe) -> None:
    # Remark 1 is a statement about sign conventions.
    facts = airframe_facts(airframe)
    assert facts.pairing is not None
    assert facts.pairing.outputs == facts.pairing.inputs == tuple(range(facts.m))
    assert facts.pairing.signs == PUBLISHED[airframe.name].D


def test_coupling_in_published_units_matches_the_table(airframe: Airframe) -> None:
    tolerance = 0.05 if airframe.name.startswith("aerosonde_first") else 0.006
    result = coupling(airframe.matrix_c() @ np.array(airframe.B))
    assert result == approx(PUBLISHED[airframe.name].coupling, abs=tolerance)


@pytest.mark.parametrize(
    "name, published, si", [("f16_longitudinal", 0.989, 0.302), ("b747_longitudinal", 0.607, 0.282)]
)
def test_coupling_depends_on_the_unit_of_speed(name: str, published: float, si: float) -> None:
    # F-16: U_12 = 0.1737 / 0.17555 (ft/s) / (rad/s), times 0.3048 in SI.
    airframe = load_airframe(name)
    assert coupling(airframe.matrix_c() @ np.array(airframe.B)) == approx(published, abs=1e-3)
    assert airframe_facts(airframe).coupling == approx(si, abs=1e-3)


def test_every_airframe_is_in_theorem_with_zero_dynamics_that_only_outer_loop_bounds(
    airframe: Airframe,
) -> None:
    # theta (longitudinal) and phi (lateral) integrate the rates. Each gives a zero at the origin:
    # never strictly stable.
    facts = airframe_facts(airframe)
    angles = [state for state in airframe.states if state in ("theta", "phi")]
    assert facts.is_controllable
    assert facts.zero_dynamics is ZeroDynamics.MARGINAL
    assert np.count_nonzero(np.abs(facts.zeros) < 1e-9) == len(angles)
    assert facts.is_in_theorem
    assert len(facts.zeros) == facts.n - facts.m > 0
    assert list(facts.integrated) == angles


@pytest.mark.equation(5, 6, 7, 8, 9)
@pytest.mark.parametrize("name", SPLIT)
def test_more_inputs_than_outputs_give_d_equal_to_one_through_the_pseudo_inverse(name: str) -> None:
    facts = airframe_facts(name)
    assert_allclose(facts.Omega, np.eye(len(facts.outputs)), atol=1e-9)
    assert facts.is_in_theorem


def test_split_effectors_moved_together_are_those_of_the_osprey() -> None:
    """Effectors that are split have the effects of the osprey's when they move together.

    They are those of the twin and of the V-tail, and follow from the geometry alone.
    """
    whole, twin, tail = (
        load_airframe(name).matrix_b() for name in ("osprey", "osprey_twin", "osprey_vtail")
    )
    both = np.array(
        [twin[:, 0] + twin[:, 1], twin[:, 5] + twin[:, 6], twin[:, 2] + twin[:, 3], twin[:, 4]]
    ).T
    assert_allclose(both, whole, atol=1e-12)
    both = np.array(
        [tail[:, 0] + tail[:, 1], tail[:, 4], tail[:, 2] + tail[:, 3], tail[:, 0] - tail[:, 1]]
    ).T
    assert_allclose(both, whole, atol=1e-12)


def test_the_flying_wing_has_the_short_period_of_its_coefficients() -> None:
    """Z_alpha, M_alpha and M_q are by hand from the coefficients of Gryte et al. 2018 at 18 m/s.

    The file names this source.
    """
    q_S = 0.5 * 1.225 * 18.0**2 * 0.75
    Z_alpha = -(q_S * 4.0203 + 3.459) / (3.364 * 18.0)
    M_alpha = -q_S * 0.35714 * 0.4629 / 0.165
    M_q = -q_S * 0.35714 * 1.30124 * 0.35714 / (2.0 * 18.0) / 0.165
    airframe = load_airframe("x8_elevons")
    A = airframe.matrix_a()
    rows = [airframe.index("alpha"), airframe.index("q")]
    assert_allclose(A[rows, rows], [Z_alpha, M_q], rtol=0.01)
    assert A[airframe.index("q"), airframe.index("alpha")] == approx(M_alpha, rel=0.01)


def test_zeros_of_the_osprey() -> None:
    zeros = airframe_facts(load_airframe("osprey")).zeros
    # -0.69 is Y_beta; -7.19 is Z_alpha with the elevator that holds q.
    assert_allclose(zeros, [-7.188, -0.69, 0.0, 0.0], atol=5e-4)


def test_minors_are_of_omega_in_si() -> None:
    facts = airframe_facts(load_airframe("f16_lateral"))
    per_degree = np.array([-0.7333, -0.7333 * -0.0620 - 0.1315 * -0.0319])
    assert_allclose(facts.minors, per_degree / np.deg2rad(1.0) ** np.array([1, 2]), rtol=1e-12)


def test_the_foot_is_exact() -> None:
    # 1 ft = 0.3048 m by definition (1959).
    assert si_per_unit("ft/s") == 0.3048


AEROSONDE = {
    "Jx": 0.8244,
    "Jz": 1.759,
    "Jxz": 0.1204,
    "S": 0.55,
    "b": 2.8956,
    "rho": 1.2682,
    "g": 9.81,
    "V": 25.0,
}
SECOND_EDITION = (
    {
        "mass": 11.0,
        "CL0": 0.23,
        "CLa": 5.61,
        "CLde": 0.13,
        "Cm0": 0.0135,
        "Cma": -2.74,
        "Cmde": -0.99,
    }
    | {
        "Y_beta": -0.98,
        "l_beta": -0.13,
        "n_beta": 0.073,
        "l_p": -0.51,
        "n_p": 0.069,
        "l_r": 0.25,
        "n_r": -0.095,
    }
    | {"Y_da": 0.075, "l_da": 0.17, "n_da": -0.011, "Y_dr": 0.19, "l_dr": 0.0024, "n_dr": -0.069}
)
FIRST_EDITION = (
    {
        "mass": 13.5,
        "CL0": 0.28,
        "CLa": 3.45,
        "CLde": -0.36,
        "Cm0": -0.02338,
        "Cma": -0.38,
        "Cmde": -0.5,
    }
    | {
        "Y_beta": -0.98,
        "l_beta": -0.12,
        "n_beta": 0.25,
        "l_p": -0.26,
        "n_p": 0.022,
        "l_r": 0.14,
        "n_r": -0.35,
    }
    | {"Y_da": 0.0, "l_da": 0.08, "n_da": 0.06, "Y_dr": -0.17, "l_dr": 0.105, "n_dr": -0.032}
)


def lateral_state_space(c: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    """Return Beard and McLain's Table 5.1 as matrices, with the states v, p, r, phi.

    In trim, lift equals weight, and the pitching moment is zero.
    """
    pressure = 0.5 * c["rho"] * c["V"] ** 2 * c["S"]
    lift = c["mass"] * c["g"] / pressure - c["CL0"]
    alpha = (lift * c["Cmde"] + c["Cm0"] * c["CLde"]) / (
        c["CLa"] * c["Cmde"] - c["Cma"] * c["CLde"]
    )
    inertia = np.array([[c["Jx"], -c["Jxz"]], [-c["Jxz"], c["Jz"]]])

    def moments(key: str) -> FloatArray:
        return (
            np.linalg.solve(inertia, np.array([c["l_" + key], c["n_" + key]])) * pressure * c["b"]
        )

    force = pressure / c["mass"]
    rate = c["b"] / (2.0 * c["V"])
    A = np.zeros((4, 4))
    A[0] = [
        force * c["Y_beta"] / c["V"],
        c["V"] * math.sin(alpha),
        -c["V"] * math.cos(alpha),
        c["g"] * math.cos(alpha),
    ]
    A[1:3, 0], A[1:3, 1], A[1:3, 2] = (
        moments("beta") / c["V"],
        moments("p") * rate,
        moments("r") * rate,
    )
    A[3] = [0.0, 1.0, math.tan(alpha), 0.0]
    B = np.zeros((4, 2))
    B[0] = [force * c["Y_da"], force * c["Y_dr"]]
    B[1:3, 0], B[1:3, 1] = moments("da"), moments("dr")
    return A, B


@pytest.mark.parametrize(
    "name, coefficients",
    [("aerosonde_lateral", SECOND_EDITION), ("aerosonde_first_edition_lateral", FIRST_EDITION)],
)
def test_the_aerosondes_follow_from_their_published_coefficients(
    name: str, coefficients: Mapping[str, float]
) -> None:
    A, B = lateral_state_space({**AEROSONDE, **coefficients})
    airframe = load_airframe(name)
    # The files keep four figures: half a unit of the fourth is at most 5e-4 of the value.
    assert_allclose(airframe.matrix_a(), A, rtol=5e-4, atol=1e-12)
    assert_allclose(airframe.matrix_b(), B, rtol=5e-4, atol=1e-12)


def toy(k: float) -> Airframe:
    """Return y_dot = -y + z + u, z_dot = z + k u.

    If y is kept at zero, u is -z, so the zero is at 1 - k.
    """
    inputs = {"u": {"unit": "1", "positive": "more y"}}
    states = {"y": "1", "z": "1"}
    return Airframe.validate_mapping(
        {
            "name": "toy",
            "source": "none",
            "speed": 1.0,
            "states": states,
            "inputs": inputs,
            "outputs": ["y"],
        }
        | {"A": [[-1.0, 1.0], [0.0, 1.0]], "B": [[1.0], [k]]},
        "toy",
    )


@pytest.mark.equation(5, 6, 7, 8, 9)
@pytest.mark.parametrize(
    "k, zero, kind",
    [
        (3.0, -2.0, ZeroDynamics.STABLE),
        (1.0, 0.0, ZeroDynamics.MARGINAL),
        (0.5, 0.5, ZeroDynamics.UNSTABLE),
    ],
)
def test_zero_dynamics_are_classified_by_their_zeros(
    k: float, zero: float, kind: ZeroDynamics
) -> None:
    facts = airframe_facts(toy(k))
    assert_allclose(facts.zeros, [zero], atol=1e-12)
    assert facts.zero_dynamics is kind
    assert facts.is_in_theorem is (kind is not ZeroDynamics.UNSTABLE)


@pytest.mark.equation("Assumption 1")
def test_an_uncontrollable_airframe_is_outside_the_theorem() -> None:
    facts = airframe_facts(toy(0.0))  # nothing drives z
    assert not facts.is_controllable
    assert not facts.is_in_theorem


def test_airframe_without_s_d_u_has_no_d_and_no_remedy() -> None:
    osprey = load_airframe("osprey")
    doubled = tuple((*row[:3], row[2]) for row in osprey.B)  # the rudder does what the aileron does
    facts = airframe_facts(osprey.model_copy(update={"B": doubled}))
    assert facts.D is None
    assert facts.coupling is None
    assert facts.remedy == "none"
    assert not facts.is_in_theorem


def test_input_that_drives_another_output_gets_new_pairing() -> None:
    osprey = load_airframe("osprey")
    swapped = [[row[0], row[1], row[3], row[2]] for row in osprey.B]
    swapped[osprey.index("p")][2] = 0.0  # the input named aileron only yaws
    facts = airframe_facts(osprey.model_copy(update={"B": swapped}))
    assert facts.D is None
    assert facts.remedy == "pair q-elevator, V-thrust, p-rudder, r-aileron"


def test_zeros_do_not_depend_on_coordinates_of_state() -> None:
    generator = np.random.default_rng(7)
    airframe = load_airframe("osprey")
    A = airframe.matrix_a()
    B = airframe.matrix_b()
    C = airframe.matrix_c()
    expected = invariant_zeros(A, B, C)
    for _ in range(50):
        T = generator.standard_normal((8, 8))
        if np.linalg.cond(T) > 100.0:
            # Beyond that the result measures the rounding of T, not the zeros.
            continue
        result = invariant_zeros(T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T))
        # Rounding in dense coordinates must not turn infinite zeros into finite ones.
        assert len(result) == 4
        assert_allclose(np.sort(result.real), np.sort(expected.real), atol=1e-6)
        assert is_controllable(T @ A @ np.linalg.inv(T), T @ B)
