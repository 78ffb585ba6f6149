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

from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario import Scenario
from flight_guidance import guidance
from rise_di_controller import internals

COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#ff7f0e", "#9467bd", "#8c564b")
COLUMNS = 2
MAP = "3D!map"
"""The 3-D panel of a guided flight: route and aircraft in the frame `map`, ENU."""
MAP_TOPICS = ("odometry", "path", "markers")
HERE = Path(__file__).parent

FOXGLOVE = json.loads((HERE / "layout.foxglove.json").read_text(encoding="utf-8"))
"""The parts of a layout of Foxglove that are the same for every aircraft, lengths in m."""

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
    return json.dumps({"configById": panels, **FOXGLOVE["layout"]}, indent=2) + "\n"


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
    titles = dict.fromkeys(("foxglovePanelTitle", "lichtblickPanelTitle"), plot.title)
    return {**titles, "paths": paths, **FOXGLOVE["plot"]}


def _foxglove_map(namespaces: Sequence[str]) -> dict[str, Any]:
    topics = [_topic(*pair) for pair in product(namespaces, MAP_TOPICS)]
    return {**FOXGLOVE["map"], "topics": {name: {"visible": True} for name in topics}}


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


def plotjuggler(aircraft: Mapping[str, Channels]) -> str:
    """A layout of PlotJuggler: XML, tabs of docked plots, curves "/topic/channel/position".
    `aircraft` as in `foxglove`.
    """
    tabs = [
        (namespace, tab) for namespace, channels in aircraft.items() for tab in tabs_of(channels)
    ]
    return _rendered("plotjuggler.xml", tabs=tabs, columns=COLUMNS, colours=COLOURS)


def rviz(namespaces: Sequence[str], description: Path) -> str:
    """A configuration of RViz: aircraft, path and route of each namespace in the frame `map`, a
    camera that follows the first.

    `description`: the file of `urdf`.
    """
    body = f"{namespaces[0]}/base_link".lstrip("/")
    return _rendered("rviz", namespaces=namespaces, description=str(description), body=body)


def _rendered(program: str, **values: Any) -> str:
    """The template of a program with values."""
    from jinja2 import Environment, FileSystemLoader  # noqa: PLC0415 - a flight does not need it

    environment = Environment(
        loader=FileSystemLoader(HERE),
        autoescape=program.endswith("xml"),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(f"layout.{program}.jinja").render(topic=_topic, **values) + "\n"


def urdf() -> str:
    """An aircraft of four boxes, 3 m wide, as the link `base_link`, forward-left-up, as URDF."""
    return (HERE / "aircraft.urdf").read_text(encoding="utf-8")
