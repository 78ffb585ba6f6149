# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di check-signs`: D of the controller beside what a channel map, and a recorded flight, do with the signs."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.table import Table

from aircraft_sim.airframe import Airframe, load_airframe
from autopilot_bridge.params import ChannelMap, InputRow, OutputRow, load_map
from autopilot_bridge.signs import SURE, Estimate, estimate, output_signs, through
from flight_analysis.bag_reader import read_run
from flight_analysis.scenario import Scenario
from flight_bringup.scenarios import find_scenario
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray
from rise_di_controller.decomposition import signs

CONTRADICTS = 1


class Channel(NamedTuple):
    """One channel of the law, through the map."""

    output: str
    input: str
    effect: float  # Omega_ii as the controller sees it, SI
    D: int  # that follows from the airframe and the map
    D_controller: int
    measured: float | None  # Omega_ii by a recorded flight
    ratio: float | None  # beside its standard error


class Checked(NamedTuple):
    """What the check found."""

    channels: tuple[Channel, ...]
    contradictions: tuple[str, ...]  # sentences
    intervals: int  # of the recorded flight


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
    checked = _check_for(chart, chosen, frame, bag)
    if as_json:
        print(json.dumps(_plain(chart, checked)))
    else:
        _show(Console(), chart, checked, frame.name)
    for sentence in checked.contradictions:
        print(f"error: {sentence}", file=sys.stderr)
    if checked.contradictions:
        raise typer.Exit(CONTRADICTS)


def require_signs(chart: ChannelMap, scenario: Scenario) -> None:
    """Raise ParameterError where a map contradicts the D of a scenario's controller, by the scenario's airframe."""
    checked = _check_for(chart, scenario, load_airframe(scenario.aircraft.airframe), None)
    if checked.contradictions:
        raise ParameterError("; ".join(checked.contradictions))


def _check_for(chart: ChannelMap, scenario: Scenario, frame: Airframe, bag: Path | None) -> Checked:
    outputs, inputs = scenario.controller.outputs, scenario.controller.inputs
    for key, found, expected in (
        (f"map {chart.name}: outputs", tuple(chart.outputs), outputs),
        (f"map {chart.name}: inputs", tuple(chart.inputs), inputs),
        (f"airframe {frame.name}: outputs", frame.outputs, outputs),
        (f"airframe {frame.name}: inputs", tuple(frame.inputs), inputs),
    ):
        require(sorted(found) == sorted(expected), key, ", ".join(found), f"the controller's: {', '.join(expected)}")
    Omega = frame.matrix_c() @ frame.matrix_b()
    in_map = Omega[
        np.ix_([frame.outputs.index(one) for one in chart.outputs], [list(frame.inputs).index(one) for one in chart.inputs])
    ]
    measured = None
    if bag is not None:
        tape = read_run(bag).tape
        for topic in ("y", "u"):
            require(topic in tape, str(bag), f"no {topic}", "a log with y and u")
        measured = estimate(tape["y"], tape["u"], outputs, inputs)
    return check(chart, in_map, outputs, inputs, scenario.controller.D, measured)


def check(
    chart: ChannelMap,
    Omega: FloatArray,
    outputs: tuple[str, ...],
    inputs: tuple[str, ...],
    D: tuple[int, ...],
    measured: Estimate | None = None,
) -> Checked:
    """D of diag(output signs) Omega diag(input signs) against the controller's, and against a recorded flight.

    Arguments: Omega = C B of the airframe, (m, m), in the map's order; the channels and D in the controller's. Raises
    ParameterError where the map does not fit the airframe, or Omega has no D.
    """
    rows, columns = (
        [list(part).index(one) for one in names] for part, names in ((chart.outputs, outputs), (chart.inputs, inputs))
    )
    seen = through(chart, Omega)[np.ix_(rows, columns)]
    follows = [int(sign) for sign in signs(seen)]
    sentences = [
        f"outputs.{name} of the map {chart.name} comes with the wrong sign: {_grows(chart.outputs[name])} as it grows"
        for name, sign in zip(chart.outputs, output_signs(chart), strict=True)
        if sign < 0
    ]
    channels = []
    for i, (output, name) in enumerate(zip(outputs, inputs, strict=True)):
        found = None if measured is None else float(measured.Omega[i, i])
        ratio = None if measured is None else float(measured.ratio[i, i])
        channels.append(Channel(output, name, float(seen[i, i]), follows[i], D[i], found, ratio))
        if follows[i] != D[i]:
            sentences.append(
                f"with the map {chart.name} D of {output} and {name} is {follows[i]:+d}, the controller has {D[i]:+d}:"
                f" a positive {name} makes the aircraft {_grows(chart.inputs[name])}"
            )
        if found is not None and ratio is not None and ratio >= SURE and found * seen[i, i] < 0.0:
            sentences.append(
                f"the recorded flight has {output}_dot {'rise' if found > 0.0 else 'fall'} with {name}"
                f" ({found:.3g}, {ratio:.0f} standard errors), the map {chart.name} says the opposite"
            )
    return Checked(tuple(channels), tuple(sentences), 0 if measured is None else measured.intervals)


OPPOSITE = {
    "nose up": "nose down",
    "roll right": "roll left",
    "nose right": "nose left",
    "faster": "slower",
    "more thrust": "less thrust",
}


def _grows(row: OutputRow | InputRow) -> str:
    """What the aircraft does as the channel, not the raw value, grows."""
    both = OPPOSITE | {after: before for before, after in OPPOSITE.items()}
    return row.positive if row.sign > 0 else both[row.positive]


def _show(console: Console, chart: ChannelMap, checked: Checked, airframe: str) -> None:
    title = f"Map {chart.name}, airframe {airframe}: what a positive u does"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("u", "moves", "seen in", "effect", "D", "of law"):
        table.add_column(heading, justify="right" if heading in {"effect", "D", "of law"} else "left", no_wrap=True)
    if checked.intervals:
        table.add_column("recorded", justify="right", no_wrap=True)
    for one in checked.channels:
        cells = [
            one.input,
            _grows(chart.inputs[one.input]),
            f"{one.output} ({_grows(chart.outputs[one.output])})",
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


def _plain(chart: ChannelMap, checked: Checked) -> dict[str, Any]:
    return {
        "map": chart.name,
        "channels": [one._asdict() for one in checked.channels],
        "intervals": checked.intervals,
        "contradictions": list(checked.contradictions),
    }
