# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw the drawings of the documentation: topics, a bridge, packages, laws, flights.

Each is drawn from what it shows: the tables of topics and of imports, a table of evidence, a
flight. A drawing is an SVG whose title says what it shows.
"""

import csv
from collections.abc import Mapping, Sequence
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import yaml
from benchmarks.tables import plain
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.guided_figures import flown_routes
from flight_core import topics
from flight_guidance.steering.path import Arc, leg_places, route_outline

REPOSITORY = Path(__file__).resolve().parents[1]
IMPORTS = REPOSITORY / "tests" / "pure" / "imports.yaml"
LAWS = REPOSITORY / "docs" / "evidence" / "tables" / "experiments-laws.csv"
STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "rise_di", "font.size": 9.0}
INK, QUIET, BLUE, ORANGE, RED = ("#2b3640", "#66717b", "#123c52", "#f6a85f", "#8b1f4f")
FILLS = ("#e9f2fb", "#f5f7f8")  # of the box of a node of the stack, and of another box

Place = tuple[float, float]


def save_drawing(figure: Figure, path: Path, shows: str) -> None:
    """Write a figure as an SVG whose texts remain text, and whose title is `shows`."""
    with mpl.rc_context(STYLE):
        metadata = {"Title": shows, "Date": None, "Creator": None}
        figure.savefig(path, format="svg", metadata=metadata, facecolor="white")


def board(width: float, height: float) -> tuple[Figure, Axes]:
    """Make a figure without axes, in tenths of an inch, with the origin at the lower left."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width / 10.0, height / 10.0))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, width), ylim=(0.0, height))
    axes.set_axis_off()
    return figure, axes


def box(axes: Axes, place: Place, text: str, fill: str = FILLS[0]) -> None:
    """Draw a text in a box around a place."""
    style = {"boxstyle": "round,pad=0.7", "facecolor": fill, "edgecolor": QUIET}
    axes.text(*place, text, ha="center", va="center", color=INK, bbox=style, zorder=3)


class Arrow(NamedTuple):
    """An arrow from one place to another, with a label beside its middle."""

    start: Place
    end: Place
    label: Place = (0.0, 0.0)  # from the middle of the arrow to the label
    bend: float = 0.0
    dotted: bool = False


def draw_arrow(axes: Axes, arrow: Arrow, text: str) -> None:
    """Draw an arrow with its label."""
    style: dict[str, Any] = {
        "arrowstyle": "-|>",
        "color": QUIET,
        "linestyle": ":" if arrow.dotted else "-",
    }
    style |= {"connectionstyle": f"arc3,rad={arrow.bend}", "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", arrow.end, arrow.start, arrowprops=style, zorder=2)
    x, y = (
        (begin + end) / 2.0 + offset
        for begin, end, offset in zip(arrow.start, arrow.end, arrow.label, strict=True)
    )
    axes.text(x, y, text, ha="center", va="center", color=BLUE, style="italic", zorder=4)


# ---- Nodes

NODES: dict[str, Place] = {
    "external": (12.0, 30.0),
    "guidance": (12.0, 15.0),
    "reference_model": (36.0, 15.0),
    "controller": (60.0, 15.0),
    "aircraft": (84.0, 15.0),
    "learner": (60.0, 30.0),
}
NODE_NAMES = {"external": "you: rise-di guide,\nyour program", "reference_model": "reference model"}
NODE_ARROWS: dict[tuple[str, str], Arrow] = {
    ("external", "guidance"): Arrow((12.0, 26.6), (12.0, 17.6), (6.2, 0.0)),
    ("external", "reference_model"): Arrow((20.0, 27.4), (33.0, 17.6), (2.6, 1.2)),
    ("guidance", "reference_model"): Arrow((17.4, 15.0), (28.2, 15.0), (0.0, 1.4)),
    ("reference_model", "controller"): Arrow((43.8, 15.0), (54.4, 15.0), (0.0, 1.4)),
    ("controller", "aircraft"): Arrow((65.6, 15.7), (79.0, 15.7), (0.0, 1.4)),
    ("aircraft", "controller"): Arrow((79.0, 14.3), (65.6, 14.3), (0.0, -1.5)),
    ("aircraft", "guidance"): Arrow((83.0, 12.4), (13.0, 12.4), (0.0, -11.0), -0.28),
    ("controller", "guidance"): Arrow((58.0, 12.4), (15.0, 12.4), (0.0, -5.6), -0.2),
    ("controller", "learner"): Arrow((58.8, 17.6), (58.8, 27.4), (-5.2, 0.0)),
    ("learner", "controller"): Arrow((61.2, 27.4), (61.2, 17.6), (4.8, 0.0)),
}
"""Where the arrow of each pair of nodes is drawn."""
LEFT_OUT = {"clocks", "/clock", "start", "recorded", "clock"}  # of lockstep, time and the start


def node_topics() -> dict[tuple[str, str], list[str]]:
    """Return the topics between two nodes of NODES, by publisher and subscriber."""
    found: dict[tuple[str, str], list[str]] = {}
    for topic in topics.TOPICS:
        for publisher in topic.publishers:
            for subscriber in topic.subscribers:
                pair = (publisher, subscriber)
                is_drawn = {*pair} <= {*NODES} and subscriber != topics.EXTERNAL
                if is_drawn and topic.name not in LEFT_OUT:
                    found.setdefault(pair, []).append(topic.name)
    return found


def nodes() -> Figure:
    """Draw the nodes of a flight with the topics between them."""
    figure, axes = board(94.0, 35.0)
    for name, place in NODES.items():
        box(axes, place, NODE_NAMES.get(name, name), FILLS[name == topics.EXTERNAL])
    for pair, names in node_topics().items():
        draw_arrow(axes, NODE_ARROWS[pair], ", ".join(names))
    box(axes, (84.0, 30.0), "recorder")
    draw_arrow(axes, Arrow((84.0, 18.0), (84.0, 27.4), (5.0, 0.0), dotted=True), "every topic")
    return figure


# ---- Bridge


def bridge() -> Figure:
    """Draw an autopilot behind a bridge, in place of the aircraft."""
    figure, axes = board(94.0, 24.0)
    places: dict[str, Place] = {
        "guidance\nreference model": (11.0, 12.0),
        "controller": (33.0, 12.0),
        "bridge\nchannel map": (56.0, 12.0),
    }
    for name, place in places.items():
        box(axes, place, name)
    box(axes, (82.0, 12.0), "autopilot\nArduPlane, PX4\nin SITL", FILLS[1])
    draw_arrow(axes, Arrow((17.8, 12.0), (27.6, 12.0), (0.0, 1.4)), "y_m")
    draw_arrow(axes, Arrow((38.4, 12.8), (50.2, 12.8), (0.0, 1.4)), "u, effects")
    draw_arrow(axes, Arrow((50.2, 11.2), (38.4, 11.2), (0.0, -1.5)), "y")
    draw_arrow(axes, Arrow((54.0, 8.6), (12.0, 8.6), (0.0, -6.6), -0.24), "y, pose")
    draw_arrow(
        axes, Arrow((61.8, 12.8), (74.8, 12.8), (0.0, 2.4)), "DDS or MAVLink:\nsurfaces, throttle"
    )
    draw_arrow(
        axes, Arrow((74.8, 11.2), (61.8, 11.2), (0.0, -2.6)), "rates, airspeed,\nattitude, mode"
    )
    draw_arrow(axes, Arrow((56.0, 22.0), (56.0, 15.0), (7.4, 1.6)), "rise-di engage")
    return figure


# ---- Packages


def levels(imports: Mapping[str, Sequence[str]]) -> list[list[str]]:
    """Return the units of the stack by level, each right above the highest that it imports."""
    sorter = TopologicalSorter(imports)
    sorter.prepare()
    rows = []
    while sorter.is_active():
        rows.append(sorted(sorter.get_ready()))
        sorter.done(*rows[-1])
    return rows


def packages() -> Figure:
    """Draw the units of the stack by level, from the table of imports."""
    rows = levels(yaml.safe_load(IMPORTS.read_text()))
    figure, axes = board(98.0, 6.0 * len(rows) + 1.0)
    for height, units in enumerate(rows):
        y = 6.0 * height + 3.5
        for k, unit in enumerate(units):
            box(axes, ((k + 0.5) * 96.0 / len(units) + 1.0, y), unit)
        if height:
            draw_arrow(axes, Arrow((1.5, y), (1.5, y - 5.0)), "")
    return figure


# ---- Laws


def laws() -> Figure:
    """Draw the mean score of each law in gusts and in turbulence, the best first."""
    with LAWS.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    winds = {"gusts": BLUE, "turbulence": ORANGE}
    scores = {
        wind: [float(row[f"score in {wind} at +-30 %: mean (worst)"].split()[0]) for row in rows]
        for wind in winds
    }
    order = np.argsort(-np.sum([*scores.values()], axis=0))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.2, 4.6), layout="constrained")
        axes = figure.subplots()
        places = np.arange(len(rows), dtype=float)
        for offset, (wind, colour) in zip((0.2, -0.2), winds.items(), strict=True):
            values = np.array(scores[wind])[order]
            axes.barh(places + offset, values, 0.36, color=colour, label=wind)
        names = [f"{rows[k]['law']}: sees {rows[k]['signals that it measures']}" for k in order]
        axes.set_yticks(places, names)
        axes.set_xlabel("mean score of 200 aircraft at +-30 %; less is better")
        plain(axes, "", "x")
        axes.legend(frameon=False, loc="upper right")
    return figure


# ---- Flights

LEG_ROUTE = "osprey_route"
LEG_SECONDS = 70.0  # s: the first line, its fillet, a part of the second line
LEG_FENCE = {"north": [-300.0, 1350.0, 1350.0, -300.0], "east": [-400.0, -400.0, 950.0, 950.0]}


def leg() -> Figure:
    """Draw the beginning of a flown route: lines with numbers, a fillet, the fence."""
    scenario = find_scenario(LEG_ROUTE, LEG_SECONDS).vary(guidance={"fence": {"field": LEG_FENCE}})
    tape = simulate(scenario)
    (route,) = flown_routes(scenario, tape)
    north, east, _ = np.array(route_outline(route)).T
    pose = tape["guidance"].group("pose")
    corner = next(leg for leg in route.legs if isinstance(leg, Arc))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 4.6), layout="constrained")
        axes = figure.subplots()
        axes.plot(east, north, color=ORANGE, linewidth=5.0, label="route")
        axes.plot(pose["east"][::20], pose["north"][::20], color=BLUE, linewidth=1.2, label="flown")
        fence_north, fence_east = (
            [*LEG_FENCE[name], LEG_FENCE[name][0]] for name in ("north", "east")
        )
        axes.plot(fence_east, fence_north, color=RED, linestyle="--", label="fence")
        radius = abs(corner.radius)
        centre_north, centre_east = corner.centre
        axes.plot([centre_east], [centre_north], "+", color=INK)
        axes.annotate(
            f"fillet, {radius:.0f} m",
            (centre_east - radius, centre_north),
            (centre_east + 40.0, centre_north - 12.0),
            arrowprops={"arrowstyle": "->", "color": INK},
        )
        for number, (place_north, place_east) in enumerate(leg_places(route)):
            style = {"boxstyle": "circle,pad=0.25", "facecolor": "white", "edgecolor": ORANGE}
            axes.text(place_east, place_north, f"{number}", ha="center", va="center", bbox=style)
        axes.set(xlabel="east (m)", ylabel="north (m)", aspect="equal")
        plain(axes, "")
        axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


WING = "x8_elevons"
WING_SECONDS = 18.0  # s: commands of q, then of p


def effectors() -> Figure:
    """Draw what the law commands of a flying wing, and the elevons that give it."""
    scenario = find_scenario(WING, WING_SECONDS)
    tape = simulate(scenario)
    ticks = tape["internals"]
    t = tape.time("internals")
    inputs = ticks.group("u")
    elevons = {name: angle for name, angle in _elevons(ticks).items() if name != "thrust"}
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.8), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True)
        for name, colour in (("v_q", BLUE), ("v_p", ORANGE)):
            above.plot(t[::10], inputs[name][::10], color=colour, linewidth=1.2, label=name)
        for k, (name, angle) in enumerate(elevons.items()):
            line = ("-", "--")["inner" in name]
            colour = (BLUE, ORANGE)["right" in name]
            degrees = np.degrees(angle[::10])
            below.plot(
                t[::10], degrees, line, color=colour, linewidth=1.0 + 0.2 * (k % 2), label=name
            )
        plain(above, "inputs v of the law (rad/s²)")
        plain(below, "effectors u = T v (deg)")
        below.set_xlabel("t (s)")
        for axes in (above, below):
            axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _elevons(ticks: Any) -> dict[str, Any]:
    effector = ticks.group("effector")
    return {name: effector[name] for name in effector.names}
