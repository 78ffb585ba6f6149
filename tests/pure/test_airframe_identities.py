# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test units, output matrix and identities of an airframe file.

They are compared with published factors and python-control, and wrong files are refused.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose, assert_array_equal
from tests.conftest import refusing

from aircraft_sim.airframes.airframe import Airframe, airframes, check_identities, load_airframe
from flight_core.parameters import ParameterError
from flight_core.units import in_si, quantity, si_per_unit
from flight_design.gains.airframe_properties import airframe_facts, output_coordinates

PUBLISHED: dict[str, dict[str, Any]] = yaml.safe_load(
    Path(__file__).with_name("published_airframes.yaml").read_text()
)
NAVION, F4C, B747 = PUBLISHED.values()


def airframe(values: Mapping[str, Any]) -> Airframe:
    """Return an airframe, checked as a file is."""
    checked = Airframe.validate_mapping(values, "airframe plane")
    check_identities(checked)
    return checked


def exchanged(
    key: str, i: int, j: int, axis: int = 0
) -> Callable[[Mapping[str, Any]], dict[str, Any]]:
    """Return a change that exchanges two rows or columns of a matrix."""

    def change(values: Mapping[str, Any]) -> dict[str, Any]:
        matrix = np.array(values[key])
        order = np.arange(matrix.shape[axis])
        order[[i, j]] = j, i
        return {key: np.take(matrix, order, axis).tolist()}

    return change


def scaled(
    key: str, i: int, j: int, factor: float
) -> Callable[[Mapping[str, Any]], dict[str, Any]]:
    """Return a change that multiplies an entry of a matrix."""

    def change(values: Mapping[str, Any]) -> dict[str, Any]:
        matrix = np.array(values[key])
        matrix[i, j] *= factor
        return {key: matrix.tolist()}

    return change


def states(**units: str) -> Callable[[Mapping[str, Any]], dict[str, Any]]:
    """Return a change of units of states."""
    return lambda values: {"states": values["states"] | units}


def first_input(**values: str) -> Callable[[Mapping[str, Any]], dict[str, Any]]:
    """Return a change of the unit or the sign of the first input."""

    def change(frame: Mapping[str, Any]) -> dict[str, Any]:
        name, channel = next(iter(frame["inputs"].items()))
        return {"inputs": frame["inputs"] | {name: channel | values}}

    return change


WRONG: dict[str, tuple[dict[str, Any], Callable[[Mapping[str, Any]], dict[str, Any]],
tuple[str, ...]]] = {
    "transposed": (NAVION, lambda v: {"A": np.transpose(v["A"]).tolist()},
    ("theta_dot = 0 q", "expected 1")),
    "rows of B": (NAVION, exchanged("B", 2, 3),
    ("theta_dot = -11.04 elevator", "no input moves theta at once")),
    "no kinematics": (NAVION, scaled("A", 3, 2, 0.0), ("theta_dot = 0 q", "expected 1")),
    "sign of gravity": (NAVION, scaled("A", 0, 3, -1.0),
    ("V_dot = 9.81 theta", "expected -g = -9.81")),
    "g in ft/s^2": (NAVION, scaled("A", 0, 3, 3.28084),
    ("V_dot = -32.19 theta", "expected -g = -9.81")),
    "speed in ft/s": (NAVION, lambda _: {"speed": 176.0},
    ("w_dot = 53.64 q", "expected V0 = 176 at the speed 176 m/s")),
    "alpha as w": (NAVION, states(w="rad"),
    ("states.w: found rad, expected a speed",)),
    "elevator per rad declared deg": (NAVION, first_input(unit="deg"),
    ("inputs.elevator.unit: found q_dot = -633 elevator in SI", "for an aircraft with this A")),
    "elevator per crad declared rad": (B747, first_input(unit="rad"),
    ("inputs.elevator.unit: found q_dot = -0.0116 elevator in SI",)),
    "elevator named nose up": (B747, first_input(positive="nose up"),
    ("q_dot = -1.16 elevator beside 'nose up', expected more than 0",)),
    "columns of B": (B747, exchanged("B", 2, 3, axis=1),
    ("r_dot = 0.00775 rudder beside 'nose left', expected less than 0",)),
    "crad declared rad": (B747, states(q="rad/s", theta="rad"),
    ("u_dot = -0.09815 theta", "expected -g = -9.81")),
    "crad declared deg": (B747, states(q="deg/s", theta="deg"),
    ("u_dot = -5.623 theta", "expected -g = -9.81")),
    "name of a book": (NAVION, lambda v: {"states": {"VT": "ft/s", "w": "m/s", "q": "rad/s",
    "theta": "rad"}, "outputs": ["q", "VT"]}, ("states.VT: found VT, expected V:",)),
    "sign of the elevator": (NAVION, lambda v: {"B": (np.array(v["B"]) * [-1.0, 1.0]).tolist()},
    ("q_dot = 11.04",)),
    "input that turns an angle": (NAVION, lambda v: {"B": [*v["B"][:3], [0.1, 0.0]]},
    ("no input moves theta at once",)),
    "pitch driven by its rate": (NAVION, scaled("A", 2, 2, -1.0), ("q_dot = 2.948 q", "air damps")),
    "a state missing": (F4C, lambda v: {"states": {name: v["states"][name] for name in "vpr"}},
    ("expected 3 rows of 3",)),
    "feedthrough": (F4C, lambda _: {"D": [[0.0, 0.0], [0.1, 0.0]]},
    ("D: found a feedthrough of 0.1", "take an output")),
    "output without a unit": (NAVION, lambda _: {"outputs": ["q", "n"], "C": [[0, 0, 1, 0]] * 2},
    ("output_units.n",)),
    "rows of C exchanged": (NAVION, lambda _: {"C": [[1, 0, 0, 0], [0, 0, 1, 0]]},
    ("a row of q with V", "the state q alone")),
}  # fmt: skip


@pytest.mark.parametrize("name", airframes())
def test_shipped_airframes_are_not_refused(name: str) -> None:
    check_identities(load_airframe(name))


@pytest.mark.parametrize("values", PUBLISHED.values(), ids=PUBLISHED)
def test_textbook_matrices_are_not_refused(values: dict[str, Any]) -> None:
    assert airframe(values).matrix_a().shape == (len(values["A"]),) * 2


@pytest.mark.parametrize("mistake", WRONG)
def test_wrong_airframe_is_told_in_one_sentence(mistake: str) -> None:
    values, change, words = WRONG[mistake]
    with pytest.raises(ParameterError) as refusal:
        airframe(values | change(values))
    sentence = str(refusal.value)
    for word in words:
        assert word in sentence, sentence
    assert "\n" not in sentence


def test_file_may_differ_on_purpose() -> None:
    values = NAVION | {"speed": 176.0, "identities": False}
    assert airframe(values).speed == 176.0


def test_file_has_its_speed_with_a_unit_and_is_named_when_its_ending_is_wrong(
    tmp_path: Path,
) -> None:
    path = tmp_path / "navion.yaml"
    path.write_text(yaml.safe_dump(NAVION | {"speed": "176 ft/s"}, sort_keys=False))
    navion = load_airframe(path)
    assert navion.speed == pytest.approx(53.6448)  # 176 * 0.3048
    with refusing(f"found '.*navion.yml', expected {path}, which exists"):
        load_airframe(path.with_suffix(".yml"))
    with refusing("expected a gust of the airframe plane: none, write its key gusts"):
        navion.gust_direction("vertical")


def test_multirotor_in_hover_is_not_refused() -> None:
    """Near hover there is no coupling with the speed, because there is no control surface."""
    values = {
        "states": {"q": "rad/s", "w": "m/s", "theta": "rad"},
        "inputs": {
            "moment": {"unit": "1", "positive": "nose up"},
            "lift": {"unit": "1", "positive": "up"},
        },
        "outputs": ["q", "w"],
        "A": [[-2.0, 0.0, 0.0], [0.0, -0.3, 0.0], [1.0, 0.0, 0.0]],
        "B": [[80.0, 0.0], [0.0, -20.0], [0.0, 0.0]],
    }
    assert airframe({"name": "quad", "source": "made up", "speed": 5.0} | values).name == "quad"


def test_height_is_a_state() -> None:
    """h_dot is V0 (theta - alpha), in ft while speeds are in kt. The file converts the units."""
    kt = 1852.0 / 3600.0
    ft = 0.3048
    V0 = 20.0
    values = NAVION | {
        "speed": V0,
        "states": {"V": "kt", "alpha": "deg", "q": "deg/s", "theta": "deg", "h": "ft"},
        "A": [
            [-0.19, 9.4 / kt * np.pi / 180.0, 0.0, -9.81 / kt * np.pi / 180.0, 0.0],
            [-0.05 * kt * 180.0 / np.pi, -3.0, 0.98, 0.0, 0.0],
            [0.0, -46.0, -3.6, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0, 0.0],
            [0.0, -V0 / ft * np.pi / 180.0, 0.0, V0 / ft * np.pi / 180.0, 0.0],
        ],
        "B": [
            [0.0, 12.0 / kt],
            [-0.2 * 180.0 / np.pi, 0.0],
            [-60.0 * 180.0 / np.pi, 0.0],
            [0.0, 0.0],
            [0.0, 0.0],
        ],
    }
    A = airframe(values).matrix_a()
    expected = [
        [-0.19, 9.4, 0.0, -9.81, 0.0],
        [-0.05, -3.0, 0.98, 0.0, 0.0],
        [0.0, -46.0, -3.6, 0.0, 0.0],
    ]
    assert_allclose(A, [*expected, [0.0, 0.0, 1.0, 0.0, 0.0], [0.0, -V0, 0.0, V0, 0.0]], atol=1e-12)


@pytest.mark.parametrize(
    "unit, factor",
    [
        ("ft", 0.3048), ("kt", 0.514444), ("mph", 0.44704), ("km/h", 0.277778), ("nmi", 1852.0),
        ("slug", 14.5939),
        ("lb", 0.45359237), ("lbf", 4.448222), ("slug*ft^2", 1.355818), ("slug/ft^3", 515.3788),
        ("ft/s^2", 0.3048),
        ("lbf/ft^2", 47.88026), ("deg/s", 0.01745329), ("s^-1", 1.0),
    ],
)  # fmt: skip
def test_factors_are_the_published_ones(unit: str, factor: float) -> None:
    """The factors are from NIST SP 811, appendix B.8."""
    assert si_per_unit(unit) == pytest.approx(factor, rel=2e-6)


@pytest.mark.parametrize("unit", ["knots", "", "ft//s", "m^x"])
def test_unknown_unit_is_refused(unit: str) -> None:
    with refusing("or a product such as ft/s"):
        quantity(unit, "states.V")


def test_text_with_a_unit_becomes_si() -> None:
    assert in_si("176 ft/s", "speed", "m/s") == pytest.approx(53.6448, rel=1e-12)
    assert in_si(53.6, "speed", "m/s") == 53.6
    for wrong, like in (("176 ft", "m/s"), ("fast", "m/s"), ("", "kg"), ("3 stone", "kg")):
        with refusing(r"^mass: found"):
            in_si(wrong, "mass", like)


def body_axes(alpha: float = 0.16) -> tuple[dict[str, Any], Airframe]:
    """Return the Navion turned by a trim angle of attack to u, w of body axes.

    V = u cos + w sin. The Navion in V, w is returned as well.
    """
    sine = np.sin(alpha)
    cosine = np.cos(alpha)
    turn = np.eye(4)
    # u, w of body axes from those of stability axes
    turn[:2, :2] = [[cosine, -sine], [sine, cosine]]
    values = NAVION | {
        "states": {"u": "m/s", "w": "m/s", "q": "rad/s", "theta": "rad"},
        "A": (turn @ NAVION["A"] @ turn.T).tolist(),
        "B": (turn @ NAVION["B"]).tolist(),
        "C": [[0.0, 0.0, 1.0, 0.0], [cosine, sine, 0.0, 0.0]],
        "output_units": {"V": "m/s"},
    }
    return values, airframe(NAVION)


def test_output_of_body_axes_has_the_transfer_function_of_stability_axes() -> None:
    """python-control computes C (s I - A)^-1 B at 1 rad/s, and the invariant zeros."""
    values, stability = body_axes()
    body = airframe(values)
    responses = [
        control.ss(frame.matrix_a(), frame.matrix_b(), frame.matrix_c(), np.zeros((2, 2)))(1j)
        for frame in (body, stability)
    ]
    assert_allclose(responses[0], responses[1], rtol=1e-9)
    plant = control.ss(body.matrix_a(), body.matrix_b(), body.matrix_c(), np.zeros((2, 2)))
    facts = airframe_facts(body)
    assert_allclose(facts.zeros, np.sort_complex(control.zeros(plant)), atol=1e-6)
    assert facts.outputs == ("q", "V")
    assert facts.integrated == ("theta",)


def test_coordinates_of_selected_states_are_the_states() -> None:
    C = load_airframe("osprey").matrix_c()
    P, N, H = output_coordinates(C)
    assert_array_equal(P, C.T)
    assert_array_equal(N, H)
    assert_array_equal(H, np.eye(8)[:, ~C.any(axis=0)])


def test_coordinates_rebuild_the_state() -> None:
    C = airframe(body_axes()[0]).matrix_c()
    P, N, H = output_coordinates(C)
    x = np.array([1.0, -2.0, 0.3, 0.7])
    assert_allclose(P @ (C @ x) + N @ (H.T @ x), x, rtol=1e-12)
    with refusing("independent outputs"):
        output_coordinates(np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
