# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Results of guidance, stored in build/guidance, and the page docs/evidence_guidance.md that is written from them."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.evidence import revision
from benchmarks.guidance_grid import Point

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDER = REPOSITORY / "build" / "guidance"
PAGE = REPOSITORY / "docs" / "evidence_guidance.md"
INTRODUCTION = """\
# Evidence: guidance

`python -m benchmarks.guidance` flies guidance by rule and writes this page; what it means is in [guidance](guidance.md) and
[experiments](experiments.md#guidance-by-rule). *Italics* miss their limit. In turbulence a figure is the worst of the seeds.
[Long flights](evidence.md#long-flights) are with the other evidence.
"""


def store(name: str, result: Any) -> None:
    """Keep a result with its date and revision, and write the page again."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    dated = {"date": f"{datetime.now(UTC):%Y-%m-%d %H:%M UTC}, {revision()}", "result": result}
    (FOLDER / f"{name}.json").write_text(json.dumps(dated, indent=1), encoding="utf-8")
    results = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(FOLDER.glob("*.json"))}
    PAGE.write_text(page(results, PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""), encoding="utf-8")


def page(results: Mapping[str, Mapping[str, Any]], before: str = "") -> str:
    """The page from the stored results by name: "flights NAME", "grid NAME", "rates" and "route".

    A section without a result stays as it is on the page `before`: another machine may have measured it.
    """
    makers = {"flights": _flights, "grid": _grid, "rates": _rates, "route": _route}
    sections = {one.partition("\n")[0]: one.strip() + "\n" for one in re.split(r"^## ", before, flags=re.MULTILINE)[1:]}
    for name, stored in results.items():
        kind, _, aircraft = name.partition(" ")
        title, command, lines = makers[kind](aircraft, stored["result"])
        sections[title] = "\n".join([f"{title}\n\n    {command}    # {stored['date']}\n", *lines]) + "\n"
    return "\n## ".join([INTRODUCTION, *sections.values()])


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Lines of a table in Markdown; its first column is text."""
    yield "| " + " | ".join(heads) + " |"
    yield "| --- |" + " ---: |" * (len(heads) - 1)
    for row in rows:
        yield "| " + " | ".join(row) + " |"


def _flights(aircraft: str, rows: Any) -> tuple[str, str, list[str]]:
    """Rows (manoeuvre, air, figure, value, limit, seeds)."""
    title, command = f"Holds and paths, {aircraft}", f"python -m benchmarks.guidance --only {aircraft}"
    return title, command, list(_figures(rows))


def _route(_: str, rows: Any) -> tuple[str, str, list[str]]:
    """Rows (aircraft, manoeuvre, air, figure, value, limit, seeds)."""
    sentences = [
        "Seven waypoints with turns of 45, 45, 63, 117 and -76 deg at the least radius, a climb of 10 m and a sink of as much.",
        "Nothing of guidance was tried on these aircraft while it was built; each is identified first.\n",
    ]
    lines = [*sentences, *_figures((aircraft, *row) for aircraft, _, *row in rows)]
    seeds = max(row[-1] for row in rows)
    return "Another route, other aircraft", f"python -m benchmarks.guidance --route --seeds {seeds}", lines


def _figures(rows: Iterable[Any]) -> Iterator[str]:
    """The table of rows (about, air, figure, value, limit, seeds)."""
    cells = []
    for about, air, figure, value, limit, seeds in rows:
        shown = f"{value:.3g}" if value <= limit else f"*{value:.3g}*"
        cells.append((f"{about}: {figure}", air + (f", {seeds} seeds" if seeds else ""), shown, f"{limit:.3g}"))
    return table(("figure", "air", "worst", "limit"), cells)


def _grid(aircraft: str, points: Any) -> tuple[str, str, list[str]]:
    """Points as `guidance_grid.Point`."""
    flown = [Point(*point) for point in points]
    speeds = sorted({point.speed for point in flown})
    by_place = {(point.altitude, point.speed): point.result for point in flown}
    rows = [
        [f"{altitude:g}", *(by_place.get((altitude, speed), "-") for speed in speeds)]
        for altitude in sorted({point.altitude for point in flown})
    ]
    lost = [point for point in flown if point.result == "lost"]
    sentence = f"{sum(point.result == 'ok' for point in flown)} of {len(flown)} points flown, {len(lost)} lost."
    reasons = [f"- lost at {point.speed:g} m/s and {point.altitude:g} m: {point.reason}" for point in lost]
    heads = ["altitude (m), airspeed (m/s)", *(f"{speed:g}" for speed in speeds)]
    title, command = f"Off the design point, {aircraft}", f"python -m benchmarks.guidance --grid --only {aircraft}"
    return title, command, [*table(heads, rows), "", sentence, *reasons]


def _rates(_: str, rows: Any) -> tuple[str, str, list[str]]:
    """Rows (aircraft, air, ratio by rate, limit)."""
    cells = [
        (f"{aircraft}, {air}", *(f"{one:.2f}" if one <= limit else f"*{one:.2f}*" for one in ratios.values()), f"{limit:g}")
        for aircraft, air, ratios, limit in rows
    ]
    lines = [
        "The rms of e with guidance over that without. In calm air: a turn of 90 deg over the commands of the scenario's own.",
        "In turbulence of 1.5 m/s: straight flight over straight flight without commands. r of the f16 misses its limit:",
        "its rudder is at its stop in turns.\n",
        *table(("aircraft", *rows[0][2], "limit"), cells),
    ]
    return "Errors of the rates", "python -m benchmarks.guidance --rates", lines
