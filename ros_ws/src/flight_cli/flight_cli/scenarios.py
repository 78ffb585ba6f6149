# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di scenarios`, which lists the scenarios by name."""

from dataclasses import dataclass
from itertools import dropwhile, takewhile

from rich.console import Console

from flight_analysis.closed_loop.scenario_library import LIBRARY, find_scenario
from flight_cli.output import new_table, print_json
from flight_cli.words import argument, json_option, scenario_names


def first_sentences(text: str) -> str:
    """Return the first sentences of the comment at the head of a file.

    The text ends at the first line that ends with a full stop, or at the end of the paragraph.
    """
    head = takewhile(lambda line: line.startswith("#") or not line.strip(), text.splitlines())
    comment = (line.removeprefix("#").strip() for line in head)
    written = dropwhile(lambda line: not line or line.startswith("SPDX"), comment)
    lines: list[str] = []
    for line in takewhile(bool, written):
        lines.append(line)
        if line.endswith("."):
            break
    return " ".join(lines)


@dataclass(frozen=True, kw_only=True)
class Scenarios:
    """List scenarios: what each flies, its aircraft and its law.

    Exit status: 0, or 2 for a file with a mistake.
    """

    names: list[str] | None = argument(
        "Names, or scenario files (.yaml); by default all scenarios that ship.",
        metavar="[SCENARIO]...",
        autocompletion=scenario_names,
    )
    as_json: bool = json_option()

    def execute(self) -> None:
        """Print a row for each scenario."""
        rows = []
        for name in self.names or sorted(path.stem for path in LIBRARY.glob("*.yaml")):
            scenario = find_scenario(name)
            text = scenario.path.read_text(encoding="utf-8")
            sentences = first_sentences(text)
            row = {
                "name": scenario.name,
                "flies": sentences,
                "aircraft": scenario.aircraft.airframe,
            }
            rows.append(row | {"law": scenario.controller.law})
        if self.as_json:
            print_json(rows)
            return
        headings = ("name", "flies", "aircraft", "law")
        table = new_table("Scenarios", headings, left_aligned=headings, wrapped=("flies",))
        for row in rows:
            table.add_row(*row.values())
        Console().print(table)
