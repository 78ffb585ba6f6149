# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test replay and report of a flight of which only the controller's section is known.

Users who fly their own aircraft have no section for it.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from tests.conftest import refusing

from flight_analysis.closed_loop.replay import recorded_parameters, replay
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.run_report import rewrite_report
from flight_bringup.fly import fly_and_report
from flight_core.parameter_template import parameter_template
from flight_log.tape_reader import stored_scenario
from rise_di_controller.rise_di_config import RiseDiConfig


@pytest.mark.parametrize("name", ["controller", "/uav7/controller", "/**/controller"])
def test_section_of_controller_is_enough(name: str, osprey_gust: Scenario, tmp_path: Path) -> None:
    flown = fly_and_report(find_scenario(osprey_gust, duration=1.0), tmp_path / "runs")
    sections = yaml.safe_load(osprey_gust.path.read_text())
    alone = tmp_path / "my_params.yaml"
    alone.write_text(yaml.safe_dump({name: sections["/**/controller"]}))
    parameters = recorded_parameters(stored_scenario(alone))
    assert parameters == osprey_gust.controller
    assert replay(flown.mcap, parameters).is_equal()
    result = rewrite_report(flown.mcap.parent, output=tmp_path / "out", scenario=alone)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["scenario"] is None  # nothing is judged by a model of the aircraft
    expected = flown.flight.summary["errors"]
    assert summary["e"].keys() == expected.keys()
    assert "Measured errors" in result.report.read_text()


def test_file_without_controller_is_refused(osprey_gust: Scenario, tmp_path: Path) -> None:
    other = tmp_path / "other.yaml"
    other.write_text("/**/recorder: {ros__parameters: {rate: 50.0}}\n")
    with refusing("controller: found no such section, expected one for each of controller"):
        recorded_parameters(stored_scenario(other))


def test_template_names_what_is_needed_and_reads_back_with_it(osprey_gust: Scenario) -> None:
    text = parameter_template("controller", RiseDiConfig)
    values = yaml.safe_load(text)["/**/controller"]["ros__parameters"]
    given = osprey_gust.controller.model_dump(mode="json", exclude_none=True)
    needed = {name for name in RiseDiConfig.model_fields if f"    # {name}:" in text}
    controller = RiseDiConfig.validate_mapping(
        {**values, **{name: given[name] for name in needed if name in given}}, "controller"
    )
    assert controller == osprey_gust.controller


def test_controller_prints_its_parameters() -> None:
    words = [sys.executable, "-m", "rise_di_controller.main", "--print-parameters"]
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=dict(os.environ))
    assert done.stdout == parameter_template("controller", RiseDiConfig)
