# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that scenario files are read as rcl reads ROS parameter files.

The expected values were read by nodes of rclpy 7.1 from the same sections. A later section of a
node replaces the values that it has in common with an earlier one, whatever the names are, and
keeps the rest.
"""

import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.node import Node
from tests.conftest import refusing

from flight_analysis.closed_loop.scenario import Scenario, load_scenario, parse_scenario_sections
from flight_analysis.closed_loop.scenario_library import as_flown
from flight_bringup.fleet import is_fleet


def with_sections(scenario: Scenario, named: str, further: str = "", first: str = "") -> str:
    """Return the text of a scenario with other names of its sections, and with further sections."""
    text = re.sub(
        r"^/\*\*/(\w+):$",
        lambda match: named.replace("NODE", match[1]),
        scenario.path.read_text(),
        flags=re.MULTILINE,
    )
    return f"{first}\n{text}\n{further}\n"


def section(name: str, **values: object) -> str:
    return yaml.safe_dump({name: {"ros__parameters": values}})


# by form: names of the sections, sections before, sections after, k_g of the controller
FORMS: Mapping[str, tuple[str, str, str, float]] = {
    "any namespace": ("/**/NODE:", "", "", 1.0),
    "plain": ("NODE:", "", "", 1.0),
    "root": ("/NODE:", "", "", 1.0),
    "as ros2 param dump": ("/uav7/NODE:", "", "", 1.0),
    "one name of a namespace": ("/*/NODE:", "", "", 1.0),
    "special after general": ("/**/NODE:", "", section("controller", k_g=2.0), 2.0),
    "special before general": ("/**/NODE:", section("/controller", k_g=2.0), "", 1.0),
    "all nodes before": ("/**/NODE:", section("/**", k_g=2.0, depth=3), "", 1.0),
    "all nodes after": ("/**/NODE:", "", section("/**", k_g=2.0, depth=3), 2.0),
    "all nodes of the root": ("/**/NODE:", "", section("/*", k_g=2.0), 2.0),
    "foreign nodes": ("NODE:", section("amcl", k_g=5.0), section("/a/b/c", k_g=6.0), 1.0),
    "dotted names": (
        "/**/NODE:",
        "",
        section("controller", **{"probe.window": 6.0, "k_g": 2.0}),
        2.0,
    ),
    "parameters of ROS": (
        "/**/NODE:",
        section("/**", use_sim_time=False, start_type_description_service=False),
        "",
        1.0,
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_form_of_parameter_file_is_a_scenario(
    form: str, osprey_gust: Scenario, tmp_path: Path
) -> None:
    named, first, further, k_g = FORMS[form]
    path = tmp_path / "form.yaml"
    path.write_text(with_sections(osprey_gust, named, further, first))
    assert not is_fleet(path)
    scenario = load_scenario(path)
    assert scenario.rise_di().k_g == k_g
    assert scenario.rise_di().Lambda == osprey_gust.rise_di().Lambda
    assert scenario.aircraft == osprey_gust.aircraft
    assert scenario.recorder == osprey_gust.recorder


@pytest.mark.parametrize("namespace", ["", "/uav7"])
@pytest.mark.parametrize("form", FORMS)
def test_nodes_read_from_file_of_flight_what_was_validated(
    form: str, namespace: str, osprey_gust: Scenario, tmp_path: Path
) -> None:
    """With this file, a node of rclpy has the same values as the scenario."""
    named, first, further, k_g = FORMS[form]
    path = tmp_path / "form.yaml"
    path.write_text(with_sections(osprey_gust, named, further, first))
    (tmp_path / "run").mkdir()
    flown = as_flown(load_scenario(path), tmp_path / "run", namespace)
    assert as_read_by_ros(flown.path, namespace)["k_g"] == k_g
    # what rcl reads from the user's own file is what the sections of this namespace say
    read = as_read_by_ros(path, namespace)
    try:
        sections: Mapping[str, Any] = parse_scenario_sections(path.read_bytes(), path, namespace)
    except ValueError:
        assert "rate" not in read  # the file has nothing for this namespace
    else:
        assert read["k_g"] == sections["controller"]["k_g"]


def as_read_by_ros(path: Path, namespace: str) -> dict[str, Any]:
    """Return the parameters that rclpy gives to the controller, by dotted name."""
    words = [sys.argv[0], "--ros-args", "--params-file", str(path)]
    words += ["-r", f"__ns:={namespace}"] if namespace else []
    context = Context()
    rclpy.init(args=words, context=context)
    try:
        node = Node(
            "controller", context=context, automatically_declare_parameters_from_overrides=True
        )
        values = {name: each.value for name, each in node.get_parameters_by_prefix("").items()}
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
    return values


def test_simulated_time_of_any_node_is_that_of_the_flight(
    osprey_gust: Scenario, tmp_path: Path
) -> None:
    path = tmp_path / "clock.yaml"
    path.write_text(with_sections(osprey_gust, "NODE:", "", section("/**", use_sim_time=True)))
    assert load_scenario(path).flight.use_sim_time
    assert not osprey_gust.flight.use_sim_time


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("controller: 5", r"controller: found no parameters under ros__parameters"),
        ("controller: {k: 1}", r"controller: found no parameters under ros__parameters"),
        ("a: {ros__parameters: {}, b: {}}", r"a: found no parameters under ros__parameters"),
        (
            "/uav1/controller: {ros__parameters: {}}\n/uav2/controller: {ros__parameters: {}}",
            r"controller: found sections in /uav1 and in /uav2, expected sections in one namespace",
        ),
    ],
)
def test_sections_that_no_node_can_take_are_refused(
    text: str, sentence: str, osprey_gust: Scenario, tmp_path: Path
) -> None:
    path = tmp_path / "bad.yaml"
    sections = re.sub(
        r"^/\*\*/controller:", "/**/other:", osprey_gust.path.read_text(), flags=re.MULTILINE
    )
    path.write_text(f"{sections}\n{text}\n")
    with refusing(sentence):
        load_scenario(path)


def test_defaults_are_those_of_the_shipped_scenarios(osprey_gust: Scenario) -> None:
    """A controller only needs the values that differ from aircraft to aircraft."""
    values = osprey_gust.controller.model_dump()
    obvious = ("hold", "ramp", "max_age", "sign", "softening", "delay")
    bare = {name: value for name, value in values.items() if name not in (*obvious, "omega")}
    controller = type(osprey_gust.controller).validate_mapping(bare, "controller")
    for name in obvious:
        assert getattr(controller, name) == values[name]
    assert controller.model_dump()["omega"] == (1.0, 1.0, 1.0, 1.0)
