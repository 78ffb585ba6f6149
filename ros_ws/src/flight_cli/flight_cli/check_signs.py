# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di check-signs`: D of the controller beside what a channel map, and a recorded flight, do with the signs."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from aircraft_sim.airframe import load_airframe
from autopilot_bridge.params import ChannelMap, InputRow, OutputRow, load_map
from autopilot_bridge.signs import SURE
from flight_analysis.design.sign_check import SignCheck, check_scenario, motion_as_channel_grows
from flight_bringup.scenarios import find_scenario

CONTRADICTS = 1


def check_signs(
    map_name: Annotated[str, typer.Argument(metavar="MAP", help="Name of a channel map, or path of one (.yaml).")],
    airframe: Annotated[str | None, typer.Option(help="The airframe, in place of the scenario's.")] = None,
    scenario: Annotated[str, typer.Option(help="The scenario whose controller is to fly.")] = "osprey_gust",
    bag: Annotated[Path | None, typer.Option(help="A recorded flight with y and u, each input excited.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON, nothing else.")] = False,
) -> None:
    """Follow each input through a channel map to the output it moves, and compare the D that follows with the controller's.

    Exit status: 0 they agree, 1 they contradict each other, 2 bad input.
    """
    chart = load_map(map_name)
    chosen = find_scenario(scenario)
    frame = load_airframe(airframe or chosen.aircraft.airframe)
    checked = check_scenario(chart, chosen, frame, bag)
    if as_json:
        print(json.dumps(_plain(chart, checked)))
    else:
        _show(Console(), chart, checked, frame.name)
    for sentence in checked.contradictions:
        print(f"error: {sentence}", file=sys.stderr)
    if checked.contradictions:
        raise typer.Exit(CONTRADICTS)


def _show(console: Console, chart: ChannelMap, checked: SignCheck, airframe: str) -> None:
    title = f"Map {chart.name}, airframe {airframe}: what a positive u does"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("u", "moves", "seen in", "effect", "D", "of law"):
        table.add_column(heading, justify="right" if heading in {"effect", "D", "of law"} else "left", no_wrap=True)
    if checked.intervals:
        table.add_column("recorded", justify="right", no_wrap=True)
    for one in checked.channels:
        cells = [
            one.input,
            motion_as_channel_grows(chart.inputs[one.input]),
            f"{one.output} ({motion_as_channel_grows(chart.outputs[one.output])})",
            f"{one.effect:+.3g}",
            f"{one.D:+d}",
            f"{one.D_controller:+d}" + ("" if one.D_controller == one.D else " !"),
        ]
        if one.measured is not None and one.ratio is not None:
            cells.append(f"{one.measured:+.3g} ({one.ratio:.0f}){' ' if one.ratio >= SURE else '?'}")
        table.add_row(*cells)
    console.print(table)
    fields = Table(box=box.SIMPLE_HEAD)
    for heading in ("channel", "raw value", "topic"):
        fields.add_column(heading, no_wrap=True)
    for one in checked.channels:
        given, taken = chart.inputs[one.input], chart.outputs[one.output]
        fields.add_row(f"u.{one.input}", _signed(given), chart.messages[given.message].topic)
        fields.add_row(f"y.{one.output}", _signed(taken), taken.topic)
    console.print(fields)
    if checked.intervals:
        console.print(
            f"recorded: least squares over {checked.intervals} intervals; in brackets beside its standard error,"
            f" unsure (?) below {SURE:g}",
            style="dim",
        )


def _signed(row: OutputRow | InputRow) -> str:
    """The field, with the sign between it and the channel."""
    return f"{'-' if row.sign < 0 else '+'} {row.field}"


def _plain(chart: ChannelMap, checked: SignCheck) -> dict[str, Any]:
    return {
        "map": chart.name,
        "channels": [one._asdict() for one in checked.channels],
        "intervals": checked.intervals,
        "contradictions": list(checked.contradictions),
    }
