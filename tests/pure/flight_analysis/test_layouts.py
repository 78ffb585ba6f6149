# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the shipped layouts of Foxglove and PlotJuggler: each curve is a channel of a flight.

The formats follow the sources of the two programs. Neither program is run here.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator
from importlib.resources import files
from typing import Any
from xml.etree import ElementTree

import pytest

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.tape import Tape
from flight_core.topics import LOG, TOPICS

FOLDER = files("flight_analysis") / "layouts"
FOXGLOVE = json.loads((FOLDER / "osprey.foxglove.json").read_text())
PLOTJUGGLER = ElementTree.fromstring((FOLDER / "osprey.plotjuggler.xml").read_text())
# A tab of the map stands in Foxglove alone.
TABS = ["guidance", "tracking", "error", "input", "integrals", "controller", "wind"]


@pytest.fixture(scope="module", params=["osprey_route", "osprey_servo", "osprey_vanes"])
def tape(request: pytest.FixtureRequest) -> Tape:
    """Return a flight with guidance, one without, and one whose observer has more channels."""
    return simulate(find_scenario(request.param, 0.1))


def foxglove_curves() -> Iterator[tuple[str, int, str]]:
    """Yield the topic, the index in `position`, and the label of each curve of Foxglove."""
    for panel in FOXGLOVE["configById"].values():
        for path in panel.get("paths", ()):
            parts = re.fullmatch(r"/(\w+)\.position\[(\d+)\]", path["value"])
            assert parts is not None, path
            yield parts[1], int(parts[2]), path["label"]


def plotjuggler_curves() -> Iterator[tuple[str, str]]:
    """Yield the topic and the channel of each curve of PlotJuggler."""
    for curve in PLOTJUGGLER.iter("curve"):
        root, topic, channel, field = curve.attrib["name"].split("/")
        assert (root, field) == ("", "position")
        yield topic, channel


def panels_of(tree: Any) -> Iterator[str]:
    """Yield the panels of a tree of splits (react-mosaic).

    A tree is a name, or a direction with two parts.
    """
    if isinstance(tree, str):
        yield tree
        return
    assert set(tree) == {"direction", "first", "second", "splitPercentage"}
    assert tree["direction"] in {"row", "column"}
    assert 0 < tree["splitPercentage"] < 100
    for part in ("first", "second"):
        yield from panels_of(tree[part])


def test_every_curve_of_foxglove_is_the_channel_that_its_label_names(tape: Tape) -> None:
    for topic, index, label in foxglove_curves():
        if topic != "guidance" or topic in tape:
            assert label == f"{topic}: {tape[topic].names[index]}"


def test_every_curve_of_plotjuggler_is_a_channel(tape: Tape) -> None:
    for topic, channel in plotjuggler_curves():
        if topic != "guidance" or topic in tape:
            assert channel in tape[topic].names


def test_both_programs_show_the_same_curves() -> None:
    labels = [label for *_, label in foxglove_curves()]
    assert Counter(labels) == Counter(f"{topic}: {name}" for topic, name in plotjuggler_curves())
    assert {topic for topic, _ in plotjuggler_curves()} == {
        "guidance",
        "internals",
        "truth",
        "y",
        "y_m",
    }


def test_every_panel_of_foxglove_stands_in_one_tab() -> None:
    assert FOXGLOVE["layout"] == "Tab!rise_di"
    panels = dict(FOXGLOVE["configById"])
    tabs = {
        tab["title"]: list(panels_of(tab["layout"])) for tab in panels.pop("Tab!rise_di")["tabs"]
    }
    assert list(tabs) == ["map", *TABS]
    assert Counter(name for names in tabs.values() for name in names) == Counter(panels.keys())


def test_map_of_foxglove_shows_recorded_topics() -> None:
    """The frame `map` is the one of REP 105."""
    panel = FOXGLOVE["configById"]["3D!map"]
    assert panel["followTf"] == "map"
    recorded = {f"/{topic.name}" for topic in TOPICS if LOG in topic.subscribers}
    assert set(panel["topics"]) <= recorded


def test_tabs_of_plotjuggler_are_those_of_foxglove() -> None:
    assert [tab.attrib["tab_name"] for tab in PLOTJUGGLER.iter("Tab")] == TABS
