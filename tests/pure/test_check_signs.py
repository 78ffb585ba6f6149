# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di check-signs`: a map with a wrong sign is refused before anything is sent."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from aircraft_sim.airframe import load_airframe
from autopilot_bridge.params import LIBRARY, ChannelMap, load_map
from autopilot_bridge.signs import MIN_ERROR_RATIO, Estimate, estimate, through
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.design.sign_check import SignCheck, check
from flight_bringup.scenarios import find_scenario
from flight_cli.cli import COMMANDS, application
from flight_core.parameters import ParameterError
from flight_core.rates import nanoseconds
from flight_core.tape import Signal
from flight_core.vectors import FloatArray

app = application([*COMMANDS])
MAPS = sorted(path.stem for path in LIBRARY.glob("*.yaml"))
OUTPUTS, INPUTS = ("q", "p", "r", "V"), ("elevator", "aileron", "rudder", "thrust")
AIRFRAME = load_airframe("osprey")
OMEGA: FloatArray = AIRFRAME.matrix_c() @ AIRFRAME.matrix_b()


def check_osprey(channel_map: ChannelMap, D: tuple[int, ...] = (1, 1, 1, 1), measured: Estimate | None = None) -> SignCheck:
    return check(channel_map, OMEGA, OUTPUTS, INPUTS, D, measured)


def changed(original: ChannelMap, kind: str, channel: str, **values: Any) -> ChannelMap:
    content = original.model_dump()
    content[kind][channel] |= values
    return ChannelMap.validate_mapping(content, "map")


@pytest.mark.parametrize("name", MAPS)
def test_the_shipped_maps_fit_the_controller_of_the_osprey(name: str) -> None:
    result = CliRunner().invoke(app, ["check-signs", name, "--json"])
    assert result.exit_code == 0
    channels = [(one["output"], one["input"], one["D"]) for one in json.loads(result.stdout)["channels"]]
    assert channels == [("q", "elevator", 1), ("p", "aileron", 1), ("r", "rudder", 1), ("V", "thrust", 1)]


def test_through_a_map_of_the_right_signs_omega_is_that_of_the_airframe() -> None:
    assert AIRFRAME.outputs == ("q", "V", "p", "r")  # as in the maps
    for name in MAPS:
        assert through(load_map(name), OMEGA) == pytest.approx(OMEGA)


@pytest.mark.parametrize("channel", INPUTS)
@pytest.mark.parametrize("name", MAPS)
def test_an_input_with_the_wrong_sign_changes_its_own_d_only(name: str, channel: str) -> None:
    original, k = load_map(name), INPUTS.index(channel)
    row = original.inputs[channel]
    span = sum(row.range)  # the sign changes about the middle, so that trim stays inside the range
    flipped = changed(original, "inputs", channel, sign=-row.sign, offset=row.offset + row.sign * row.scale * span)
    checked = check_osprey(flipped)
    assert [one.D for one in checked.channels] == [-1 if i == k else 1 for i in range(4)]
    assert len(checked.contradictions) == 1
    assert f"D of {OUTPUTS[k]} and {channel} is -1, the controller has +1" in checked.contradictions[0]


@pytest.mark.parametrize("channel", OUTPUTS)
def test_two_wrong_signs_that_cancel_in_d_are_still_a_contradiction(channel: str) -> None:
    k = OUTPUTS.index(channel)
    original = load_map("ardupilot")
    flipped = changed(original, "outputs", channel, sign=-original.outputs[channel].sign)
    checked = check_osprey(changed(flipped, "inputs", INPUTS[k], sign=-original.inputs[INPUTS[k]].sign))
    assert [one.D for one in checked.channels] == [1, 1, 1, 1]
    assert f"outputs.{channel} of the map ardupilot has the wrong sign" in checked.contradictions[0]


def test_the_command_refuses_a_flipped_map_with_a_sentence(tmp_path: Path) -> None:
    path, flipped = tmp_path / "ardupilot.yaml", changed(load_map("ardupilot"), "inputs", "elevator", sign=-1)
    content = json.loads(json.dumps(flipped.model_dump(exclude_none=True)))  # lists in place of tuples, for YAML
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    result = CliRunner().invoke(app, ["check-signs", str(path)])
    assert result.exit_code == 1
    sentence = "error: with the map ardupilot D of q and elevator is -1, the controller has +1: a positive elevator makes"
    assert sentence in result.stderr


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--bridge", "ardupilot", "--lockstep"), "--bridge: found a flight in lockstep or in one process"),
        (("--bridge", "ardupilot", "--in-process"), "--bridge: found a flight in lockstep or in one process"),
        (("--send",), "--send: found no --bridge"),
        (("--bridge", "nowhere"), "map: found 'nowhere', expected one of ardupilot"),
    ],
    ids=lambda one: " ".join(one) if isinstance(one, tuple) else "",
)
def test_options_that_contradict_a_bridge_are_refused(options: tuple[str, ...], sentence: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["fly", "osprey_gust", *options, "--runs", str(tmp_path)])
    assert isinstance(result.exception, ParameterError)
    assert str(result.exception).startswith(sentence)
    assert not list(tmp_path.iterdir())  # refused before a run folder is created


def test_a_map_of_other_channels_or_motions_is_one_sentence() -> None:
    original = load_map("ardupilot")
    with pytest.raises(ParameterError, match=r"outputs\.q\.positive: found 'roll right', .* a motion to which q responds"):
        through(changed(original, "outputs", "q", positive="roll right"), OMEGA)
    with pytest.raises(ParameterError, match=r"inputs\.elevator\.positive: found 'roll right', .* in the airframe p"):
        through(changed(original, "inputs", "elevator", positive="roll right"), OMEGA)


def excited(Omega: FloatArray, noise: float) -> tuple[Signal, Signal]:
    """y_dot = -2 y + Omega u at 100 Hz for 20 s, each input in steps of its own period; exact between samples."""
    generator = np.random.default_rng(1)
    t = 0.01 * np.arange(2000)
    periods = np.array([1.1, 1.7, 2.3, 2.9])
    u = 0.1 * np.sign(np.sin(2.0 * np.pi * t[:, None] / periods))
    y = np.zeros((len(t), 4))
    decay = np.exp(-2.0 * 0.01)
    for k in range(len(t) - 1):
        y[k + 1] = decay * y[k] + (1.0 - decay) / 2.0 * (Omega @ u[k])
    stamps = np.array([nanoseconds(one) for one in t], dtype=np.int64)
    y = y + noise * generator.standard_normal(y.shape)
    return Signal(stamps, OUTPUTS, y), Signal(stamps, INPUTS, u)


def test_an_excited_flight_gives_omega_back() -> None:
    Omega = np.array([[50.0, 1.0, 0.0, 0.0], [0.0, -80.0, 2.0, 0.0], [0.0, 3.0, 10.0, 0.0], [0.5, 0.0, 0.0, -6.0]])
    y, u = excited(Omega, noise=0.0)
    assert estimate(y, u, OUTPUTS, INPUTS).Omega == pytest.approx(Omega, rel=0.1, abs=0.5)  # slopes over 0.05 s of 1 / (2 1/s)


def test_noise_makes_the_estimate_uncertain_but_not_wrong() -> None:
    """With ten times the noise of osprey_servo the strong channels are certain, and no certain sign is wrong."""
    Omega = np.diag([50.0, -80.0, 1.0, -0.1])
    y, u = excited(Omega, noise=0.02)
    measured = estimate(y, u, OUTPUTS, INPUTS)
    diagonal, ratio = np.diag(measured.Omega), np.diag(measured.ratio)
    assert (ratio[:2] > MIN_ERROR_RATIO).all()
    assert ratio[3] < MIN_ERROR_RATIO
    assert all(np.sign(diagonal[k]) == np.sign(Omega[k, k]) for k in range(4) if ratio[k] > MIN_ERROR_RATIO)


def test_a_recorded_flight_of_the_osprey_shows_the_signs_of_its_omega() -> None:
    tape = simulate(find_scenario("osprey_gust").vary(flight={"duration": 28.0}))
    measured = estimate(tape["y"], tape["u"], OUTPUTS, INPUTS)
    assert (np.diag(measured.ratio) > MIN_ERROR_RATIO).all()
    right = load_map("ardupilot")
    assert not check_osprey(right, measured=measured).contradictions
    checked = check_osprey(changed(right, "inputs", "rudder", positive="nose left"), (1, 1, -1, 1), measured)
    assert len(checked.contradictions) == 1
    assert "the recorded flight has r_dot rise with rudder" in checked.contradictions[0]


def test_a_log_with_a_constant_input_or_too_few_samples_is_refused() -> None:
    y, u = excited(np.eye(4), noise=0.0)
    constant = Signal(u.stamp_ns, u.names, u.values * np.array([1.0, 1.0, 0.0, 1.0]))
    with pytest.raises(ParameterError, match=r"u\.rudder of the log: found a value that never changes"):
        estimate(y, constant, OUTPUTS, INPUTS)
    with pytest.raises(ParameterError, match=r"the log: found 2 intervals"):
        estimate(y, u.until(nanoseconds(0.12)), OUTPUTS, INPUTS)
