# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di check-map`: compare the rows of a channel map with the message definitions of releases of an autopilot."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from autopilot_bridge.map_check import CheckedRow, definitions_below, installed_definitions, is_known
from autopilot_bridge.map_check import check_map as checked_rows
from autopilot_bridge.params import MAVLINK, load_map
from flight_cli.output import new_table, print_json

DOES_NOT_HOLD = 1


def check_map(
    map_name: Annotated[str, typer.Argument(metavar="MAP", help="Name of a channel map, or path of one (.yaml).")],
    definitions: Annotated[
        list[Path] | None,
        typer.Option(help="Folder with the sources of a message package, of one release; several, each a column."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON, nothing else.")] = False,
) -> None:
    """Tell for which releases of an autopilot the rows of a channel map hold: topic, field and constants of each.

    Without --definitions against the installed message packages; rows of MAVLink always against pymavlink.
    Exit status: 0 every row holds, 1 a row does not, 2 bad input.
    """
    channel_map = load_map(map_name)
    kinds = list(dict.fromkeys(kind for _, _, kind, *_ in channel_map.used_fields()))
    installed = installed_definitions(kinds)
    mavlink_types = {kind: types for kind, types in installed.items() if kind.startswith(f"{MAVLINK}/")}
    names = ["installed"] if not definitions else [folder.resolve().name for folder in definitions]
    releases = (
        [installed] if not definitions else [{**definitions_below(folder, kinds), **mavlink_types} for folder in definitions]
    )
    rows = checked_rows(channel_map, releases)
    if as_json:
        print_json({"map": channel_map.name, "releases": names, "rows": [row._asdict() for row in rows]})
    else:
        _show(channel_map.name, rows, names)
        for name, types in zip(names, releases, strict=True):
            if absent := sorted({kind.partition("/")[0] for kind in kinds if not is_known(types, kind)}):
                print(f"note: {name}: no definition of {', '.join(absent)}: make messages, or --definitions", file=sys.stderr)
    if any(any(row.faults) for row in rows):
        raise typer.Exit(DOES_NOT_HOLD)


def _show(name: str, rows: Sequence[CheckedRow], releases: Sequence[str]) -> None:
    """Print a row for each row of the map, and a sentence for each that does not hold."""
    faults: dict[str, list[dict[str, None]]] = {}
    for row in rows:
        by_release = faults.setdefault(row.key, [{} for _ in releases])
        for sentences, fault in zip(by_release, row.faults, strict=True):
            sentences.update({fault: None} if fault else {})
    table = new_table(f"Map {name}: which rows hold", ("row", *releases), left_aligned=("row", *releases), wrapped=releases)
    for key, by_release in faults.items():
        table.add_row(key, *("no" if fault else "holds" for fault in by_release))
    Console().print(table)
    for k, release in enumerate(releases):
        held = sum(not by_release[k] for by_release in faults.values())
        print(f"{release}: {held} of {len(faults)} rows hold")
        for key, by_release in faults.items():
            if by_release[k]:
                print(f"    {key}: {', '.join(by_release[k])}")
