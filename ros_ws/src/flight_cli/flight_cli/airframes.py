# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di airframes`, which checks the assumptions of the theorem on any airframe.

The airframe comes from the library or from the user. The command can also write a new airframe.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from flight_cli.output import new_table, parse_numbers, print_json, print_table, say
from flight_cli.words import (
    airframe_names,
    argument,
    json_option,
    option,
    rare_option,
    values_of,
    warn,
    write_option,
)
from flight_core.files import display_path
from flight_core.parameters import require
from flight_design.gains.airframe_properties import (
    AirframeFacts,
    ComplexArray,
    airframe_facts,
    library,
    marginal_sentence,
)
from rise_di.own_airframe import NewAirframe, new_airframe

ROOTS = "Poles and zeros in 1/s, leading minors of C B in SI"
# Exit status if an input was at its stop in the first flight, or if this flight did not end as
# planned.
FALLS_SHORT = 3


@dataclass(frozen=True, kw_only=True)
class Airframes:
    """Show airframes: poles, zeros, minors of Omega = C B, D, and pairs and signs that give D = I.

    With --write FOLDER, make two files. NAME.yaml is an airframe that is checked against physics,
    and NAME_flight.yaml is a scenario with selected gains. The command flies the scenario once in
    this process. You fly it with: rise-di fly NAME_flight.yaml --in-process.

    Exit status: 0; 2 if a file has a mistake; 3 if this first flight does not reach its goal.
    """

    names: list[str] | None = argument(
        "Names, or airframe files (.yaml); by default the whole library. With --write, give "
        "exactly one: an airframe file, a MATLAB file (.mat), or a text file of AVL (system "
        "matrix, stability derivatives) or XFLR5.",
        metavar="[AIRFRAME]...",
        autocompletion=airframe_names,
    )
    write: Path | None = write_option(
        "Write NAME.yaml, an airframe, and NAME_flight.yaml, a scenario that flies it.",
        metavar="FOLDER",
    )
    name: str = rare_option("Name of the airframe; by default the name of the file.", default="")
    speed: str | None = rare_option('Trim speed, in m/s or with a unit: "176 ft/s".')
    states: str = option(
        'States in the order of A, with units: "u: ft/s, w: ft/s, q: rad/s, theta: rad".',
        default="",
    )
    inputs: str = option(
        'Inputs in the order of B, with units and effects: "elevator: rad nose down, thrust: 1".',
        default="",
    )
    outputs: str = option(
        "Outputs, at most as many as inputs: a state, a row of C with its unit "
        '("V: ft/s"), or a sum of states: "q, V = 0.987 u + 0.163 w".',
        default="",
    )
    thrust: bool = rare_option(
        "Add an input thrust along the flight path, in units of the weight.", default=False
    )
    lag: str | None = option(
        "Lags of the actuators in s, in the order of the inputs, as in 0.05,0.3."
    )
    mass: str | None = rare_option(
        'Mass, which the derivatives of AVL need: "3.2 kg" or "85 slug".'
    )
    Ixx: str | None = rare_option(
        'Moment of inertia in body axes: "0.2 kg*m^2" or "1048 slug*ft^2".'
    )
    Iyy: str | None = rare_option("As --Ixx.")
    Izz: str | None = rare_option("As --Ixx.")
    Ixz: str | None = rare_option("Product of inertia, as --Ixx; by default 0.")
    density: str | None = rare_option('Density of the air: "1.225 kg/m^3" or "0.002377 slug/ft^3".')
    length: str | None = rare_option("Unit of length in the file of AVL; by default m.")
    source: str = rare_option(
        "Where the figures come from, for example a book and a page.", default=""
    )
    replace: bool = rare_option(
        "Replace files that have these names.", "--replace", "--force", default=False
    )
    as_json: bool = json_option()

    def execute(self) -> None:
        """Write a new airframe, or show the airframes that the user names."""
        if self.write is not None:
            self._make(self.write)
            return
        facts = [airframe_facts(name) for name in self.names] if self.names else library()
        if self.as_json:
            print_json([_as_json(airframe) for airframe in facts])
        else:
            _show(Console(), facts)

    def _make(self, folder: Path) -> None:
        """Write the airframe and the scenario, fly the scenario once, and show the result."""
        sources = self.names or []
        sources_text = f"{len(sources)} sources"
        require(len(sources) == 1, "airframes", sources_text, "one beside --write")
        lags = None if self.lag is None else parse_numbers(self.lag)
        require(lags is None or bool(lags), "lag", repr(self.lag), "seconds separated by commas")
        body = values_of(self, "mass", "Ixx", "Iyy", "Izz", "Ixz", "density", "length")
        with Console().status("selecting gains and flying"):
            draft = new_airframe(
                sources[0],
                **values_of(self, "name", "speed", "states", "inputs", "outputs", "thrust"),
                **{key: value for key, value in body.items() if value is not None},
                folder=folder,
                text=self.source,
                lag=lags,
                replace=self.replace,
            )
        _show_draft(draft)


def _show(console: Console, facts: Sequence[AirframeFacts]) -> None:
    """Print the assumptions of the theorem, with a table for each group of assumptions."""
    for title, headings, cells in (
        ("Signs and pairing", ("D", "for D = I", "coupling"), _signs),
        ("Assumptions 1 and 3", ("n, m", "controllable", "zeros", "integrated"), _assumptions),
        (ROOTS, ("poles", "zeros at", "minors"), _roots),
    ):
        columns = ("airframe", *headings)
        table = new_table(title, columns, columns, wrapped=headings if cells is _roots else ())
        for airframe in facts:
            table.add_row(airframe.name, *cells(airframe))
        print_table(console, table)
    outside = [airframe.name for airframe in facts if not airframe.is_in_theorem]
    say(
        console,
        f"Without D, controllability or stable zeros: {', '.join(outside) or 'none'}. Coupling "
        "is max abs(U - I).",
    )
    if marginal := marginal_sentence(facts):
        say(console, marginal)


def _show_draft(draft: NewAirframe) -> None:
    """Print what was read, and which files were written."""
    frame = draft.airframe
    print(f"read:     {draft.note}")
    effects = (
        f"{key} ({channel.unit}, positive: {channel.positive})"
        for key, channel in frame.inputs.items()
    )
    print(f"inputs:   {', '.join(effects)}")
    print(f"outputs:  {', '.join(frame.outputs)}")
    print(f"airframe: {display_path(draft.airframe_file)}")
    print(f"scenario: {display_path(draft.scenario_file)}")
    print(f"fly it:   rise-di fly {display_path(draft.scenario_file)} --in-process")
    if draft.shortfall:
        warn(f"error: {draft.shortfall}")
        raise typer.Exit(FALLS_SHORT)


def _signs(facts: AirframeFacts) -> tuple[str, str, str]:
    D = "none" if facts.D is None else " ".join("+" if sign > 0 else "-" for sign in facts.D)
    return D, facts.remedy, "-" if facts.coupling is None else f"{facts.coupling:.3g}"


def _assumptions(facts: AirframeFacts) -> tuple[str, str, str, str]:
    controllable = "yes" if facts.is_controllable else "no"
    integrals = ", ".join(facts.integrated) or "-"
    return f"{facts.n}, {facts.m}", controllable, facts.zero_dynamics, integrals


def _roots(facts: AirframeFacts) -> tuple[str, str, str]:
    minors = "  ".join(f"{minor:.3g}" for minor in facts.minors)
    return _format_roots(facts.poles), _format_roots(facts.zeros), minors


def _format_roots(roots: ComplexArray) -> str:
    """Write roots as text. A conjugate pair is one text, and tiny parts are 0."""
    texts = []
    for root in roots:
        real, imaginary = (
            0.0 if abs(part) < 1e-6 else float(part) for part in (root.real, root.imag)
        )
        if imaginary >= 0.0:
            texts.append(f"{real:.3g}" + (f"+-{imaginary:.3g}j" if imaginary else ""))
    return "  ".join(texts) or "none"


def _as_json(facts: AirframeFacts) -> dict[str, Any]:
    return {
        "name": facts.name,
        "n": facts.n,
        "m": facts.m,
        "poles": [[root.real, root.imag] for root in facts.poles],
        "zeros": [[root.real, root.imag] for root in facts.zeros],
        "integrated": list(facts.integrated),
        "zero_dynamics": str(facts.zero_dynamics),
        "minors": facts.minors.tolist(),
        "D": None if facts.D is None else [int(sign) for sign in facts.D],
        "for_D_I": facts.remedy,
        "coupling": facts.coupling,
        "controllable": facts.is_controllable,
        "in_theorem": facts.is_in_theorem,
    }
