# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The layouts for Foxglove and PlotJuggler: what they name is in a run, at the place where they look for it.

The formats are held against what the two programs' own sources read; neither program is run here.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.layouts import channels_of, foxglove, plotjuggler
from flight_bringup.scenarios import find_scenario
from flight_core.tape import Tape

LAYOUTS = Path(__file__).resolve().parents[2] / "ros_ws" / "src" / "flight_bringup" / "layouts"
JSON = (LAYOUTS / "osprey_gust.foxglove.json").read_text(encoding="utf-8")
XML = (LAYOUTS / "osprey_gust.plotjuggler.xml").read_text(encoding="utf-8")
OUTPUTS, INPUTS = ("q", "V", "p", "r"), ("elevator", "aileron", "rudder", "thrust")
WANTED = {
    *(f"{topic} {name}" for topic in ("y", "y_m") for name in OUTPUTS),
    *(f"internals {group}.{name}" for group in ("e", "integral_e", "Pi") for name in OUTPUTS),
    *(f"internals {group}.{name}" for group in ("u", "u_free", "limited") for name in INPUTS),
    *(f"internals {name}" for name in ("mode", "late", "age", "dt")),
    "truth gust.vertical",
    "truth gust.lateral",
}


@pytest.fixture(scope="module", params=["osprey_gust", "osprey_servo"])
def tape(request: pytest.FixtureRequest) -> Tape:
    return simulate(find_scenario(request.param).vary(flight={"duration": 0.1}))


def leaves(tree: Any) -> Iterator[str]:
    """Panels of a tree of splits, as react-mosaic has it: a name, or a direction with a first and a second."""
    if isinstance(tree, str):
        yield tree
        return
    assert set(tree) == {"direction", "first", "second", "splitPercentage"}
    assert tree["direction"] in {"row", "column"}
    assert 0 < tree["splitPercentage"] < 100
    yield from leaves(tree["first"])
    yield from leaves(tree["second"])


def test_the_files_are_what_the_command_writes() -> None:
    channels = channels_of(find_scenario("osprey_gust"))
    mend = "write them again: rise-di layouts osprey_gust --folder ros_ws/src/flight_bringup/layouts"
    assert foxglove(channels) == JSON, mend
    assert plotjuggler(channels) == XML, mend


def test_every_path_of_foxglove_leads_to_the_channel_that_its_label_names(tape: Tape) -> None:
    shown = set()
    for panel in json.loads(JSON)["configById"].values():
        for path in panel.get("paths", ()):
            found = re.fullmatch(r"/(\w+)\.position\[(\d+)\]", path["value"])
            assert found is not None, path
            topic, place = found[1], int(found[2])
            assert path["label"] == f"{topic}: {tape[topic].names[place]}"
            shown.add(f"{topic} {tape[topic].names[place]}")
    assert shown >= WANTED


def test_every_panel_of_foxglove_stands_in_one_tab() -> None:
    layout = json.loads(JSON)
    assert layout["layout"] == "Tab!rise_di"
    tabs = layout["configById"]["Tab!rise_di"]["tabs"]
    placed = Counter(name for tab in tabs for name in leaves(tab["layout"]))
    assert set(placed.values()) == {1}
    assert set(placed) == set(layout["configById"]) - {"Tab!rise_di"}
    assert {name.split("!")[0] for name in placed} == {"Plot"}


def test_every_curve_of_plotjuggler_is_a_channel_of_a_run(tape: Tape) -> None:
    shown = set()
    for curve in ElementTree.fromstring(XML).iter("curve"):
        _, topic, channel, position = curve.attrib["name"].split("/")
        assert channel in tape[topic].names
        assert position == "position"
        shown.add(f"{topic} {channel}")
    assert shown >= WANTED


def test_every_splitter_of_plotjuggler_says_how_many_it_holds() -> None:
    root = ElementTree.fromstring(XML)
    splitters = list(root.iter("DockSplitter"))
    assert len(splitters) > 6
    for splitter in splitters:
        assert splitter.attrib["orientation"] in {"|", "-"}
        assert {child.tag for child in splitter} <= {"DockSplitter", "DockArea"}
        assert len(splitter) == int(splitter.attrib["count"]) == len(splitter.attrib["sizes"].split(";"))
    assert all(len(area.findall("plot")) == 1 for area in root.iter("DockArea"))
    assert [tab.attrib["tab_name"] for tab in root.iter("Tab")] == [
        "tracking",
        "error",
        "input",
        "integrals",
        "controller",
        "wind",
    ]
