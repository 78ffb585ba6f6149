# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test parameters with which a node does not start. Each gives a sentence, which is printed."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from tests.conftest import refusing
from tests.nodes.world import EPOCH_NS, world_of

from aircraft_sim.node import AircraftNode
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS
from flight_recorder.node import RecorderNode
from flight_ros.flight_node import FlightNode
from reference_model.node import ReferenceModelNode
from rise_di_controller.node import ControllerNode

NODES: Mapping[str, type[FlightNode[Any]]] = {
    "aircraft": AircraftNode,
    "reference_model": ReferenceModelNode,
    "controller": ControllerNode,
    "recorder": RecorderNode,
}


@pytest.mark.parametrize("name", ["aircraft", "reference_model", "controller"])
def test_node_without_parameters_names_a_missing_one(name: str) -> None:
    with world_of() as world, pytest.raises(ParameterError) as refused:
        world.make(NODES[name])
    assert str(refused.value).startswith(
        f"{name}: found no parameters, expected a section for /{name} in a file"
    )
    assert f"file of --params-file: {name}: missing " in str(refused.value)


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["-p", "k_g:=-1.0"], "controller.k_g: found -1.0, expected greater than 0"),
        (
            ["-p", "controller:max_agee:=1.0"],
            "controller.max_agee: unknown key, expected max_age perhaps",
        ),
        (
            ["-r", "__node:=rise"],
            "rise: found no parameters, expected a section for /rise in a file of --params-file",
        ),
        (
            ["-p", "rate:=0100"],
            "rate: found '0100' in line 1, expected a number without a 0 before it",
        ),
    ],
)
def test_an_invalid_parameter_is_one_sentence(
    arguments: list[str], sentence: str, osprey_gust: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("--params-file", str(osprey_gust.path), *arguments)
    monkeypatch.setattr(sys, "argv", ["controller", "--ros-args", *words])
    with world_of(*words) as world, pytest.raises(ParameterError) as refused:
        world.make(ControllerNode)
    assert str(refused.value).startswith(sentence)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("given", ["-p", "/**", "/*", "/**/*"])
def test_parameter_for_all_nodes_is_left_alone_by_a_node_that_has_no_such(
    given: str, osprey_gust: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SetParameter of a launch file gives a parameter to every node.

    Only the controller has this one.
    """
    file = tmp_path / "all.yaml"
    file.write_text(f"{given}:\n  ros__parameters: {{k_g: 2.0, other: {{depth: 1}}}}\n")
    words = ["--params-file", str(osprey_gust.path), "-p", f"recorder:directory:={tmp_path}/run"]
    by_option = ["-p", "k_g:=2.0", "-p", "other.depth:=1"]
    words += by_option if given == "-p" else ["--params-file", str(file)]
    monkeypatch.setattr(sys, "argv", ["node", "--ros-args", *words])
    with world_of(*words) as world:
        recorder = world.make(RecorderNode)
        controller = world.make(ControllerNode)
        assert controller.parameters.model_dump()["k_g"] == 2.0
        assert not recorder.has_parameter("k_g")
        assert not controller.has_parameter("other.depth")
        assert recorder.parameters.rate == osprey_gust.recorder.rate


def test_all_missing_parameters_are_in_one_sentence(tmp_path: Path) -> None:
    """Values that differ between aircraft have no default, and no other value is asked for."""
    file = tmp_path / "mine.yaml"
    file.write_text("/**/controller:\n  ros__parameters: {rate: 100.0, max_age: 0.2}\n")
    needed = "outputs, inputs, D, input_scale, lag, k_g, k_d, Lambda, beta"
    with (
        world_of("--params-file", str(file)) as world,
        refusing(rf"^controller: missing {needed}, expected a value for each$"),
    ):
        world.make(ControllerNode)


@pytest.mark.parametrize("name", ["aircraft", "reference_model"])
@pytest.mark.parametrize("ago, refused", [(11.0, True), (9.0, False)])
def test_start_time_long_ago_is_refused(
    name: str, ago: float, refused: bool, osprey_gust: Scenario
) -> None:
    """A late node makes up for missed ticks, but not for those of more than 10 s."""
    now = 1000.0 + EPOCH_NS / NANOSECONDS
    with world_of(
        "--params-file", str(osprey_gust.path), "-p", f"start_time:={now - ago}"
    ) as world:
        if refused:
            with refusing(rf"{name}\.start_time: found an instant 11 s ago, expected a future one"):
                world.start(NODES[name])
        else:
            world.start(NODES[name])


def test_recorder_that_cannot_write_names_folder(osprey_gust: Scenario) -> None:
    words = ("--params-file", str(osprey_gust.path), "-p", "directory:=/proc/nowhere")
    refusal = r"^recorder\.directory: /proc/nowhere cannot be written"
    with world_of(*words) as world, refusing(refusal):
        world.make(RecorderNode)
