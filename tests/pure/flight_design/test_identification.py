# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the identification of an aircraft of JSBSim from end to end."""

import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pytest import approx
from tests.conftest import invoke
from typer.testing import Result

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.jsbsim.jsbsim_aircraft import FlightCondition
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.outcome import FlightEnded
from flight_core.parameters import ParameterError
from flight_design.gains.first_scenario import FirstCommands
from flight_design.identification import jsbsim_identification
from flight_design.identification.jsbsim_identification import (
    IdentifiedAircraft,
    identify_jsbsim,
    sideslip_zero,
    slowest_trim,
    with_sideslip_held,
)
from flight_design.identification.manoeuvre import ManoeuvreResult, fly_all, manoeuvre_result

pytestmark = pytest.mark.slow

Progress = Callable[[str], None]


@pytest.fixture(scope="module")
def cessna() -> IdentifiedAircraft:
    """Return the c172p, identified with 20 s of each of its three flights of a minute."""

    def fly_briefly(scenario: Scenario, progress: Progress) -> dict[str, ManoeuvreResult]:
        return fly_all(scenario.vary(flight={"duration": 20.0}), progress)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jsbsim_identification, "fly_all", fly_briefly)
        return identify_jsbsim("c172p", 46.3, 1219.2)


def test_signs_and_pairing_of_aircraft_found(cessna: IdentifiedAircraft) -> None:
    # Elevator and rudder of JSBSim's convention turn nose down and nose left: the signs of all its
    # conventional aircraft.
    assert cessna.D == (-1, 1, 1, -1)
    # full throttle pitches it by slipstream: 0.13 rad/s^2 beside 4.2 m/s^2, in units of 0.05 rad/s
    # and 2 m/s
    assert cessna.coupling == approx(1.25, abs=0.05)
    assert cessna.sideslip_zero < 0.0
    # Its surfaces act one step of 5 ms later; its engine has to speed up the propeller, which takes
    # about a second.
    assert cessna.linear.lag[[0, 2, 3]] == approx([0.005] * 3, abs=1e-3)
    assert 0.5 < cessna.linear.lag[1] < 2.0
    assert cessna.failure is None


def test_margins_are_those_of_the_linear_aircraft(cessna: IdentifiedAircraft) -> None:
    # of the loop around A and B, not of y_dot = Omega u: MIL-F-9490D asks for 45 deg
    margins = cessna.selection.engineering.margins
    assert margins is not None
    assert cessna.selection.study.airframe.states == cessna.linear.airframe.states
    assert np.degrees(margins.nominal.phase).min() >= 45.0
    assert cessna.selection.engineering.unmet == ()


def test_aircraft_whose_sideslip_diverges_has_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    # sideslip of the f15 grows while p and r are held, outside Assumption 3: guidance flies it
    def calm(scenario: Scenario, progress: Progress) -> dict[str, ManoeuvreResult]:
        """Return 20 s of the first of the three flights of a minute."""
        brief = scenario.vary(flight={"duration": 20.0}, aircraft={"gusts": {}})
        return {"calm": manoeuvre_result(simulate(brief))}

    monkeypatch.setattr(jsbsim_identification, "fly_all", calm)
    # JSBSim searches for the trims that do not exist for 45 s of processor
    monkeypatch.setattr(jsbsim_identification, "slowest_trim", lambda _: 82.125)
    aircraft = identify_jsbsim("f15", 180.0, 3000.0, guided=True)
    assert aircraft.sideslip_zero > 0.0
    assert aircraft.flights["calm"].outcome == "completed"
    guidance = aircraft.scenario().guidance
    assert guidance is not None
    assert guidance.stall_speed == 82.125


def test_zero_of_sideslip_is_that_of_its_equations() -> None:
    # beta_dot = Y_beta beta + Y_u u with p and r held: Y_beta - Y_u N_u^-1 N_beta
    airframe = load_airframe("osprey")
    A, B = airframe.matrix_a(), airframe.matrix_b()
    beta, p, r = (airframe.index(name) for name in ("beta", "p", "r"))
    u = [list(airframe.inputs).index(name) for name in ("aileron", "rudder")]
    correction = np.linalg.solve(B[np.ix_([p, r], u)], A[[p, r], beta])
    assert sideslip_zero(airframe) == approx(A[beta, beta] - B[beta, u] @ correction)


def test_held_sideslip_has_the_opposite_zero() -> None:
    airframe = load_airframe("osprey")
    A = airframe.matrix_a()
    A[airframe.index("beta"), airframe.index("beta")] += 0.3 - sideslip_zero(airframe)
    gusts = np.ones((len(A), len(airframe.gusts)))
    diverging = airframe.with_matrices(A, airframe.matrix_b(), gusts)
    assert sideslip_zero(diverging) == approx(0.3)
    assert sideslip_zero(with_sideslip_held(diverging, 0.3)) == approx(-0.3)
    assert with_sideslip_held(airframe, -0.1) is airframe


def test_slowest_trim_is_found_within_one_percent(
    monkeypatch: pytest.MonkeyPatch, cessna: IdentifiedAircraft
) -> None:
    def trims_from_30(condition: FlightCondition) -> None:
        if condition.speed < 30.0:
            raise FlightEnded("does not trim")

    monkeypatch.setattr(jsbsim_identification, "trim_solution", trims_from_30)
    assert 30.0 <= slowest_trim(cessna.condition) <= 30.0 + 0.01 * 46.3


def test_guidance_turns_and_climbs(cessna: IdentifiedAircraft) -> None:
    commands = FirstCommands(cessna.scenario().reference_model.model_dump(exclude_none=True), 60.0)
    text = jsbsim_identification._text(cessna.linear, commands, cessna.selection, stall=30.0)
    log = simulate(jsbsim_identification._load(text).vary(aircraft={"gusts": {}}))["guidance"]
    # the band of a settled heading
    assert log["pose.psi"][-1] == approx(math.pi / 2.0, abs=math.radians(2.0))
    assert log["pose.altitude"][-1] == approx(1219.2 + 100.0, abs=5.0)  # that of a settled altitude


def rise_di(*arguments: str) -> Result:
    """Run `rise-di identify jsbsim` in this process."""
    return invoke("identify", "jsbsim", *arguments)


@pytest.mark.parametrize(
    "airframe, sentence",
    [
        ("f61", "aircraft: found 'f61', expected jsbsim:f16 perhaps, or jsbsim:PATH "),
        (
            "jsbsim:f61",
            "aircraft: found 'jsbsim:f61', expected jsbsim:f16 perhaps, or jsbsim:PATH ",
        ),
    ],
)
def test_airframe_that_is_none_of_jsbsim_refused_with_one_sentence(
    airframe: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    error = rise_di(airframe, "--speed", "46", "--altitude", "900").exception
    assert isinstance(error, ParameterError)
    assert str(error).startswith(sentence)
    assert not list(tmp_path.iterdir())


def test_aircraft_that_does_not_trim_gives_one_sentence(tmp_path: Path) -> None:
    """The command runs in its own process, to show that JSBSim itself prints nothing either."""
    words = [
        sys.executable,
        "-m",
        "flight_cli.cli",
        "identify",
        "jsbsim",
        "dr1",
        "--speed",
        "46",
        "--altitude",
        "900",
    ]
    run = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 3
    assert run.stderr.startswith(
        "error: jsbsim:dr1 does not trim at 46 m/s and 900 m: its model needs the property "
    )
    assert run.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_file_is_overwritten_only_if_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "jsbsim_c172p.yaml").write_text("mine\n")
    error = rise_di("c172p", "--speed", "46", "--altitude", "900").exception
    assert isinstance(error, ParameterError)
    assert "jsbsim_c172p.yaml exists" in str(error)
    assert (tmp_path / "jsbsim_c172p.yaml").read_text() == "mine\n"
