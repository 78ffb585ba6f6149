# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""From a channel map to gains without a model: experiment, response, and a scenario that flies the aircraft."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aircraft_sim.airframe import load_airframe
from aircraft_sim.params import AircraftParameters
from autopilot_bridge.params import load_map
from flight_analysis.closed_loop.scenario import Scenario, load_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.design.bridge_identification import (
    channel_pairs,
    experiment,
    flying_scenario,
)
from flight_analysis.design.response_identification import Response, identify_response
from flight_analysis.metrics import best_error, engaged_spans, error_metrics
from flight_bringup.scenarios import find_scenario
from flight_core.parameters import ParameterError
from flight_core.vectors import FloatArray

MAP, SPEED, DELAY = load_map("ardupilot"), 25.0, 0.05  # m/s; s, by which y is late
OSPREY = load_airframe("osprey")


def aircraft() -> AircraftParameters:
    """The osprey with servos and noise, and y late by DELAY: what the map's aircraft is not known to be."""
    servo = find_scenario("osprey_servo")
    sensors = servo.aircraft.sensors.model_dump() | {"delay": DELAY}
    return servo.vary(aircraft={"gusts": {}, "rate": 100.0, "step": 0.005, "sensors": sensors}).aircraft


def loaded(folder: Path, name: str, airframe: str, scenario: str) -> Scenario:
    """A scenario and its airframe as files, as the command writes them, with the real aircraft in the airframe's place."""
    (folder / f"{name}_airframe.yaml").write_text(airframe, encoding="utf-8")
    (folder / f"{name}.yaml").write_text(scenario, encoding="utf-8")
    return replace(load_scenario(folder / f"{name}.yaml"), aircraft=aircraft())


@pytest.fixture(scope="module")
def response(tmp_path_factory: pytest.TempPathFactory) -> Response:
    folder = tmp_path_factory.mktemp("experiment")
    planned = experiment(MAP, SPEED, 0.15, str(folder / "experiment_airframe.yaml"), wait=1.0)
    tape = simulate(loaded(folder, "experiment", planned.airframe, planned.scenario))
    pairing, _ = channel_pairs(MAP)
    return identify_response(tape["y"], tape["u"], pairing.outputs, pairing.inputs, engaged=engaged_spans(tape))


def test_the_response_of_an_unknown_aircraft_is_identified(response: Response) -> None:
    rows = [OSPREY.outputs.index(name) for name in response.outputs]
    columns = [list(OSPREY.inputs).index(name) for name in response.inputs]
    known = np.diag((OSPREY.matrix_c() @ OSPREY.matrix_b())[np.ix_(rows, columns)])
    assert response.refusal == ("",) * 4
    found = np.diag(response.Omega)
    np.testing.assert_allclose(found, known, rtol=0.15)
    # four standard errors: one flight in 16,000 is further away
    assert (np.abs(found - known) < 4.0 * np.diag(response.Omega_deviation)).all()
    lag = np.array([0.02 if name != "thrust" else 0.1 for name in response.inputs])
    # u is held for a period of 10 ms, so that it acts half of one late
    np.testing.assert_allclose(response.lag + response.delay, lag + DELAY + 0.005, atol=0.03)


def test_the_written_scenario_flies_the_aircraft_and_tracks(response: Response, tmp_path: Path) -> None:
    selection, airframe, text = flying_scenario(MAP, response, SPEED, str(tmp_path / "flight_airframe.yaml"))
    assert selection.engineering.controller.D == (1, 1, 1, 1)
    tape = simulate(loaded(tmp_path, "flight", airframe, text))
    _, error = best_error(tape)
    rms = {name: error_metrics(error[name]).rms for name in error.names}
    # the figures that a first flight of an autopilot is asked for: 10, 20, 15 mrad/s in q, p, r and 0.05 m/s
    assert rms["q"] < 0.010
    assert rms["p"] < 0.020
    assert rms["r"] < 0.015
    assert rms["V"] < 0.06


def test_a_longer_delay_lowers_the_bandwidths(response: Response, tmp_path: Path) -> None:
    def bandwidths(found: Response) -> FloatArray:
        selection, *_ = flying_scenario(MAP, found, SPEED, str(tmp_path / "airframe.yaml"))
        return np.asarray(selection.engineering.controller.law_params().K)

    assert (bandwidths(response._replace(delay=response.delay + 0.1)) < bandwidths(response)).all()


def test_a_refused_channel_and_a_sign_against_the_map_write_nothing(response: Response) -> None:
    refused = response._replace(refusal=("", "V by thrust: found no movement, expected one", "", ""))
    with pytest.raises(ParameterError, match=r"^V by thrust: found no movement, expected one$"):
        flying_scenario(MAP, refused, SPEED, "airframe.yaml")
    flipped = response._replace(Omega=response.Omega * np.array([1.0, 1.0, -1.0, 1.0]))
    sentence = r"inputs\.aileron: found p_dot that falls with aileron, expected the opposite: change `sign`"
    with pytest.raises(ParameterError, match=sentence):
        flying_scenario(MAP, flipped, SPEED, "airframe.yaml")


def test_an_experiment_stays_within_a_part_of_the_limits_of_the_map() -> None:
    planned = experiment(MAP, SPEED, 0.2, "airframe.yaml").controller
    for name, amplitude in zip(planned.inputs, planned.amplitude, strict=True):
        row = MAP.inputs[name]
        assert amplitude == pytest.approx(0.2 * min(-row.lower, row.upper))
