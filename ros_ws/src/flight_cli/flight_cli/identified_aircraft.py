# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Print tables of an aircraft of JSBSim that `rise-di identify jsbsim` has linearised."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from aircraft_sim.jsbsim.jsbsim_aircraft import INPUTS, OUTPUTS, RESIDUALS, STATES
from flight_analysis.report.display_units import display_unit
from flight_cli.gains_tables import speed_of_margin
from flight_cli.output import new_table, print_table, say
from flight_core.units import si_per_unit
from flight_design.identification.jsbsim_identification import IdentifiedAircraft

# An input is not linear if its smallest effect is below this share of its largest effect.
LINEAR = 0.8

# An effect of at most this value is printed as 0, SI. No aircraft flies by so small an effect, and
# its digits would hide the effects that matter.
LARGEST_HIDDEN = 1e-3


def show_identified(console: Console, aircraft: IdentifiedAircraft) -> None:
    """Print the trim, the effects, the gains and the flights of an aircraft."""
    linear = aircraft.linear
    trim = linear.trim
    states = dict(zip(STATES, trim.states, strict=True))
    degrees = {name: states[name] / si_per_unit("deg") for name in ("alpha", "beta", "phi")}
    say(
        console,
        f"{aircraft.condition.title} in trim: V {states['V']:.4g} m/s, altitude "
        f"{states['altitude']:.5g} m, "
        + ", ".join(f"{name} {value:.3g} deg" for name, value in degrees.items())
        + f"; largest residual acceleration {np.max(np.abs(trim.residuals[:3])):.1g} m/s^2,"
        f" {np.max(np.abs(trim.residuals[3:])):.1g} rad/s^2",
    )
    # Two tables have a row for each input: one shows its stops, the other its effects.
    stops = new_table(
        "\nCommands: trim, and range down and up from trim", ("input", "trim", "down", "up")
    )
    columns = (
        "input",
        "steps of",
        *(f"{name}_dot" for name in aircraft.condition.paired_outputs()),
        "lag, s",
        "D",
    )
    responses = new_table(
        "\nEffects: Omega = C B per unit of a command, rad/s^2 and m/s^2", columns
    )
    inputs = aircraft.condition.inputs()
    for j, name in enumerate(inputs):
        # -0.0 + 0.0 is 0.0, which is printed without a sign.
        stops.add_row(
            name,
            *(f"{value + 0.0:.3f}" for value in (trim.commands[j], trim.lower[j], trim.upper[j])),
        )
        column = [
            f"{value:.3g}" if abs(value) > LARGEST_HIDDEN else "0" for value in linear.Omega[:, j]
        ]
        responses.add_row(
            name, f"{linear.size[j]:.3g}", *column, f"{linear.lag[j]:.3f}", f"{aircraft.D[j]:+d}"
        )
    console.print(stops)
    console.print(responses)
    # Name the inputs that are not linear, and those without an effect.
    for name, spread in zip(inputs, linear.spread, strict=True):
        if spread < LINEAR:
            differ = f"the effects of its steps differ by a factor of {1.0 / spread:.2g}"
            console.print(f"{name} is not linear: {differ}; the largest is used")
    if len(inputs) < len(INPUTS):
        console.print("the rudder moves nothing: the scenario has none, and r is not commanded")
    for sentence in linear.still:
        say(console, f"without effect: {sentence}")

    _show_gains(console, aircraft)
    _show_flights(console, aircraft)


def _show_gains(console: Console, aircraft: IdentifiedAircraft) -> None:
    Omega = aircraft.linear.Omega
    answer = aircraft.selection.engineering
    controller = answer.controller
    params = answer.controller.law_params()
    headings = ("channel", "bandwidth", "Lambda", "beta", "lag, s")
    table = new_table("\nGains: bandwidth and Lambda in 1/s, beta in units of y / s^2", headings)
    for i, (output, name) in enumerate(zip(controller.outputs, controller.inputs, strict=True)):
        response = (
            abs(Omega[list(OUTPUTS).index(output), list(INPUTS).index(name)])
            * params.input_scale[i]
        )
        figures = (params.K[i] * response, params.Lambda[i], params.beta[i], controller.lag[i])
        table.add_row(f"{output} by {name}", *(f"{figure:.3g}" for figure in figures))
    print_table(console, table)
    margin = (
        "" if answer.delay_margin is None else f"; delay margin {1e3 * answer.delay_margin:.0f} ms"
    )
    if answer.delay_margin:
        margin += f", {speed_of_margin(aircraft.selection.study, answer)}"
    outputs = "p and r"
    mend = "the sideslip feedback of --guidance flies it"
    if "r" not in controller.outputs:
        outputs = "p"
        mend = "without a rudder no feedback holds it"
    if aircraft.sideslip_zero > 0.0:
        say(
            console,
            f"with {outputs} constant, sideslip grows at {aircraft.sideslip_zero:.2g} 1/s: a zero "
            f"in the right half plane, outside the theorem; {mend}",
        )
    sign = controller.sampled_sign().name.lower()
    say(console, f"coupling max abs(U - I) = {aircraft.coupling:.2g}; {sign} sign{margin}")


def _show_flights(console: Console, aircraft: IdentifiedAircraft) -> None:
    condition = aircraft.condition
    units = {name: display_unit(OUTPUTS[name]) for name in condition.paired_outputs()}
    headings = [f"{name}\n{unit.unit}" for name, unit in units.items()]
    qualifier = ", with the gains alone" if aircraft.scenario().rise_di().learn is not None else ""
    flights = new_table(
        f"\nFlights of 60 s in one process{qualifier}: rms of the error",
        ["flight", *headings, "outcome"],
        ("flight", "outcome"),
        ("outcome",),
    )
    largest = new_table(
        "\nLargest deviation of a command from trim", ["flight", *condition.inputs()]
    )
    for title, flight in aircraft.flights.items():
        errors = [f"{flight.rms[name] * unit.factor:.3g}" for name, unit in units.items()]
        flights.add_row(title, *errors, flight.text)
        largest.add_row(title, *(f"{flight.largest[name]:.2g}" for name in condition.inputs()))
    console.print(flights)
    console.print(largest)


def identified_as_json(aircraft: IdentifiedAircraft, path: Path) -> dict[str, Any]:
    """Return the result of an identification as a dict that JSON can hold, in SI."""
    linear = aircraft.linear
    trim = linear.trim
    outputs = aircraft.condition.paired_outputs()
    by_input = {
        name: {
            "trim": float(trim.commands[j]),
            "lower": float(trim.lower[j]),
            "upper": float(trim.upper[j]),
            "step": float(linear.size[j]),
            "spread": float(linear.spread[j]),
            "Omega": dict(zip(outputs, linear.Omega[:, j].tolist(), strict=True)),
            "lag": float(linear.lag[j]),
            "D": aircraft.D[j],
        }
        for j, name in enumerate(aircraft.condition.inputs())
    }
    return {
        "airframe": aircraft.condition.title,
        "speed": aircraft.condition.speed,
        "altitude": aircraft.condition.altitude,
        "trim": dict(zip(STATES, trim.states.tolist(), strict=True)),
        "residuals": dict(zip(RESIDUALS, trim.residuals.tolist(), strict=True)),
        "inputs": by_input,
        "without_effect": list(linear.still),
        "coupling": aircraft.coupling,
        "sideslip_zero": aircraft.sideslip_zero,
        "lost": str(aircraft.failure or ""),
        "delay_margin": aircraft.selection.engineering.delay_margin,
        "controller": aircraft.scenario().controller.model_dump(exclude_defaults=True),
        "flights": {title: flight._asdict() for title, flight in aircraft.flights.items()},
        "scenario": str(path),
    }
