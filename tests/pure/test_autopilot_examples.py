# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The examples of autopilots: airframe, scenario and map fit together. docs/autopilots.md says how they flew."""

import pytest
from tests.conftest import REPOSITORY

from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.design.sign_check import require_signs
from flight_bringup.graph import find_autopilot, require_limits
from flight_bringup.scenarios import find_scenario

EXAMPLES = {"arduplane": "ardupilot", "px4_airplane": str(REPOSITORY / "examples" / "px4_airplane" / "map.yaml")}


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_has_the_signs_and_the_limits_of_its_map_and_tracks_in_simulation(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(REPOSITORY)  # the path of an airframe counts from the working folder
    scenario = find_scenario(str(REPOSITORY / "examples" / name / "scenario.yaml"), 15.0)
    autopilot = find_autopilot(EXAMPLES[name], dry_run=False)
    require_signs(autopilot.channel_map, scenario)
    require_limits(autopilot, scenario)
    tape = simulate(scenario)
    y, y_m = tape["y"], tape["y_m"]
    for output, largest in {"q": 0.1, "V": 1.0, "p": 0.2, "r": 0.2}.items():  # an aircraft that is lost leaves them at once
        assert abs(y[output][: len(y_m.stamp_ns)] - y_m[output][: len(y.stamp_ns)]).max() < largest, output
