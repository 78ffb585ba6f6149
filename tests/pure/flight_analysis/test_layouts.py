# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The layouts of `rise-di layouts` for Foxglove and PlotJuggler: format, arrangement, and channels
of a run.

The formats follow the sources of the two programs. Neither program runs here.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from tests.conftest import invoke

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.layouts import MAP_TOPICS, channels_of, foxglove, plotjuggler
from flight_core.tape import Tape

CHANNELS = channels_of(find_scenario("osprey_gust"))
JSON = foxglove({"": CHANNELS})
XML = plotjuggler({"": CHANNELS})
OUTPUTS = ("q", "V", "p", "r")
INPUTS = ("elevator", "aileron", "rudder", "thrust")
CURVES = {
    *(f"{topic} {name}" for topic in ("y", "y_m") for name in OUTPUTS),
    *(f"internals {group}.{name}" for group in ("e", "integral_e", "Pi") for name in OUTPUTS),
    *(f"internals {group}.{name}" for group in ("u", "u_free", "limited") for name in INPUTS),
    *(f"internals {name}" for name in ("mode", "late", "age", "dt")),
    *(f"truth gust.{axis}" for axis in ("longitudinal", "lateral", "vertical")),
}
# title: number of plots
TABS = {"tracking": 4, "error": 4, "input": 4, "integrals": 8, "controller": 4, "wind": 3}
"""The fixed part of a Plot panel of Foxglove."""


@pytest.fixture(scope="module", params=["osprey_gust", "osprey_servo"])
def tape(request: pytest.FixtureRequest) -> Tape:
    """A run; the layout of osprey_gust fits both scenarios."""
    return simulate(find_scenario(request.param, 0.1))


def leaves(tree: Any) -> Iterator[str]:
    """Panels of a tree of splits (react-mosaic): a name, or a direction with a first and a second
    part.
    """
    if isinstance(tree, str):
        yield tree
        return
    assert set(tree) == {"direction", "first", "second", "splitPercentage"}
    assert tree["direction"] in {"row", "column"}
    assert 0 < tree["splitPercentage"] < 100
    for part in ("first", "second"):
        yield from leaves(tree[part])


def test_the_command_writes_both_layouts(tmp_path: Path) -> None:
    result = invoke("layouts", "osprey_gust", "--folder", str(tmp_path / "new"))
    assert result.exit_code == 0, result.output
    files = {path.name: path.read_text() for path in (tmp_path / "new").iterdir()}
    assert files == {"osprey_gust.foxglove.json": JSON, "osprey_gust.plotjuggler.xml": XML}
    assert result.output.split() == [str(tmp_path / "new" / name) for name in sorted(files)]


def test_every_path_of_foxglove_leads_to_channel_that_label_names(tape: Tape) -> None:
    curves = []
    for panel in json.loads(JSON)["configById"].values():
        for path in panel.get("paths", ()):
            parts = re.fullmatch(r"/(\w+)\.position\[(\d+)\]", path["value"])
            assert parts is not None, path
            curve = f"{parts[1]}: {tape[parts[1]].names[int(parts[2])]}"
            assert path["label"] == curve
            curves.append(curve.replace(": ", " "))
    assert Counter(curves) == Counter(CURVES)


def test_every_panel_of_foxglove_stands_in_one_tab() -> None:
    layout = json.loads(JSON)
    assert layout.keys() == {
        "configById",
        "globalVariables",
        "userNodes",
        "playbackConfig",
        "layout",
    }
    assert (layout["globalVariables"], layout["userNodes"], layout["playbackConfig"]) == (
        {},
        {},
        {"speed": 1},
    )
    assert layout["layout"] == "Tab!rise_di"
    tab_panel = layout["configById"]["Tab!rise_di"]
    assert tab_panel.keys() == {"activeTabIdx", "tabs"}
    assert tab_panel["activeTabIdx"] == 0
    placed = {tab["title"]: list(leaves(tab["layout"])) for tab in tab_panel["tabs"]}
    assert {title: len(names) for title, names in placed.items()} == TABS
    assert list(placed) == list(TABS)
    count = Counter(name for names in placed.values() for name in names)
    assert set(count.values()) == {1}
    assert set(count) == set(layout["configById"]) - {"Tab!rise_di"}
    assert {name.split("!")[0] for name in count} == {"Plot"}


def test_every_curve_of_plotjuggler_is_channel_of_run(tape: Tape) -> None:
    curves = []
    for curve in ElementTree.fromstring(XML).iter("curve"):
        root, topic, channel, position = curve.attrib["name"].split("/")
        assert channel in tape[topic].names
        assert (root, position) == ("", "position")
        curves.append(f"{topic} {channel}")
    assert Counter(curves) == Counter(CURVES)


def test_fleet_has_common_map_and_tabs_by_aircraft(tmp_path: Path) -> None:
    """RViz shows each aircraft at the frame that guidance publishes, after REP 105."""
    fleet = tmp_path / "fleet.yaml"
    fleet.write_text("aircraft: {uav1: {}, uav2: {scenario: osprey_gust}, uav3: {}}")
    result = invoke("layouts", str(fleet), "--folder", str(tmp_path))
    assert result.exit_code == 0, result.output
    panels = json.loads((tmp_path / "fleet.foxglove.json").read_text())["configById"]
    assert [tab["title"] for tab in panels["Tab!rise_di"]["tabs"]] == [
        "map",
        "uav1",
        "uav2",
        "uav3",
    ]
    assert set(panels["3D!map"]["topics"]) == {
        f"/{name}/{topic}" for name in ("uav1", "uav3") for topic in MAP_TOPICS
    }
    (tracking,) = (tab for tab in panels["Tab!uav2"]["tabs"] if tab["title"] == "tracking")
    first = panels[next(leaves(tracking["layout"]))]["paths"][0]
    assert (first["value"], first["label"]) == (
        f"/uav2/y.position[{CHANNELS['y'].index('q')}]",
        "y: q",
    )
    tabs = [
        tab.attrib["tab_name"]
        for tab in ElementTree.parse(tmp_path / "fleet.plotjuggler.xml").iter("Tab")
    ]
    assert tabs[len(TABS) + 1 :][: len(TABS)] == [f"uav2 {title}" for title in TABS]
    shown = yaml.safe_load((tmp_path / "fleet.rviz").read_text())["Visualization Manager"]
    models = [display for display in shown["Displays"] if display["Class"].endswith("/RobotModel")]
    assert [(model["TF Prefix"], Path(model["Description File"])) for model in models] == [
        (name, tmp_path / "aircraft.urdf") for name in ("uav1", "uav3")
    ]
    assert (shown["Global Options"]["Fixed Frame"], shown["Views"]["Current"]["Target Frame"]) == (
        "map",
        "uav1/base_link",
    )
    (link,) = ElementTree.parse(tmp_path / "aircraft.urdf").iter("link")
    widths = [float(box.attrib["size"].split()[1]) for box in link.iter("box")]
    assert (link.attrib["name"], max(widths)) == ("base_link", 3.0)  # m, the span
