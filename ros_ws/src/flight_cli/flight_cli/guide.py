# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di guide`, which commands a guided flight while it flies.

The command also calls the services of guidance, keeps the operator's link alive and sends a route.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import typer

from flight_cli.route_options import RouteWords
from flight_cli.words import (
    REQUIRED,
    argument,
    list_of,
    namespace_option,
    warn,
)
from flight_core.environment import require_ros_environment
from flight_core.outcome import Refusal
from flight_core.parameters import ParameterError, require
from flight_guidance.guidance_state import TARGETS
from flight_guidance.modes.targets import ANGLES

REFUSED = 1
SERVICES = {
    "hold": "holds heading, altitude and airspeed",
    "skip": "skips the waypoint ahead",
    "resume": "resumes the last leg",
    "home": "flies home",
}
"""The services of guidance, and what guidance does after each."""
LINK = "link"


@dataclass(frozen=True, kw_only=True)
class Guide(RouteWords):
    """Command a running guided flight, as in: rise-di guide heading=90 altitude=1300.

    What you do not name stays as it is. Exit status: 0 done, 1 refused, 2 bad input or no guidance.
    """

    commands: list[str] = argument(
        "NAME=VALUE, several at once: one of phi, heading, course, leg, or an orbit by north, "
        "east and radius; one of theta, climb, altitude; V. phi, theta, heading and course are in "
        "degrees, r (together with phi) in degrees per second, all else in m and m/s. A "
        "multicopter takes phi and theta, or course, or north and east, or leg; climb or "
        "altitude; heading; V over ground. Or one word: hold keeps the present heading, altitude "
        "and airspeed; skip leaves out the waypoint ahead; resume flies the last leg again; home "
        "flies home and orbits there; link keeps the operator's link until Ctrl-C. Or a route "
        "file without airspeeds.",
        default=REQUIRED,
        metavar="COMMAND...",
        autocompletion=list_of((*SERVICES, LINK, *(f"{name}=" for name in TARGETS))),
    )
    namespace: str = namespace_option()

    def execute(self) -> None:
        """Send the request, and print what guidance holds from then on."""
        command = self.commands[0]
        is_service = command in {*SERVICES, LINK}
        points: list[tuple[float, float, float]] = []
        values: dict[str, float] = {}
        if len(self.commands) == 1 and "=" not in command and not is_service:
            points = self._points(command)
        elif not is_service:
            values = dict(map(_parse, self.commands))
        # Each name may be given once. A service or a route file must be the only word.
        once = len(self.commands) == len(values or "1")
        require(once, "guide", "a command twice, or two", "each once")
        require_ros_environment()
        if refusal := self._send(command, values, points):
            warn(f"error: refused: {refusal}")
            raise typer.Exit(REFUSED)
        if points:
            print(f"flies the route of {len(points)} waypoints")
        else:
            print(SERVICES.get(command, f"in force: {', '.join(self.commands)}"))

    def _send(
        self,
        command: str,
        values: dict[str, float],
        points: list[tuple[float, float, float]],
    ) -> Refusal | None:
        """Send targets, a route or a service call.

        Returns the reason if guidance refuses the request, else None.
        """
        from flight_guidance.client import GuidanceClient, TargetClient  # noqa: PLC0415 - loads rclpy, which other commands do not need

        if values or command == LINK:
            with TargetClient(self.namespace) as targets:
                if command == LINK:
                    print("keeps the link until Ctrl-C", flush=True)
                    targets.hold_link()
                return targets.send(values) if values else None
        with GuidanceClient(namespace=self.namespace) as client:
            return client.send_route(points) if points else client.call(command)

    def _points(self, file: str) -> list[tuple[float, float, float]]:
        """Read a route file, and return its waypoints as north, east and altitude in m.

        Raises ParameterError if the file is invalid.
        """
        expected = f"NAME=VALUE, {', '.join((*SERVICES, LINK))} or a route file"
        require(Path(file).suffix != "", "guide", repr(file), expected)
        waypoints = self.read_waypoints(Path(file), above_sea=None)
        for k, waypoint in enumerate(waypoints):
            if waypoint.speed is not None:
                raise ParameterError(
                    f"route[{k}].V: found {waypoint.speed:g} m/s, expected none in flight: rise-di "
                    "guide V=VALUE"
                )
            circle = "a circle to the left" if waypoint.left else "a circle round the waypoint"
            has_none = not (waypoint.is_loiter or waypoint.left)
            require(has_none, f"route[{k}]", circle, "none in flight")
        return [(waypoint.north, waypoint.east, waypoint.altitude) for waypoint in waypoints]


def _parse(text: str) -> tuple[str, float]:
    """Parse NAME=VALUE into a channel of `rise-di guide` and its value in SI."""
    name, _, number = text.partition("=")
    require(name in TARGETS, "guide", repr(text), f"NAME=VALUE with one of {', '.join(TARGETS)}")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ParameterError(f"guide: found {text!r}, expected {name}=VALUE with a number")
    return name, math.radians(value) if name in ANGLES else value
