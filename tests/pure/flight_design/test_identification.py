# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification by step tests: systems with a response in closed form, then an aircraft of JSBSim
from end to end.
"""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pytest import approx
from tests.conftest import invoke
from typer.testing import Result

from aircraft_sim.jsbsim_aircraft import FlightCondition
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.outcome import FlightEnded
from flight_core.parameters import ParameterError
from flight_core.units import GRAVITY
from flight_core.vectors import FloatArray
from flight_design.identification import step_identification
from flight_design.identification.manoeuvre import AUTHORITY_FRACTION, HEIGHTS, reference_parameters
from flight_design.identification.step_identification import (
    IdentifiedAircraft,
    identify,
    slowest_trim,
    that_learns,
)
from flight_design.identification.step_responses import (
    SIZES,
    SPAN,
    Fly,
    Responses,
    steepest_tangent,
    step_responses,
)
from reference_model.params import ReferenceModelConfig
from reference_model.reference import Reference

pytestmark = pytest.mark.slow

DT = 0.005
WIDE = np.full(2, 10.0)


def lagged(Omega: FloatArray, lag: FloatArray) -> Fly:
    """y_dot = Omega v, lag v_dot = u - v from rest: y = Omega (t - lag (1 - exp(-t / lag))) u."""

    def fly(u: FloatArray, duration: float) -> FloatArray:
        t = DT * np.arange(round(duration / DT) + 1)[:, None]
        return np.asarray((t - lag * (1.0 - np.exp(-t / lag))) * u @ Omega.T)

    return fly


def respond(fly: Fly, upper: FloatArray = WIDE) -> Responses:
    """Step tests of two channels, every DT."""
    return step_responses(fly, -WIDE, upper, ("q", "p"), ("elevator", "aileron"), DT)


STRAIGHT = lagged(np.diag([3.0, 3.0]), np.array([0.02, 0.02]))


@settings(deadline=None, max_examples=30)
@given(
    Omega=st.lists(st.floats(0.1, 10.0), min_size=2, max_size=2),
    signs=st.lists(st.sampled_from((-1.0, 1.0)), min_size=2, max_size=2),
    coupled=st.floats(-0.5, 0.5),
    lag=st.lists(st.floats(0.01, 0.1), min_size=2, max_size=2),
)
def test_omega_and_lags_of_linear_system_identified(
    Omega: list[float], signs: list[float], coupled: float, lag: list[float]
) -> None:
    # The last chord begins 0.5 - 0.025 s after the step: what is left of the lag there is
    # exp(-4.75) = 0.9 % of the slope, and (0.475 + 0.1) / 0.1 times that of the lag.
    known = np.diag(np.array(Omega) * signs) @ np.array([[1.0, coupled], [coupled, 1.0]])
    found = respond(lagged(known, np.array(lag)))
    assert found.Omega == approx(known, rel=0.015, abs=1e-6)
    assert found.lag == approx(np.array(lag), rel=0.06)
    assert found.spread == approx(np.ones(2))
    assert found.rejected == ()


def test_tangent_of_damped_rate_is_initial_slope() -> None:
    # y = b/a (1 - exp(-a t)): the first chord of s = 25 ms has the slope b (1 - exp(-a s)) / (a s)
    # and, at its middle, no lag.
    a = 8.0
    b = -5.0
    t = DT * np.arange(101)
    found = steepest_tangent(b / a * (1.0 - np.exp(-a * t)), DT)
    assert found is not None
    assert found.slope == approx(b * (1.0 - math.exp(-a * SPAN)) / (a * SPAN))
    assert found.lag == approx(0.0, abs=1e-12)
    assert found.first == 0


def test_the_first_maximum_of_the_slope_counts() -> None:
    # A slope of 1 that decays, then one of -50, as from the aircraft's change of path.
    t = DT * np.arange(2001)
    y = np.sin(t) * (t < 6.0) - 50.0 * np.maximum(t - 6.0, 0.0)
    found = steepest_tangent(y, DT)
    assert found is not None
    assert found.slope == approx(1.0, rel=1e-3)


def test_a_constant_response_has_no_tangent() -> None:
    assert steepest_tangent(np.zeros(101), DT) is None


def test_drift_and_even_parts_of_response_cancel() -> None:
    known = np.diag([3.0, -2.0])
    lag = np.array([0.05, 0.02])
    straight = lagged(known, lag)

    def drifting(u: FloatArray, duration: float) -> FloatArray:
        t = DT * np.arange(round(duration / DT) + 1)[:, None]
        return np.asarray(straight(u, duration) + 0.3 * t**2 + 5.0 * t * (u @ u))

    found = respond(drifting)
    clean = respond(straight)
    assert found.Omega == approx(clean.Omega, abs=1e-9)
    assert found.lag == approx(clean.lag, abs=1e-9)


def test_largest_step_determines_omega_behind_dead_zone() -> None:
    # Half a dead zone of 0.06 hides the step of 0.05 and removes 30 % of that of 0.2: the slope is
    # 0.7 of the true one.
    def dead(u: FloatArray, duration: float) -> FloatArray:
        return STRAIGHT(u - np.clip(u, -0.06, 0.06), duration)

    found = respond(dead)
    assert found.size == approx([SIZES[-1]] * 2)
    assert np.diag(found.Omega) == approx([0.7 * 3.0] * 2, rel=0.01)
    assert found.rejected == (
        "elevator by 0.05: q does not move",
        "aileron by 0.05: p does not move",
    )


def test_steps_stay_inside_the_stops() -> None:
    steps: list[float] = []

    def fly(u: FloatArray, duration: float) -> FloatArray:
        steps.append(float(np.max(np.abs(u))))
        return STRAIGHT(u, duration)

    respond(fly, np.array([0.1, 10.0]))
    assert sorted(set(steps)) == approx([0.05, 0.09, 0.1, 0.2])


def test_step_that_ends_flight_rejected_with_reason() -> None:
    def fragile(u: FloatArray, duration: float) -> FloatArray:
        if np.max(np.abs(u)) > 0.15:
            raise FlightEnded("gave up at t = 0.10 s")
        return STRAIGHT(u, duration)

    found = respond(fragile)
    assert np.diag(found.Omega) == approx([3.0, 3.0], rel=0.01)
    assert found.rejected == (
        "elevator by 0.2: gave up at t = 0.10 s",
        "aileron by 0.2: gave up at t = 0.10 s",
    )


def test_an_output_without_response_ends_the_identification() -> None:
    with pytest.raises(FlightEnded, match=r"^p does not respond to aileron: .*p does not move"):
        respond(lagged(np.diag([3.0, 0.0]), np.full(2, 0.02)))


@pytest.mark.parametrize("speed, authority", [(30.0, 0.8), (150.0, 2.5), (250.0, 0.4)])
def test_commanded_airspeed_needs_third_of_throttle(speed: float, authority: float) -> None:
    # The filter's answer to a step, 2 m/s (1 - (1 + w t) exp(-w t)), is steepest at t = 1/w: 2 m/s
    # w / e. The pulse's edge of 0.1 s rounds that off by less than 1 %.
    params = ReferenceModelConfig.validate_mapping(
        reference_parameters(speed, authority), "reference_model"
    )
    y_m = Reference(params)
    row = list(params.outputs).index("V")
    samples = np.array([y_m.sample(k)[row] for k in range(round(30.0 * params.rate))])
    steepest = float(np.max(np.abs(np.diff(samples)))) * params.rate
    assert steepest <= min(AUTHORITY_FRACTION * authority, 1.2 * HEIGHTS["V"] / math.e) * 1.001
    assert steepest == approx(
        min(AUTHORITY_FRACTION * authority, 1.2 * HEIGHTS["V"] / math.e), rel=0.02
    )
    # at most 1 g in addition to gravity
    assert max(params.pulses["q"].value) * speed <= GRAVITY * (1.0 + 1e-9)


@pytest.fixture(scope="module")
def cessna() -> IdentifiedAircraft:
    return identify("c172p", 46.3, 1219.2)


def test_signs_and_pairing_of_aircraft_found(cessna: IdentifiedAircraft) -> None:
    # Elevator and rudder of JSBSim's convention turn nose down and nose left: the signs of all its
    # conventional aircraft.
    assert cessna.D == (-1, 1, 1, -1)
    assert cessna.coupling < 1.0
    assert cessna.sideslip_zero < 0.0
    # Its surfaces act one step of 5 ms later; its engine has to speed up the propeller, which takes
    # about a second.
    assert cessna.responses.lag[[0, 2, 3]] == approx([DT] * 3, abs=1e-3)
    assert 0.5 < cessna.responses.lag[1] < 2.0
    assert cessna.failure == ""


def test_shipped_scenario_is_what_command_writes(cessna: IdentifiedAircraft) -> None:
    # Numbers in the file have six digits; other machines may round the last ones of a flight
    # differently.
    shipped = yaml.safe_load(find_scenario("jsbsim_c172p").path.read_text())
    written = yaml.safe_load(cessna.text)
    assert shipped.keys() == written.keys()
    for section, content in written.items():
        for key, value in content["ros__parameters"].items():
            found = shipped[section]["ros__parameters"][key]
            numbers = isinstance(value, float) or (
                isinstance(value, list) and isinstance(value[0], float)
            )
            assert found == (approx(value, rel=1e-3, abs=1e-6) if numbers else value), key


def test_shipped_learner_begins_with_sketch(cessna: IdentifiedAircraft) -> None:
    shipped = find_scenario("jsbsim_c172p_learn").rise_di()
    gains = cessna.selection.chosen
    learned = that_learns(cessna.selection, cessna.condition, cessna.responses.Omega, 0.015).chosen
    assert shipped.feedforward is not None
    assert learned.feedforward is not None
    assert shipped.beta == approx(gains.beta, rel=1e-3)
    for key in ("A", "B"):
        assert getattr(shipped.feedforward, key) == approx(
            getattr(learned.feedforward, key), rel=1e-3, abs=1e-6
        )


def test_slowest_trim_is_found_within_one_percent(
    monkeypatch: pytest.MonkeyPatch, cessna: IdentifiedAircraft
) -> None:
    def trims_from_30(condition: FlightCondition) -> None:
        if condition.speed < 30.0:
            raise FlightEnded("does not trim")

    monkeypatch.setattr(step_identification, "trim_solution", trims_from_30)
    assert 30.0 <= slowest_trim(cessna.condition) <= 30.0 + 0.01 * 46.3


def test_guidance_turns_and_climbs(cessna: IdentifiedAircraft) -> None:
    commands = reference_parameters(46.3, 2.0)
    text = step_identification._text(
        cessna.condition, cessna.trim, cessna.responses, commands, cessna.selection, stall=30.0
    )
    log = simulate(step_identification._load(text).vary(aircraft={"gusts": {}}))["guidance"]
    # the band of a settled heading
    assert log["pose.psi"][-1] == approx(math.pi / 2.0, abs=math.radians(2.0))
    assert log["pose.altitude"][-1] == approx(1219.2 + 100.0, abs=5.0)  # that of a settled altitude


def rise_di(*arguments: str) -> Result:
    """`rise-di identify` in this process."""
    return invoke("identify", *arguments)


@pytest.mark.parametrize(
    "airframe, sentence",
    [
        ("osprey", "aircraft: found 'osprey', expected an aircraft of JSBSim, jsbsim:NAME"),
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
    refused = rise_di(airframe, "--speed", "46", "--altitude", "900").exception
    assert isinstance(refused, ParameterError)
    assert str(refused).startswith(sentence)
    assert not list(tmp_path.iterdir())


def test_aircraft_that_does_not_trim_gives_one_sentence(tmp_path: Path) -> None:
    """In a process of its own: JSBSim itself prints nothing either."""
    words = [
        sys.executable,
        "-m",
        "flight_cli.cli",
        "identify",
        "jsbsim:dr1",
        "--speed",
        "46",
        "--altitude",
        "900",
    ]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert done.stderr.startswith(
        "error: jsbsim:dr1 does not trim at 46 m/s and 900 m: its model needs the property "
    )
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_file_is_overwritten_only_if_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "jsbsim_c172p.yaml").write_text("mine\n")
    refused = rise_di("jsbsim:c172p", "--speed", "46", "--altitude", "900").exception
    assert isinstance(refused, ParameterError)
    assert "jsbsim_c172p.yaml exists" in str(refused)
    assert (tmp_path / "jsbsim_c172p.yaml").read_text() == "mine\n"
