# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Rendering of docs/evidence.md: the template evidence.md.jinja, filled with results of benchmarks/evidence.py."""

import math
import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined

Result = dict[str, Any]
"""name, command, quick, date, revision, machine, busy (before it), seconds, status (exit), result (None where it failed)."""

WIDTH = 120  # characters of a line of prose
HARD_SPACE = "\u00a0"  # no line is broken here
BUSY = 0.1  # share of the processors in use just before a measurement; the page marks results above it
MINUTE = 60.0  # s, to which the date of a measurement is known
ECHOES = ("bare echo, single", "bare echo, multi", "bare echo, events")  # rows of the group "node"
MEASURED = re.compile(r"^    .+    # \d{4}-\d\d-\d\d ", re.MULTILINE)  # a command with its date
GOAL, NOT_MET, UNMET = "- Goal: ", "**not met**", "UNMET"
WITHOUT_RATIO = ("missed", "missed excluding host delays", "lost", "ticks", "max (us)", "answered (%)")
"""Counts, single outliers, and shares."""


class Measurement(NamedTuple):
    """A program that measures, and its result."""

    name: str
    command: tuple[str, ...]  # FILE stands for the file that it writes; without it, its output is the result
    quick: tuple[str, ...]
    what: str  # in a line
    takes: str  # about, on two cores
    timed: bool = False  # whether a busy host spoils it
    long: bool = False  # whether it is only measured by its name


SPEED = {
    "law": ("one step of the law", 10.0, "10 s"),
    "node": ("the controller's tick compared with an echo's callback", 10.0, "1 min"),
    "latency": ("from y sent to u received, over DDS", 10.0, "4 min"),
    "ticks": ("lateness of ticks", 60.0, "8 min"),
    "flight": ("CPU and memory of each process of a flight in real time", 10.0, "1 min"),
    "start": ("from the start of a process to its first u", 10.0, "1 min"),
    "lockstep": ("lockstep flights", 30.0, "1 min"),
    "recorder": ("the recorder at 1 kHz on six topics", 30.0, "1 min"),
}
"""What each group of benchmarks/speed.py measures, s a figure, and the time it takes."""

LONG_FLIGHTS = {
    "lockstep": ("six hours in lockstep", ("--observer", "--one-process", "--rate", "100", "--minutes", "360"), "80 min"),
    "real-time": ("one hour in real time", ("--observer", "--real-time"), "65 min"),
    "jsbsim": ("one hour of an aircraft of JSBSim in lockstep", ("--one-process",), "25 min"),
}
"""What each long flight is, the options of benchmarks/long_flight.py, and the time it takes."""


def render(measurements: Sequence[Measurement], results: Mapping[str, Result], before: str = "") -> str:
    """The page from the results by name of the measurement; lines of prose are at most WIDTH long.

    A section without any result stays as it is on the page `before`: another machine may have measured it.
    """
    hosts = [host(result["machine"]) for result in results.values()]
    page = TEMPLATES.get_template("evidence.md.jinja").render(
        measurements={one.name: one for one in measurements},
        results=results,
        hosts=sorted({*hosts, *re.findall(r"^- (.+, Python \S+)$", before, re.MULTILINE)}),
        value=lambda name: results[name]["result"] if name in results else None,
        beside=lambda name: beside(name, results),
    )
    kept = {_heading(section): section for section in _sections(before) if MEASURED.search(section)}
    return finished(
        "".join(section if MEASURED.search(section) else kept.get(_heading(section), section) for section in _sections(page))
    )


def beside(name: str, results: Mapping[str, Result]) -> list[str]:
    """The measurements that ran at the same time on such a host, by more than the minute to which the dates are known."""

    def times(result: Result) -> tuple[float, float]:
        begin = datetime.strptime(result["date"], "%Y-%m-%d %H:%M UTC").replace(tzinfo=UTC).timestamp()
        return begin, begin + result["seconds"]

    here, (begin, end) = results[name]["machine"], times(results[name])
    others = {other: times(one) for other, one in results.items() if other != name and one["machine"] == here}
    return [other for other, (since, until) in others.items() if min(end, until) - max(begin, since) > MINUTE]


def _sections(page: str) -> list[str]:
    """A page in parts that begin with a heading, but for the first."""
    return re.split(r"^(?=##)", page, flags=re.MULTILINE)


def _heading(section: str) -> str:
    return section.partition("\n")[0]


def finished(page: str) -> str:
    """A page whose goals that are not met are said in the place of UNMET, in lines of at most WIDTH."""
    paragraphs = _unmet_first(re.sub(r"(?<=[^\n|])\n *(?=[^\s|#-])", " ", page).splitlines())
    wrapped = "\n".join(line for paragraph in paragraphs for line in _wrapped(paragraph.rstrip()))
    return re.sub(r"\n{3,}", "\n\n", wrapped).strip() + "\n"


def _unmet_first(paragraphs: Sequence[str]) -> list[str]:
    """With the goals that are not met in the place of UNMET, each behind its section."""
    section, unmet = "", []
    for paragraph in paragraphs:
        if paragraph.startswith("#"):
            section = paragraph.strip("# ")
        elif NOT_MET in paragraph:
            unmet.append(f"- {section}: {paragraph.removeprefix(GOAL)}")
    lines = ["Goals that are not met:", "", *unmet] if unmet else ["Every goal on this page is met."]
    return [line for one in paragraphs for line in (lines if one == UNMET else [one])]


def _wrapped(paragraph: str) -> list[str]:
    """A paragraph or list item in lines of at most WIDTH, code spans unbroken; tables, headings and code as they are."""
    if paragraph.startswith(("|", "#", "    ")) or not paragraph:
        return [paragraph]
    unbroken = re.sub("`[^`]*`", lambda code: code.group().replace(" ", HARD_SPACE), paragraph)
    indent = "  " * paragraph.startswith("- ")
    lines = textwrap.wrap(unbroken, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return [line.replace(HARD_SPACE, " ") for line in lines]


def host(of: Mapping[str, Any]) -> str:
    """A host in a line."""
    return f"{of['processor']}, {of['cores']} cores, {of['memory']} GiB, {of['system']}, Python {of['python']}"


def number(value: float | None) -> str:
    """Three digits, or all of a larger number."""
    if value is None or math.isnan(value):
        return "-"
    if value == 0 or abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}" if abs(value) >= 1e-3 else f"{value:.1e}"


def ratio(value: float | None, baseline: float | None, column: str = "") -> str:
    """A figure as a ratio to its baseline with the figure in parentheses; the figure alone without a baseline."""
    if value is None:
        return ""
    if math.isnan(value) or not baseline or column in WITHOUT_RATIO:
        return number(value)
    return f"{number(value / baseline)} ({number(value)})"


def milliseconds(times: Mapping[str, float] | None) -> str:
    """Median / worst of times in s."""
    return "-" if times is None else f"{1e3 * times['median']:.0f} / {1e3 * times['worst']:.0f}"


def goal(sentence: str, value: float, limit: float, unit: str, *, at_least: bool = False) -> str:
    """A list item that compares a figure with its goal."""
    met = value >= limit if at_least else value <= limit
    return f"{GOAL}{sentence}. Measured: {number(value)}{' ' + unit if unit else ''}, {'met' if met else NOT_MET}."


def speed_goal(row: Mapping[str, Any], wanted: Mapping[str, Any], figures: Mapping[str, Mapping[str, float]]) -> str:
    """The goal of a row of a table of speed; `figures` by name of the row."""
    column, value, limit = wanted["column"], row["figures"][wanted["column"]], wanted["at_most"]
    name, unit = re.fullmatch(r"([^(]+?)(?: \((.*)\))?", column).groups("")  # type: ignore[union-attr]
    if wanted["of_floor"]:
        sentence = f"{row['what']}: {name} at most {number(limit)} times that of {row['floor']}"
        return goal(sentence, value / figures[row["floor"]][column], limit, "times")
    return goal(f"{row['what']}: {name} at most {number(limit)}{' ' + unit if unit else ''}", value, limit, unit)


def fastest_echo(rows: Sequence[Mapping[str, Any]]) -> str:
    """The medians of the controller as ratios to that of the fastest echo; empty without an echo."""
    medians = {row["what"]: row["figures"]["p50 (us)"] for row in rows if "p50 (us)" in row["figures"]}
    echoes = [name for name in medians if name in ECHOES]
    if not echoes:
        return ""
    fastest = min(echoes, key=lambda name: medians[name])
    others = (f"{name} {number(median / medians[fastest])}" for name, median in medians.items() if name not in echoes)
    return f"- Ratios of p50 to that of the fastest echo ({fastest}): {'; '.join(others)}."


def counts(outcomes: Iterable[str]) -> str:
    """How many tests passed, failed and were skipped."""
    return ", ".join(f"{count} {outcome}" for outcome, count in Counter(sorted(outcomes)).items())


def outcomes(cases: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """The outcome of each test by its name in words; that of several cases is the worst of them."""
    by_test: dict[str, list[str]] = {}
    for case in cases:
        by_test.setdefault(case["name"].partition("[")[0].removeprefix("test_").replace("_", " "), []).append(case["outcome"])
    return {test: _outcome(those) for test, those in by_test.items()}


def _outcome(cases: Sequence[str]) -> str:
    if "failed" in cases:
        return "**failed**"
    return ("skipped" if "skipped" in cases else "passed") + (f" ({len(cases)} cases)" if len(cases) > 1 else "")


def scores(law: Mapping[str, Any], wind: str) -> list[float | None]:
    """Score on the nominal aircraft, then mean and worst at each level; None where it diverged."""
    return [law["score"][wind], *(level[wind][key] for level in law["levels"] for key in ("mean", "worst"))]


def marked_scores(law: Mapping[str, Any], laws: Sequence[Mapping[str, Any]]) -> list[str]:
    """The scores of each wind as cells, the lowest of a column among laws with the same measurements and knowledge in bold."""
    peers = [one for one in laws if (one["sees"], one["knows"]) == (law["sees"], law["knows"])]
    row = []
    for wind in law["score"]:
        of_peers = [[math.inf if value is None else value for value in scores(one, wind)] for one in peers]
        cells = []
        for value, column in zip(scores(law, wind), zip(*of_peers, strict=True), strict=True):
            text = "diverged" if value is None else f"{value:.2f}"
            cells.append(f"**{text}**" if value is not None and value <= min(column) else text)
        row += [cells[0], *(f"{mean} ({worst})" for mean, worst in zip(cells[1::2], cells[2::2], strict=True))]
    return row


TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    undefined=StrictUndefined,
    autoescape=False,  # noqa: S701 - Markdown from our own results
    trim_blocks=True,
    lstrip_blocks=True,
)
TEMPLATES.globals |= {
    "BUSY": BUSY,
    "SPEED": SPEED,
    "LONG_FLIGHTS": LONG_FLIGHTS,
    "goal": goal,
    "ratio": ratio,
    "speed_goal": speed_goal,
    "zip": zip,
}
TEMPLATES.globals |= {"UNMET": UNMET, "fastest_echo": fastest_echo, "marked_scores": marked_scores, "outcomes": outcomes}
TEMPLATES.filters |= {"number": number, "milliseconds": milliseconds, "counts": counts}
TEMPLATES.tests["always_passed"] = lambda fault: fault["passed"] == fault["injected"]
