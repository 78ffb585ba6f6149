# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run measurements, each of which writes its figures to docs/evidence/NAME.csv.

docs/evidence.md is the table of these files.

    make evidence                              # run the measurements that have no file yet
    make evidence ARGS="--again faults"
        # run each measurement whose name begins with "faults" again; repeatable
    make evidence ARGS="--again long-faults"   # a long one, which runs by its name alone

Commands and goals are in benchmarks/evidence.yaml. build/evidence/ has the logs.
"""

import csv
import json
import math
import os
import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import yaml
from benchmarks.tables import parser_of

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDER = REPOSITORY / "docs/evidence"
PAGE = REPOSITORY / "docs/evidence.md"
BUILD = REPOSITORY / "build/evidence"
SECTIONS: Mapping[str, Mapping[str, Any]] = yaml.safe_load(
    Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8")
)
MEASUREMENTS = {
    name: measurement
    for measurements in SECTIONS.values()
    for name, measurement in measurements.items()
}
COMMANDS = {name: each["command"] for name, each in MEASUREMENTS.items() if "command" in each}
DIRTY = "-dirty"  # end of a revision with changes that are not committed
# end of the column `host` if other work used more than BUSY_SHARE of the processors
BUSY, BUSY_SHARE = ("busy with other work", 0.1)
BASELINE = " x baseline"  # end of a goal that limits the ratio to the baseline
HEAD = """\
# Evidence

For you if you want to check a figure. Each link leads to the figures of a measurement, with goals, command, revision, host and date;
`docs/evidence/tables/` has tables of other pages. `make evidence ARGS="--again NAME"` measures again and writes this page, where NAME is
that of the file. The programs of learning, guidance and real autopilots write their files themselves. All measurements are limited to one
host, the loopback interface and simulated aircraft. In turbulence a figure is the worst of the seeds. Flights of real autopilots before
2026-11-23 have the times of their commands some seconds too early: measure their rms again.

## How to read a table

    name,value,unit,baseline,goal,command,revision,host,date
    "controller, tick to u, 100 Hz: CPU",830,us each,"bare echo, single, 100 Hz: CPU",<= 2 x baseline,python -m benchmarks.speed ...

A table is a CSV file: your spreadsheet opens it, `pandas.read_csv` reads it. Its first row names each column with quantity and unit.

| column | holds |
|---|---|
| name | "subject: figure" |
| value, unit | the figure, or a word if the result is a word |
| baseline | the name of the row that the value is compared with: the least program that does the same on this host |
| goal | the limit: `<= 2`, `>= 0.05`, or `<= 2 x baseline` for a ratio; empty if the figure has no goal |
| command | what measures it again |
| revision | the commit that was measured; `-dirty` if the folder had changes that are not committed |
| host, date | where and when; `busy with other work` means that times are longer than on an idle host |

Most tables of other pages have a row for each case instead, such as [the laws with vanes](evidence/tables/laws-vanes.csv): each column names
its quantity, and `conditions` says what was flown. "mean (worst)" is over the aircraft of the row, "+-30 %" means that each entry of A and B
is drawn within 30 % of the airframe's, and a [score](glossary.md) sums the errors of the outputs.
"""  # noqa: E501 - a text as it is written


class Row(NamedTuple):
    """A figure, as text."""

    name: str  # "subject: figure", unique in a measurement
    value: str  # a number, or words such as "refused"
    unit: str = ""
    baseline: str = ""  # name of the row with which the value is compared
    goal: str = ""  # "<= 2", ">= 0.05", "<= 2 x baseline"


class Origin(NamedTuple):
    """Where the figures of a measurement come from."""

    command: str
    revision: str
    host: str
    date: str


def row(
    name: str,
    value: float | str | None,
    unit: str = "",
    *,
    at_most: float | None = None,
    at_least: float | None = None,
) -> Row:
    """Make a row; its goal is `at_most` or `at_least`, if one of them is given.

    The value is a number, or words, or None for what this host could not measure.
    """
    sign, limit = ("<=", at_most) if at_least is None else (">=", at_least)
    text = (
        "not measured"
        if value is None
        else f"{value:.6g}"
        if isinstance(value, float)
        else str(value)
    )
    return Row(name, text, unit, goal="" if limit is None else f"{sign} {limit:.6g}")


def goals_of(name: str) -> Mapping[str, str]:
    """Return the goals of a measurement. A key is a pattern of the end of a figure's name."""
    goals: Mapping[str, str] = MEASUREMENTS[name].get("goals", {})
    return goals


def split(name: str) -> tuple[str, str]:
    """Split a label into name and unit: "late p99" and "ms" from "late p99 (ms)"."""
    parts = re.fullmatch(r"(.+?) \(([^()]+)\)(.*)", name)
    return (parts[1] + parts[3], parts[2]) if parts else (name, "")


def rows(result: Any, goals: Mapping[str, str], name: str = "") -> Iterator[Row]:
    """Yield a row for each figure of a JSON result.

    Its name joins the keys that lead to it with ": ". Its goal is the first of `goals` whose
    pattern matches the end of the name.
    """
    if isinstance(result, dict):
        for key, value in result.items():
            if not (name and isinstance(value, str)):  # words are part of the label
                yield from rows(value, goals, f"{name}: {key}".removeprefix(": "))
    elif isinstance(result, list):
        labels = [_label(value) for value in result]
        for number, (label, value) in enumerate(zip(labels, result, strict=True), 1):
            place = label if labels.count(label) == 1 else f"{label} {number}".strip()
            yield from rows(value, goals, f"{name}: {place}".removeprefix(": "))
    else:
        goal = next((goal for pattern, goal in goals.items() if re.search(f"{pattern}$", name)), "")
        yield row(name, result)._replace(goal=goal)


def _label(result: Any) -> str:
    """Return the words of a JSON object, which tell it from its neighbours."""
    return (
        ", ".join(value for value in result.values() if isinstance(value, str))
        if isinstance(result, dict)
        else ""
    )


def compared(figure: Row, figures: Mapping[str, Row]) -> float:
    """Return what the goal of a figure limits: the value, or the ratio to the baseline.

    It is NaN for words.
    """
    try:
        ratio = figure.goal.endswith(BASELINE)
        return float(figure.value) / (float(figures[figure.baseline].value) if ratio else 1.0)
    except ValueError:
        return math.nan


def used(figure: Row, figures: Mapping[str, Row]) -> float:
    """Return how much of its goal a figure uses: the value over the limit, above 1 if it misses.

    For a goal with ">=" it is the limit over the value.
    """
    sign, limit = figure.goal.split()[:2]
    value = compared(figure, figures)
    low, high = (value, float(limit)) if sign == "<=" else (float(limit), value)
    if math.isnan(value) or low > high:
        return low / high if high > 0.0 else math.inf
    return max(low / high, 0.0) if high > 0.0 else 0.0


def write(name: str, figures: Iterable[Row], origin: Origin) -> None:
    """Write the CSV file of a measurement, and the page. Raises ValueError if a name repeats."""
    ordered = sorted(figures)
    if len({figure.name for figure in ordered}) < len(ordered):
        raise ValueError(f"{name}: found a name twice, expected names that differ")
    with (FOLDER / f"{name}.csv").open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(Row._fields + Origin._fields)
        writer.writerows(figure + origin for figure in ordered)
    write_page()


def write_page() -> None:
    """Write the page from the files."""
    lines = [HEAD]
    for section, measurements in SECTIONS.items():
        lines += [
            f"## {section}",
            "",
            "| measurement | goals met, and missed |",
            "|---|---|",
        ]
        for name, measurement in measurements.items():
            lines.append(_line(FOLDER / f"{name}.csv", measurement["title"]))
        lines.append("")
    PAGE.write_text("\n".join(lines))


def _line(path: Path, title: str) -> str:
    if not path.exists():
        return f"| {title} | not measured |"
    with path.open(newline="") as stream:
        lines = list(csv.reader(stream))[1:]
    figures = {line[0]: Row(*line[:5]) for line in lines}
    origin = Origin(*lines[0][5:])
    judged = sorted(
        ((used(figure, figures), figure) for figure in figures.values() if figure.goal),
        reverse=True,
    )
    met_count = sum(share <= 1.0 for share, _ in judged)
    misses: dict[str, str] = {}  # the worst of the figures that differ by their subject alone
    for _, figure in judged[: len(judged) - met_count]:
        value = compared(figure, figures)
        text = (
            figure.value
            if math.isnan(value)
            else f"{value:.3g}{'' if figure.baseline else ' ' + figure.unit}".strip()
        )
        misses.setdefault(
            figure.name.rpartition(": ")[2] + figure.goal,
            f"{figure.name} **{text}** ({figure.goal})",
        )
    verdict = f"{met_count} of {len(judged)}" if judged else "-"
    busy = ["busy host"] if BUSY in origin.host else []
    goals = "; ".join([verdict, *misses.values(), *busy])
    return f"| [{title}](evidence/{path.name}) | {goals} |"


def origin(command: str) -> Origin:
    """Return the origin of the figures of a command that starts now on this host."""
    return Origin(command, revision(), host(), f"{datetime.now(UTC):%Y-%m-%d %H:%M UTC}")


def revision(*paths: str) -> str:
    """Return the commit, with DIRTY at its end if any file but the evidence differs from it.

    With `paths`, return the last commit that touched them, with DIRTY if one of them differs from
    it.
    """
    status = _git(
        "status", "--porcelain", "--", *(paths or (".", ":(exclude)docs/evidence*"))
    ).strip()
    commit = (
        _git("log", "-1", "--format=%h", "--", *paths) if paths else _git("describe", "--always")
    )
    return commit.strip() + (DIRTY if status else "")


def _git(*arguments: str) -> str:
    command = ("git", *arguments)
    return subprocess.run(  # noqa: S603 - this repository
        command, cwd=REPOSITORY, check=False, capture_output=True, text=True
    ).stdout


def host() -> str:
    """Describe processor, cores, memory, system and Python of this host."""
    cpuinfo = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    model = re.search(r"^model name\s*: (.+)$", cpuinfo, re.MULTILINE)
    memory = round(psutil.virtual_memory().total / 2**30)
    system = f"{platform.system()} {platform.release()}, Python {platform.python_version()}"
    return (
        f"{model[1] if model else platform.machine()}, {os.cpu_count()} cores, {memory} GiB, "
        f"{system}"
    )


def measure(name: str) -> int:
    """Run a measurement and write its rows. Returns the exit status of its program.

    An exit status other than 0 becomes a row whose goal is not met.
    """
    busy = psutil.cpu_percent(interval=2.0) / 100.0
    template = COMMANDS[name]
    start = origin(template)  # before the run: a commit meanwhile is not what runs
    with tempfile.TemporaryDirectory() as folder, (BUILD / f"{name}.log").open("w") as log:
        file = Path(folder) / "result.json"
        command = template.replace("FILE", str(file)).replace("FOLDER", folder).split()
        command[0] = str(Path(sys.executable).parent / command[0])
        process = subprocess.run(  # noqa: S603
            command, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=log, text=True, check=False
        )
        log.write(process.stdout)
        text = file.read_text() if file.exists() else process.stdout
    if template.startswith("pytest"):
        counts = re.findall(
            r"(\d+) (passed|failed|skipped|error)", text.strip().rpartition("\n")[2]
        )
        result: Any = {"failed": 0} | {kind: int(count) for count, kind in counts}
    else:
        result = json.loads(text) if text.lstrip().startswith(("{", "[")) else {}
    if busy > BUSY_SHARE:
        start = start._replace(host=f"{start.host}, {100 * busy:.0f} % {BUSY}")
    failed = (
        [row("exit status", process.returncode, at_most=0)]
        if process.returncode or not result
        else []
    )
    figures = result["evidence"] if isinstance(result, dict) and "evidence" in result else None
    write(
        name,
        [
            *failed,
            *(
                rows(result, goals_of(name))
                if figures is None
                else (Row(*each) for each in figures)
            ),
        ],
        start,
    )
    return process.returncode


def main() -> int:
    """Measure, write the rows, write the page."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "--again",
        action="append",
        default=[],
        metavar="NAME",
        help="only measure again what begins so",
    )
    again = tuple(parser.parse_args().again)
    short = [name for name in COMMANDS if "long" not in MEASUREMENTS[name]]
    missing = [name for name in short if not (FOLDER / f"{name}.csv").exists()]
    todo = [name for name in COMMANDS if name.startswith(again)] if again else missing
    if again and not todo:
        parser.error(f"--again: found {again[0]!r}, expected one of {', '.join(COMMANDS)}")
    BUILD.mkdir(parents=True, exist_ok=True)
    failed = 0
    for number, name in enumerate(todo, 1):
        print(f"[{number} of {len(todo)}] {name}: {COMMANDS[name]}", flush=True)
        failed += measure(name) != 0
    write_page()
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
