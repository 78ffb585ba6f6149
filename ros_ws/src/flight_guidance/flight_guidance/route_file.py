# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Route files: GeoJSON, KML and YAML as waypoints in the local tangent plane.

GeoJSON (RFC 7946) and KML (OGC 12-007r2) hold longitude and latitude in degrees of WGS84, and altitude in m. A single
LineString is the route; without a LineString the Points are, in the order of the file. A YAML file holds the list `route` of
[north, east, altitude], [north, east, altitude, V] or {latitude: ..., longitude: ..., altitude: ..., V: ...}.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import ParseError, TreeBuilder, XMLParser

from flight_core.fields import short_repr
from flight_core.files import parse_yaml, read_file
from flight_core.parameters import ParameterError, require
from flight_guidance.path import Point

SEMI_MAJOR, FLATTENING = 6378137.0, 1.0 / 298.257223563
"""a in m and f of the ellipsoid WGS84. Source: NGA.STND.0036 (2014)."""

MAX_DISTANCE = 100e3
"""m from the origin. The plane's north and east are 4 m short of the distance on the ground there (d^3 / 6 R^2)."""


class Waypoint(NamedTuple):
    """A waypoint of a route."""

    north: float  # m from the origin
    east: float  # m from the origin
    altitude: float  # m, as `pose` counts it
    speed: float | None = None  # airspeed on the leg to the waypoint, m/s; None: as on the leg before

    @property
    def point(self) -> Point:
        """The waypoint in the local tangent plane."""
        return self.north, self.east


class Origin(NamedTuple):
    """Where north = east = 0."""

    latitude: float  # deg
    longitude: float  # deg


GEODETIC = ("latitude", "longitude", "altitude", "V")  # keys of a waypoint of a YAML file

Place = tuple[str, Any, Any, Any, Any]  # key in the file, latitude and longitude in deg, altitude, V: not validated yet


def local(latitude: float, longitude: float, origin: Origin) -> Point:
    """North and east of a position on the ellipsoid WGS84 in the tangent plane at the origin, m; angles in deg.

        [x, y, z] = N(lat) [cos(lat) cos(lon), cos(lat) sin(lon), (1 - e^2) sin(lat)],  N = a / sqrt(1 - e^2 sin(lat)^2)

    and the difference of two vectors [x, y, z] turned to north and east at the origin. Altitude takes no part: the altitude of
    an aircraft follows the curved Earth. Source: IOGP publication 373-7-2, methods EPSG:9602 and 9836.
    """
    lat, turn = math.radians(origin.latitude), math.radians(longitude - origin.longitude)
    (out_0, up_0), (out, up) = _meridian(lat), _meridian(math.radians(latitude))
    outward = out * math.cos(turn) - out_0
    return (up - up_0) * math.cos(lat) - outward * math.sin(lat), out * math.sin(turn)


def _is_above(latitude: float, longitude: float, origin: Origin) -> bool:
    """Whether a position is on the half of the Earth around the origin; the antipodal half has the same north and east."""
    lat, turn = math.radians(origin.latitude), math.radians(longitude - origin.longitude)
    out, up = _meridian(math.radians(latitude))
    return out * math.cos(turn) * math.cos(lat) + up * math.sin(lat) > 0.0


def _meridian(latitude: float) -> tuple[float, float]:
    """Distance of a position on the ellipsoid from the Earth's axis, and from the plane of the equator, m."""
    e_squared = FLATTENING * (2.0 - FLATTENING)
    normal = SEMI_MAJOR / math.sqrt(1.0 - e_squared * math.sin(latitude) ** 2)
    return normal * math.cos(latitude), normal * (1.0 - e_squared) * math.sin(latitude)


def read_route(path: Path, origin: Origin | None = None) -> tuple[Waypoint, ...]:
    """The waypoints of a route file, by the ending: .geojson or .json, .kml, .yaml or .yml.

    Latitudes and longitudes are turned to north and east of the origin. Raises ParameterError for an unreadable file, a
    value missing or out of range, and latitudes without an origin.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ParameterError(f"route: found the file {path}, expected one that ends in {', '.join(READERS)}")
    return tuple(reader(read_file(path, str(path), "a route file"), str(path), origin))


def _read_yaml(content: bytes, key: str, origin: Origin | None) -> Iterator[Waypoint]:
    tree = parse_yaml(content, key, "a route file")
    points = tree.get("route") if isinstance(tree, Mapping) and set(tree) == {"route"} else None
    require(isinstance(points, list), key, "another content", "the key route alone, with a list of waypoints")
    for k, point in enumerate(points or ()):
        name = f"route[{k}]"
        if isinstance(point, Mapping):
            unknown = sorted(map(str, set(point) - set(GEODETIC)))
            require(not unknown, name, f"the keys {short_repr(unknown)}", "latitude, longitude, altitude and perhaps V")
            latitude, longitude, altitude, speed = (point.get(each) for each in GEODETIC)
            yield _placed((name, latitude, longitude, altitude, speed), origin)
        else:
            fits = isinstance(point, list) and 3 <= len(point) <= 4
            require(fits, name, short_repr(point), "[north, east, altitude], [north, east, altitude, V] or a mapping")
            north, east, altitude, *speed = point
            yield _waypoint(name, _number(name, north, "north"), _number(name, east, "east"), altitude, *speed)


def _read_geojson(content: bytes, key: str, origin: Origin | None) -> Iterator[Waypoint]:
    try:
        tree = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ParameterError(f"{key}: not valid JSON ({error}), expected a route file") from None
    features = _member(tree, "features")
    lines: list[list[Any]] = []  # positions with V
    points: list[Any] = []
    for feature in features if isinstance(features, list) else [tree]:
        geometry, speed = _member(feature, "geometry") or feature, _member(_member(feature, "properties"), "V")
        kind, coordinates = _member(geometry, "type"), _member(geometry, "coordinates")
        if kind == "LineString" and isinstance(coordinates, list):
            lines.append([(position, speed) for position in coordinates])
        elif kind == "Point":
            points.append((coordinates, speed))
    for k, (position, speed) in enumerate(_only_line(key, lines, points)):
        yield _placed(_lon_lat(f"route[{k}]", position, speed), origin)


def _member(tree: Any, name: str) -> Any:
    """A member of a JSON object; None of anything else."""
    return tree.get(name) if isinstance(tree, Mapping) else None


class _NoDoctype(TreeBuilder):
    """Refuses a document type, the only place of entity declarations: no entity is ever expanded or fetched."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ParseError("a document type")


def _read_kml(content: bytes, key: str, origin: Origin | None) -> Iterator[Waypoint]:
    parser = XMLParser(target=_NoDoctype())  # noqa: S314 - without a document type there is nothing to expand
    try:
        parser.feed(content)
        root = parser.close()
    except (ParseError, ValueError, LookupError) as error:  # the last two: of an encoding
        raise ParameterError(f"{key}: found {error}, expected the XML of a KML file") from None
    lines: list[list[Any]] = []  # positions
    points: list[Any] = []
    kinds = [(str(element.tag).rpartition("}")[2], element) for element in root.iter()]
    used = "LineString" if any(kind == "LineString" for kind, _ in kinds) else "Point"
    for kind, geometry in kinds:
        if kind != used:
            continue
        texts = {str(child.tag).rpartition("}")[2]: child.text or "" for child in geometry}
        mode = texts.get("altitudeMode", "clampToGround").strip()  # the default of KML
        found = f"a {kind} with the altitudeMode {short_repr(mode)}"
        require(mode == "absolute", key, found, "absolute, for the height of the ground is not known")
        tuples = [text.split(",") for text in texts.get("coordinates", "").split()]
        if kind == "LineString":
            lines.append(tuples)
        else:
            require(len(tuples) == 1, key, f"a Point with {len(tuples)} positions", "one")
            points += tuples
    for k, position in enumerate(_only_line(key, lines, points)):
        yield _placed(_lon_lat(f"route[{k}]", list(map(_parsed, position))), origin)


def _parsed(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _lon_lat(key: str, position: Any, speed: Any = None) -> Place:
    """A position of GeoJSON or KML."""
    fits = isinstance(position, list) and len(position) == 3
    require(fits, key, short_repr(position), "longitude, latitude, altitude")
    longitude, latitude, altitude = position
    return key, latitude, longitude, altitude, speed


def _only_line(key: str, lines: list[list[Any]], points: list[Any]) -> list[Any]:
    """The positions of the line; of the points where there is none."""
    require(len(lines) <= 1, key, f"{len(lines)} LineStrings", "one, or Points alone")
    places = lines[0] if lines else points
    require(bool(places), key, "no LineString and no Point", "a route")
    return places


def _placed(place: Place, origin: Origin | None) -> Waypoint:
    key, latitude, longitude, altitude, speed = place
    if origin is None:
        raise ParameterError(f"{key}: found a latitude and a longitude, expected an origin, where north and east are 0")
    degrees = (_number(key, latitude, "latitude", 90.0), _number(key, longitude, "longitude", 180.0))
    require(_is_above(*degrees, origin), key, "a position on the other half of the Earth", "one near the origin")
    return _waypoint(key, *local(*degrees, origin), altitude, speed)


def _waypoint(key: str, north: float, east: float, altitude: Any, speed: Any = None) -> Waypoint:
    distance = math.hypot(north, east)
    found = f"{distance / 1e3:.0f} km from the origin"
    require(distance <= MAX_DISTANCE, key, found, f"at most {MAX_DISTANCE / 1e3:g} km, on a plane that touches the Earth")
    if speed is not None:
        speed = _number(key, speed, "V")
        require(speed > 0.0, f"{key}.V", f"{speed:g} m/s", "a speed above 0")
    return Waypoint(north, east, _number(key, altitude, "altitude"), speed)


def _number(key: str, value: Any, name: str, largest: float = 1e9) -> float:
    """A value as a finite number within +-largest. Raises ParameterError."""
    fits = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= largest
    expected = "a finite number" + (f" from {-largest:g} to {largest:g}" if largest < 1e9 else "")
    require(fits, f"{key}.{name}", "nothing" if value is None else short_repr(value), expected)
    return float(value)


READERS: Mapping[str, Callable[[bytes, str, Origin | None], Iterator[Waypoint]]] = {
    ".geojson": _read_geojson,
    ".json": _read_geojson,
    ".kml": _read_kml,
    ".yaml": _read_yaml,
    ".yml": _read_yaml,
}
