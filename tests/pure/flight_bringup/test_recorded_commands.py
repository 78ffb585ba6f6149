# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a recorded command is found beside the scenario, and its values in the log."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from pytest import approx
from scipy.signal import lsim
from tests.conftest import refusing

import rise_di
from flight_analysis.closed_loop.scenario_library import LIBRARY

STICK = "time,value\n0,0\n0.5,0.02\n0.8,0.02\n1.1,-0.01\n"


@pytest.fixture
def scenario_file(tmp_path: Path) -> Path:
    """Return a scenario with the file stick.csv beside it, outside of the working folder."""
    content = yaml.safe_load((LIBRARY / "osprey_servo.yaml").read_text())
    commands = content["/**/reference_model"]["ros__parameters"]
    commands.pop("pulses")
    commands["recorded"] = {"q": {"file": "stick.csv"}}
    content["/**/flight"]["ros__parameters"]["duration"] = 1.5
    file = tmp_path / "scenarios" / "stick.yaml"
    file.parent.mkdir()
    file.write_text(yaml.safe_dump(content))
    (file.parent / "stick.csv").write_text(STICK)
    return file


def test_flight_of_a_recorded_command_is_flown_again_from_its_log_alone(
    scenario_file: Path, tmp_path: Path
) -> None:
    flight = rise_di.fly(rise_di.find_scenario(scenario_file), runs=tmp_path / "runs")
    (scenario_file.parent / "stick.csv").unlink()
    log = flight.mcap.rename(tmp_path / "alone.mcap")
    again = rise_di.recorded_scenario(log)
    recorded = again.reference_model.recorded["q"]
    assert recorded.source.endswith("scenarios/stick.csv")
    assert (recorded.time, recorded.value) == ((0.0, 0.5, 0.8, 1.1), (0.0, 0.02, 0.02, -0.01))
    flown = flight.flight.tape["y_m"]
    assert np.array_equal(rise_di.simulate(again)["y_m"].values, flown.values)
    # the model of q is 16 / (s^2 + 7.2 s + 16); lsim is exact for a piecewise linear input whose
    # corners are samples
    t = np.arange(len(flown.values)) / 500.0
    stick = np.interp(t, recorded.time, recorded.value)
    assert flown["q"] == approx(lsim(([16.0], [1.0, 7.2, 16.0]), stick, t)[1], abs=1e-9)


def test_file_in_place_of_the_values_of_another_refused(scenario_file: Path) -> None:
    scenario = rise_di.find_scenario(scenario_file)
    recorded = scenario.reference_model.recorded["q"].model_dump() | {"file": "other.csv"}
    found = "found a file together with source, time, value"
    with refusing(f"recorded.q.file: {found}, expected a file alone"):
        scenario.vary(reference_model={"recorded": {"q": recorded}})


def test_missing_file_of_a_recorded_command_refused(scenario_file: Path) -> None:
    (scenario_file.parent / "stick.csv").unlink()
    with refusing("reference_model.recorded.q.file: stick.csv: cannot be read"):
        rise_di.find_scenario(scenario_file)
