# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Layouts of Foxglove, PlotJuggler and RViz for the runs of a scenario or of a fleet.

Foxglove addresses a channel by the index in `position`, PlotJuggler by the name. A layout therefore
fits every scenario with the same channels in the same order.
"""

import json
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import yaml

from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario import Scenario
from flight_guidance import guidance
from rise_di_controller import internals

COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#ff7f0e", "#9467bd", "#8c564b")
COLUMNS = 2
MAP = "3D!map"
"""The 3-D panel of a guided flight: route and aircraft in the frame `map`, ENU."""
MAP_TOPICS = ("odometry", "path", "markers")
# m
CAMERA_DISTANCE = 3000.0
GRID_SIZE = 10_000.0
CHASE_DISTANCE = 15.0  # m, of the camera of RViz behind the aircraft

SPAN = 3.0  # m, of the drawn aircraft
BOXES = {  # (size, centre) of its parts in spans: forward, left, up
    "body": ((0.8, 0.08, 0.09), (-0.1, 0.0, 0.0)),
    "wing": ((0.2, 1.0, 0.02), (-0.03, 0.0, 0.01)),
    "tail": ((0.11, 0.36, 0.01), (-0.465, 0.0, 0.01)),
    "fin": ((0.11, 0.01, 0.17), (-0.465, 0.0, 0.09)),
}

Channels = Mapping[str, Sequence[str]]
"""The channels of the topics of an aircraft, in their order."""


class Plot(NamedTuple):
    """Curves over time in a pair of axes, SI and radians."""

    title: str
    curves: tuple[tuple[str, str], ...]  # topic and channel


class Tab(NamedTuple):
    """Plots on a screen."""

    title: str
    plots: tuple[Plot, ...]


def channels_of(scenario: Scenario) -> dict[str, tuple[str, ...]]:
    """The channels of the topics of a run."""
    controller = scenario.controller
    guided = (
        {} if scenario.guidance is None else {"guidance": guidance.names(scenario.guidance.outputs)}
    )
    return guided | {
        "y": tuple(scenario.aircraft.channels().outputs),
        "y_m": scenario.reference_model.outputs,
        "u": controller.effectors,
        "internals": internals.names(controller.logged_groups()),
        "truth": tuple(Simulator(scenario.aircraft).truth_names),
    }


def tabs_of(channels: Channels) -> tuple[Tab, ...]:
    """The tabs: y over y_m and e by output, u with u_free, integral_e and Pi, state and timing of
    the controller, the wind.

    A guided flight has a further tab, of the commands and measurements of guidance.
    """
    outputs = channels["y_m"]
    wind = [name for name in channels["truth"] if name.startswith("gust.")]
    inputs = [
        name.removeprefix("u_free.") for name in channels["internals"] if name.startswith("u_free.")
    ]
    integrals = [f"{group}.{name}" for name, group in product(outputs, ("integral_e", "Pi"))]
    # another law may have neither
    integrals = [name for name in integrals if name in channels["internals"]]

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
        Tab(
            "tracking",
            tuple(Plot(f"{name}: y, y_m", (("y", name), ("y_m", name))) for name in outputs),
        ),
        Tab("error", tuple(log(f"e {name}", f"e.{name}") for name in outputs)),
        Tab(
            "input",
            tuple(log(f"u {name}: u_free, u", f"u_free.{name}", f"u.{name}") for name in inputs),
        ),
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


def foxglove(aircraft: Mapping[str, Channels]) -> str:
    """A layout of Foxglove and Lichtblick: JSON, a Tab panel with Plot panels. `aircraft`: channels
    by namespace, "" the root.

    Paths are "/topic.position[index]". The time axis is log time: stamps are flight time, far from
    log time in lockstep. With several aircraft each namespace has a tab, beside a common map.
    """
    panels: dict[str, Any] = {}
    tabs: list[dict[str, Any]] = []
    if guided := [namespace for namespace, channels in aircraft.items() if "guidance" in channels]:
        panels[MAP] = _foxglove_map(guided)
        tabs.append({"title": "map", "layout": MAP})
    for namespace, channels in aircraft.items():
        panel_tabs = _foxglove_tabs(panels, namespace, channels)
        if len(aircraft) == 1:
            tabs += panel_tabs
        else:
            panels[f"Tab!{namespace}"] = {"activeTabIdx": 0, "tabs": panel_tabs}
            tabs.append({"title": namespace, "layout": f"Tab!{namespace}"})
    panels["Tab!rise_di"] = {"activeTabIdx": 0, "tabs": tabs}
    defaults = {"globalVariables": {}, "userNodes": {}, "playbackConfig": {"speed": 1}}
    return json.dumps({"configById": panels, **defaults, "layout": "Tab!rise_di"}, indent=2) + "\n"


def _foxglove_tabs(
    panels: dict[str, Any], namespace: str, channels: Channels
) -> list[dict[str, Any]]:
    """The tabs of an aircraft; their plots are added to the panels."""
    tabs = []
    for tab in tabs_of(channels):
        names = []
        for number, plot in enumerate(tab.plots):
            names.append(f"Plot!{namespace}{tab.title}{number}")
            panels[names[-1]] = _foxglove_plot(plot, namespace, channels)
        if names:
            tabs.append({"title": tab.title, "layout": _mosaic(names)})
    return tabs


def _topic(namespace: str, name: str) -> str:
    """The full name of a topic."""
    return f"/{namespace}/{name}" if namespace else f"/{name}"


def _foxglove_plot(plot: Plot, namespace: str, channels: Channels) -> dict[str, Any]:
    paths = [
        {
            "value": f"{_topic(namespace, topic)}.position[{list(channels[topic]).index(channel)}]",
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


def _foxglove_map(namespaces: Sequence[str]) -> dict[str, Any]:
    return {
        "cameraState": {
            "distance": CAMERA_DISTANCE, "perspective": True, "phi": 45.0, "thetaOffset": 0.0,
            "fovy": 45.0,
            "near": 1.0, "far": 100.0 * CAMERA_DISTANCE,
            "target": [0.0, 0.0, 0.0], "targetOffset": [0.0, 0.0, 0.0],
            "targetOrientation": [0.0, 0.0, 0.0, 1.0],
        },
        "followMode": "follow-none",
        "followTf": "map",
        "scene": {},
        "transforms": {},
        "topics": {_topic(*pair): {"visible": True} for pair in product(namespaces, MAP_TOPICS)},
        "layers": {
            "grid": {
                "visible": True, "label": "Grid", "instanceId": "grid", "layerId": "foxglove.Grid",
                "frameId": "map",
                "size": GRID_SIZE, "divisions": 10, "color": "#808080ff", "position": [0, 0, 0],
                "rotation": [0, 0, 0],
            }
        },
    }  # fmt: skip


def _mosaic(names: Sequence[str]) -> Any:
    """Panels in rows of COLUMNS as a binary tree: a node splits off the first panel."""
    rows = [
        _split(names[start : start + COLUMNS], "row") for start in range(0, len(names), COLUMNS)
    ]
    return _split(rows, "column")


def _split(parts: Sequence[Any], direction: str) -> Any:
    first, *others = parts
    if not others:
        return first
    share = 100.0 / len(parts)
    return {
        "direction": direction,
        "first": first,
        "second": _split(others, direction),
        "splitPercentage": share,
    }


def _plotjuggler_tab(window: ElementTree.Element, namespace: str, tab: Tab) -> None:
    """Add the tab to the window with its plots in rows; a tab without a plot is left out."""
    if not tab.plots:
        return
    title = f"{namespace} {tab.title}".strip()
    element = ElementTree.SubElement(window, "Tab", {"tab_name": title, "containers": "1"})
    rows = [tab.plots[start : start + COLUMNS] for start in range(0, len(tab.plots), COLUMNS)]
    outer = _splitter(ElementTree.SubElement(element, "Container"), "-", len(rows))
    for row in rows:
        inner = _splitter(outer, "|", len(row))
        for plot in row:
            _plotjuggler_plot(inner, plot, namespace)


def plotjuggler(aircraft: Mapping[str, Channels]) -> str:
    """A layout of PlotJuggler: XML, tabs of docked plots, curves "/topic/channel/position".
    `aircraft` as in `foxglove`.
    """
    root = ElementTree.Element("root")
    window = ElementTree.SubElement(
        root, "tabbed_widget", {"name": "Main Window", "parent": "main_window"}
    )
    for namespace, channels in aircraft.items():
        for tab in tabs_of(channels):
            _plotjuggler_tab(window, namespace, tab)
    ElementTree.SubElement(window, "currentTabIndex", {"index": "0"})
    ElementTree.SubElement(root, "use_relative_time_offset", {"enabled": "1"})
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _splitter(parent: ElementTree.Element, orientation: str, count: int) -> ElementTree.Element:
    sizes = ";".join([f"{1.0 / count:.6g}"] * count)
    return ElementTree.SubElement(
        parent, "DockSplitter", {"orientation": orientation, "count": str(count), "sizes": sizes}
    )


def _plotjuggler_plot(parent: ElementTree.Element, plot: Plot, namespace: str) -> None:
    area = ElementTree.SubElement(parent, "DockArea", {"name": plot.title})
    element = ElementTree.SubElement(
        area, "plot", {"mode": "TimeSeries", "style": "Lines", "flip_x": "false", "flip_y": "false"}
    )
    for (topic, channel), colour in zip(plot.curves, COLOURS, strict=False):
        ElementTree.SubElement(
            element,
            "curve",
            {"name": f"{_topic(namespace, topic)}/{channel}/position", "color": colour},
        )


def rviz(namespaces: Sequence[str], description: Path) -> str:
    """A configuration of RViz: aircraft, path and route of each namespace in the frame `map`, a
    camera that follows the first.

    `description`: the file of `urdf`.
    """
    displays: list[dict[str, Any]] = [
        {
            "Class": "rviz_default_plugins/Grid",
            "Name": "Grid",
            "Cell Size": 100.0,
            "Plane Cell Count": int(GRID_SIZE / 100.0),
        }
    ]
    for name in namespaces:
        model = {
            "Description Source": "File",
            "Description File": str(description),
            "TF Prefix": name,
        }
        displays += [
            {"Class": "rviz_default_plugins/RobotModel", "Name": name or "aircraft"} | model,
            {
                "Class": "rviz_default_plugins/Path",
                "Name": f"{name} path".strip(),
                "Topic": {"Value": _topic(name, "path")},
            },
            {
                "Class": "rviz_default_plugins/MarkerArray",
                "Name": f"{name} route".strip(),
                "Topic": {"Value": _topic(name, "markers")},
            },
        ]
    body = f"{namespaces[0]}/base_link".lstrip("/")
    behind = {"Target Frame": body, "Distance": CHASE_DISTANCE, "Pitch": 0.3, "Yaw": 3.1416}
    manager = {
        "Class": "",
        "Displays": [display | {"Enabled": True, "Value": True} for display in displays],
        "Global Options": {"Fixed Frame": "map", "Frame Rate": 30},
        "Tools": [{"Class": "rviz_default_plugins/MoveCamera"}],
        "Views": {
            "Current": {"Class": "rviz_default_plugins/Orbit", "Name": "Current View"} | behind
        },
    }
    panels = [{"Class": f"rviz_common/{name}", "Name": name} for name in ("Displays", "Views")]
    return yaml.safe_dump({"Panels": panels, "Visualization Manager": manager}, sort_keys=False)


def urdf() -> str:
    """The aircraft of `BOXES` as the link `base_link`, forward-left-up, as URDF."""
    robot = ElementTree.Element("robot", {"name": "aircraft"})
    link = ElementTree.SubElement(robot, "link", {"name": "base_link"})
    for name, (size, centre) in BOXES.items():
        visual = ElementTree.SubElement(link, "visual", {"name": name})
        ElementTree.SubElement(visual, "origin", {"xyz": _spans(centre)})
        geometry = ElementTree.SubElement(visual, "geometry")
        ElementTree.SubElement(geometry, "box", {"size": _spans(size)})
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode", xml_declaration=True) + "\n"


def _spans(values: Sequence[float]) -> str:
    """Lengths in spans as m, as an attribute."""
    return " ".join(f"{SPAN * value:.4g}" for value in values)
