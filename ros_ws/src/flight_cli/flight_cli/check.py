# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di check`, which compares a channel map with the D of the controller.

It also checks a map against a recorded flight, and against the message definitions of an
autopilot's releases.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import typer
from rich.console import Console

from aircraft_sim.airframes.airframe import load_airframe
from autopilot_bridge.channel_map import version_faults
from autopilot_bridge.map_check import (
    CheckedRow,
    check_map,
    definitions_below,
    installed_definitions,
    is_known,
)
from autopilot_bridge.map_rows import MAVLINK, InputRow, OutputRow
from autopilot_bridge.params import ChannelMap, load_map
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_cli.log_options import log_namespace, warn_of_lacks_in
from flight_cli.output import new_table, print_json, print_table, say
from flight_cli.words import (
    REQUIRED,
    airframe_names,
    argument,
    json_option,
    map_names,
    option,
    scenario_names,
    warn,
)
from flight_design.identification.response_identification import MIN_RATIO
from flight_design.identification.sign_check import (
    SignCheck,
    check_scenario,
    motion_as_channel_grows,
)

CONTRADICTS = 1
INSTALLED = "installed"  # stands for the message packages of this host, in place of a folder


@dataclass(frozen=True, kw_only=True)
class Check:
    """Compare the D of the controller with the D of a channel map, and with a recorded flight.

    With --definitions, compare the topic, the field and the constants of each row of the map with
    releases of an autopilot, and tell for which releases the row holds. Rows of MAVLink are always
    compared with pymavlink.

    A sign that was not measured with certainty is no contradiction: the table has a ? and a
    sentence says which excitation is necessary. Exit status: 0 agreement, 1 a contradiction or a
    row that does not hold, 2 bad input.
    """

    map_name: str = argument(
        "Name of a channel map, or path of its file (.yaml).",
        default=REQUIRED,
        metavar="MAP",
        autocompletion=map_names,
    )
    airframe: str | None = option(
        "Airframe; by default the one of the scenario.", autocompletion=airframe_names
    )
    scenario: str = option(
        "Scenario that has the controller.", default="osprey_servo", autocompletion=scenario_names
    )
    run: Path | None = option(
        "A recorded flight with y and u in which each input was excited; with a bridge, only the "
        "engaged time counts."
    )
    namespace: str | None = log_namespace()
    definitions: list[Path] | None = option(
        "Check the rows of the map against this folder, the sources of a message package of one "
        f"release, or {INSTALLED} for this host; may be repeated, one column each."
    )
    as_json: bool = json_option()

    def execute(self) -> None:
        """Compare signs, or the rows of the map with releases, and print the contradictions."""
        channel_map = load_map(self.map_name)
        if self.definitions:
            _check_rows(channel_map, self.definitions, self.as_json)
            return
        topics = [(topic, kind) for _, topic, kind in channel_map.used_topics()]
        for fault in version_faults(row for row in topics if row[0].startswith("/fmu/")):
            warn(f"warning: {fault}")
        scenario = find_scenario(self.scenario)
        frame = load_airframe(self.airframe or scenario.aircraft.airframe)
        if self.run is not None:
            warn_of_lacks_in(self.run, self.namespace)
        sign_check = check_scenario(channel_map, scenario, frame, self.run, self.namespace)
        if self.as_json:
            print_json(
                {
                    "map": channel_map.name,
                    "channels": [channel._asdict() for channel in sign_check.channels],
                    "seconds": sign_check.seconds,
                    "contradictions": list(sign_check.contradictions),
                }
            )
        else:
            _show(Console(), channel_map, sign_check, frame.name)
        for sentence in sign_check.uncertain:
            warn(f"not certain: {sentence}")
        for sentence in sign_check.contradictions:
            warn(f"error: {sentence}")
        if sign_check.contradictions:
            raise typer.Exit(CONTRADICTS)


def _show(console: Console, channel_map: ChannelMap, sign_check: SignCheck, airframe: str) -> None:
    title = f"Map {channel_map.name}, airframe {airframe}: what a positive u does"
    headings = (
        "u",
        "moves",
        "seen in",
        "effect",
        "D",
        "of law",
        *(["recorded"] if sign_check.seconds else []),
    )
    table = new_table(title, headings, left_aligned=("u", "moves", "seen in"))
    for channel in sign_check.channels:
        cells = [
            channel.input,
            motion_as_channel_grows(channel_map.inputs[channel.input]),
            f"{channel.output} ({motion_as_channel_grows(channel_map.outputs[channel.output])})",
            f"{channel.effect:+.3g}",
            f"{channel.D:+d}",
            f"{channel.D_controller:+d}" + ("" if channel.D_controller == channel.D else " !"),
        ]
        if channel.measured is not None and channel.ratio is not None:
            cells.append(
                f"{channel.measured:+.3g} "
                f"({channel.ratio:.0f}){' ' if channel.ratio >= MIN_RATIO else '?'}"
            )
        table.add_row(*cells)
    print_table(console, table)
    # A second table has the fields of the map and their topics.
    headings = ("channel", "raw value", "topic")
    fields = new_table("", headings, left_aligned=headings)
    for channel in sign_check.channels:
        command = channel_map.inputs[channel.input]
        output = channel_map.outputs[channel.output]
        fields.add_row(
            f"u.{channel.input}",
            _format_field(command),
            channel_map.messages[command.message].topic,
        )
        fields.add_row(f"y.{channel.output}", _format_field(output), output.topic)
    print_table(console, fields)
    if sign_check.seconds:
        say(
            console,
            f"recorded: Omega_ii from {sign_check.seconds:.0f} s, in brackets the response in "
            f"standard errors; below {MIN_RATIO:g} the sign is not certain (?)",
            style="dim",
        )


def _format_field(row: OutputRow | InputRow) -> str:
    """Write the name of a field with the sign of the channel in front."""
    return f"{'-' if row.sign < 0 else '+'} {row.field}"


def _check_rows(channel_map: ChannelMap, definitions: Sequence[Path], as_json: bool) -> None:
    """Compare the rows of a map with message definitions, and print which rows do not hold.

    The definitions come from releases of an autopilot.
    """
    kinds = list(dict.fromkeys(field.type for field in channel_map.used_fields()))
    installed = installed_definitions(kinds)
    mavlink_types = {
        kind: types for kind, types in installed.items() if kind.startswith(f"{MAVLINK}/")
    }
    names = [folder.resolve().name for folder in definitions]
    releases = [
        installed
        if str(folder) == INSTALLED
        else {**definitions_below(folder, kinds), **mavlink_types}
        for folder in definitions
    ]
    rows = check_map(channel_map, releases)
    if as_json:
        print_json(
            {
                "map": channel_map.name,
                "releases": names,
                "rows": [_row_as_json(row) for row in rows],
            }
        )
    else:
        _show_rows(channel_map.name, rows, names)
        for name, types in zip(names, releases, strict=True):
            if absent := sorted(
                {kind.partition("/")[0] for kind in kinds if not is_known(types, kind)}
            ):
                warn(
                    f"note: {name}: no definition of {', '.join(absent)}: make messages, or "
                    "another folder"
                )
    if any(any(row.faults) for row in rows):
        raise typer.Exit(CONTRADICTS)


def _row_as_json(row: CheckedRow) -> dict[str, object]:
    """Return a row of a channel map as a dict that JSON can hold.

    It has a sentence for each release, which is empty if the row fits this release.
    """
    return row._asdict() | {"faults": [str(fault or "") for fault in row.faults]}


def _show_rows(name: str, rows: Sequence[CheckedRow], releases: Sequence[str]) -> None:
    """Print one line for each row of the map, and a sentence for each row that does not hold."""
    faults: dict[str, list[dict[str, None]]] = {}
    for row in rows:
        by_release = faults.setdefault(row.key, [{} for _ in releases])
        for sentences, fault in zip(by_release, row.faults, strict=True):
            sentences.update({str(fault): None} if fault else {})
    table = new_table(
        f"Map {name}: which rows hold",
        ("row", *releases),
        left_aligned=("row", *releases),
        wrapped=releases,
    )
    for key, by_release in faults.items():
        table.add_row(key, *("no" if fault else "holds" for fault in by_release))
    Console().print(table)
    for k, release in enumerate(releases):
        holding_count = sum(not by_release[k] for by_release in faults.values())
        print(f"{release}: {holding_count} of {len(faults)} rows hold")
        for key, by_release in faults.items():
            if by_release[k]:
                print(f"    {key}: {', '.join(by_release[k])}")
