# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di check-signs`: compare D of the controller with the signs of a channel map and of a recorded flight."""

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from aircraft_sim.airframe import load_airframe
from autopilot_bridge.channel_map import version_faults
from autopilot_bridge.params import ChannelMap, InputRow, OutputRow, load_map
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_cli.log_options import LogNamespace, warn_of_lacks_in
from flight_cli.output import new_table, print_json
from flight_design.identification.response_identification import MIN_RATIO
from flight_design.identification.sign_check import SignCheck, check_scenario, motion_as_channel_grows

CONTRADICTS = 1


def check_signs(
    map_name: Annotated[str, typer.Argument(metavar="MAP", help="Name of a channel map, or path of one (.yaml).")],
    airframe: Annotated[str | None, typer.Option(help="Airframe; by default that of the scenario.")] = None,
    scenario: Annotated[str, typer.Option(help="Scenario with the controller.")] = "osprey_servo",
    bag: Annotated[
        Path | None, typer.Option(help="A recorded flight with y and u, each input excited; with a bridge, its engaged time.")
    ] = None,
    namespace: LogNamespace = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON, nothing else.")] = False,
) -> None:
    """Compare the D of the controller with the D of a channel map, and with a recorded flight.

    A sign without a certain measurement is no contradiction: a ? in the table, and a sentence with the necessary excitation.
    Exit status: 0 agreement, 1 contradiction, 2 bad input.
    """
    channel_map = load_map(map_name)
    for fault in version_faults((topic, kind) for _, topic, kind in channel_map.used_topics() if topic.startswith("/fmu/")):
        print(f"warning: {fault}", file=sys.stderr)
    chosen = find_scenario(scenario)
    frame = load_airframe(airframe or chosen.aircraft.airframe)
    if bag is not None:
        warn_of_lacks_in(bag, namespace)
    checked = check_scenario(channel_map, chosen, frame, bag, namespace)
    if as_json:
        channels = [channel._asdict() for channel in checked.channels]
        sentences = list(checked.contradictions)
        result = {"map": channel_map.name, "channels": channels, "seconds": checked.seconds, "contradictions": sentences}
        print_json(result)
    else:
        _show(Console(), channel_map, checked, frame.name)
    for sentence in checked.uncertain:
        print(f"not certain: {sentence}", file=sys.stderr)
    for sentence in checked.contradictions:
        print(f"error: {sentence}", file=sys.stderr)
    if checked.contradictions:
        raise typer.Exit(CONTRADICTS)


def _show(console: Console, channel_map: ChannelMap, checked: SignCheck, airframe: str) -> None:
    title = f"Map {channel_map.name}, airframe {airframe}: what a positive u does"
    headings = ("u", "moves", "seen in", "effect", "D", "of law", *(["recorded"] if checked.seconds else []))
    table = new_table(title, headings, left_aligned=("u", "moves", "seen in"))
    for channel in checked.channels:
        cells = [
            channel.input,
            motion_as_channel_grows(channel_map.inputs[channel.input]),
            f"{channel.output} ({motion_as_channel_grows(channel_map.outputs[channel.output])})",
            f"{channel.effect:+.3g}",
            f"{channel.D:+d}",
            f"{channel.D_controller:+d}" + ("" if channel.D_controller == channel.D else " !"),
        ]
        if channel.measured is not None and channel.ratio is not None:
            cells.append(f"{channel.measured:+.3g} ({channel.ratio:.0f}){' ' if channel.ratio >= MIN_RATIO else '?'}")
        table.add_row(*cells)
    console.print(table)
    headings = ("channel", "raw value", "topic")
    fields = new_table("", headings, left_aligned=headings)
    for channel in checked.channels:
        command = channel_map.inputs[channel.input]
        output = channel_map.outputs[channel.output]
        fields.add_row(f"u.{channel.input}", _format_field(command), channel_map.messages[command.message].topic)
        fields.add_row(f"y.{channel.output}", _format_field(output), output.topic)
    console.print(fields)
    if checked.seconds:
        console.print(
            f"recorded: Omega_ii from {checked.seconds:.0f} s, in brackets the response in standard errors;"
            f" below {MIN_RATIO:g} the sign is not certain (?)",
            style="dim",
        )


def _format_field(row: OutputRow | InputRow) -> str:
    """The field with the sign of the channel in front."""
    return f"{'-' if row.sign < 0 else '+'} {row.field}"
