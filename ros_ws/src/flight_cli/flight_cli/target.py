# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di target`: what a guided flight holds from now on."""

import math
import sys
from typing import Annotated

import typer

from flight_core.environment import require_ros_environment
from flight_core.parameters import ParameterError, require
from flight_guidance.modes import ANGLES, TARGETS

REFUSED = 1


def target(
    commands: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME=VALUE ...",
            help="One of phi, heading, course, leg, or north, east and radius of an orbit; one of theta, climb, altitude; V."
            " phi, theta, heading and course in degrees, r (beside phi) in degrees a second; all else in m and m/s.",
        ),
    ],
    namespace: Annotated[str, typer.Option(help="Namespace of the aircraft.")] = "",
) -> None:
    """Command a running guided flight, as in: rise-di target heading=90 altitude=1300. What is not named stays.

    Exit status: 0 the commands are in force, 1 refused, 2 bad input or no guidance.
    """
    values = dict(map(_parse, commands))
    require(len(values) == len(commands), "target", "a command twice", "each once")
    require_ros_environment()
    from flight_guidance.client import TargetClient  # noqa: PLC0415 - loads rclpy, which other commands do not need

    with TargetClient(namespace) as client:
        refusal = client.send(values)
    if refusal:
        print(f"error: not in force: {refusal}", file=sys.stderr)
        raise typer.Exit(REFUSED)
    print(f"in force: {', '.join(commands)}")


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
