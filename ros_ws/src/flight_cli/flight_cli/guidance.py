# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di guidance`: hold, skip, resume, home, the operator's link and a route for a guided flight."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flight_cli.route_options import Altitude, Line, Simplify, read_waypoints
from flight_core.parameters import ParameterError

if TYPE_CHECKING:
    from flight_guidance.client import GuidanceClient

REFUSED = 1
Namespace = Annotated[str, typer.Option(help="Namespace of the aircraft.")]

guidance = typer.Typer(no_args_is_help=True)


def _ask(namespace: str, request: "Callable[[GuidanceClient], str]", success: str) -> None:
    """Send a request to guidance. Exit status: 0 done, 1 refused, 2 bad input or no guidance."""
    from flight_guidance.client import GuidanceClient  # noqa: PLC0415 - loads rclpy, which other commands do not need

    with GuidanceClient(namespace=namespace) as client:
        refusal = request(client)
    if refusal:
        print(f"error: refused: {refusal}", file=sys.stderr)
        raise typer.Exit(REFUSED)
    print(success)


def _command(service: str, help_text: str, success: str) -> None:
    """Add a command that calls a service of guidance."""

    def call(namespace: Namespace = "") -> None:
        _ask(namespace, lambda client: client.call(service), success)

    guidance.command(service, help=help_text)(call)


_command("hold", "Hold the heading, the altitude and the airspeed of now.", "holds heading, altitude and airspeed")
_command("skip", "Leave the waypoint ahead out and fly to the next waypoint.", "skips the waypoint ahead")
_command("resume", "Fly the last leg of the route again, from the nearest point.", "resumes the last leg")
_command("home", "Fly home and orbit there.", "flies home")


@guidance.command()
def link(namespace: Namespace = "") -> None:
    """Keep the operator's link of a flight with `home.link_timeout`, until Ctrl-C: then the aircraft flies home."""
    from flight_guidance.client import TargetClient  # noqa: PLC0415 - loads rclpy, which other commands do not need

    with TargetClient(namespace) as client:
        print("keeps the link until Ctrl-C", flush=True)
        client.hold_link()


@guidance.command()
def route(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Route file, as of `rise-di fly --route`.")],
    origin: Annotated[str | None, typer.Option(metavar="LAT,LON", help="Where north and east are 0, for FILE.")] = None,
    altitude: Altitude = None,
    simplify: Simplify = 0.0,
    line: Line = None,
    namespace: Namespace = "",
) -> None:
    """Fly a route from its first leg on. An airspeed of a waypoint is refused: the topic has none."""
    waypoints = read_waypoints(file, origin, altitude, simplify, line, above_sea=None)
    for k, waypoint in enumerate(waypoints):
        if waypoint.speed is not None:
            raise ParameterError(f"route[{k}].V: found {waypoint.speed:g} m/s, expected none in flight: rise-di target V=VALUE")
        if waypoint.loiters:
            raise ParameterError(f"route[{k}]: found a circle round the waypoint, expected none in flight")
    points = [(waypoint.north, waypoint.east, waypoint.altitude) for waypoint in waypoints]
    _ask(namespace, lambda client: client.send_route(points), f"flies the route of {len(points)} waypoints")
