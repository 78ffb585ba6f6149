# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Declare the options of the commands that read a route file."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import overload

from flight_cli.output import parse_numbers
from flight_cli.words import rare_option, warn
from flight_core.parameters import require
from flight_guidance.routes.mission_files import FENCE_NOTE
from flight_guidance.routes.route_file import Origin, Waypoint, read_route_file


@dataclass(frozen=True, kw_only=True)
class RouteWords:
    """The options of the commands that read a route file."""

    origin: str | None = rare_option(
        "Place of north = east = 0 for a route in latitude and longitude, degrees; by default the "
        "home of the file.",
        metavar="LAT,LON",
    )
    altitude: float | None = rare_option(
        "Altitude of a route that has none, or of the ground or home above which it is given, m.",
    )
    simplify: float = rare_option(
        "Leave out positions that are within this distance of the line through the others, m.",
        default=0.0,
        min=0.0,
    )
    line: str | None = rare_option(
        "Which line to fly, if the file has several: a number from 1 on, or a name.",
        metavar="LINE",
    )

    def read_waypoints(
        self, file: Path, *, above_sea: bool | None, fence: Path | None = None
    ) -> tuple[Waypoint, ...]:
        """Read the waypoints of a route file, and print notes on all that is left out of the file.

        `fence` is the file with the fence, which may be the route file itself. Raises what
        `read_route_file` raises.
        """
        for key, value in (("altitude", self.altitude), ("simplify", self.simplify)):
            require(value is None or math.isfinite(value), f"--{key}", value, "a number")
        route = read_route_file(
            file,
            parse_origin(self.origin),
            self.altitude,
            self.simplify,
            above_sea=above_sea,
            line=self.line,
        )
        for note in route.notes:
            # The flight keeps a fence that is given.
            if note == FENCE_NOTE and fence is not None and fence.samefile(file):
                continue
            warn(f"note: {note}")
        return route.waypoints


@overload
def parse_origin(text: str) -> Origin: ...
@overload
def parse_origin(text: None) -> None: ...
def parse_origin(text: str | None) -> Origin | None:
    """Parse the origin of a route, for example "47.38,8.54"."""
    if text is None:
        return None
    numbers = parse_numbers(text)
    fits = len(numbers) == 2 and abs(numbers[0]) <= 90.0 and abs(numbers[1]) <= 180.0
    require(fits, "--origin", repr(text), "a latitude and a longitude in degrees, as in 47.38,8.54")
    return Origin(*numbers)
