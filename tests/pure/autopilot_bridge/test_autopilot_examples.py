# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that airframe, scenario and map of each example of an autopilot fit together.

docs/autopilots-reference.md says how they flew.
"""

import shutil
from pathlib import Path

import pytest
from tests.conftest import REPOSITORY, refusing

from aircraft_sim.airframes.airframe import load_airframe
from autopilot_bridge.params import load_map
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_bringup.graph import AIRCRAFT, find_autopilot, parameter_overrides, require_limits
from flight_cli.bridge_experiment import guided_scenario
from flight_design.identification.sign_check import require_signs

EXAMPLE = "examples/arduplane/scenario.yaml"
OF_PX4 = ("px4_airplane", "px4_quadrotor")
EXAMPLES = {"arduplane": "ardupilot"} | {
    name: str(REPOSITORY / "examples" / name / "map.yaml") for name in OF_PX4
}
# An aircraft that is lost leaves them at once.
LARGEST = {"q": 0.1, "V": 1.0, "p": 0.2, "r": 0.2, "vertical_speed": 1.0}


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_has_signs_and_limits_of_map_and_tracks_in_simulation(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The example can be flown from any working folder."""
    monkeypatch.chdir(tmp_path)
    scenario = find_scenario(str(REPOSITORY / "examples" / name / "scenario.yaml"), 15.0)
    autopilot = find_autopilot(EXAMPLES[name], dry_run=False)
    require_signs(autopilot.channel_map, scenario)
    require_limits(autopilot, scenario)
    tape = simulate(scenario)
    y = tape["y"]
    y_m = tape["y_m"]
    for output in y.names:
        assert (
            abs(y[output][: len(y_m.stamp_ns)] - y_m[output][: len(y.stamp_ns)]).max()
            < LARGEST[output]
        ), output


def test_copy_of_scenario_takes_the_airframe_beside(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A copy in another folder flies the airframe of the sources, unless one lies beside it."""
    example = REPOSITORY / "examples" / "arduplane"
    copy = tmp_path / "mine" / "my_scenario.yaml"
    copy.parent.mkdir()
    shutil.copyfile(example / "scenario.yaml", copy)
    monkeypatch.chdir(tmp_path)
    shipped = find_scenario(str(copy))
    assert shipped.aircraft.airframe == "examples/arduplane/airframe.yaml"
    assert load_airframe(shipped.aircraft.airframe).name == "arduplane"
    beside = copy.parent / "airframe.yaml"
    text = (example / "airframe.yaml").read_text()
    beside.write_text(text.replace("name: arduplane", "name: mine", 1))
    scenario = find_scenario(str(copy))
    assert load_airframe(scenario.aircraft.airframe).name == "mine"
    overrides = parameter_overrides(AIRCRAFT, scenario, tmp_path, 0.0, lockstep=False)
    assert overrides["airframe"] == str(beside)


def test_identified_scenario_flies_under_guidance_where_map_has_a_pose(tmp_path: Path) -> None:
    text = (REPOSITORY / "examples" / "arduplane" / "scenario.yaml").read_text()
    path = tmp_path / "guided.yaml"
    written = guided_scenario(text, load_map("ardupilot_mavlink"), 23.9)
    assert written is not None
    path.write_text(written)
    guided = find_scenario(str(path))
    assert guided.guidance is not None
    assert guided.guidance.speed == 23.9
    assert guided.reference_model.pulses == {}
    assert guided.controller == find_scenario(str(REPOSITORY / EXAMPLE)).controller
    assert guided_scenario(text, load_map(EXAMPLES["px4_quadrotor"]), None) is None


def test_limits_of_u_beyond_those_of_map_refused_before_flight_that_sends() -> None:
    """The bridge would clip u, and the integrals of the law would continue."""
    scenario = find_scenario(str(REPOSITORY / "examples" / "px4_airplane" / "scenario.yaml"))
    wide = scenario.vary(controller={"upper": [0.13, 0.14, 0.13, 0.202]})
    with refusing(
        r"controller\.upper: found 0\.14, expected at most 0\.13, the upper limit of aileron"
    ):
        require_limits(find_autopilot(EXAMPLES["px4_airplane"], dry_run=False), wide)
    require_limits(find_autopilot(EXAMPLES["px4_airplane"], dry_run=True), wide)


def test_controller_that_holds_u_while_it_is_inactive_refused_before_flight_that_sends() -> None:
    """The bridge deactivates it before an engagement, which needs a u near trim."""
    shipped = find_scenario(str(REPOSITORY / "examples" / "px4_airplane" / "scenario.yaml"))
    scenario = shipped.vary(controller={"on_deactivate": "hold"})
    with refusing(r"controller\.on_deactivate: found 'hold', expected 'trim' with a bridge"):
        require_limits(find_autopilot(EXAMPLES["px4_airplane"], dry_run=False), scenario)
