# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Layouts of Foxglove and PlotJuggler for the runs of a scenario.

Foxglove addresses a channel by the index in `position`, PlotJuggler by the name. A layout therefore fits every scenario with
the same channels in the same order.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple
from xml.etree import ElementTree

from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario import Scenario
from flight_guidance import guidance
from rise_di_controller import internals

COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#ff7f0e", "#9467bd", "#8c564b")
COLUMNS = 2
MAP = "3D!map"
"""The 3-D panel of a guided flight: route and aircraft in the frame `map`, ENU."""
MAP_TOPICS = ("/odometry", "/path", "/markers")
CAMERA_DISTANCE, GRID_SIZE = 3000.0, 10_000.0  # m


class Plot(NamedTuple):
    """Curves over time in a pair of axes, SI and radians."""

    title: str
    curves: tuple[tuple[str, str], ...]  # topic and channel


class Tab(NamedTuple):
    """Plots on a screen."""

    title: str
    plots: tuple[Plot, ...]


def channels_of(scenario: Scenario) -> dict[str, tuple[str, ...]]:
    """The channels of the topics of a run, in their order."""
    controller = scenario.controller
    guided = {} if scenario.guidance is None else {"guidance": guidance.names(scenario.guidance.outputs)}
    return guided | {
        "y": tuple(scenario.aircraft.channels().outputs),
        "y_m": scenario.reference_model.outputs,
        "u": controller.effectors,
        "internals": internals.names(controller.logged_groups()),
        "truth": tuple(Simulator(scenario.aircraft).truth_names),
    }


def tabs_of(channels: Mapping[str, Sequence[str]]) -> tuple[Tab, ...]:
    """The tabs: y over y_m and e by output, u with u_free, integral_e and Pi, state and timing of the controller, the wind.

    A guided flight has a further tab, of the commands and measurements of guidance.
    """
    outputs, wind = channels["y_m"], [name for name in channels["truth"] if name.startswith("gust.")]
    inputs = [name.removeprefix("u_free.") for name in channels["internals"] if name.startswith("u_free.")]
    integrals = [f"{group}.{name}" for name in outputs for group in ("integral_e", "Pi")]
    integrals = [name for name in integrals if name in channels["internals"]]  # another law may have neither

    def log(title: str, *names: str) -> Plot:
        return Plot(title, tuple(("internals", name) for name in names))

    def guided(title: str, *names: str) -> Plot:
        return Plot(title, tuple(("guidance", name) for name in names))

    held = (
        guided("altitude: target, flown (m)", "target.altitude", "pose.altitude"),
        guided("V about trim: command, flown (m/s)", "u_m.V", "y.V"),
        guided("phi: command, flown (rad)", "phi_c", "pose.phi"),
        guided("theta: command, flown (rad)", "theta_c", "pose.theta"),
        guided("cross-track error (m)", "xtrack"),
        guided("modes: lateral, vertical; leg", "mode.lateral", "mode.vertical", "leg"),
    )
    return (
        *([Tab("guidance", held)] if "guidance" in channels else []),
        Tab("tracking", tuple(Plot(f"{name}: y, y_m", (("y", name), ("y_m", name))) for name in outputs)),
        Tab("error", tuple(log(f"e {name}", f"e.{name}") for name in outputs)),
        Tab("input", tuple(log(f"u {name}: u_free, u", f"u_free.{name}", f"u.{name}") for name in inputs)),
        Tab("integrals", tuple(log(name.replace(".", " "), name) for name in integrals)),
        Tab(
            "controller",
            (
                log("mode: 1 engaged, 2 hold, 3 ramp, 4 trim, 5 inactive", "mode"),
                log("saturation: 1 magnitude, 2 rate", *(f"limited.{name}" for name in inputs)),
                log("late, age (s)", "late", "age"),
                log("dt (s)", "dt"),
            ),
        ),
        Tab("wind", tuple(Plot(f"{name} (m/s)", (("truth", name),)) for name in wind)),
    )


def foxglove(channels: Mapping[str, Sequence[str]]) -> str:
    """A layout of Foxglove and Lichtblick: JSON, a Tab panel with Plot panels.

    Paths are "/topic.position[index]". The time axis is log time: stamps are flight time, far from log time in lockstep.
    """
    panels: dict[str, Any] = {}
    tabs: list[dict[str, Any]] = []
    if "guidance" in channels:
        panels[MAP] = _foxglove_map()
        tabs.append({"title": "map", "layout": MAP})
    for tab in tabs_of(channels):
        names = []
        for number, plot in enumerate(tab.plots):
            names.append(f"Plot!{tab.title}{number}")
            panels[names[-1]] = _foxglove_plot(plot, channels)
        if names:
            tabs.append({"title": tab.title, "layout": _mosaic(names)})
    panels["Tab!rise_di"] = {"activeTabIdx": 0, "tabs": tabs}
    defaults = {"globalVariables": {}, "userNodes": {}, "playbackConfig": {"speed": 1}}
    return json.dumps({"configById": panels, **defaults, "layout": "Tab!rise_di"}, indent=2) + "\n"


def _foxglove_plot(plot: Plot, channels: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    paths = [
        {
            "value": f"/{topic}.position[{list(channels[topic]).index(channel)}]",
            "label": f"{topic}: {channel}",
            "color": colour,
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for (topic, channel), colour in zip(plot.curves, COLOURS, strict=False)
    ]
    return {
        "foxglovePanelTitle": plot.title,
        "lichtblickPanelTitle": plot.title,
        "paths": paths,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 240,
    }


def _foxglove_map() -> dict[str, Any]:
    return {
        "cameraState": {
            "distance": CAMERA_DISTANCE, "perspective": True, "phi": 45.0, "thetaOffset": 0.0, "fovy": 45.0,
            "near": 1.0, "far": 100.0 * CAMERA_DISTANCE,
            "target": [0.0, 0.0, 0.0], "targetOffset": [0.0, 0.0, 0.0], "targetOrientation": [0.0, 0.0, 0.0, 1.0],
        },
        "followMode": "follow-none",
        "followTf": "map",
        "scene": {},
        "transforms": {},
        "topics": {topic: {"visible": True} for topic in MAP_TOPICS},
        "layers": {
            "grid": {
                "visible": True, "label": "Grid", "instanceId": "grid", "layerId": "foxglove.Grid", "frameId": "map",
                "size": GRID_SIZE, "divisions": 10, "color": "#808080ff", "position": [0, 0, 0], "rotation": [0, 0, 0],
            }
        },
    }  # fmt: skip


def _mosaic(names: Sequence[str]) -> Any:
    """Panels in rows of COLUMNS as a binary tree: a node splits off the first panel."""
    rows = [_split(names[start : start + COLUMNS], "row") for start in range(0, len(names), COLUMNS)]
    return _split(rows, "column")


def _split(parts: Sequence[Any], direction: str) -> Any:
    first, *others = parts
    if not others:
        return first
    share = 100.0 / len(parts)
    return {"direction": direction, "first": first, "second": _split(others, direction), "splitPercentage": share}


def plotjuggler(channels: Mapping[str, Sequence[str]]) -> str:
    """A layout of PlotJuggler: XML, tabs of docked plots, curves named "/topic/channel/position"."""
    root = ElementTree.Element("root")
    window = ElementTree.SubElement(root, "tabbed_widget", {"name": "Main Window", "parent": "main_window"})
    for tab in tabs_of(channels):
        if not tab.plots:
            continue
        element = ElementTree.SubElement(window, "Tab", {"tab_name": tab.title, "containers": "1"})
        rows = [tab.plots[start : start + COLUMNS] for start in range(0, len(tab.plots), COLUMNS)]
        outer = _splitter(ElementTree.SubElement(element, "Container"), "-", len(rows))
        for row in rows:
            inner = _splitter(outer, "|", len(row))
            for plot in row:
                _plotjuggler_plot(inner, plot)
    ElementTree.SubElement(window, "currentTabIndex", {"index": "0"})
    ElementTree.SubElement(root, "use_relative_time_offset", {"enabled": "1"})
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _splitter(parent: ElementTree.Element, orientation: str, count: int) -> ElementTree.Element:
    sizes = ";".join([f"{1.0 / count:.6g}"] * count)
    return ElementTree.SubElement(parent, "DockSplitter", {"orientation": orientation, "count": str(count), "sizes": sizes})


def _plotjuggler_plot(parent: ElementTree.Element, plot: Plot) -> None:
    area = ElementTree.SubElement(parent, "DockArea", {"name": plot.title})
    element = ElementTree.SubElement(
        area, "plot", {"mode": "TimeSeries", "style": "Lines", "flip_x": "false", "flip_y": "false"}
    )
    for (topic, channel), colour in zip(plot.curves, COLOURS, strict=False):
        ElementTree.SubElement(element, "curve", {"name": f"/{topic}/{channel}/position", "color": colour})
