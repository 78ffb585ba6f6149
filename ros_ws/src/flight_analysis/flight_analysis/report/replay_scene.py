# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Build the 3-D replay of a report page, with the scripts of the live view.

The replay uses the samples that the page holds for its figures.
"""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flight_analysis.report.display_units import NO_UNIT
from flight_analysis.report.guided import mission_drawing
from flight_analysis.report.guided_figures import flown_routes
from flight_analysis.report.plotting import PlotContext, pack, stored
from flight_analysis.report.summary import RecordedFlight
from flight_core.modes import Mode
from flight_core.tape import Signal

HERE = Path(__file__).parent
SCENE = HERE / "scene"
SCRIPTS = (
    *(SCENE / f"{name}.js" for name in ("canvas", "series", "units", "map", "scene")),
    HERE / "replay.js",
)

POSE = ("phi", "theta", "psi", "north", "east", "altitude")
POSE_RATE = 10.0  # rate of the poses on the page, Hz, between which it interpolates
MAX_POSES = 6000


class Replay(NamedTuple):
    """What a page needs for the 3-D replay, except the samples."""

    data: dict[str, Any]
    code: str  # packed scripts
    style: str


def replay_of(flight: RecordedFlight, context: PlotContext) -> Replay | None:
    """Return the 3-D replay of a flight, or None if its attitude is not logged.

    The poses are added to the samples of the page.
    """
    tape = flight.tape
    topics = {}
    truth = tape.signals.get("truth")
    if (pose := tape.signals.get("pose")) is not None and "phi" in pose.names:
        topics["pose"] = _topic(context, _thinned(pose), {name: name for name in POSE})
    attitude = () if "pose" in topics else ("x.phi", "x.theta")
    if truth is not None:
        groups = [
            name
            for name in truth.names
            if name.startswith(("actuator.", "gust.")) or name in attitude
        ]
        topics["truth"] = _topic(context, truth, {name: name.partition(".")[2] for name in groups})
    names = set().union(*(topic["channels"] for topic in topics.values()))
    if not {"phi", "x.phi"} & names:
        return None
    if "internals" in tape:
        topics["internals"] = _topic(context, tape["internals"], {"mode": ""})
    scenario = flight.scenario
    routes = flown_routes(scenario, tape) if flight.summary["guidance"] is not None else []
    info = {
        "units": {name: {"unit": unit.unit} for name, unit in context.units.items()},
        "positive": {} if scenario is None else scenario.aircraft.channels().positive,
        "modes": {int(mode): mode.name for mode in Mode},
        **(
            {}
            if scenario is None or scenario.guidance is None
            else mission_drawing(scenario.guidance, routes)
        ),
    }
    return Replay(
        {"topics": topics, "info": info},
        pack(_code().encode()),
        (SCENE / "scene.css").read_text(encoding="utf-8"),
    )


def _topic(context: PlotContext, signal: Signal, channels: dict[str, str]) -> dict[str, Any]:
    """Store a topic on the page, and return the names of its arrays and the factors of its units.

    `channels` maps each channel to the name under which the display unit of the channel is known.
    """
    stored_channels = {}
    times = ""
    for name, quantity in channels.items():
        if name in signal.names:
            factor = context.units.get(quantity, NO_UNIT).factor
            times, values = stored(context, signal, name, factor)
            stored_channels[name] = [values, factor]
    return {"t": times, "channels": stored_channels}


def _thinned(pose: Signal) -> Signal:
    """Return the pose with fewer samples: at most POSE_RATE, and at most MAX_POSES in all."""
    count = len(pose.stamp_ns)
    span = (pose.stamp_ns[-1] - pose.stamp_ns[0]) / 1e9 if count > 1 else 0.0
    rows = np.unique(
        np.linspace(0, max(count - 1, 0), min(count, MAX_POSES, int(span * POSE_RATE) + 2)).astype(
            int
        )
    )
    names = tuple(name for name in POSE if name in pose.names)
    return Signal(pose.stamp_ns[rows], names, np.column_stack([pose[name][rows] for name in names]))


def _code() -> str:
    """Return the scripts of the replay as a single JavaScript function that calls itself.

    The function contains all modules of the replay, without their imports, exports, comment lines
    and indentation.
    """
    text = "\n".join(path.read_text(encoding="utf-8") for path in SCRIPTS)
    text = re.sub(r"^(import |\s*//).*\n|^\s+", "", text, flags=re.MULTILINE)
    return "(() => {\n" + re.sub(r"^export ", "", text, flags=re.MULTILINE) + "})();\n"
