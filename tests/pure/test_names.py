# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the names of channels, states and inputs.

All files have one grammar, and every text in another language escapes them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.conftest import REPOSITORY, refusing
from tests.maps import MAP_FILES

from aircraft_sim.airframes.airframe import LIBRARY as AIRFRAMES
from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.params import AircraftConfig
from autopilot_bridge.params import ChannelMap
from flight_analysis.closed_loop.scenario import SCHEMAS
from flight_analysis.closed_loop.scenario_library import LIBRARY as SCENARIOS
from flight_core.files import comment, dump_yaml, parse_yaml
from flight_core.parameters import Config
from flight_design.gains.gain_yaml import yaml_flow, yaml_template
from rise_di import new_airframe

FREE = {"conditions", "messages", "overrides", "topics", "fence", "link", "values"}
"""Sections of a map and of guidance whose keys name no channel."""
NAME_KEYS = {
    "states",
    "inputs",
    "outputs",
    "output_units",
    "sensors",
    "effectors",
    "priority",
    "channels",
}
HOSTILE = ("q*/", 'q"', "q\\", "??/", "<q>", "q: 1", "q\n", "1q", "", "q,p", "naïve", "../q")


def places(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of the names of channels, states and inputs in a file.

    Names are entries of a list, or keys of a mapping.
    """
    if not isinstance(tree, dict):
        return []
    found = []
    for key, value in tree.items():
        if key in NAME_KEYS and isinstance(value, (list, dict)):
            found += [(*path, key, name) for name in value if isinstance(name, str)]
        if key not in FREE:
            found += places(value, (*path, key))
    return found


def renamed(tree: Any, path: tuple[Any, ...], name: str) -> Any:
    """Return a copy of a tree with another name at a path."""
    key, *rest = path
    if rest:
        return {**tree, key: renamed(tree[key], tuple(rest), name)}
    if isinstance(tree, list):
        return [name if entry == key else entry for entry in tree]
    return {name if entry == key else entry: value for entry, value in tree.items()}


def sections(path: Path) -> list[tuple[type[Config], dict[str, Any]]]:
    tree = {
        key.removeprefix("/**/"): value["ros__parameters"]
        for key, value in yaml.safe_load(path.read_text()).items()
    }
    return [(SCHEMAS[name], values) for name, values in tree.items()]


FILES = [
    *((Airframe, yaml.safe_load(path.read_text())) for path in sorted(AIRFRAMES.glob("*.yaml"))),
    *((ChannelMap, yaml.safe_load(path.read_text())) for path in MAP_FILES.values()),
    *(section for path in sorted(SCENARIOS.glob("*.yaml")) for section in sections(path)),
]
DOORS = {
    (schema.__name__, *(str(key) for key in path[:-1])): (schema, values, path)
    for schema, values in FILES
    for path in places(values)
    if schema is not AircraftConfig
}
"""A name of each place that has names: the last one of the files. The names in `aircraft` are
compared with the airframe's."""


def test_the_places_are_those_of_channels_states_and_inputs() -> None:
    listed = {".".join(place) for place in DOORS}
    assert {
        "Airframe.states",
        "Airframe.inputs",
        "Airframe.outputs",
        "ChannelMap.inputs",
        "ChannelMap.outputs",
    } <= listed
    assert {
        "AnyLaw.outputs",
        "AnyLaw.inputs",
        "AnyLaw.feedforward.states",
        "AnyLaw.observer.states",
    } <= listed
    assert {"ReferenceModelConfig.outputs", "AnyLaw.allocation.effectors"} <= listed


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("door", DOORS.values(), ids=[".".join(place) for place in DOORS])
def test_name_outside_of_the_grammar_is_refused_at_each_place(
    door: tuple[type[Config], dict[str, Any], tuple[Any, ...]], name: str
) -> None:
    schema, values, path = door
    with refusing(r"expected (a string that matches \[A-Za-z\]|printable characters)"):
        schema.validate_mapping(renamed(values, path, name), "set")


def test_every_file_of_the_repository_has_names_of_the_grammar() -> None:
    """The examples are included, whose files other tests read."""
    files = [
        path
        for path in sorted((REPOSITORY / "examples").rglob("*.yaml"))
        if path not in MAP_FILES.values()
    ]
    names = {path[-1] for file in files for path in places(yaml.safe_load(file.read_text()))}
    assert all(
        name.replace("_", "").replace(".", "").isalnum() and name[0].isalpha() for name in names
    )


@pytest.mark.parametrize("name", ["../osprey", "a/b", "/x"])
def test_airframe_whose_name_leaves_the_folder_is_refused(name: str, tmp_path: Path) -> None:
    """NAME.yaml would be written into the folder that the user gives."""
    source = tmp_path / "source.yaml"
    source.write_text(
        dump_yaml(yaml.safe_load((AIRFRAMES / "osprey.yaml").read_text()) | {"name": name})
    )
    with refusing(r"^name: found .*, expected the name of a file in the folder, without a /$"):
        new_airframe(source, folder=tmp_path / "folder")
    assert [path.name for path in tmp_path.iterdir()] == ["source.yaml"]


TEXTS = (
    "runs/a\n/**/controller: {rate: 1}",
    "a: b",
    "a # b",
    "true",
    "1e3",
    "'",
    '"',
    "- x",
    "\u2028x: 1",
    "osprey",
    "/x-y.yaml",
    "jsbsim:c172p",
    "jsbsim:",
)


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize(
    "write",
    [
        lambda text: comment([f"of {text}"]) + "value: 1\n",
        lambda text: yaml_template("# {{ text | line }}\nvalue: 1\n").render(text=text),
    ],
)
def test_text_stays_in_its_comment_of_yaml(write: Callable[[str], str], text: str) -> None:
    assert parse_yaml(write(text), "", "") == {"value": 1}


@pytest.mark.parametrize("text", TEXTS)
def test_text_in_a_yaml_template_reads_back(text: str) -> None:
    assert parse_yaml(f"value: {yaml_flow(text)}\n", "", "") == {"value": text}
