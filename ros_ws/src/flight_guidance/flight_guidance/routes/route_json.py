# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read routes from GeoJSON (RFC 7946), and members of JSON objects."""

import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from types import MappingProxyType
from typing import Any

from flight_core.fields import short_repr
from flight_core.parameters import ParameterError, require
from flight_guidance.routes.route_places import A_ROUTE, Geometry, Place, Places, lon_lat, one_route


def parsed_json(content: bytes, key: str) -> Any:
    """Parse the content of a JSON file. Raises ParameterError if it is not valid JSON."""
    try:
        return json.loads(
            content.removeprefix(b"\xef\xbb\xbf"), object_pairs_hook=_members, parse_int=_whole
        )
    except (ValueError, RecursionError) as error:
        raise ParameterError(f"{key}: not valid JSON ({error}), expected {A_ROUTE}") from None


def _whole(digits: str) -> int | float:
    """Read a whole number of JSON: as an int up to 15 digits, and as a float beyond.

    A float with so many digits is rounded. It is infinite if the number is too large for a float.
    """
    return int(digits) if len(digits) < 16 else float(digits)


def _members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        twice = next(name for name, count in counts.items() if count > 1)
        raise ValueError(f"the member {short_repr(twice)} twice")
    return members


def json_route(tree: Any, key: str, line: str | None) -> Places:
    """Read the route in a parsed GeoJSON file.

    `line` chooses one of several lines, see `one_route`. Raises ParameterError if the file has no
    route, or more than one without a choice.
    """
    require_wgs84(tree, key)
    geometries: list[Geometry] = []
    others: list[str] = []
    for node, properties in nodes(tree):
        speed = member(properties, "V")
        name = member(properties, "name")
        kind = member(node, "type")
        coordinates = member(node, "coordinates")
        if isinstance(kind, str) and kind in GEOJSON:
            parts = GEOJSON[kind](coordinates if isinstance(coordinates, list) else [])
            part_kind = kind if len(parts) == 1 else PARTS.get(kind, kind)
            route_name = name if isinstance(name, str) else ""
            for part in parts:
                places = [lon_lat(position, speed) for position in part]
                geometries.append(Geometry(part_kind, places, route_name))
        elif node is not None:
            others.append(f"geometry of the type {short_repr(kind)}")
    return one_route(key, geometries, others, line)


def read_lines(content: bytes, key: str) -> list[list[Place]]:
    """Read the lines, rings and points of a GeoJSON file, in the order of the file.

    Raises ParameterError for invalid JSON, another coordinate system or an unknown geometry.
    """
    tree = parsed_json(content, key)
    require_wgs84(tree, key)
    lines: list[list[Place]] = []
    for node, _ in nodes(tree):
        kind = member(node, "type")
        coordinates = member(node, "coordinates")
        if node is None:
            continue
        is_geometry = isinstance(kind, str) and kind in GEOJSON
        require(
            is_geometry,
            key,
            f"a geometry of the type {short_repr(kind)}",
            f"one of {', '.join(GEOJSON)}",
        )
        parts = GEOJSON[kind](coordinates if isinstance(coordinates, list) else [])
        if kind == "MultiPoint":
            parts = [[position] for position in chain.from_iterable(parts)]
        lines += [[*map(lon_lat, part)] for part in parts]
    return lines


def _ring(rings: list[Any]) -> list[list[Any]]:
    """Return the rings of a GeoJSON Polygon, which are the members that are lists.

    The first ring is the outer border of the polygon, and further rings are holes. If a file has no
    line, the outer border is taken as the route.
    """
    return [ring for ring in rings if isinstance(ring, list)]


GEOJSON: Mapping[str, Callable[[list[Any]], list[list[Any]]]] = MappingProxyType(
    {
        "Point": lambda coordinates: [[coordinates]],
        "MultiPoint": lambda coordinates: [coordinates],
        "LineString": lambda coordinates: [coordinates],
        "MultiLineString": _ring,
        "Polygon": _ring,
        "MultiPolygon": lambda polygons: [*chain.from_iterable(map(_ring, _ring(polygons)))],
    }
)
"""Lines or points of a geometry, by its type."""

PARTS = {
    "MultiLineString": "line of a MultiLineString",
    "Polygon": "ring of a Polygon",
    "MultiPolygon": "ring of a MultiPolygon",
}
"""Name of one of several parts, by the type of the geometry."""


def nodes(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the geometries with the properties of their Feature, in the order of the file.

    A Feature without a geometry yields None.
    """
    pending: list[tuple[Any, Any]] = [(tree, None)]
    while pending:
        node, properties = pending.pop()
        members = [member(node, name) for name in ("features", "geometries")]
        inside = next((member for member in members if isinstance(member, list)), None)
        if inside is not None:
            pending += [(child, properties) for child in reversed(inside)]
        elif isinstance(node, Mapping) and "geometry" in node:
            pending.append((node["geometry"], member(node, "properties")))
        else:
            yield node, properties


def require_wgs84(tree: Any, key: str) -> None:
    """Check that a member `crs` names no other coordinate system than WGS84.

    RFC 7946 permits only WGS84, but older versions of GDAL wrote other systems. Raises
    ParameterError.
    """
    crs = member(tree, "crs")
    name = str(member(member(crs, "properties"), "name") or "")
    is_wgs84 = crs is None or re.search(
        r"CRS84h?$|EPSG:+4326$|EPSG:+4979$|WGS ?84$", name, re.IGNORECASE
    )
    require(
        bool(is_wgs84),
        key,
        f"the coordinate system {short_repr(name)}",
        "WGS84: ogr2ogr -t_srs EPSG:4326 converts it",
    )


def member(tree: Any, name: str) -> Any:
    """Return a member of a JSON object, or None for anything else."""
    return tree.get(name) if isinstance(tree, Mapping) else None


def entries(tree: Any, name: str, key: str) -> list[Any]:
    """Return a member of a JSON object as a list; an absent member is an empty list."""
    value = member(tree, name)
    require(value is None or isinstance(value, list), key, f"{name}: {short_repr(value)}", "a list")
    return list(value or ())


def flag(tree: Any, name: str, absent: bool | None, key: str) -> bool:
    """Return a member of a JSON object that must be true or false, or 1 or 0.

    Returns `absent` if the object has no such member.
    """
    value = absent if member(tree, name) is None else tree[name]
    require(value in (True, False), key, f"{name}: {short_repr(value)}", "true or false")
    return bool(value)


def as_list(value: Any, key: str) -> list[Any]:
    """Return a value that is a list with entries. Raises ParameterError for any other value."""
    require(isinstance(value, list) and bool(value), key, short_repr(value), "a list of positions")
    return list(value)
