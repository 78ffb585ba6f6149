# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di guide`: what a guided flight holds from now on, the services of guidance, the operator's
link, a route.
"""

import math
from pathlib import Path
from typing import Annotated

import typer

from flight_cli.route_options import Altitude, Line, OriginOfRoute, Simplify, read_waypoints
from flight_cli.words import Namespace, argument, warn
from flight_core.environment import require_ros_environment
from flight_core.parameters import ParameterError, require
from flight_guidance.guidance_state import TARGETS
from flight_guidance.targets import ANGLES

REFUSED = 1
SERVICES = {
    "hold": "holds heading, altitude and airspeed",
    "skip": "skips the waypoint ahead",
    "resume": "resumes the last leg",
    "home": "flies home",
}
"""The services of guidance, and what guidance does after each."""
LINK = "link"


def guide(
    commands: Annotated[
        list[str],
        argument(
            "NAME=VALUE: one of phi, heading, course, leg, or north, east and radius of an "
            "orbit; one of theta, climb,"
            " altitude; V. phi, theta, heading and course in degrees, r (beside phi) in degrees "
            "a second; else m and m/s."
            " Or hold: the heading, altitude and airspeed of now. skip: the waypoint ahead. "
            "resume: the last leg. home: fly"
            " home and orbit. link: keep the operator's link until Ctrl-C. Or a route file, "
            "without airspeeds.",
            metavar="COMMAND...",
        ),
    ],
    origin: OriginOfRoute = None,
    altitude: Altitude = None,
    simplify: Simplify = 0.0,
    line: Line = None,
    namespace: Namespace = "",
) -> None:
    """Command a running guided flight, as in: rise-di guide heading=90 altitude=1300. What is not
    named stays.

    Exit status: 0 done, 1 refused, 2 bad input or no guidance.
    """
    command = commands[0]
    points = []
    values = {}
    if len(commands) == 1 and "=" not in command and command not in {*SERVICES, LINK}:
        require(
            Path(command).suffix != "",
            "guide",
            repr(command),
            f"NAME=VALUE, {', '.join((*SERVICES, LINK))} or a route file",
        )
        points = _points(Path(command), origin, altitude, simplify, line)
    elif command not in {*SERVICES, LINK}:
        values = dict(map(_parse, commands))
    require(len(commands) == len(values or "1"), "guide", "a command twice, or two", "each once")
    require_ros_environment()
    from flight_guidance.client import GuidanceClient, TargetClient  # noqa: PLC0415 - loads rclpy, which other commands do not need

    if values or command == LINK:
        with TargetClient(namespace) as targets:
            if command == LINK:
                print("keeps the link until Ctrl-C", flush=True)
                targets.hold_link()
            refusal = targets.send(values) if values else ""
    else:
        with GuidanceClient(namespace=namespace) as client:
            refusal = client.send_route(points) if points else client.call(command)
    if refusal:
        warn(f"error: refused: {refusal}")
        raise typer.Exit(REFUSED)
    print(
        SERVICES.get(
            command,
            f"flies the route of {len(points)} waypoints"
            if points
            else f"in force: {', '.join(commands)}",
        )
    )


def _points(
    file: Path, origin: str | None, altitude: float | None, simplify: float, line: str | None
) -> list[tuple[float, float, float]]:
    """The waypoints of a route file for a flight: north, east, altitude in m. Raises
    ParameterError.
    """
    waypoints = read_waypoints(file, origin, altitude, simplify, line, above_sea=None)
    for k, waypoint in enumerate(waypoints):
        if waypoint.speed is not None:
            raise ParameterError(
                f"route[{k}].V: found {waypoint.speed:g} m/s, expected none in flight: rise-di "
                "guide V=VALUE"
            )
        if waypoint.loiters:
            raise ParameterError(
                f"route[{k}]: found a circle round the waypoint, expected none in flight"
            )
    return [(waypoint.north, waypoint.east, waypoint.altitude) for waypoint in waypoints]


def _parse(text: str) -> tuple[str, float]:
    """A channel of `guide` and its value, SI."""
    name, _, number = text.partition("=")
    require(name in TARGETS, "guide", repr(text), f"NAME=VALUE with one of {', '.join(TARGETS)}")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ParameterError(f"guide: found {text!r}, expected {name}=VALUE with a number")
    return name, math.radians(value) if name in ANGLES else value
