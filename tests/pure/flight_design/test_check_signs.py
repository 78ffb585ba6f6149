# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test `rise-di check`: a map with a wrong sign is refused before anything is sent."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tests.conftest import REPOSITORY, invoke, refusing
from tests.maps import MAP_FILES, named_map

from aircraft_sim.airframes.airframe import load_airframe
from autopilot_bridge.params import ChannelMap, load_map
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.run_folder import attachments_for
from flight_core.rates import nanoseconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_design.identification.response_identification import Response, identify_response
from flight_design.identification.sign_check import (
    SignCheck,
    check_signs,
    recorded_response,
    through,
)
from flight_log.tape_writer import write_run
from rise_di_controller.laws import AnyLaw

pytestmark = pytest.mark.slow

MAPS = sorted(MAP_FILES)
OUTPUTS = ("q", "p", "r", "V")
INPUTS = ("elevator", "aileron", "rudder", "thrust")
AIRFRAME = load_airframe("osprey")
OMEGA: FloatArray = AIRFRAME.matrix_c() @ AIRFRAME.matrix_b()


def check_osprey(
    channel_map: ChannelMap, D: tuple[int, ...] = (1, 1, 1, 1), measured: Response | None = None
) -> SignCheck:
    return check_signs(channel_map, OMEGA, OUTPUTS, INPUTS, D, measured)


def changed(original: ChannelMap, kind: str, channel: str, **values: Any) -> ChannelMap:
    content = original.model_dump()
    content[kind][channel] |= values
    return ChannelMap.validate_mapping(content, "map")


@pytest.mark.parametrize("name", MAPS)
def test_shipped_maps_fit_controller_of_osprey(name: str) -> None:
    result = invoke("check", MAP_FILES[name], "--json")
    assert result.exit_code == 0
    channels = [
        (channel["output"], channel["input"], channel["D"])
        for channel in json.loads(result.stdout)["channels"]
    ]
    assert channels == [
        ("q", "elevator", 1),
        ("p", "aileron", 1),
        ("r", "rudder", 1),
        ("V", "thrust", 1),
    ]


def test_through_map_of_right_signs_omega_is_that_of_airframe() -> None:
    assert AIRFRAME.outputs == ("q", "V", "p", "r")  # as in the maps
    for name in MAPS:
        assert through(named_map(name), OMEGA) == pytest.approx(OMEGA)


@pytest.mark.parametrize("channel", INPUTS)
@pytest.mark.parametrize("name", MAPS)
def test_input_with_wrong_sign_changes_own_d_only(name: str, channel: str) -> None:
    original = named_map(name)
    k = INPUTS.index(channel)
    row = original.inputs[channel]
    span = sum(row.range)  # the sign changes about the middle, so that trim stays inside the range
    flipped = changed(
        original, "inputs", channel, sign=-row.sign, offset=row.offset + row.sign * row.scale * span
    )
    check = check_osprey(flipped)
    assert [channel.D for channel in check.channels] == [-1 if i == k else 1 for i in range(4)]
    assert len(check.contradictions) == 1
    assert (
        f"D of {OUTPUTS[k]} and {channel} is -1, the controller has +1" in check.contradictions[0]
    )


@pytest.mark.parametrize("channel", OUTPUTS)
def test_two_wrong_signs_that_cancel_in_d_are_still_contradiction(channel: str) -> None:
    k = OUTPUTS.index(channel)
    original = load_map("ardupilot")
    flipped = changed(original, "outputs", channel, sign=-original.outputs[channel].sign)
    check = check_osprey(
        changed(flipped, "inputs", INPUTS[k], sign=-original.inputs[INPUTS[k]].sign)
    )
    assert [channel.D for channel in check.channels] == [1, 1, 1, 1]
    assert f"outputs.{channel} of the map ardupilot has the wrong sign" in check.contradictions[0]


def test_command_refuses_flipped_map_with_sentence(tmp_path: Path) -> None:
    path = tmp_path / "ardupilot.yaml"
    flipped = changed(load_map("ardupilot"), "inputs", "elevator", sign=-1)
    # lists in place of tuples, for YAML
    content = json.loads(json.dumps(flipped.model_dump(exclude_none=True)))
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    result = invoke("check", path)
    assert result.exit_code == 1
    sentence = (
        "error: with the map ardupilot D of q and elevator is -1, the controller has +1: "
        "a positive elevator means nose"
    )
    assert sentence in result.stderr


def test_channels_of_quadrotor_go_by_their_motions() -> None:
    folder = REPOSITORY / "examples" / "px4_quadrotor"
    hover = load_map(str(folder / "map.yaml"))
    frame = load_airframe(str(folder / "airframe.yaml"))
    Omega = frame.matrix_b()
    # outputs are the states, in one order
    np.testing.assert_array_equal(through(hover, Omega), Omega)
    climbs = changed(hover, "inputs", "thrust", positive="climbs")  # of a raw value that sinks
    np.testing.assert_array_equal(through(climbs, Omega), Omega * [1.0, -1.0, 1.0, 1.0])
    with refusing(r"outputs\.p\.positive: found 'climbs', expected a motion to which p responds"):
        through(changed(hover, "outputs", "p", positive="climbs"), Omega)


# Recorded flights, with the servos' lags, a delay of 0.15 s as on an autopilot, and moderate
# turbulence.

DELAY = 0.15  # s
LOOP = {"rate": 50.0, "delay": DELAY, "max_age": 0.4, "hold": 0.5, "ramp": 2.0}
EXCITATION = {  # half a minute in all
    "law": "excitation", "amplitude": [0.04, 0.04, 0.1, 0.2], "width": [0.3, 0.3, 0.4, 1.0],
    "period": [4.0, 4.0, 4.0, 6.0],
    "lowest": [0.3, 0.3, 0.3, 0.15], "highest": [2.5, 2.5, 2.5, 0.8], "pause": 0.5,
}  # fmt: skip


@pytest.fixture(scope="module")
def experiment() -> Tape:
    """Return the osprey in an experiment.

    y is stamped when it arrives, and u when it is computed.
    """
    base = find_scenario("osprey_servo")
    shared = {
        key: getattr(base.controller, key)
        for key in ("outputs", "inputs", "D", "input_scale", "lag", "lower", "upper")
    }
    turbulence = {"altitude": 100.0, "wind": 15.4, "seed": 1}
    sensors = {"noise": base.aircraft.sensors.noise, "delay": DELAY, "seed": 1}
    values = shared | LOOP | EXCITATION
    aircraft = {
        "rate": 100.0,
        "step": 0.005,
        "gusts": {},
        "turbulence": turbulence,
        "sensors": sensors,
    }
    flight = base.vary(
        flight={"duration": 36.0}, aircraft=aircraft, reference_model={"rate": 100.0}
    )
    flight = replace(flight, controller=AnyLaw.validate_mapping(values, "controller"))
    tape = simulate(flight)
    signals = dict(tape.signals)
    for topic in ("y", "u"):  # both have the stamp of the measurement, which arrives later
        signals[topic] = replace(tape[topic], stamp_ns=tape[topic].stamp_ns + nanoseconds(DELAY))
    return Tape(signals)


def response(tape: Tape, excitation: Signal | None) -> Response:
    return identify_response(tape["y"], tape["u"], OUTPUTS, INPUTS, excitation=excitation)


def turned(signal: Signal, name: str) -> Signal:
    """Return a signal with one channel reversed, as a wrong row of a map would record it."""
    return Signal(
        signal.stamp_ns,
        signal.names,
        signal.values * np.where(np.array(signal.names) == name, -1.0, 1.0),
    )


def test_an_experiment_in_turbulence_shows_every_sign(experiment: Tape) -> None:
    check = check_osprey(load_map("ardupilot"), measured=response(experiment, None))
    assert not check.contradictions
    assert not check.uncertain
    # within a factor of two of C B: enough for a sign; the elevator's is spread by the short period
    # of 10 rad/s
    responses = np.array([channel.measured for channel in check.channels])
    assert (np.abs(np.log2(responses / [channel.effect for channel in check.channels])) < 1.0).all()


@pytest.mark.parametrize("topic, k", [("u", 0), ("y", 3)])
def test_each_wrong_sign_found_in_experiment(experiment: Tape, topic: str, k: int) -> None:
    name = {"u": INPUTS, "y": OUTPUTS}[topic][k]
    wrong = Tape({**experiment.signals, topic: turned(experiment[topic], name)})
    check = check_osprey(load_map("ardupilot"), measured=response(wrong, None))
    assert len(check.contradictions) == 1
    assert (
        f"the recorded flight has {OUTPUTS[k]}_dot fall with {INPUTS[k]}" in check.contradictions[0]
    )


def test_flight_under_guidance_refused_since_commands_follow_y(tmp_path: Path) -> None:
    scenario = find_scenario("osprey_route", 1.0)
    (tmp_path / "run").mkdir()
    write_run(simulate(scenario), tmp_path / "run", attachments_for(scenario, tmp_path / "run"))
    with refusing(
        "found a flight under guidance, whose y_m follows y, "
        "expected an experiment, or a flight without guidance$"
    ):
        recorded_response(tmp_path / "run", OUTPUTS, INPUTS)


def test_flight_that_does_not_show_sign_says_which_input_to_excite(experiment: Tape) -> None:
    u = experiment["u"]
    at_trim = replace(u, values=u.values * [name != "rudder" for name in u.names])
    tape = Tape({**experiment.signals, "u": at_trim})
    check = check_osprey(load_map("ardupilot"), measured=response(tape, None))
    assert not check.contradictions
    assert len(check.uncertain) == 1
    assert (
        "the recorded flight does not show the sign of rudder: r by rudder: found rudder constant"
        in check.uncertain[0]
    )
