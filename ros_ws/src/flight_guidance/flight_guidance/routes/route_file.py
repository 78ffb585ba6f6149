# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read route files as waypoints in the local tangent plane.

`route_formats` reads the formats with latitudes and longitudes. A YAML file holds the list `route`.
Each entry is [north, east, altitude], [north, east, altitude, V] or a mapping. A mapping has north
and east, or latitude and longitude. It also has the altitude, and may have V, turns, wait, leave
and left, which are those of `Waypoint`.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flight_core.fields import short_repr
from flight_core.files import parse_yaml, read_file
from flight_core.parameters import ParameterError, require
from flight_guidance.routes import route_formats
from flight_guidance.routes.mission_files import FencePlaces
from flight_guidance.routes.route_formats import FORMATS
from flight_guidance.routes.route_json import read_lines
from flight_guidance.routes.route_places import Above, HomePlace, Place
from flight_guidance.steering.path import Point

SEMI_MAJOR = 6378137.0
FLATTENING = 1.0 / 298.257223563
"""Semi-major axis a, m, and flattening f of the ellipsoid WGS84. Source: NGA.STND.0036 (2014)."""

MAX_DISTANCE = 100e3
"""Largest distance from the origin, m. There the distance in the plane is 4 m shorter than that on
the ground (d^3 / 6 R^2)."""


class Waypoint(NamedTuple):
    """A waypoint of a route."""

    north: float  # m from the origin
    east: float  # m from the origin
    altitude: float  # m, altitude with the reference of `pose`
    # Airspeed on the leg to the waypoint, m/s; if None, as on the previous leg.
    speed: float | None = None
    turns: float = 0.0  # number of turns round the waypoint before the aircraft flies on
    wait: float = 0.0  # time on the circle round the waypoint, or in a hover, s
    # Altitude at which the aircraft leaves a circle round the waypoint, m; if None, `altitude`.
    leave: float | None = None
    # Whether circles round the waypoint are counter-clockwise; None if not given, which means
    # clockwise.
    left: bool | None = None

    @property
    def point(self) -> Point:
        """Position of the waypoint in the local tangent plane."""
        return self.north, self.east

    @property
    def is_loiter(self) -> bool:
        """Whether the aircraft flies circles round the waypoint before it flies on."""
        return self.turns > 0.0 or self.wait > 0.0 or self.departure != self.altitude

    @property
    def departure(self) -> float:
        """Altitude at which the aircraft flies on, m."""
        return self.altitude if self.leave is None else self.leave


class RouteFile(NamedTuple):
    """The content of a route file."""

    waypoints: tuple[Waypoint, ...]
    notes: tuple[str, ...]  # sentences on content of the file that is not flown


class Origin(NamedTuple):
    """Position on the Earth at which north and east are 0."""

    latitude: float  # deg
    longitude: float  # deg


POSITIONS = (("north", "east"), ("latitude", "longitude"))  # keys of a position in a YAML waypoint
FURTHER = ("V", "turns", "wait", "leave", "left")


def local(latitude: float, longitude: float, origin: Origin) -> Point:
    """Project a position on the ellipsoid WGS84 to north and east in the tangent plane, m.

    The plane touches the ellipsoid at the origin; angles are in deg.

        [x, y, z] = N(lat) [cos(lat) cos(lon), cos(lat) sin(lon), (1 - e^2) sin(lat)],
            N = a / sqrt(1 - e^2 sin(lat)^2)

    The difference of the vectors [x, y, z] of the position and of the origin is rotated into north
    and east. Altitude is not used, because the altitude of an aircraft follows the curved Earth.
    Source: IOGP publication 373-7-2, methods EPSG:9602 and 9836.
    """
    lat = math.radians(origin.latitude)
    turn = math.radians(longitude - origin.longitude)
    (out_0, up_0), (out, up) = _meridian(lat), _meridian(math.radians(latitude))
    outward = out * math.cos(turn) - out_0
    return (up - up_0) * math.cos(lat) - outward * math.sin(lat), out * math.sin(turn)


def geographic(north: float, east: float, origin: Origin) -> Origin:
    """Compute latitude and longitude, deg, of a position in m north and east of the origin.

    This is the inverse of `local`, for a position on the ellipsoid. Within 50 km of an origin below
    80 deg of latitude, each step of the iteration reduces the error to a hundredth.
    """
    latitude, longitude = origin
    for _ in range(8):
        offset = local(latitude, longitude, origin)
        out, _up = _meridian(math.radians(latitude))
        latitude += math.degrees((north - offset[0]) / SEMI_MAJOR)
        longitude += math.degrees((east - offset[1]) / out)
    return Origin(latitude, longitude)


def _is_above(latitude: float, longitude: float, origin: Origin) -> bool:
    """Return whether a position is on the half of the Earth that surrounds the origin.

    A position on the other half would have the same north and east as one on this half.
    """
    lat = math.radians(origin.latitude)
    turn = math.radians(longitude - origin.longitude)
    out, up = _meridian(math.radians(latitude))
    return out * math.cos(turn) * math.cos(lat) + up * math.sin(lat) > 0.0


def _meridian(latitude: float) -> tuple[float, float]:
    """Return the distances of a position on the ellipsoid from the Earth's axis and equator, m."""
    e_squared = FLATTENING * (2.0 - FLATTENING)
    normal = SEMI_MAJOR / math.sqrt(1.0 - e_squared * math.sin(latitude) ** 2)
    return normal * math.cos(latitude), normal * (1.0 - e_squared) * math.sin(latitude)


YAML = (".yaml", ".yml")
ENDINGS = (*FORMATS, *YAML)


def read_route(path: Path, origin: Origin | None = None) -> tuple[Waypoint, ...]:
    """Read the waypoints of a route file. Raises as `read_route_file` does."""
    return read_route_file(path, origin).waypoints


def read_route_file(
    path: Path,
    origin: Origin | None = None,
    altitude: float | None = None,
    simplify: float = 0.0,
    *,
    above_sea: bool | None = False,
    line: str | None = None,
) -> RouteFile:
    """Read the waypoints of a route file, whose ending is one of ENDINGS.

    Latitudes and longitudes are converted to north and east of the origin, by default the home in
    the file. If the file has no altitudes, `altitude` is the altitude to fly at, m. If the
    altitudes of the file are above the ground or above the home, `altitude` is the altitude of the
    ground or of the home. `above_sea` says whether the altitudes of `pose` are above the sea
    (True), or above the start, which is the home in the file (False). None means that this is
    unknown.

    Successive equal positions become one waypoint. A waypoint is left out if the line without it
    passes within `simplify`, m. In a file with several lines, `line` chooses one by its number from
    1 on, or by its name.

    Raises ParameterError for an unreadable file, for a geometry that is no route, for a value that
    is missing or out of range, and for latitudes without an origin.
    """
    suffix = path.suffix.lower()
    require(
        suffix in ENDINGS, "route", f"the file {path}", f"one that ends in {', '.join(ENDINGS)}"
    )
    content = read_file(path, str(path), "a route file")
    if suffix in YAML:
        require(line is None, "line", f"the route {path}", "a file with several lines")
        waypoints = list(_read_yaml(content, str(path), origin))
        notes = list[str]()
    else:
        route = route_formats.read_places(content, str(path), suffix, line)
        home = route.home
        notes = list(route.notes)
        if origin is None and home is not None and above_sea is not None:
            origin = Origin(home.latitude, home.longitude)
        _require_order(route.places, origin)
        heights = _Heights(altitude, home, above_sea=above_sea)
        waypoints = []
        for place in route.places:
            waypoint = _placed(place, origin, heights)
            if place.climbs and waypoints:
                waypoint = waypoint._replace(
                    altitude=waypoints[-1].departure, leave=waypoint.altitude
                )
            waypoints.append(waypoint)
    waypoints = _merged(waypoints)
    if simplify > 0.0:
        thinner = thinned(waypoints, simplify)
        notes.append(
            f"{len(thinner)} of {len(waypoints)} positions: the others are within {simplify:g} "
            "m of the line"
        )
        waypoints = thinner
    return RouteFile(tuple(waypoints), tuple(notes))


def _merged(waypoints: Sequence[Waypoint]) -> list[Waypoint]:
    """Merge successive waypoints at one place into a single waypoint with all of their circles.

    The aircraft leaves this waypoint at the altitude and with the airspeed of the last one. Raises
    ParameterError for circles in both directions at one place.
    """
    places: list[Waypoint] = []
    speed: float | None = None
    for waypoint in waypoints:
        if places and waypoint.point == (last := places[-1]).point:
            turns = last.turns + waypoint.turns
            wait = last.wait + waypoint.wait
            leave = None if waypoint.departure == last.altitude else waypoint.departure
            sides = {last.left, waypoint.left} - {None}
            both = "circles to the left and to the right round one place"
            require(len(sides) < 2, f"route[{len(places) - 1}]", both, "one direction a place")
            left = next(iter(sides), None)
            places[-1] = last._replace(turns=turns, wait=wait, leave=leave, left=left)
            speed = waypoint.speed or speed
        else:
            places.append(waypoint if waypoint.speed else waypoint._replace(speed=speed))
            speed = None
    return places


def read_fence_file(
    path: Path,
    origin: Origin | None = None,
    altitude: float | None = None,
    *,
    above_sea: bool = False,
) -> dict[str, Any]:
    """Read the sections `fence` and `home` of guidance from a file.

    The arguments are as for `read_route_file`. Home is the rally point nearest to the origin.
    Without rally points it is the return point of the fence, and without a return point it is the
    home in the file. If the file has none of them, the result has no home. Raises ParameterError
    for an unreadable file, a file without a zone, and a number that is missing or out of range.
    """
    suffix = path.suffix.lower()
    require(
        suffix in route_formats.FENCES,
        "fence",
        f"the file {path}",
        f"one that ends in {', '.join(route_formats.FENCES)}",
    )
    fence_places = route_formats.read_fence(
        read_file(path, str(path), "a fence file"), str(path), suffix
    )
    if origin is None and fence_places.home is not None:
        origin = Origin(fence_places.home.latitude, fence_places.home.longitude)
    places = chain.from_iterable(area.places for area in fence_places.zones)
    _require_order([place._replace(key=str(path)) for place in places], origin)
    zones: dict[str, Any] = {}
    for k, area in enumerate(fence_places.zones):
        key = f"zone_{k}"
        flat = [
            place._replace(key=f"fence.{key}", altitude=0.0, above=Above.AS_POSE)
            for place in area.places
        ]
        corners = _merged([_placed(place, origin, _Heights()) for place in flat])
        points = [waypoint.point for waypoint in corners]
        if len(points) > 1 and points[0] == points[-1]:
            del points[-1]  # a ring repeats its first point at the end
        zones[key] = {
            "north": [point[0] for point in points],
            "east": [point[1] for point in points],
            "exclude": area.exclude,
        }
        if area.radius is not None:
            zones[key]["radius"] = _number(f"fence.{key}", area.radius, "radius")
        if area.group is not None:
            zones[key]["group"] = area.group
    heights = _Heights(altitude, fence_places.home, above_sea=above_sea)
    home = _home_of_fence(fence_places, origin, heights)
    return {"fence": zones} | ({} if home is None else {"home": home})


def placed_lines(content: bytes, key: str, origin: Origin) -> list[list[Point]]:
    """Read the lines, rings and points of a GeoJSON file as north and east of the origin, m.

    Raises ParameterError for unreadable content, for content without a position, for a coordinate
    system other than WGS84, and for a position out of range.
    """
    lines = [line for line in read_lines(content, key) if line]
    require(bool(lines), key, "no position", "lines, polygons or points")
    _require_order([*chain.from_iterable(lines)], origin)
    lines_in_plane: list[list[Point]] = []
    for line in lines:
        flat = [place._replace(key=key, altitude=0.0) for place in line]
        lines_in_plane.append([_placed(place, origin, _Heights()).point for place in flat])
    return lines_in_plane


def thinned(waypoints: Sequence[Waypoint], tolerance: float) -> list[Waypoint]:
    """Leave out each waypoint within `tolerance`, m, of the line between the remaining ones.

    Waypoints with circles stay, and so do waypoints at which the airspeed changes. Each waypoint in
    the result has the airspeed of its leg. Source: Douglas and Peucker (1973), Algorithms for the
    reduction of the number of points required to represent a line.
    """
    speed: float | None = None
    waypoints_with_speed = [
        waypoint._replace(speed=(speed := waypoint.speed or speed)) for waypoint in waypoints
    ]
    points = np.array([waypoint[:3] for waypoint in waypoints_with_speed])
    changes = {
        k
        for k, (before, after) in enumerate(pairwise(waypoints_with_speed))
        if before.is_loiter or before.speed != after.speed
    }
    corner_numbers = {0, len(points) - 1} | changes
    spans = list(pairwise(sorted(corner_numbers)))
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        start = points[first]
        along = points[last] - points[first]
        inside = points[first + 1 : last] - start
        share = np.clip(inside @ along / max(float(along @ along), np.finfo(float).tiny), 0.0, 1.0)
        distance = np.linalg.norm(inside - share[:, None] * along, axis=1)
        farthest = first + 1 + int(np.argmax(distance))
        if distance.max() > tolerance:
            corner_numbers.add(farthest)
            spans += [(first, farthest), (farthest, last)]
    return [waypoints_with_speed[k] for k in sorted(corner_numbers)]


class _Heights:
    """Converts the altitude of a place in a file to an altitude with the reference of `pose`."""

    def __init__(
        self,
        fixed: float | None = None,
        home: HomePlace | None = None,
        *,
        above_sea: bool | None = None,
    ) -> None:
        self._fixed = fixed
        self._sea = None if home is None else home.altitude
        self._zero = fixed  # altitude of the home with the reference of `pose`
        if fixed is None and above_sea is not None:
            self._zero = self._sea if above_sea else 0.0
        self._above_sea = above_sea

    def altitude(self, place: Place) -> Any:
        """Return the altitude of a place in m, before it is validated.

        Raises ParameterError if the file does not say above what the altitude is measured.
        """
        altitude = place.altitude
        above = place.above
        if above is Above.AS_POSE or altitude is None:
            return self._fixed if altitude is None else altitude
        altitude = _number(place.key, altitude, "altitude")
        if above is Above.GROUND:
            way_out = "absolute, or --altitude with the height of the ground, which is not known"
            require(self._fixed is not None, place.key, place.altitude_text, way_out)
            return altitude + (self._fixed or 0.0)
        if above is Above.SEA and self._above_sea:
            return altitude
        reference = f"an altitude above the {above.name.lower()}"
        require(
            above is Above.HOME or self._sea is not None,
            place.key,
            reference,
            "a home with its altitude in the file",
        )
        require(
            self._zero is not None,
            place.key,
            reference,
            "--altitude with the altitude of the home, as the aircraft counts",
        )
        above_home = altitude + (self._zero or 0.0)
        return above_home - (self._sea or 0.0) if above is Above.SEA else above_home


def _home_of_fence(
    places: FencePlaces, origin: Origin | None, heights: _Heights
) -> dict[str, Any] | None:
    """Return the section `home` by the rule of `read_fence_file`, or None if there is no home."""
    rally = [_placed(place._replace(key="rally point"), origin, heights) for place in places.rally]
    if rally:
        nearest = min(rally, key=lambda point: math.hypot(*point.point))
        return {"north": nearest.north, "east": nearest.east, "altitude": nearest.altitude}
    if places.back is not None:
        has_altitude = places.back.altitude is not None
        level = places.back
        if not has_altitude:
            level = places.back._replace(altitude=0.0, above=Above.AS_POSE)
        back = _placed(level._replace(key="return point"), origin, heights)
        section: dict[str, Any] = {"north": back.north, "east": back.east}
        return section | ({"altitude": back.altitude} if has_altitude else {})
    if places.home is not None and origin is not None:
        north, east = local(places.home.latitude, places.home.longitude, origin)
        return {"north": north, "east": east}
    return None


def _require_order(places: Sequence[Place], origin: Origin | None) -> None:
    """Check that latitudes and longitudes are in order, and not exchanged.

    They seem to be exchanged if the places are near the origin only after an exchange. This raises
    ParameterError.
    """
    if origin is None:
        return
    numbers = [(place.latitude, place.longitude) for place in places]
    if not all(
        isinstance(value, int | float) and math.isfinite(value)
        for value in chain.from_iterable(numbers)
    ):
        return
    near = all(_is_near(latitude, longitude, origin) for latitude, longitude in numbers)
    near_exchanged = all(_is_near(longitude, latitude, origin) for latitude, longitude in numbers)
    exchange = "latitude and longitude exchanged, by the origin"
    require(
        near or not near_exchanged,
        places[0].key,
        exchange,
        "longitude first in GeoJSON and KML, latitude first in --origin",
    )


def _is_near(latitude: float, longitude: float, origin: Origin) -> bool:
    inside = (
        abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and _is_above(latitude, longitude, origin)
    )
    return inside and math.hypot(*local(latitude, longitude, origin)) <= MAX_DISTANCE


def _read_yaml(content: bytes, key: str, origin: Origin | None) -> Iterator[Waypoint]:
    tree = parse_yaml(content, key, "a route file")
    points = tree.get("route") if isinstance(tree, Mapping) and set(tree) == {"route"} else None
    require(
        isinstance(points, list),
        key,
        "another content",
        "the key route alone, with a list of waypoints",
    )
    require(bool(points), key, "no waypoint", "two or more")
    for k, point in enumerate(points or ()):
        name = f"route[{k}]"
        if isinstance(point, Mapping):
            yield _waypoint_of_mapping(name, point, origin)
        else:
            fits = isinstance(point, list) and 3 <= len(point) <= 4
            require(
                fits,
                name,
                short_repr(point),
                "[north, east, altitude], [north, east, altitude, V] or a mapping",
            )
            north, east, altitude, *speed = point
            yield _waypoint(
                name, _number(name, north, "north"), _number(name, east, "east"), altitude, *speed
            )


def _waypoint_of_mapping(name: str, point: Mapping[str, Any], origin: Origin | None) -> Waypoint:
    position = next((pair for pair in POSITIONS if pair[0] in point), POSITIONS[0])
    unknown = sorted(map(str, set(point) - {*position, "altitude", *FURTHER}))
    expected = (
        "north and east or latitude and longitude, altitude, and perhaps V, turns, wait, leave, "
        "left"
    )
    require(not unknown, name, f"the keys {short_repr(unknown)}", expected)
    first, second, altitude, speed, turns, wait, leave, left = (
        point.get(key) for key in (*position, "altitude", *FURTHER)
    )
    if position == POSITIONS[0]:
        north = _number(name, first, "north")
        waypoint = _waypoint(name, north, _number(name, second, "east"), altitude, speed)
    else:
        place = Place(key=name, latitude=first, longitude=second, altitude=altitude, speed=speed)
        waypoint = _placed(place, origin, _Heights())
    circles = {
        key: _loiter(name, value, key)
        for key, value in (("turns", turns), ("wait", wait))
        if value is not None
    }
    is_boolean = left is None or isinstance(left, bool)
    require(is_boolean, f"{name}.left", short_repr(left), "true or false")
    waypoint = waypoint._replace(**circles, left=left)
    return waypoint if leave is None else waypoint._replace(leave=_number(name, leave, "leave"))


def _placed(place: Place, origin: Origin | None, heights: _Heights) -> Waypoint:
    key = place.key
    altitude = heights.altitude(place)
    if altitude is None and place.altitude_text:
        raise ParameterError(
            f"{key}: found {place.altitude_text}, expected longitude, latitude, altitude, or "
            "--altitude to fly at"
        )
    if origin is None:
        raise ParameterError(
            f"{key}: found a latitude and a longitude, expected an origin, where north and east "
            "are 0"
        )
    degrees = (
        _number(key, place.latitude, "latitude", 90.0),
        _number(key, place.longitude, "longitude", 180.0),
    )
    require(
        _is_above(*degrees, origin),
        key,
        "a position on the other half of the Earth",
        "one near the origin",
    )
    waypoint = _waypoint(key, *local(*degrees, origin), altitude, place.speed)
    return waypoint._replace(
        turns=_loiter(key, place.turns or 0.0, "turns"),
        wait=_loiter(key, place.wait or 0.0, "wait"),
        left=place.left,
    )


def _loiter(key: str, value: Any, name: str) -> float:
    number = _number(key, value, name)
    require(number >= 0.0, f"{key}.{name}", f"{number:g}", "at least 0")
    return number


def _waypoint(key: str, north: float, east: float, altitude: Any, speed: Any = None) -> Waypoint:
    distance = math.hypot(north, east)
    remoteness = f"{distance / 1e3:.0f} km from the origin"
    require(
        distance <= MAX_DISTANCE,
        key,
        remoteness,
        f"at most {MAX_DISTANCE / 1e3:g} km, on a plane that touches the Earth",
    )
    if speed is not None:
        speed = _number(key, speed, "V")
        require(speed > 0.0, f"{key}.V", f"{speed:g} m/s", "a speed above 0")
    return Waypoint(north, east, _number(key, altitude, "altitude"), speed)


def _number(key: str, value: Any, name: str, largest: float = 1e9) -> float:
    """Return a value as a finite number within +-`largest`, or raise ParameterError."""
    fits = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= largest
    expected = "a finite number" + (f" from {-largest:g} to {largest:g}" if largest < 1e9 else "")
    require(fits, f"{key}.{name}", "nothing" if value is None else short_repr(value), expected)
    return float(value)
