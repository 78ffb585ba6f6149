# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test airframes from python-control, SciPy, MATLAB, AVL and XFLR5.

They are compared with the printed matrices of a book and with the library.
"""

from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
import scipy.io
import scipy.signal
import yaml
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx
from tests.conftest import REPOSITORY, invoke, refusing

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.airframes.airframe_import import import_airframe
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.parameters import ParameterError
from flight_core.vectors import FloatArray
from rise_di.own_airframe import new_airframe

# R. C. Nelson, Flight Stability and Automatic Control, 2nd ed. (1998), p. 158, with the elevator of
# NASA CR-96008, in ft.
A: FloatArray = np.array(
    [
        [-0.045, 0.036, 0.0, -32.2],
        [-0.369, -2.02, 176.0, 0.0],
        [0.0019, -0.0396, -2.948, 0.0],
        [0.0, 0.0, 1.0, 0.0],
    ]
)
B: FloatArray = np.array([[0.0], [-28.17], [-11.044], [0.0]])
NAMES: dict[str, Any] = {
    "name": "navion",
    "speed": "176 ft/s",
    "states": "u: ft/s, w: ft/s, q: rad/s, theta: rad",
    "inputs": "elevator: rad nose down",
}
SYSTEM = control.ss(A, B, np.eye(4), np.zeros((4, 1)))

AVL_ST = """\
 Vortex Lattice Output -- Total Forces
 Configuration: Navion
 Sref =  184.00       Cref =  5.7000       Bref =  33.400
 Standard axis orientation,  X fwd, Z down
  Alpha =   0.00000     pb/2V =  -0.00000     p'b/2V =  -0.00000
  CLtot =   0.41000
  CDtot =   0.05000
  CDvis =   0.02600     CDind = 0.0240000
  CLff  =   0.41000     CDff  = 0.0240000    | Trefftz
  CYff  =   0.00000         e =    0.8000    | Plane
 Stability-axis derivatives...
                             alpha                beta
 z' force CL |    CLa =   4.440000    CLb =   0.000000
 y  force CY |    CYa =   0.000000    CYb =  -0.564000
 x  force CD |    CDa =   0.330000    CDb =   0.000000
 x' mom.  Cl'|    Cla =   0.000000    Clb =  -0.074000
 y  mom.  Cm |    Cma =  -0.683000    Cmb =   0.000000
 z' mom.  Cn'|    Cna =   0.000000    Cnb =   0.071000
                     roll rate  p'      pitch rate  q'        yaw rate  r'
 z' force CL |    CLp =   0.000000    CLq =   3.800000    CLr =   0.000000
 y  force CY |    CYp =   0.000000    CYq =   0.000000    CYr =   0.000000
 x' mom.  Cl'|    Clp =  -0.410000    Clq =   0.000000    Clr =   0.107000
 y  mom.  Cm |    Cmp =   0.000000    Cmq =  -9.960000    Cmr =   0.000000
 z' mom.  Cn'|    Cnp =  -0.057500    Cnq =   0.000000    Cnr =  -0.125000
                  elevator     d1      aileron     d2       rudder     d3
                  ----------------    ----------------    ----------------
 z' force CL |   CLd1 =   0.006196   CLd2 =   0.000000   CLd3 =   0.000000
 y  force CY |   CYd1 =   0.000000   CYd2 =   0.000000   CYd3 =   0.002740
 x' mom.  Cl'|   Cld1 =   0.000000   Cld2 =   0.002339   Cld3 =   0.000187
 y  mom.  Cm |   Cmd1 =  -0.016109   Cmd2 =   0.000000   Cmd3 =   0.000000
 z' mom.  Cn'|   Cnd1 =   0.000000   Cnd2 =  -0.000061   Cnd3 =  -0.001257
 Neutral point  Xnp =   2.0
"""
"""The derivatives of the Navion, Nelson, table B.1, in the form of AVL's command ST; per deg of a
control."""
BODY = {
    "mass": "2750 lb",
    "Ixx": "1048 slug*ft^2",
    "Iyy": "3000 slug*ft^2",
    "Izz": "3530 slug*ft^2",
    "density": "0.002378 slug/ft^3",
    "length": "ft",
}


def tool_file(folder: Path, name: str, text: str) -> Path:
    """Write a file of a tool."""
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "system",
    [SYSTEM, scipy.signal.StateSpace(A, B, np.eye(4), np.zeros((4, 1)))],
    ids=["control", "scipy"],
)
def test_state_space_becomes_the_airframe_of_the_library(system: Any) -> None:
    frame, _ = import_airframe(system, thrust=True, **NAMES)
    library = load_airframe("navion_longitudinal")
    assert_allclose(frame.matrix_a(), library.matrix_a(), rtol=1e-12, atol=0.0)
    # g of 32.2 ft/s^2 in the thrust
    assert_allclose(frame.matrix_b(), library.matrix_b(), rtol=1e-3, atol=0.0)
    assert frame.speed == approx(library.speed)
    # alpha_0 is 0 in stability axes
    assert_allclose(frame.matrix_c(), np.eye(4)[[2, 0]], atol=1e-12)
    assert frame.outputs == ("q", "V")


def test_gusts_are_minus_the_columns_of_the_flow() -> None:
    """W. MacKunis et al. 2010 take a gust as minus the column of alpha, where w is V0 alpha."""
    frame, _ = import_airframe(SYSTEM, thrust=True, **NAMES)
    assert_allclose(frame.gust_direction("vertical")[:3], -frame.matrix_a()[:3, 1], rtol=1e-4)
    assert "theta" not in frame.gusts["vertical"]


def test_body_axes_give_the_airspeed_along_the_path() -> None:
    """u_dot has -W0 q and w_dot has U0 q, so V = u cos(alpha_0) + w sin(alpha_0).

    In Cook's example 4.2 alpha_0 is 9.4 deg.
    """
    f4c = np.array(
        [
            [7.181e-4, 4.57e-3, -29.072, -9.678], [-0.0687, -0.2953, 174.868, -1.601],
            [1.73e-3, -0.0105, -0.4462, 1.277e-3],
            [0.0, 0.0, 1.0, 0.0],
        ]
    )  # fmt: skip
    system = control.ss(f4c, [[1.041], [-6.294], [-4.888], [0.0]], np.eye(4), np.zeros((4, 1)))
    frame, _ = import_airframe(
        system,
        name="f4c",
        speed=178.0,
        states=["u", "w", "q", "theta"],
        inputs="elevator: rad nose down",
        thrust=True,
    )
    u, w, *_ = frame.matrix_c()[1]
    assert np.degrees(np.arctan2(w, u)) == approx(9.4, abs=0.05)


def test_names_of_python_control_are_taken() -> None:
    system = control.ss(
        A,
        B,
        np.eye(4),
        np.zeros((4, 1)),
        states=["u", "w", "q", "theta"],
        inputs=["elevator"],
        outputs=["u", "w", "q", "theta"],
    )
    with refusing(r"expected -g = -9.81"):  # the labels have no unit, and A is in ft
        import_airframe(system, thrust=True, speed="176 ft/s")
    frame, _ = import_airframe(system, thrust=True, speed="176 ft/s", states=NAMES["states"])
    assert list(frame.inputs) == ["elevator", "thrust"]
    assert frame.inputs["elevator"].positive == "nose down"  # from the sign of B


def test_matlab_file_carries_names(tmp_path: Path) -> None:
    names: dict[str, Any] = {
        "StateName": np.array(["u", "w", "q", "theta"], dtype=object),
        "InputName": np.array(["elevator"], dtype=object),
    }
    scipy.io.savemat(tmp_path / "flat.mat", {"A": A, "B": B, **names})
    scipy.io.savemat(
        tmp_path / "group.mat", {"sys": {"a": A, "b": B, "c": np.eye(4), "d": np.zeros((4, 1))}}
    )
    given: dict[str, Any] = {"speed": "176 ft/s", "thrust": True, "states": NAMES["states"]}
    flat, note = import_airframe(tmp_path / "flat.mat", **given)
    group, _ = import_airframe(tmp_path / "group.mat", **given, inputs="elevator: rad nose down")
    assert note == "A and B of flat.mat"
    assert flat.name == "flat"
    assert_array_equal(flat.matrix_a(), group.matrix_a())


def test_avl_derivatives_give_the_printed_matrices(tmp_path: Path) -> None:
    """Nelson prints the lateral matrix on p. 199 and the longitudinal derivatives on p. 153.

    These have no alpha_dot, so that M_q is -2.05.
    """
    frame, note = import_airframe(
        tool_file(tmp_path, "navion.st", AVL_ST), speed="176 ft/s", thrust=True, **BODY
    )
    matrix = frame.matrix_a()
    x = list(frame.states)
    lateral = matrix[
        np.ix_(
            [x.index(name) for name in ("beta", "p", "r", "phi")],
            [x.index(n) for n in ("beta", "p", "r", "phi")],
        )
    ]
    printed = [
        [-0.254, 0.0, -1.0, 0.182],
        [-16.02, -8.40, 2.19, 0.0],
        [4.488, -0.350, -0.760, 0.0],
        [0.0, 1.0, 0.0, 0.0],
    ]
    assert_allclose(lateral, printed, rtol=0.03, atol=1e-9)
    entry = {(row, column): matrix[x.index(row), x.index(column)] for row in x for column in x}
    assert entry["V", "V"] == approx(-0.045, rel=0.02)
    assert entry["alpha", "V"] * 176.0 * 0.3048 == approx(-0.369, rel=0.02)  # Z_u of w = V0 alpha
    assert entry["alpha", "alpha"] == approx(-2.02, rel=0.02)
    assert entry["q", "alpha"] == approx(-8.8, rel=0.02)  # M_alpha, p. 153
    assert entry["q", "q"] == approx(-2.05, rel=0.03)
    # by hand: q S c C_m / I_y
    assert_allclose(frame.matrix_b()[x.index("q"), 0], -11.88, rtol=0.005)
    assert frame.inputs["elevator"].unit == "deg"
    assert [given.positive for given in frame.inputs.values()][:3] == [
        "nose down",
        "roll right",
        "nose left",
    ]
    assert "without the ones by alpha_dot" in note


def supra(axes: float) -> str:
    """Return AVL's system matrix of the sailplane Supra, as a user of AVL posted it.

    It is longitudinal, with an elevator in deg.
    """
    longitudinal = [
        [-0.0486, 2.397, -0.6799, -9.81],
        [-1.4589, -11.0072, 4.693, 0.0],
        [0.1097, -2.4217, -8.1535, 0.0],
        [0, 0, 1, 0],
    ]
    full = np.zeros((12, 12))
    full[:4, :4] = np.array(longitudinal)
    full[4:8, 4:8] = [
        [-0.5, 0.7, -6.6, 9.81],
        [-1.4, -9.0, 2.0, 0.0],
        [0.9, -0.6, -0.8, 0.0],
        [0.0, 1.0, 0.0, 0.0],
    ]
    B = np.zeros((12, 2))
    B[:3, 0] = [0.0, -0.09, -1.03]
    B[4:7, 1] = [0.05, 0.02, -0.2]
    turn = np.array([axes, axes, 1, 1, 1, axes, axes, axes, axes, 1, axes, 1])
    rows = np.hstack([turn[:, None] * full * turn, turn[:, None] * B])
    header = (
        "     u    w    q    the    v    p    r    phi    x    y    z    psi  |  elevator  rudder"
    )
    return "\n".join(
        [
            " A Matrix",
            header,
            *(
                " ".join(f"{v:.4f}" for v in row[:12])
                + " | "
                + " ".join(f"{v:.4f}" for v in row[12:])
                for row in rows
            ),
        ]
    )


@pytest.mark.parametrize("axes", [1.0, -1.0], ids=["forward", "aft"])
def test_avl_system_matrix_has_the_published_eigenvalues(tmp_path: Path, axes: float) -> None:
    """The user printed AVL's eigenvalues: -9.466 +-3.209j and -0.1385 +-0.668j at 6.824 m/s."""
    frame, _ = import_airframe(tool_file(tmp_path, "supra.txt", supra(axes)), speed=6.824)
    poles = np.linalg.eigvals(frame.matrix_a()[:4, :4])
    assert_allclose(
        np.sort_complex(poles),
        [-9.4662 - 3.2089j, -9.4662 + 3.2089j, -0.1385 - 0.668j, -0.1385 + 0.668j],
        atol=2e-3,
    )
    assert [frame.inputs[name].positive for name in ("elevator", "rudder")] == [
        "nose down",
        "nose left",
    ]
    assert frame.outputs == ("q", "r")


def test_xflr5_log_gives_both_motions(tmp_path: Path) -> None:
    f16 = load_airframe("navion_longitudinal")
    b747 = load_airframe("aerosonde_lateral")
    longitudinal = np.array(f16.matrix_a())
    lateral = np.array(b747.matrix_a())
    longitudinal[:, 2] *= [1.0, 25.0 / f16.speed, 1.0, 1.0]  # w_dot = V0 q of the speed of both
    longitudinal[1, 0] *= f16.speed / 25.0

    def matrix(values: FloatArray) -> str:
        return "\n".join(
            "   ".join(f"{value:13g}" for value in row) for row in np.atleast_2d(values)
        )

    log = "\n".join(
        [
            "      _____State matrices__________", "       Longitudinal state matrix",
            matrix(longitudinal),
            "       Lateral state matrix", matrix(lateral), "",
            "      _____Control Matrices for set Elevator __________",
            "       Longitudinal control matrix",
            matrix(f16.matrix_b()[:, :1]), "       Lateral control matrix",
            matrix(np.zeros((4, 1))),
            "      _____Control Matrices for set Rudder __________",
            "       Longitudinal control matrix",
            matrix(np.zeros((4, 1))), "       Lateral control matrix",
            matrix(b747.matrix_b()[:, 1:]),
        ]
    )  # fmt: skip
    frame, note = import_airframe(tool_file(tmp_path, "plane.log", log))
    assert frame.speed == approx(25.0, rel=1e-4)
    assert_allclose(frame.matrix_a()[4:, 4:], lateral, rtol=1e-5)
    assert_allclose(frame.matrix_b()[4:, 1], b747.matrix_b()[:, 1], rtol=1e-5)
    assert list(frame.inputs) == ["elevator", "rudder"]
    assert note == "XFLR5's matrices"


REFUSED: dict[str, tuple[Any, dict[str, Any], str]] = {
    "sampled": (
        control.ss(np.eye(4), B, np.eye(4), np.zeros((4, 1)), 0.01),
        {},
        "sampled system of period 0.01, expected a continuous",
    ),
    "no state space": ([1.0], {}, "found list, expected a state space"),
    "no names": (SYSTEM, {"states": ""}, "states: found no names beside 4 rows of A"),
    "a state missing": (
        SYSTEM,
        {"states": "u: ft/s, w: ft/s, q: rad/s"},
        "states: found u, w, q beside 4 rows of A",
    ),
    "unit of speed": (SYSTEM, {"speed": "176 ft"}, "expected a unit like m/s"),
    "feedthrough": (
        control.ss(A, np.hstack([B, B]), A[1:3], [[-28.17, 0.0], [0.0, 0.0]]),
        {"inputs": "elevator: rad nose down, flap: rad", "outputs": "n: ft/s^2, q_dot: rad/s^2"},
        "D: found a feedthrough of 28.17",
    ),
    "not finite": (
        control.ss(np.where(A == 1.0, np.inf, A), B, np.eye(4), np.zeros((4, 1))),
        {},
        "not finite",
    ),
    "wrong units": (
        SYSTEM,
        {"states": "u: m/s, w: m/s, q: rad/s, theta: rad"},
        "u_dot = -32.2 theta in SI, expected -g = -9.81",
    ),
}


@pytest.mark.parametrize("mistake", REFUSED)
def test_wrong_model_is_told_in_one_sentence(mistake: str) -> None:
    system, changes, words = REFUSED[mistake]
    if mistake in {"feedthrough", "not finite"}:
        changes = {"thrust": False} | changes
    with pytest.raises(ParameterError) as refusal:
        import_airframe(system, **({"thrust": True} | NAMES | changes))
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "name, text, changes, words",
    [("a.txt", "no matrix here", {}, "found none of these"), ("a.mat", "no MAT-file", {}, "-v7"),
        ("a.st", AVL_ST.replace("Clp =", "Clx ="), BODY | {"speed": "176 ft/s"}, "no Clp"),],
)  # fmt: skip
def test_wrong_file_is_told_in_one_sentence(
    tmp_path: Path, name: str, text: str, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(ParameterError) as refusal:
        import_airframe(tool_file(tmp_path, name, text), **changes)
    assert words in str(refusal.value)


@pytest.mark.slow
def test_new_airframe_flies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made = new_airframe(SYSTEM, thrust=True, **NAMES)
    assert (made.airframe_file, made.scenario_file) == (
        Path("navion.yaml"),
        Path("navion_flight.yaml"),
    )
    tape = simulate(find_scenario("navion_flight.yaml"))
    assert tape.outcome.status == 0
    error = np.abs(tape["y"]["V"] - np.interp(tape.time("y"), tape.time("y_m"), tape["y_m"]["V"]))
    assert error.max() < 1.0  # m/s of a command of 1.6 and a gust of 1.6
    with refusing("expected a new file, or replace"):
        new_airframe(SYSTEM, thrust=True, **NAMES)


@pytest.mark.slow
def test_command_writes_airframe_and_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scipy.io.savemat("navion.mat", {"A": A, "B": B})
    arguments = [
        "airframes",
        "navion.mat",
        "--write",
        ".",
        "--speed",
        str(NAMES["speed"]),
        "--states",
        NAMES["states"],
        "--inputs",
        NAMES["inputs"],
        "--thrust",
    ]
    result = invoke(*arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert "elevator (rad, positive: nose down)" in result.stdout
    read: Airframe = load_airframe("navion.yaml")
    assert_allclose(read.matrix_a(), load_airframe("navion_longitudinal").matrix_a(), rtol=1e-12)
    assert find_scenario("navion_flight.yaml").controller.D == (-1, 1)


def test_f4c_of_tutorial_follows_from_the_derivatives_of_the_book() -> None:
    """Cook's examples 4.2 and 4.3 have the dimensionless derivatives in body axes, kg, m, s.

    The mass matrix has w_dot and Ixz.
    """
    m, Ix, Iy, Iz, Ixz = 17642.0, 33898.0, 165669.0, 189496.0, 2952.0
    S = 49.239
    b = 11.787
    c = 4.889
    rho = 0.3809
    V0 = 178.0
    theta = np.radians(9.4)
    g = 9.81
    U = V0 * np.cos(theta)
    W = V0 * np.sin(theta)
    force = 0.5 * rho * V0 * S
    mass = np.array(
        [
            [m, 0.0, 0.0],
            [0.0, m + 0.3997 * 0.5 * rho * S * c, 0.0],
            [0.0, 0.5910 * 0.5 * rho * S * c**2, Iy],
        ]
    )
    forces = np.array(
        [
            [0.0076 * force, 0.0483 * force, -m * W, -m * g * np.cos(theta)],
            [-0.7273 * force, -3.1245 * force, -1.2109 * force * c + m * U, -m * g * np.sin(theta)],
            [0.0340 * force * c, -0.2169 * force * c, -1.2732 * force * c**2, 0.0],
        ]
    )
    lateral_mass = np.array([[m, 0.0, 0.0], [0.0, Ix, -Ixz], [0.0, -Ixz, Iz]])
    lateral = np.array(
        [
            [-0.5974 * force, m * W, -m * U, m * g * np.cos(theta)],
            [-0.1048 * force * b, -0.1164 * force * b**2, 0.0455 * force * b**2, 0.0],
            [0.0987 * force * b, -0.0045 * force * b**2, -0.1132 * force * b**2, 0.0],
        ]
    )
    text = (REPOSITORY / "docs" / "tutorials" / "textbook.md").read_text()
    page = yaml.safe_load(text.split("cat > f4c.yaml <<'EOF'\n")[1].split("EOF")[0])
    A = np.array(page["A"])
    assert_allclose(A[:3, :4], np.linalg.solve(mass, forces), rtol=0.01, atol=1e-4)
    assert_allclose(A[4:7, 4:], np.linalg.solve(lateral_mass, lateral), rtol=0.005, atol=1e-4)
    assert Airframe.validate_mapping(page, "f4c").matrix_c()[1, :2] == approx(
        [np.cos(theta), np.sin(theta)], abs=1e-4
    )
