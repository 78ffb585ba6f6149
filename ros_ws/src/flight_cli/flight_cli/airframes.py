# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di airframes`: the assumptions of the theorem, checked on every airframe of the library, or on your own."""

from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from flight_cli.output import new_table, print_json
from flight_design.gains.airframe_properties import AirframeFacts, ComplexArray, airframe_facts, library, marginal_sentence


def airframes(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[AIRFRAME]...", help="Names, or airframe files (.yaml); by default the library."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the facts as JSON, nothing else.")] = False,
) -> None:
    """Show airframes: poles, zeros, the minors of Omega = C B, D as published and what gives D = I.

    Exit status: 0, or 2 for a file with a mistake.
    """
    facts = [airframe_facts(name) for name in names] if names else library()
    if as_json:
        print_json([_as_json(airframe) for airframe in facts])
        return
    console = Console()
    signs = _table("Signs and pairing", "airframe", "D", "for D = I", "coupling")
    for airframe in facts:
        signs.add_row(
            airframe.name,
            "none" if airframe.D is None else " ".join("+" if sign > 0 else "-" for sign in airframe.D),
            airframe.remedy,
            "-" if airframe.coupling is None else f"{airframe.coupling:.3g}",
        )
    console.print(signs)
    assumptions = _table("Assumptions 1 and 3", "airframe", "n, m", "controllable", "zeros", "integrated")
    for airframe in facts:
        yes = "yes" if airframe.controllable else "no"
        assumptions.add_row(
            airframe.name, f"{airframe.n}, {airframe.m}", yes, airframe.zero_dynamics, ", ".join(airframe.integrated) or "-"
        )
    console.print(assumptions)
    roots = _table("Poles and zeros in 1/s, leading minors of C B in SI", "airframe", "poles", "zeros at", "minors")
    for airframe in facts:
        minors = "  ".join(f"{minor:.3g}" for minor in airframe.minors)
        roots.add_row(airframe.name, _format_roots(airframe.poles), _format_roots(airframe.zeros), minors)
    console.print(roots)
    outside = [airframe.name for airframe in facts if not airframe.in_theorem]
    console.print(
        f"Without D, controllability or stable zeros: {', '.join(outside) or 'none'}. Coupling is max abs(U - I).",
        soft_wrap=True,
    )
    if marginal := marginal_sentence(facts):
        console.print(marginal, soft_wrap=True)


def _table(title: str, *headings: str) -> Table:
    return new_table(title, headings, left_aligned=headings, wrapped=("poles", "zeros at", "minors"))


def _format_roots(roots: ComplexArray) -> str:
    """Roots as text: a conjugate pair once, a root that is zero to rounding as 0."""
    shown = []
    for root in roots:
        real, imaginary = (0.0 if abs(part) < 1e-6 else float(part) for part in (root.real, root.imag))
        if imaginary >= 0.0:
            shown.append(f"{real:.3g}" + (f"+-{imaginary:.3g}j" if imaginary else ""))
    return "  ".join(shown) or "none"


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
        "controllable": facts.controllable,
        "in_theorem": facts.in_theorem,
    }
