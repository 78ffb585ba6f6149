# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di target`: what a guided flight holds from now on."""

import math
import sys
from typing import Annotated

import typer

from flight_core.authentication import read_key
from flight_core.parameters import ParameterError, require
from flight_guidance.modes import TARGETS

KeyFile = Annotated[
    str, typer.Option(metavar="FILE", help="The `key_file` of guidance, where it has one: targets are refused without it.")
]
ANGLES = ("phi", "theta", "heading", "course")
REFUSED = 1


def target(
    commands: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME=VALUE ...",
            help="One of phi, heading, course, leg, or north, east and radius of an orbit; one of theta, climb, altitude; V."
            " phi, theta, heading and course in degrees; all else in m and m/s.",
        ),
    ],
    namespace: Annotated[str, typer.Option(help="Namespace of the aircraft.")] = "",
    key_file: KeyFile = "",
) -> None:
    """Command a running guided flight, as in: rise-di target heading=90 altitude=1300. What is not named stays.

    Exit status: 0 the commands are in force, 1 refused, 2 bad input or no guidance.
    """
    values = dict(map(_parse, commands))
    require(len(values) == len(commands), "target", "a command twice", "each once")
    key = operator_key(key_file)
    from flight_bringup.clients import TargetClient  # noqa: PLC0415 - loads rclpy, which other commands do not need

    with TargetClient(namespace, key=key) as client:
        refusal = client.send(values)
    if refusal:
        print(f"error: not in force: {refusal}", file=sys.stderr)
        raise typer.Exit(REFUSED)
    print(f"in force: {', '.join(commands)}")


def operator_key(key_file: str) -> bytes | None:
    """The key of guidance; None where no file is named. Raises ParameterError for an invalid one."""
    return read_key(key_file, "--key-file") if key_file else None


def _parse(text: str) -> tuple[str, float]:
    """A channel of `target` and its value, SI."""
    name, _, number = text.partition("=")
    require(name in TARGETS, "target", repr(text), f"NAME=VALUE with one of {', '.join(TARGETS)}")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ParameterError(f"target: found {text!r}, expected {name}=VALUE with a number")
    return name, math.radians(value) if name in ANGLES else value
