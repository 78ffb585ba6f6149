# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Evidence as data: docs/evidence/NAME.csv holds the figures of the measurement NAME, a row for each figure, sorted by name."""

import csv
import math
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDER = REPOSITORY / "docs" / "evidence"
BASELINE = " x baseline"  # end of a goal on a ratio
DIRTY = "-dirty"  # end of a revision with changes that are not committed
BUSY = "busy with other work"  # end of a host on which times are longer than on an idle host


class Row(NamedTuple):
    """A figure, as text."""

    name: str  # "subject: figure", unique in a measurement
    value: str  # a number, or words such as "refused"
    unit: str = ""
    baseline: str = ""  # name of the row with which the value is compared
    goal: str = ""  # "<= 2", ">= 0.05", "<= 2 x baseline"

    @property
    def figure(self) -> str:
        """The name without the subject."""
        return self.name.rpartition(": ")[2]


class Origin(NamedTuple):
    """Where the figures of a measurement come from."""

    command: str
    revision: str
    host: str
    date: str


class Measured(NamedTuple):
    """A measurement."""

    rows: tuple[Row, ...]
    origin: Origin


def row(
    name: str,
    value: float | str | None,
    unit: str = "",
    *,
    at_most: float | None = None,
    at_least: float | None = None,
    baseline: str = "",
    of_baseline: bool = False,
) -> Row:
    """A row from a number, words, or None where the host could not measure; `of_baseline`: the goal is a ratio."""
    sign, limit = ("<=", at_most) if at_least is None else (">=", at_least)
    goal = "" if limit is None else f"{sign} {_text(limit)}" + BASELINE * of_baseline
    return Row(name, "not measured" if value is None else _text(value), unit, baseline, goal)


def _text(value: float | str) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def compared(figure: Row, rows: Mapping[str, Row]) -> float:
    """What the goal of a figure limits: the value, or the ratio to the baseline. Raises ValueError for words.

    `rows` holds the rows of the measurement by name, for the baseline.
    """
    ratio = figure.goal.endswith(BASELINE)
    return float(figure.value) / (float(rows[figure.baseline].value) if ratio else 1.0)


def used(figure: Row, rows: Mapping[str, Row]) -> float | None:
    """Share of the goal that a figure uses: above 1 the goal is not met. Infinite for words, None without a goal."""
    if not figure.goal:
        return None
    sign, limit = figure.goal.split()[:2]
    try:
        value = compared(figure, rows)
    except ValueError:
        return math.inf
    low, high = (value, float(limit)) if sign == "<=" else (float(limit), value)
    if low <= high:
        return max(low / high, 0.0) if high > 0.0 else 0.0
    return low / high if high > 0.0 else math.inf


def write(name: str, rows: Iterable[Row], origin: Origin, folder: Path = FOLDER) -> None:
    """Write the CSV file of a measurement. Raises ValueError where a name repeats."""
    ordered = sorted(rows)
    if len({figure.name for figure in ordered}) < len(ordered):
        raise ValueError(f"{name}: found a name twice, expected names that differ")
    with (folder / f"{name}.csv").open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(Row._fields + Origin._fields)
        writer.writerows(figure + origin for figure in ordered)


def read(folder: Path = FOLDER) -> dict[str, Measured]:
    """The measurements of a folder by name. Raises ValueError for another heading, and for a file of several origins."""
    return {path.stem: _read(path) for path in sorted(folder.glob("*.csv"))}


def _read(path: Path) -> Measured:
    with path.open(encoding="utf-8", newline="") as stream:
        heading, *lines = csv.reader(stream)
    width, origins = len(Row._fields), {tuple(line[len(Row._fields) :]) for line in lines}
    if heading != [*Row._fields, *Origin._fields] or len(origins) != 1:
        raise ValueError(f"{path}: found {', '.join(heading)} and {len(origins)} origins, expected those of `write` and 1")
    return Measured(tuple(Row(*line[:width]) for line in lines), Origin(*origins.pop()))


def origin(command: str) -> Origin:
    """The origin of figures that a command begins to measure now on this host."""
    return Origin(command, revision(), host(), f"{datetime.now(UTC):%Y-%m-%d %H:%M UTC}")


def revision(*paths: str) -> str:
    """The commit, with DIRTY if any file but the evidence differs from the commit; of `paths` the last that touched them."""
    changed = _git("status", "--porcelain", "--", *(paths or (".", ":(exclude)docs/evidence*"))).strip()
    commit = _git("log", "-1", "--format=%h", "--", *paths) if paths else _git("describe", "--always")
    return commit.strip() + (DIRTY if changed else "")


def _git(*arguments: str) -> str:
    command = ("git", *arguments)
    return subprocess.run(command, cwd=REPOSITORY, check=False, capture_output=True, text=True).stdout  # noqa: S603 - this repository


def host() -> str:
    """Processor, cores, memory, system and Python of this host."""
    cpuinfo = Path("/proc/cpuinfo").read_text(encoding="utf-8") if Path("/proc/cpuinfo").exists() else ""
    model = re.search(r"^model name\s*: (.+)$", cpuinfo, re.MULTILINE)
    processor = model.group(1) if model else platform.machine()
    memory = round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30)
    system = f"{platform.system()} {platform.release()}, Python {platform.python_version()}"
    return f"{processor}, {os.cpu_count()} cores, {memory} GiB, {system}"
