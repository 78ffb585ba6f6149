# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di airframe new`: an airframe from the matrices of a book or of another tool, with a scenario that flies."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from flight_cli.output import options, parse_numbers
from flight_core.files import display_path
from flight_core.parameters import require
from rise_di.own_airframe import new_airframe

airframe = typer.Typer(pretty_exceptions_enable=False, no_args_is_help=True)
ARGUMENTS = ("folder", "name", "speed", "states", "inputs", "outputs", "thrust", "lag", "replace", "mass", "density", "length")


@airframe.callback()
def _airframe() -> None:
    """Make an airframe of your own, with a scenario that flies."""


@airframe.command("new")
def new(
    source: Annotated[
        Path,
        typer.Argument(
            help="Airframe file (.yaml), MATLAB file (.mat), or a text of AVL (system matrix, stability derivatives) or XFLR5."
        ),
    ],
    name: Annotated[str, typer.Option(help="Name of the airframe; by default that of the file.")] = "",
    folder: Annotated[Path, typer.Option(help="Folder of both files.")] = Path(),
    speed: Annotated[str | None, typer.Option(help='Trim speed, in m/s or with a unit: "176 ft/s".')] = None,
    states: Annotated[
        str, typer.Option(help='States in the order of A, with units: "u: ft/s, w: ft/s, q: rad/s, theta: rad".')
    ] = "",
    inputs: Annotated[
        str, typer.Option(help='Inputs in the order of B, with units and effects: "elevator: rad nose down, thrust: 1".')
    ] = "",
    outputs: Annotated[
        str,
        typer.Option(help='As many as inputs, or fewer: states, rows of C ("V: ft/s"), sums: "q, V = 0.987 u + 0.163 w".'),
    ] = "",
    thrust: Annotated[
        bool, typer.Option("--thrust", help="Add an input thrust in units of the weight along the flight path.")
    ] = False,
    lag: Annotated[str | None, typer.Option(help="Lags of the actuators in s, in the order of the inputs: 0.05,0.3")] = None,
    mass: Annotated[str | None, typer.Option(help='Beside AVL\'s derivatives: "3.2 kg" or "85 slug".')] = None,
    Ixx: Annotated[str | None, typer.Option("--Ixx", help='Body axes: "0.2 kg*m^2" or "1048 slug*ft^2".')] = None,
    Iyy: Annotated[str | None, typer.Option("--Iyy", help="As --Ixx.")] = None,
    Izz: Annotated[str | None, typer.Option("--Izz", help="As --Ixx.")] = None,
    Ixz: Annotated[str | None, typer.Option("--Ixz", help="As --Ixx; by default 0.")] = None,
    density: Annotated[str | None, typer.Option(help='"1.225 kg/m^3" or "0.002377 slug/ft^3".')] = None,
    length: Annotated[str | None, typer.Option(help="Unit of length of AVL's file, by default m.")] = None,
    text: Annotated[str, typer.Option("--source", help="Where the figures come from: a book and a page.")] = "",
    replace: Annotated[bool, typer.Option("--replace", help="Replace files of these names.")] = False,
) -> None:
    """Write NAME.yaml, an airframe that is checked against physics, and NAME_flight.yaml, a scenario with selected gains.

    The scenario has been flown once in this process: rise-di fly NAME_flight.yaml --in-process.

    Exit status: 0, or 2 bad input.
    """
    figures = {"mass": mass, "Ixx": Ixx, "Iyy": Iyy, "Izz": Izz, "Ixz": Ixz, "density": density, "length": length}
    with Console().status("selecting gains and flying"), options(*ARGUMENTS, "Ixx", "Iyy", "Izz", "Ixz"):
        if lag is not None:
            require(bool(parse_numbers(lag)), "lag", repr(lag), "seconds separated by commas")
        draft = new_airframe(
            source,
            folder=folder,
            name=name,
            speed=speed,
            states=states,
            inputs=inputs,
            outputs=outputs,
            thrust=thrust,
            text=text,
            lag=None if lag is None else parse_numbers(lag),
            replace=replace,
            **{key: value for key, value in figures.items() if value is not None},
        )
    frame = draft.airframe
    print(f"read:     {draft.note}")
    effects = (f"{key} ({channel.unit}, positive: {channel.positive})" for key, channel in frame.inputs.items())
    print(f"inputs:   {', '.join(effects)}")
    print(f"outputs:  {', '.join(frame.outputs)}")
    print(f"airframe: {display_path(draft.airframe_file)}")
    print(f"scenario: {display_path(draft.scenario_file)}")
    print(f"fly it:   rise-di fly {display_path(draft.scenario_file)} --in-process")
