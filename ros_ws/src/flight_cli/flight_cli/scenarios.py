# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di scenarios`: the scenarios by name."""

from dataclasses import dataclass

from rich.console import Console

from flight_analysis.closed_loop.scenario_library import LIBRARY, find_scenario
from flight_cli.output import new_table, print_json
from flight_cli.words import argument, json_option, scenario_names


@dataclass(frozen=True, kw_only=True)
class Scenarios:
    """List scenarios: what each flies, its aircraft and its law.

    Exit status: 0, or 2 for a file with a mistake.
    """

    names: list[str] | None = argument(
        "Names, or scenario files (.yaml); by default all that ship.",
        metavar="[SCENARIO]...",
        autocompletion=scenario_names,
    )
    as_json: bool = json_option()

    def execute(self) -> None:
        """Print a row a scenario."""
        rows = []
        for name in self.names or sorted(path.stem for path in LIBRARY.glob("*.yaml")):
            scenario = find_scenario(name)
            comment = (
                line.removeprefix("#").strip()
                for line in scenario.path.read_text(encoding="utf-8").splitlines()
            )
            sentence = next((line for line in comment if line and not line.startswith("SPDX")), "")
            row = {"name": scenario.name, "flies": sentence, "aircraft": scenario.aircraft.airframe}
            rows.append(row | {"law": scenario.controller.law})
        if self.as_json:
            print_json(rows)
            return
        headings = ("name", "flies", "aircraft", "law")
        table = new_table("Scenarios", headings, left_aligned=headings, wrapped=("flies",))
        for row in rows:
            table.add_row(*row.values())
        Console().print(table)
