# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The options of the commands that read a route file."""

import math
from pathlib import Path
from typing import Annotated, overload

from flight_cli.output import parse_numbers
from flight_cli.words import setting, warn
from flight_core.parameters import require
from flight_guidance.route_file import Origin, Waypoint, read_route_file

Altitude = Annotated[
    float | None,
    setting(
        "route.altitude",
        "Altitude of a route without, or of the ground or home that it counts from, m.",
    ),
]
OriginOfRoute = Annotated[
    str | None,
    setting(
        "route.origin",
        "Where north = east = 0 for a route in latitudes, degrees; else the file's home.",
        metavar="LAT,LON",
    ),
]
Simplify = Annotated[
    float,
    setting(
        "route.simplify",
        "Leave out positions of a route within this distance of the line without them, m.",
        min=0.0,
    ),
]
Line = Annotated[
    str | None,
    setting(
        "route.line",
        "Which line of a file with several: a number from 1 on, or a name.",
        metavar="LINE",
    ),
]


def read_waypoints(
    file: Path,
    origin: str | None,
    altitude: float | None,
    simplify: float,
    line: str | None,
    *,
    above_sea: bool | None,
) -> tuple[Waypoint, ...]:
    """The waypoints of a route file; notes on the rest of the file go to standard error. Raises as
    `read_route_file`.
    """
    require(altitude is None or math.isfinite(altitude), "route.altitude", altitude, "a number")
    require(math.isfinite(simplify), "route.simplify", simplify, "a number")
    route = read_route_file(
        file, parse_origin(origin), altitude, simplify, above_sea=above_sea, line=line
    )
    for note in route.notes:
        warn(f"note: {note}")
    return route.waypoints


@overload
def parse_origin(text: str) -> Origin: ...
@overload
def parse_origin(text: None) -> None: ...
def parse_origin(text: str | None) -> Origin | None:
    """The origin of a route, from "47.38,8.54"."""
    if text is None:
        return None
    numbers = parse_numbers(text)
    fits = len(numbers) == 2 and abs(numbers[0]) <= 90.0 and abs(numbers[1]) <= 180.0
    require(
        fits, "route.origin", repr(text), "a latitude and a longitude in degrees, as in 47.38,8.54"
    )
    return Origin(*numbers)
