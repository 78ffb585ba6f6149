# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read the background of the map from a GeoJSON file of the user.

The background has lines and points in the plane of the flight.
"""

from pathlib import Path

from flight_core.files import read_file
from flight_core.parameters import ParameterError, require
from flight_guidance.routes.route_file import Origin, placed_lines
from flight_guidance.steering.path import Point

Line = list[Point]  # points (north, east) in m; a line of a single point is a mark

MAX_POINTS = 20_000
"""Largest number of positions in a background, because the page draws all of them each time."""


def read_background(path: Path, origin: Origin | None) -> list[Line]:
    """Read the lines of a GeoJSON file, where each ring of a polygon is a line.

    Raises ParameterError if the file is unreadable, its coordinates are not WGS84, a geometry has
    an unknown type, there is no origin, or there are more than MAX_POINTS positions.
    """
    if origin is None:
        raise ParameterError(
            "origin: found none, expected the latitude and longitude where north and east are 0"
        )
    lines = placed_lines(read_file(path, str(path), "a GeoJSON"), str(path), origin)
    count = sum(map(len, lines))
    require(
        count <= MAX_POINTS,
        str(path),
        f"{count} positions",
        f"at most {MAX_POINTS}: ogr2ogr -simplify leaves some out",
    )
    return lines
