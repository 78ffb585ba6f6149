# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di identify`: trim an aircraft of JSBSim, identify it by step tests, select gains, fly it, write its scenario."""

import json
import math
import sys
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from aircraft_sim.jsbsim_aircraft import INPUTS, OUTPUTS, PREFIX, RESIDUALS, STATES, require_aircraft
from flight_analysis.design.identification import IdentifiedAircraft
from flight_analysis.design.identification import identify as identify_aircraft
from flight_cli.output import new_table, write_text
from flight_core.outcome import FlightEnded
from flight_core.parameters import require
from flight_core.units import SI_PER_UNIT

CANNOT_FLY = 3
LINEAR = 0.8  # the ratio of smallest to largest slope below which an input is reported as not linear
MILLI = 1e3
DISPLAY_UNITS = {"rad/s": ("mrad/s", MILLI), "m/s": ("m/s", 1.0)}


def identify(
    airframe: Annotated[str, typer.Argument(help="jsbsim:NAME, an aircraft of JSBSim.")],
    speed: Annotated[float, typer.Option(help="True airspeed to trim and fly at, m/s.")],
    altitude: Annotated[float, typer.Option(help="Altitude above sea level to trim and fly at, m.")],
    output: Annotated[
        Path | None, typer.Option(help="Scenario file to write; by default jsbsim_NAME.yaml, which must not exist.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON, nothing else.")] = False,
) -> None:
    """Identify an aircraft of JSBSim by step tests, select its gains, fly it and write a scenario for `rise-di fly`.

    Exit status: 0, 2 bad input, 3 the aircraft does not trim or does not fly.
    """
    require(airframe.startswith(PREFIX), "airframe", f"{airframe!r}", f"an aircraft of JSBSim, {PREFIX}NAME")
    name = require_aircraft(airframe)
    require(0.0 < speed < math.inf, "--speed", speed, "above 0 m/s")
    require(0.0 <= altitude < math.inf, "--altitude", altitude, "0 m or more")
    path = output or Path(f"jsbsim_{name}.yaml")
    require(output is not None or not path.exists(), "--output", f"none, and {path} exists", "a file to write over, or another")
    require(path.suffix == ".yaml", "--output", path, "a name that ends in .yaml, as scenario files do")
    require(path.parent.is_dir(), "--output", path, "a file in a folder that exists")
    console = Console(quiet=as_json)
    try:
        with console.status("trim") as status:
            found = identify_aircraft(name, speed, altitude, status.update)
    except FlightEnded as error:
        print(f"error: {error}", file=sys.stderr)
        raise typer.Exit(CANNOT_FLY) from None
    write_text("--output", path, found.text)
    if as_json:
        print(json.dumps(_as_json(found, path)))
    else:
        _show(console, found)
        console.print(f"scenario: {path}", highlight=False)
    if found.failure:
        print(f"error: {found.condition.title} does not fly: {found.failure}", file=sys.stderr)
        raise typer.Exit(CANNOT_FLY)


def _show(console: Console, found: IdentifiedAircraft) -> None:
    trim, steps = found.trim, found.responses
    states = dict(zip(STATES, trim.states, strict=True))
    degrees = {name: states[name] / SI_PER_UNIT["deg"] for name in ("alpha", "beta", "phi")}
    console.print(
        f"{found.condition.title} in trim: V {states['V']:.4g} m/s, altitude {states['altitude']:.5g} m, "
        + ", ".join(f"{name} {value:.3g} deg" for name, value in degrees.items())
        + f"; largest residual acceleration {np.max(np.abs(trim.residuals[:3])):.1g} m/s^2,"
        f" {np.max(np.abs(trim.residuals[3:])):.1g} rad/s^2",
        highlight=False,
        soft_wrap=True,
    )
    stops = new_table("\nCommands: trim, and range down and up from trim", ("input", "trim", "down", "up"), left=("input",))
    headings = ("input", "steps of", *(f"{name}_dot" for name in OUTPUTS), "lag, s", "D")
    responses = new_table("\nStep responses: Omega per unit of a command, rad/s^2 and m/s^2", headings, left=("input",))
    for j, name in enumerate(INPUTS):
        stops.add_row(name, *(f"{value + 0.0:.3f}" for value in (trim.commands[j], trim.lower[j], trim.upper[j])))
        column = [f"{value:.3g}" if abs(value) > 1e-3 else "0" for value in steps.Omega[:, j]]
        responses.add_row(name, f"{steps.size[j]:.3g}", *column, f"{steps.lag[j]:.3f}", f"{found.D[j]:+d}")
    console.print(stops)
    console.print(responses)
    for name, spread in zip(INPUTS, steps.spread, strict=True):
        if spread < LINEAR:
            differ = f"the slopes of its steps differ by a factor of {1.0 / spread:.2g}"
            console.print(f"{name} is not linear: {differ}; the largest is used")
    for sentence in steps.rejected:
        console.print(f"rejected: {sentence}", highlight=False, soft_wrap=True)

    answer = found.selection.engineering
    controller, params = answer.controller, answer.controller.law_params()
    headings = ("channel", "bandwidth", "Lambda", "beta", "lag, s")
    table = new_table("\nGains: bandwidth and Lambda in 1/s, beta in units of y / s^2", headings, left=("channel",))
    for i, (output, name) in enumerate(zip(controller.outputs, controller.inputs, strict=True)):
        response = abs(steps.Omega[list(OUTPUTS).index(output), list(INPUTS).index(name)]) * params.input_scale[i]
        figures = (params.K[i] * response, params.Lambda[i], params.beta[i], controller.lag[i])
        table.add_row(f"{output} by {name}", *(f"{figure:.3g}" for figure in figures))
    console.print(table)
    margin = "" if answer.delay_margin is None else f"; delay margin {MILLI * answer.delay_margin:.0f} ms"
    if found.sideslip_zero > 0.0:
        console.print(
            f"with p and r constant, sideslip grows at {found.sideslip_zero:.2g} 1/s:"
            " a zero in the right half plane, outside the theorem",
            highlight=False,
            soft_wrap=True,
        )
    sign = controller.sampled_sign()[0].name.lower()
    console.print(f"coupling max abs(U - I) = {found.coupling:.2g}; {sign} sign{margin}", highlight=False)
    _show_flights(console, found)


def _show_flights(console: Console, found: IdentifiedAircraft) -> None:
    headings = [f"{name}\n{DISPLAY_UNITS[unit][0]}" for name, unit in OUTPUTS.items()]
    flights = new_table(
        "\nFlights of 60 s in one process: rms of the error",
        ["flight", *headings, "outcome"],
        ("flight", "outcome"),
        ("outcome",),
    )
    largest = new_table("\nLargest deviation of a command from trim", ["flight", *INPUTS], left=("flight",))
    for title, one in found.flights.items():
        errors = [f"{one.rms[name] * DISPLAY_UNITS[unit][1]:.3g}" for name, unit in OUTPUTS.items()]
        flights.add_row(title, *errors, one.outcome)
        largest.add_row(title, *(f"{one.largest[name]:.2g}" for name in INPUTS))
    console.print(flights)
    console.print(largest)


def _as_json(found: IdentifiedAircraft, path: Path) -> dict[str, Any]:
    trim, steps = found.trim, found.responses
    by_input = {
        name: {
            "trim": float(trim.commands[j]),
            "lower": float(trim.lower[j]),
            "upper": float(trim.upper[j]),
            "step": float(steps.size[j]),
            "spread": float(steps.spread[j]),
            "Omega": dict(zip(OUTPUTS, steps.Omega[:, j].tolist(), strict=True)),
            "lag": float(steps.lag[j]),
            "D": found.D[j],
        }
        for j, name in enumerate(INPUTS)
    }
    return {
        "airframe": found.condition.title,
        "speed": found.condition.speed,
        "altitude": found.condition.altitude,
        "trim": dict(zip(STATES, trim.states.tolist(), strict=True)),
        "residuals": dict(zip(RESIDUALS, trim.residuals.tolist(), strict=True)),
        "inputs": by_input,
        "rejected": list(steps.rejected),
        "coupling": found.coupling,
        "sideslip_zero": found.sideslip_zero,
        "lost": found.failure,
        "delay_margin": found.selection.engineering.delay_margin,
        "controller": found.selection.engineering.controller.model_dump(exclude_defaults=True),
        "flights": {title: one._asdict() for title, one in found.flights.items()},
        "scenario": str(path),
    }
