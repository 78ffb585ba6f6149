# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""docs/evidence.md, a function of docs/evidence/*.csv alone: goals, met or not, with revision and date.

python -m benchmarks.evidence_page    # writes the page
"""

import math
from collections.abc import Mapping, Sequence
from operator import itemgetter
from typing import NamedTuple

from benchmarks.evidence_data import BASELINE, BUSY, REPOSITORY, Measured, Origin, Row, compared, read, used

PAGE = REPOSITORY / "docs" / "evidence.md"
SHOWN = 3  # goals of a measurement; the data has the rest


class Topic(NamedTuple):
    """A section of the page."""

    title: str
    titles: Mapping[str, str]  # of the measurements, by name
    text: str = ""


ROUTE_AIRCRAFT = ("osprey_servo", "c172p", "737", "f16", "c182", "A320", "F4N")

TOPICS = (
    Topic(
        "Faults",
        {
            "faults": "faults injected into a flight over DDS",
            "random-faults": "random faults, also two at a time and in lockstep",
            "long-faults": "a thousand random faults",
        },
        "[Faults](faults.md) states what each node does. Times are the median and the worst of all runs that passed; "
        "they include delays of the host.",
    ),
    Topic(
        "Speed",
        {
            "speed-law": "one step of the law",
            "speed-receiver": "a message that a receiver refuses compared with a right one",
            "speed-node": "the controller's tick compared with an echo's callback",
            "speed-latency": "from y sent to u received, over DDS",
            "speed-ticks": "lateness of ticks",
            "speed-flight": "CPU and memory of each process of a flight in real time",
            "speed-start": "from the start of a process to its first u",
            "speed-import": "processor time of `import rise_di` and of `rise-di --help`",
            "speed-lockstep": "lockstep flights",
            "speed-recorder": "the recorder at 1 kHz on six topics",
        },
        "A baseline is the least program that does the same on this host in the same run. "
        "The ratio to the baseline carries over to other hosts.",
    ),
    Topic(
        "Security",
        {
            "security": "who can receive y and command u",
            "fuzz": "external input, fuzzed by hypothesis",
            "fuzz-coverage": "readers of files and messages, coverage-guided fuzzing",
            "long-fuzz": "the same readers, ten minutes each",
        },
    ),
    Topic(
        "Long flights and replay",
        {
            "long-lockstep": "six hours in lockstep",
            "long-real-time": "one hour in real time",
            "long-jsbsim": "one hour of an aircraft of JSBSim in lockstep",
            "replay": "every scenario flown and replayed",
        },
    ),
    Topic(
        "Campaigns and other laws",
        {
            "campaign": "speed and accuracy of campaigns",
            "campaign-fleet": "uncertain aircraft flown by the same law",
            "campaign-missions": "uncertain aircraft on a route",
            "cluster": "a campaign on a cluster of dask with faults",
            "compare": "other laws on the same aircraft and course",
            "compare-self_tuner": "the indirect self-tuner on the same aircraft and course",
            "margins": "the cost of a phase margin under five laws",
            "effectors": "each effector lost at a random time",
        },
        "[Experiments](experiments.md#other-laws) describes laws, scores and costs. "
        "All laws have the same aircraft, winds and tuning.",
    ),
    Topic(
        "Learning in the air",
        {"learning": "uncertain aircraft that learn in flight, in every air and with damage"},
        "[Learning](learning.md#what-it-reaches) says what the figures mean.",
    ),
    Topic(
        "Live view",
        {"view": "the page beside a flight, and a log of one hour on it"},
    ),
    Topic(
        "Guidance",
        {f"guidance-{name}": f"holds and paths, {name}" for name in ("osprey_servo", "c172p", "737", "f16")}
        | {"guidance-route": "another route, other aircraft"}
        | {f"guidance-grid-{name}": f"off the design point, {name}" for name in ("c172p", "737", "f16")}
        | {"guidance-rates": "errors of the rates with guidance over those without"}
        | {f"guidance-routes-{name}": f"routes hard to begin, in wind, steep, {name}" for name in ROUTE_AIRCRAFT}
        | {f"guidance-fence-{name}": f"five fences in four winds, {name}" for name in ("osprey", "c172p", "f16", "737")},
        "[Experiments](experiments.md#guidance-by-rule) says what the figures mean and why some miss. "
        "In turbulence a figure is the worst of the seeds.",
    ),
    Topic(
        "Real autopilots",
        {
            "autopilots-arduplane": "ArduPlane, servos of 0.03 s, gains by `identify --bridge`",
            "autopilots-slow_servos": "ArduPlane, its default servos of 0.14 s, gains by `identify --bridge`",
            "autopilots-px4": "PX4's airplane, gains by `identify --bridge`",
            "autopilots-guided": "ArduPlane under guidance",
            "autopilots-observer": "ArduPlane with an observer of the identified Omega and lags, in turbulence",
            "autopilots-engagements": "engagements without a jump",
            "autopilots-signs": "signs, in short experiments in wind of 5 m/s",
            "autopilots-pose": "rates and pose over the autopilot's own log",
            "autopilots-own_log": "ArduPlane 15 % faster, over DDS and MAVLink, calm and in wind, by its own logs",
            "autopilots-releases": "tests, and the times of a release",
        },
        "ArduPlane 4.8.0-dev and PX4 1.16.0 in software. "
        "Flights before 2026-11-23 take the times of their commands some seconds early: their rms is to be measured again.",
    ),
)
TITLES = {name: title for topic in TOPICS for name, title in topic.titles.items()}

HEAD = """\
# Evidence

Written from the files of `docs/evidence/`; do not edit. Each link leads to all figures of a measurement, with the command,
the host and the date. `make evidence ARGS="--again NAME"` measures again: NAME is that of the file. Guidance and real
autopilots have programs of their own, which the files name. Where several figures have the same goal, you see the worst.
Limits of all measurements: one host, the loopback interface, simulated aircraft. They say nothing about a network or a
real-time kernel. On a virtual machine the times include steal time, when its host runs something else.

## Goals that are not met
"""


class Goal(NamedTuple):
    """The figures of a measurement that differ by the subject alone and have the same goal."""

    name: str  # of the worst figure
    figure: str  # without the subject
    worst: str  # value with the unit
    limit: str
    used: float  # share of the goal that the worst figure uses
    missed: int
    figures: int


def goals(measured: Measured) -> list[Goal]:
    """The goals of a measurement, the most missed first, the most easily met last."""
    rows = {figure.name: figure for figure in measured.rows}
    alike: dict[tuple[str, str], list[tuple[float, Row]]] = {}
    for figure in measured.rows:
        share = used(figure, rows)
        if share is not None:
            alike.setdefault((figure.figure, figure.goal), []).append((share, figure))
    merged = []
    for figures in alike.values():
        share, worst = max(figures, key=itemgetter(0))
        missed = sum(of > 1.0 for of, _ in figures)
        merged.append(Goal(worst.name, worst.figure, _value(worst, rows), _limit(worst), share, missed, len(figures)))
    return sorted(merged, key=lambda goal: -goal.used)


def _value(figure: Row, rows: Mapping[str, Row]) -> str:
    try:
        number = _number(compared(figure, rows))
    except ValueError:
        return figure.value
    return f"{number} {'times the baseline' if figure.goal.endswith(BASELINE) else figure.unit}".strip()


def _number(value: float) -> str:
    """Three digits, of a larger number the whole part."""
    return f"{value:,.0f}" if abs(value) >= 100.0 and math.isfinite(value) else f"{value:.3g}"


def _limit(figure: Row) -> str:
    sign, limit = figure.goal.split()[:2]
    return f"{'at most' if sign == '<=' else 'at least'} {_number(float(limit))}"


def page(measurements: Mapping[str, Measured]) -> str:
    """The page from the measurements by name. Raises ValueError for a measurement without a title."""
    judged = {name: goals(measured) for name, measured in measurements.items()}
    lines = [HEAD, *_heading("measurement", "goal", "measured", "limit")]
    for name in sorted(judged, key=[*TITLES].index):
        for goal in judged[name]:
            if goal.missed:
                share = f", {goal.missed} of {goal.figures} miss" if goal.missed > 1 else ""
                lines.append(f"| {_link(name)} | {goal.name}{share} | **{goal.worst}** | {goal.limit} |")
    for topic in TOPICS:
        lines += ["", f"## {topic.title}", "", *((topic.text, "") if topic.text else ())]
        lines += _heading("measurement", "goals met", "closest to the limits", "revision")
        for name in topic.titles:
            if name in measurements:
                origin = measurements[name].origin
                lines.append(f"| {_link(name)} | {_met(judged[name])} | {_closest(judged[name])} | {_measured_on(origin)} |")
            else:
                lines.append(f"| {TITLES[name]} | - | not measured | - |")
    return "\n".join(lines) + "\n"


def _heading(*heads: str) -> list[str]:
    return [f"| {' | '.join(heads)} |", "|" + " --- |" * len(heads)]


def _link(name: str) -> str:
    return f"[{TITLES[name]}](evidence/{name}.csv)"


def _met(judged: Sequence[Goal]) -> str:
    figures, missed = sum(goal.figures for goal in judged), sum(goal.missed for goal in judged)
    if figures == 0:
        return "-"
    return f"**{figures - missed} of {figures}**" if missed else f"{figures} of {figures}"


def _measured_on(origin: Origin) -> str:
    busy = ", busy host" if BUSY in origin.host else ""
    return f"{origin.revision or 'not recorded'}, {origin.date[:10]}{busy}"


def _closest(judged: Sequence[Goal]) -> str:
    shown = [
        f"{goal.name if goal.figures == 1 else goal.figure} {f'**{goal.worst}**' if goal.missed else goal.worst} ({goal.limit})"
        for goal in judged[:SHOWN]
    ]
    return "; ".join(shown) + (f"; {len(judged) - SHOWN} more" if len(judged) > SHOWN else "") or "no goal"


def write_page() -> None:
    """Write the page from the data."""
    PAGE.write_text(page(read()), encoding="utf-8")


if __name__ == "__main__":
    write_page()
