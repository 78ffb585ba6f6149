# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read routes in formats with latitudes and longitudes of WGS84.

The formats are GeoJSON, KML, KMZ, GPX, QGroundControl plans, and QGC WPL 110. A file holds one
route, which is a line, or points in the order of the file. Any other content is refused, or named
in a note. Sources: RFC 7946 (GeoJSON); OGC 12-007r2 (KML); GPX 1.1 schema; QGroundControl guide,
Plan File Format; MAVLink guide, File Formats and MAV_FRAME.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from flight_core.parameters import require
from flight_guidance.routes.mission_files import (
    FIRST_FENCE,
    FencePlaces,
    has_first_fence,
    json_fence,
    plan_fence,
    read_plan,
    read_plan_tree,
    read_wpl,
    wpl_fence,
)
from flight_guidance.routes.route_json import json_route, member, parsed_json
from flight_guidance.routes.route_places import Places
from flight_guidance.routes.route_xml import read_gpx, read_kml, read_kmz


def read_places(content: bytes, key: str, suffix: str, line: str | None = None) -> Places:
    """Read the route in the content of a file; `key` names the file in errors.

    In a file with several lines, `line` chooses one by its number from 1 on, or by its name. Raises
    ParameterError.
    """
    route = FORMATS[suffix](content, key, line)
    require(bool(route.places), key, "; ".join(["no position", *route.notes]), "a route")
    places = [place._replace(key=f"route[{k}]") for k, place in enumerate(route.places)]
    return route._replace(places=places)


def read_fence(content: bytes, key: str, suffix: str) -> FencePlaces:
    """Read zones and rally points from a QGroundControl plan, a QGC WPL 110 or a GeoJSON file.

    Raises ParameterError if the content cannot be read, or has no zone.
    """
    if suffix in WPL_ENDINGS:
        fence = wpl_fence(content, key)
    else:
        tree = parsed_json(content, key)
        fence = (
            plan_fence(tree, key) if member(tree, "fileType") == "Plan" else json_fence(tree, key)
        )
        require(
            not has_first_fence(tree),
            key,
            FIRST_FENCE.partition(":")[0],
            "one of version 2: save the plan again with it",
        )
    require(bool(fence.zones), key, "no zone", "a polygon or a circle of a fence")
    return fence


WPL_ENDINGS = (".waypoints", ".mission", ".txt")
FENCES = (".plan", ".geojson", ".json", *WPL_ENDINGS)
"""Endings of files that may have a fence."""


def _read_json(content: bytes, key: str, line: str | None = None) -> Places:
    tree = parsed_json(content, key)
    return (read_plan_tree if member(tree, "fileType") == "Plan" else json_route)(tree, key, line)


FORMATS: Mapping[str, Callable[[bytes, str, str | None], Places]] = MappingProxyType(
    {
        ".geojson": _read_json,
        ".json": _read_json,
        ".kml": read_kml,
        ".kmz": read_kmz,
        ".gpx": read_gpx,
        ".plan": read_plan,
        **dict.fromkeys(WPL_ENDINGS, read_wpl),
    }
)
"""Readers by the ending of a file."""
