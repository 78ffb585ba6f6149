# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure learning in the air: uncertain aircraft that learn in every air.

The learner is compared with the law alone, with the model of the airframe file and with the true
model.

    python -m benchmarks.learning  # every cell, 50 aircraft: at most 3 h on two idle cores
    python -m benchmarks.learning --aircraft 6  # fewer aircraft; a second run flies what is missing
    python -m benchmarks.learning --aircraft 20 --cell "rough prior"  # one cell

An aircraft learns for 64 s of osprey_learn. The model that flies at the end is frozen, and flies
the commands and the two gusts of osprey_observer. The law alone and the two models that are not
learned fly the same, and so do the laws of `rise-di compare` with their gains for the airframe
file. A row for each aircraft goes to build/learning.csv. The figures of the cells of which all
aircraft have flown go to docs/evidence/learning.csv. If they include all cells of turbulence, gusts
and calm air, the picture goes to docs/images/learning.png. An aircraft takes 2 to 3 min of a core
over all cells. For false alarms at most two aircraft fly 600 s without damage in each air, which
takes 2 min of a core each.
"""

import csv
import math
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Annotated

import typer
from benchmarks import evidence
from benchmarks.learning_figures import figures, plot, rival_figures
from benchmarks.learning_flights import (
    CELLS,
    REPOSITORY,
    Row,
    flown_rows,
)
from benchmarks.tables import save_picture
from rich.progress import track

IMAGE = REPOSITORY / "docs" / "images" / "learning.png"


def count(name: str, aircraft: int) -> int:
    """Return how many aircraft a cell has if a whole cell has `aircraft` of them."""
    return min(math.ceil(CELLS[name].share * aircraft), CELLS[name].most)


def code() -> list[str]:
    """Return the paths of the code that flies.

    They are benchmarks/learning_flights.py, and the packages of the stack that are imported now.
    """
    sources = REPOSITORY / "ros_ws" / "src"
    imported = {name.partition(".")[0] for name in sys.modules} & {
        folder.name for folder in sources.iterdir()
    }
    return [
        "benchmarks/learning_flights.py",
        *(f"ros_ws/src/{name}" for name in sorted(imported)),
    ]


# The results


def read(path: Path) -> list[Row]:
    """Return the rows of a file of results.

    Returns none if there is no file, or if an earlier version wrote it with other columns.
    """
    if not path.exists():
        return []
    with path.open(newline="") as stream:
        lines = csv.DictReader(stream)
        if tuple(lines.fieldnames or ()) != Row._fields:
            return []
        return [
            Row(*(kind(value) for kind, value in zip(KINDS, line.values(), strict=True)))
            for line in lines
        ]


KINDS = tuple(Row.__annotations__.values())


def write(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows, sorted."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerows(
            (
                Row._fields,
                *sorted(rows, key=lambda each: (list(CELLS).index(each.cell), each.number)),
            )
        )


def main(
    aircraft: Annotated[
        int, typer.Option(min=1, help="Aircraft of a cell; some have a part of it.")
    ] = 50,
    cell: Annotated[list[str], typer.Option(help="Cells; all where absent.")] = list(CELLS),  # noqa: B006 - typer copies it
    results: Annotated[Path, typer.Option(help="File of results, a row an aircraft.")] = REPOSITORY
    / "build"
    / "learning.csv",
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
) -> None:
    """Fly the aircraft that are missing in the results, and write the figures and the picture.

    The revision of a row is the last commit that touched the code of `code`. A row with another
    revision is flown again. All rows are flown again if this code has changes that are not
    committed.
    """
    if unknown := [name for name in cell if name not in CELLS]:
        raise typer.BadParameter(
            f"found {', '.join(unknown)}, expected cells among {', '.join(CELLS)}"
        )
    begun = evidence.origin(f"python -m benchmarks.learning --aircraft {aircraft}")
    flown_by = evidence.revision(*code())
    rows = [
        each
        for each in read(results)
        if each.revision == flown_by and not flown_by.endswith(evidence.DIRTY)
    ]
    known = {(each.cell, each.number) for each in rows}
    # one aircraft after another in all cells, so that a run that ends early has some of each cell
    cases: dict[tuple[int, float, str], list[str]] = {}
    for n in range(aircraft):
        for name in cell:
            if n < count(name, aircraft) and (name, n) not in known:
                # what does not learn flies the same in all these cells of an uncertainty
                shared = "" if CELLS[name].kind == "learn" else name
                cases.setdefault((n, CELLS[name].uncertainty, shared), []).append(name)
    with ProcessPoolExecutor(jobs) as pool:
        pending = [pool.submit(flown_rows, names, n) for (n, _, _), names in cases.items()]
        for future in track(as_completed(pending), "aircraft", total=len(pending)):
            rows += [each._replace(revision=flown_by) for each in future.result()]
            write(results, rows)
    rows = [each for each in rows if each.number < count(each.cell, aircraft)]
    whole = [
        name for name in CELLS if sum(each.cell == name for each in rows) == count(name, aircraft)
    ]
    rows = [each for each in rows if each.cell in whole]
    found = list(figures(rows))
    airs = [name for name in CELLS if CELLS[name].kind == "learn"]
    for uncertainty in sorted({CELLS[name].uncertainty for name in airs if name in whole}):
        found += rival_figures(uncertainty, range(aircraft))
    for each in found:
        print(each.name, each.value, each.unit, each.goal and f"(goal {each.goal})")
    if found:
        evidence.write("learning", found, begun)
    if set(airs) <= set(whole):
        save_picture(plot(rows), IMAGE, colours=32)


if __name__ == "__main__":
    typer.run(main)
