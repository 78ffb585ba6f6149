# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Formats of routes with latitudes and longitudes of WGS84: GeoJSON, KML, KMZ, GPX, plans of QGroundControl, QGC WPL 110.

A file holds one route: a line, or points in the order of the file. What else a file holds is refused, or named in a note.
Sources: RFC 7946 (GeoJSON); OGC 12-007r2 (KML); GPX 1.1 schema; QGroundControl guide, Plan File Format; MAVLink guide, File
Formats and MAV_FRAME.
"""

import codecs
import io
import json
import math
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum
from itertools import chain, pairwise
from types import MappingProxyType
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

from flight_core.fields import short_repr
from flight_core.files import MAX_FILE_BYTES, limited
from flight_core.parameters import ParameterError, require

A_ROUTE = "a route file"


class Above(Enum):
    """The zero of an altitude."""

    AS_POSE = 0  # as `pose` counts: the number stands
    SEA = 1
    HOME = 2
    GROUND = 3


class Place(NamedTuple):
    """A position of a file, not validated yet."""

    key: str  # "route[0]"
    latitude: Any  # deg
    longitude: Any  # deg
    altitude: Any  # m; None without an altitude
    speed: Any = None  # m/s
    above: Above = Above.AS_POSE
    altitude_text: str = ""  # what the file has in place of an altitude, for a sentence
    turns: Any = 0.0  # round the place, 1
    wait: Any = 0.0  # round the place, s
    climbs: bool = False  # whether the altitude is reached round the place, and not on the way to the place


class Home(NamedTuple):
    """The home of a mission."""

    latitude: float  # deg
    longitude: float  # deg
    altitude: float | None  # m above the sea


class Places(NamedTuple):
    """The route of a file."""

    places: list[Place]
    notes: tuple[str, ...] = ()  # what is not flown
    home: Home | None = None


class _Geometry(NamedTuple):
    kind: str  # by the name in the format
    places: list[Place]
    name: str = ""  # by the user


def read(content: bytes, key: str, suffix: str, line: str | None = None) -> Places:
    """The route in the content of a file; `key` names the file in errors. Raises ParameterError.

    `line`: the number from 1 on, or the name, of the line that is flown of a file with several.
    """
    route = FORMATS[suffix](content, key, line)
    require(bool(route.places), key, "; ".join(["no position", *route.notes]), "a route")
    named = [place._replace(key=f"route[{k}]") for k, place in enumerate(route.places)]
    return route._replace(places=named)


def _one_route(key: str, geometries: Sequence[_Geometry], others: Sequence[str] = (), line: str | None = None) -> Places:
    """The only line, or that of `line`; the points where there is no line. Raises ParameterError that names what is there."""
    joined_lines = _joined([geometry for geometry in geometries if geometry.kind not in POINTS])
    lines = [geometry for geometry in joined_lines if geometry.places]
    points = [geometry for geometry in geometries if geometry.kind in POINTS]
    ignored = _counted([point.kind for point in points])
    if (lines and others) or (lines and line is None and len(lines) > 1):
        kinds = _counted([*(geometry.kind for geometry in lines), *others])
        raise ParameterError(f"{key}: found {kinds}, expected one, or {'Points alone' if others else _choice(lines)}")
    if line is not None:
        chosen = [geometry for k, geometry in enumerate(lines, start=1) if line in (f"{k}", geometry.name)]
        mismatch = f"{short_repr(line)}, which names {len(chosen)} lines"
        require(len(chosen) == 1, "--line", mismatch, _choice(lines) if lines else "a file with several lines")
        if len(lines) > 1:
            ignored = " and ".join([f"{len(lines) - 1} further lines", *[ignored] * bool(points)])
        lines = chosen
    if lines:
        return Places(lines[0].places, (f"{ignored} beside the {lines[0].kind}: no part of the route",) if ignored else ())
    has = f", but {_counted(others)}" if others else ""
    require(bool(points) and not others, key, f"no LineString and no Point{has}", "a route")
    mixture = f"{_counted([geometry.kind for geometry in joined_lines])} without a position, and {ignored}"
    require(not joined_lines, key, mixture, "a line, or Points alone")
    return Places([*chain.from_iterable(point.places for point in points)])


def _choice(lines: Sequence[_Geometry]) -> str:
    """What `--line` may name: "--line 1 (north), 2 or 3 (south)"."""
    names = [f"{k} ({geometry.name})" if geometry.name else f"{k}" for k, geometry in enumerate(lines[:SHOWN], start=1)]
    return f"--line {', '.join(names)}{f' to {len(lines)}' if len(lines) > SHOWN else ''}"


SHOWN = 5
"""Lines of a file that a refusal names."""

POINTS = ("Point", "MultiPoint", "wpt")
GPX = ("rte", "trk", "wpt")  # names of elements, without a plural


def _counted(kinds: Sequence[str]) -> str:
    """Kinds with their numbers: "2 LineStrings and 1 Polygon"."""
    counts = []
    for kind, count in Counter(kinds).items():
        noun, *suffix = kind.split(" ", 1)
        counts.append(" ".join([f"{count} {noun}{'s' * (count > 1 and noun not in GPX)}", *suffix]))
    return " and ".join(counts)


def _joined(lines: Sequence[_Geometry]) -> list[_Geometry]:
    """The lines, with parts that were cut at the antimeridian as one line (RFC 7946, section 3.1.9)."""
    joined: list[_Geometry] = []
    for line in lines:
        cut = bool(joined and joined[-1].places and line.places)
        end, begin = (joined[-1].places[-1], line.places[0]) if cut else (None, None)
        if end is not None and begin is not None and _meets(end, begin):
            joined[-1] = joined[-1]._replace(places=[*joined[-1].places[:-1], *line.places[1:]])
        else:
            joined.append(line)
    return joined


def _meets(end: Place, begin: Place) -> bool:
    """Whether both are one position on the antimeridian."""
    try:
        return bool(abs(end.longitude) == 180.0 and (end.longitude, end.latitude) == (-begin.longitude, begin.latitude))
    except TypeError:
        return False


# GeoJSON


def _parsed_json(content: bytes, key: str) -> Any:
    try:
        return json.loads(content.removeprefix(b"\xef\xbb\xbf"), object_pairs_hook=_members, parse_int=_whole)
    except (ValueError, RecursionError) as error:
        raise ParameterError(f"{key}: not valid JSON ({error}), expected {A_ROUTE}") from None


def _whole(digits: str) -> int | float:
    """A whole number; one of more digits than a float holds is a float, infinite beyond its range."""
    return int(digits) if len(digits) < 16 else float(digits)


def _members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        twice = next(name for name, count in counts.items() if count > 1)
        raise ValueError(f"the member {short_repr(twice)} twice")
    return members


def _read_json(content: bytes, key: str, line: str | None = None) -> Places:
    tree = _parsed_json(content, key)
    if _member(tree, "fileType") == "Plan":
        return _read_plan_tree(tree, key, line)
    _require_wgs84(tree, key)
    geometries: list[_Geometry] = []
    others: list[str] = []
    for node, properties in _nodes(tree):
        speed = _member(properties, "V")
        name = _member(properties, "name")
        kind = _member(node, "type")
        coordinates = _member(node, "coordinates")
        if isinstance(kind, str) and kind in GEOJSON:
            parts = GEOJSON[kind](coordinates if isinstance(coordinates, list) else [])
            part_kind = kind if len(parts) == 1 else PARTS.get(kind, kind)
            named = name if isinstance(name, str) else ""
            for part in parts:
                places = [_lon_lat(position, speed) for position in part]
                geometries.append(_Geometry(part_kind, places, named))
        elif node is not None:
            others.append(f"geometry of the type {short_repr(kind)}")
    return _one_route(key, geometries, others, line)


def read_lines(content: bytes, key: str) -> list[list[Place]]:
    """The lines, rings and points of a GeoJSON, in the order of the file. Raises ParameterError as `read`."""
    tree = _parsed_json(content, key)
    _require_wgs84(tree, key)
    lines: list[list[Place]] = []
    for node, _ in _nodes(tree):
        kind = _member(node, "type")
        coordinates = _member(node, "coordinates")
        if node is None:
            continue
        known = isinstance(kind, str) and kind in GEOJSON
        require(known, key, f"a geometry of the type {short_repr(kind)}", f"one of {', '.join(GEOJSON)}")
        parts = GEOJSON[kind](coordinates if isinstance(coordinates, list) else [])
        if kind == "MultiPoint":
            parts = [[position] for position in chain.from_iterable(parts)]
        lines += [[*map(_lon_lat, part)] for part in parts]
    return lines


def _ring(rings: list[Any]) -> list[list[Any]]:
    """The outer ring of a Polygon, whose only line is a route; every ring of a Polygon with holes."""
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
"""By the type of a geometry: its lines, or its points."""

PARTS = {
    "MultiLineString": "line of a MultiLineString",
    "Polygon": "ring of a Polygon",
    "MultiPolygon": "ring of a MultiPolygon",
}
"""What one of several parts is called."""


def _nodes(tree: Any) -> Iterator[tuple[Any, Any]]:
    """The geometries with the properties of their Feature, in the order of the file; None for a Feature without geometry."""
    pending: list[tuple[Any, Any]] = [(tree, None)]
    while pending:
        node, properties = pending.pop()
        members = [_member(node, name) for name in ("features", "geometries")]
        inside = next((member for member in members if isinstance(member, list)), None)
        if inside is not None:
            pending += [(child, properties) for child in reversed(inside)]
        elif isinstance(node, Mapping) and "geometry" in node:
            pending.append((node["geometry"], _member(node, "properties")))
        else:
            yield node, properties


def _require_wgs84(tree: Any, key: str) -> None:
    """Refuse a member `crs` of another system: RFC 7946 has WGS84 alone, and GDAL wrote others before."""
    crs = _member(tree, "crs")
    name = str(_member(_member(crs, "properties"), "name") or "")
    known = crs is None or re.search(r"CRS84h?$|EPSG:+4326$|EPSG:+4979$|WGS ?84$", name, re.IGNORECASE)
    require(bool(known), key, f"the coordinate system {short_repr(name)}", "WGS84: ogr2ogr -t_srs EPSG:4326 converts it")


def _member(tree: Any, name: str) -> Any:
    """A member of a JSON object; None of anything else."""
    return tree.get(name) if isinstance(tree, Mapping) else None


def _lon_lat(position: Any, speed: Any = None, above: Above = Above.AS_POSE, altitude_text: str = "") -> Place:
    """A position of GeoJSON or KML: longitude, latitude and perhaps altitude."""
    fits = isinstance(position, list) and 2 <= len(position) <= 3
    require(fits, "route", short_repr(position), "longitude, latitude, altitude")
    longitude, latitude, *altitude = position
    return Place(
        "route", latitude, longitude, altitude[0] if altitude else None, speed, above, altitude_text or short_repr(position)
    )


# KML and GPX


class _NoDoctype(TreeBuilder):
    """Refuses a document type, the only place of entity declarations: no entity is ever expanded or fetched."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ParseError("a document type")


def _parsed_xml(content: bytes, key: str, kind: str) -> Element:
    parser = XMLParser(target=_NoDoctype())  # noqa: S314 - without a document type there is nothing to expand
    try:
        parser.feed(content)
        root: Element = parser.close()
    except (ParseError, ValueError, LookupError) as error:  # the last two: of an encoding
        raise ParameterError(f"{key}: found {error}, expected the XML of {kind}") from None
    return root


def _kind(element: Element) -> str:
    """The name of an element without the namespace."""
    return str(element.tag).rpartition("}")[2]


KML_LINES = ("LineString", "LinearRing", "Track")
KML_OTHERS = ("Model", "NetworkLink")  # geometry elsewhere
KML_VIEWS = ("Tour", "GroundOverlay", "PhotoOverlay", "ScreenOverlay")  # no geometry
DJI = "dji.com/wpmz"  # in the namespace of its missions, with heights and speeds beside KML's own
KML_MODES = {"absolute": Above.AS_POSE, "relativeToGround": Above.GROUND, "clampToGround": Above.GROUND}


def _read_kml(content: bytes, key: str, line: str | None = None) -> Places:
    root = _parsed_xml(content, key, "a KML file")
    elements = [*root.iter()]
    way_out = "a KML without it, a GeoJSON or a plan of QGroundControl: its heights and speeds are not read"
    require(not any(DJI in str(element.tag) for element in elements), key, "a mission of DJI (WPML)", way_out)
    kinds = [(_kind(element), element) for element in elements]
    has_line = any(kind in KML_LINES for kind, _ in kinds)
    polygons = _outer_elements(kinds, "Polygon")
    tracks = _outer_elements(kinds, "Track")
    marks = _outer_elements(kinds, "Placemark")
    others = [kind for kind, element in kinds if kind in KML_OTHERS and element not in tracks]  # whose Model is a sign
    geometries: list[_Geometry] = []
    for kind, element in kinds:
        if kind == "Point" and has_line:
            geometries.append(_Geometry(kind, []))  # a mark, at any altitude
        elif kind in (*KML_LINES, "Point"):  # the altitudeMode of a Polygon is that of its rings
            name = _text(marks.get(element), "name") or ""
            geometries.append(_Geometry(kind, _kml_places(key, kind, element, polygons.get(element)), name.strip()))
    if not geometries:
        others += [kind for kind, _ in kinds if kind in KML_VIEWS]
    return _one_route(key, geometries, others, line)


def _outer_elements(kinds: Sequence[tuple[str, Element]], outer: str) -> dict[Element, Element]:
    """The element of a kind round each element in it."""
    outers: dict[Element, Element] = {}
    for kind, element in kinds:
        if kind == outer:
            outers |= dict.fromkeys(element.iter(), element)
    return outers


def _text(parent: Element | None, kind: str) -> str | None:
    """The text of the first child of a kind; None without it."""
    return next((child.text for child in (() if parent is None else parent) if _kind(child) == kind), None)


def _kml_places(key: str, kind: str, element: Element, polygon: Element | None) -> list[Place]:
    children = chain(() if polygon is None else polygon, element)
    texts = {_kind(child): child.text or "" for child in children}
    mode = texts.get("altitudeMode", "clampToGround").strip()  # the default of KML
    mode_text = f"a {kind} with the altitudeMode {short_repr(mode)}"
    require(mode in KML_MODES, key, mode_text, "absolute, for the height of the ground is not known")
    if kind == "Track":
        tuples = [(child.text or "").split() for child in element if _kind(child) == "coord"]
    else:
        tuples = [text.split(",") for text in re.sub(r"\s*,\s*", ",", texts.get("coordinates", "")).split()]
    require(kind != "Point" or len(tuples) == 1, key, f"a Point with {len(tuples)} positions", "one")
    if mode == "clampToGround":  # which ignores the altitude
        tuples = [[*position[:2], "0"] for position in tuples]
    return [_lon_lat(list(map(_number_of, position)), None, KML_MODES[mode], mode_text) for position in tuples]


def _number_of(text: str | None) -> float | str | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return text


def _read_kmz(content: bytes, key: str, line: str | None = None) -> Places:
    """The KML file of a KMZ archive: doc.kml, or the only one, at the root where there is one (OGC 12-007r2, Annex C)."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            names = [name for name in archive.namelist() if name.lower().endswith(".kml")]
            names = [name for name in names if "/" not in name] or names
            chosen = "doc.kml" if "doc.kml" in names else names[0] if len(names) == 1 else ""
            method = archive.getinfo(chosen).compress_type if chosen else zipfile.ZIP_STORED
            require(
                method in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}, key, f"the compression {method}", "deflate, as in a KMZ"
            )
            inside = archive.open(chosen).read(MAX_FILE_BYTES + 1) if chosen else b""
    except ParameterError:
        raise
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError, ValueError) as error:
        raise ParameterError(f"{key}: cannot be unpacked ({error}), expected a KMZ archive") from None
    require(bool(chosen), key, f"{len(names)} .kml files and no doc.kml", "one")
    return _read_kml(limited(inside, f"{key}: {chosen}", A_ROUTE), key, line)


EARTH_RADIUS = 6371e3
"""m, mean radius R_1 of GRS80."""

LARGEST_GAP = 1000.0
"""m. Segments of a track that are nearer are one track: GPX begins a segment where the receiver lost its satellites."""


def _read_gpx(content: bytes, key: str, line: str | None = None) -> Places:
    """A route (rte), without one a track (trk), without both the waypoints (wpt); with `line` one of all routes and tracks."""
    root = _parsed_xml(content, key, "a GPX file")
    marks = _gpx_places(root, "wpt")
    routes = [(element, _gpx_segments(element, "rte")) for element in root.iter() if _kind(element) == "rte"]
    tracks = [(element, _gpx_segments(element, "trk")) for element in root.iter() if _kind(element) == "trk"]
    flown = routes + tracks if line is not None or not any(segments for _, segments in routes) else routes
    lines = [
        _Geometry(_kind(element), [*chain(*segments)], (_text(element, "name") or "").strip()) for element, segments in flown
    ]
    require(bool(lines or marks), key, f"no rte, no trk and no wpt in {_kind(root)}", "a route in gpx")
    route = _one_route(key, [*lines, *(_Geometry("wpt", [place]) for place in marks)], (), line)
    notes = [*route.notes]
    if flown == routes and any(segments for _, segments in tracks):
        notes.append(f"{len(tracks)} trk beside the rte: no part of the route")
    if shapes := sum(_kind(element) == "rpt" for element in root.iter()):
        notes.append(f"{shapes} rpt of extensions: no part of the route")
    segments = next((segments for _, segments in flown if [*chain(*segments)] == route.places), [])
    gaps = [_gap(before[-1], after[0]) for before, after in pairwise(segments)]
    widest = max(gaps, default=0.0)
    fits = widest <= LARGEST_GAP
    require(fits, key, f"a gap of {widest / 1e3:.1f} km between two trkseg", f"at most {LARGEST_GAP / 1e3:g} km within a track")
    if gaps:
        notes.append(f"{len(segments)} trkseg are one track: a leg joins them over each gap, up to {widest:.0f} m")
    return route._replace(notes=tuple(notes))


def _gpx_segments(line: Element, kind: str) -> list[list[Place]]:
    """The segments of a track, or the only one of a route, that have a position."""
    parts = [line] if kind == "rte" else [element for element in line if _kind(element) == "trkseg"]
    return [places for element in parts if (places := _gpx_places(element, f"{kind}pt"))]


def _gap(end: Place, begin: Place) -> float:
    """Distance of two near positions on a sphere, m; 0 where one of them is no position, which is refused later."""
    values = (end.latitude, end.longitude, begin.latitude, begin.longitude)
    if not all(isinstance(value, float) and math.isfinite(value) for value in values):
        return 0.0
    north = begin.latitude - end.latitude
    east = math.remainder(begin.longitude - end.longitude, 360.0) * math.cos(math.radians(end.latitude))
    return EARTH_RADIUS * math.radians(math.hypot(north, east))


def _gpx_places(parent: Element, kind: str) -> list[Place]:
    places = []
    for element in (child for child in parent if _kind(child) == kind):
        latitude, longitude = (_number_of(element.get(name)) for name in ("lat", "lon"))
        height = _text(element, "ele")
        places.append(Place("route", latitude, longitude, _number_of(height), altitude_text=f"a {kind} without ele"))
    return places


# Missions of MAVLink

FRAMES = {0: Above.SEA, 5: Above.SEA, 3: Above.HOME, 6: Above.HOME}  # MAV_FRAME
TERRAIN = (10, 11)
# MAV_CMD, and SPEED_TYPE
WAYPOINT = 16
LAND = 21
SPLINE = 82
JUMP = 177
CHANGE_SPEED = 178
AIRSPEED = 0
UNLIMITED, TURNS, TIME, TO_ALTITUDE = LOITERS = 17, 18, 19, 31  # NAV_LOITER_...
COMMANDS = {17: "NAV_LOITER_UNLIM", 18: "NAV_LOITER_TURNS", 19: "NAV_LOITER_TIME", 31: "NAV_LOITER_TO_ALT"}
COMMANDS |= {20: "NAV_RETURN_TO_LAUNCH", 21: "NAV_LAND", 22: "NAV_TAKEOFF", 84: "NAV_VTOL_TAKEOFF", 85: "NAV_VTOL_LAND"}
COMMANDS |= {16: "NAV_WAYPOINT", 82: "NAV_SPLINE_WAYPOINT", 93: "NAV_DELAY", 178: "DO_CHANGE_SPEED"}
COMMANDS |= {177: "DO_JUMP", 189: "DO_LAND_START", 206: "DO_SET_CAM_TRIGG_DIST", 201: "DO_SET_ROI", 183: "DO_SET_SERVO"}

COMMANDS |= {34: "DO_ORBIT", 35: "DO_FIGURE_EIGHT", 36: "NAV_ARC_WAYPOINT", 94: "NAV_PAYLOAD_PLACE"}
COMMANDS |= {5000: "NAV_FENCE_RETURN_POINT", 5001: "NAV_FENCE_POLYGON_VERTEX_INCLUSION", 5100: "NAV_RALLY_POINT"}
COMMANDS |= {5002: "NAV_FENCE_POLYGON_VERTEX_EXCLUSION", 5003: "NAV_FENCE_CIRCLE_INCLUSION", 5004: "NAV_FENCE_CIRCLE_EXCLUSION"}
LAST = (UNLIMITED, 20, LAND, 85)  # after which an autopilot flies no item: a loiter without end, the return, the landings
OTHER_WAYS = (34, 35, 36, 94)  # to a place, no line and no loiter


class _Item(NamedTuple):
    """An item of a mission."""

    name: str  # "NAV_LAND (item 5)"
    frame: int
    command: int
    params: Sequence[Any]  # seven
    number: Any  # by which a DO_JUMP names the item
    goes_on: bool = True  # autocontinue: without it an autopilot waits for the pilot after the item


def _named(command: int, number: int) -> str:
    return f"{COMMANDS.get(command, f'MAV_CMD {command}')} (item {number})"


MOST_ITEMS = 20_000


def _in_order(key: str, items: Sequence[_Item]) -> list[int]:
    """The positions of the items in the order of flight, with the jumps that are followed, up to an item of LAST.

    A DO_JUMP leads to an item as often as it says, with a negative number for good; a jump back for good ends the order. Raises
    ParameterError for a jump to no item, for a loop inside of a loop, which PX4 begins again and ArduPilot does not, and for
    more than MOST_ITEMS.
    """
    places = {items[k].number: k for k in reversed(range(len(items)))}
    repetitions: dict[int, float] = {}  # repetitions of a jump
    order: list[int] = []
    k = steps = 0
    while k < len(items) and not (order and items[order[-1]].command in LAST):
        place = k
        name, _, command, params, *_ = items[place]
        k += 1
        steps += 1
        require(steps <= MOST_ITEMS, key, f"more than {MOST_ITEMS} items by the repetitions of {name}", "fewer")
        if command != JUMP:
            order.append(place)
            continue
        target = params[0]
        count = -0.5 if params[1] is None else float(params[1])
        if not count:
            continue
        require(
            target in places and count.is_integer(), key, f"{name} to {target}", "a jump to an item, a whole number of times"
        )
        if count < 0.0 and places[target] <= place:
            break
        remaining = repetitions.get(place, count)
        require(count < 0.0 or remaining >= 0.0, key, f"{name}, a loop inside of a loop", "loops one after the other")
        repetitions[place] = remaining - 1.0 if count > 0.0 else count
        order.append(place)
        k = places[target] if remaining else k
    return order


def _mission(key: str, items: Sequence[_Item], home: Home | None, notes: Sequence[str] = ()) -> Places:
    """The waypoints and loiters of a mission in the order of flight; the items that are not flown in notes."""
    places: list[Place] = []
    flown: set[int] = set()
    circles: list[str] = []  # of a radius, negative to the left
    speed: Any = None
    for k in _in_order(key, items):
        item = items[k]
        require(item.command not in OTHER_WAYS, key, item.name, "waypoints and loiters")
        before = places[-1] if places and item.command in LOITERS else None
        if item.command in (WAYPOINT, SPLINE, *LOITERS) and (any(item.params[4:6]) or before):
            loiter = {TURNS: {"turns": item.params[0]}, TIME: {"wait": item.params[0]}, TO_ALTITUDE: {"climbs": True}}
            places.append(_mission_place(key, item, speed, before)._replace(**loiter.get(item.command, {})))
            if item.command in LOITERS and (radius := item.params[1 if item.command == TO_ALTITUDE else 2]):
                circles.append(f"{radius:g} m of {item.name}")
        elif item.command == CHANGE_SPEED and item.params[0] == AIRSPEED and (item.params[1] or 0) > 0:
            speed = item.params[1]
        elif item.command != JUMP:
            continue
        flown.add(k)
    skipped = [item.name for k, item in enumerate(items) if k not in flown]
    sentences = [f"not flown: {', '.join(dict.fromkeys(skipped))}"] * bool(skipped)
    waits = [item.name for k, item in enumerate(items) if k in flown and not item.goes_on]
    sentences += [f"flown on without autocontinue: {', '.join(dict.fromkeys(waits))}"] * bool(waits)
    circle_note = "circles are clockwise, of the radius of the route"
    sentences += [f"{circle_note}, in place of {', '.join(dict.fromkeys(circles))}"] * bool(circles)
    return Places(places, (*notes, *sentences), home)


def _mission_place(key: str, item: _Item, speed: Any, before: Place | None) -> Place:
    """The place of an item; of a loiter without a latitude and a longitude the place before."""
    latitude, longitude, altitude = item.params[4:7]
    if not (latitude or longitude) and before is not None:
        latitude = before.latitude
        longitude = before.longitude
        if not altitude:
            return before._replace(turns=0.0, wait=0.0, climbs=False, speed=speed)
    frame_text = f"the frame {item.frame}{', above the ground' if item.frame in TERRAIN else ''}"
    expected = "0 or 3: above the sea or the home, for the height of the ground is not known"
    require(item.frame in FRAMES, f"{key}: {item.name}", frame_text, expected)
    return Place("route", latitude, longitude, altitude, speed, FRAMES[item.frame])


def _read_plan(content: bytes, key: str, line: str | None = None) -> Places:
    return _read_plan_tree(_parsed_json(content, key), key, line)


def _read_plan_tree(tree: Any, key: str, line: str | None) -> Places:
    require(line is None, "--line", f"a mission, {key}", "a file with several lines")
    mission = _member(tree, "mission")
    listed = _member(mission, "items")
    require(isinstance(listed, list), key, "no mission with items", "a plan of QGroundControl")
    items = []
    for number, entry in _plan_items(listed or (), key):
        kind = _member(entry, "complexItemType") or _member(entry, "type")
        jump = number if (jump_id := _member(entry, "doJumpId")) is None else jump_id
        require(isinstance(jump, int | float), f"{key}: item {number}", f"doJumpId: {short_repr(jump)}", "a number")
        if kind in LANDINGS:
            items.append(_Item(f"{kind} (item {number})", 0, LAND, [None] * 7, jump))
            continue
        expected = f"waypoints, {' or '.join(TRANSECTS)} with their items, {' or '.join(LANDINGS)}"
        require(kind == "SimpleItem", f"{key}: item {number}", f"a {short_repr(kind)}", expected)
        params = _member(entry, "params")
        frame = _member(entry, "frame")
        command = _member(entry, "command")
        numbers = isinstance(params, list) and all(value is None or isinstance(value, int | float) for value in params)
        fits = numbers and len(params) == 7 and isinstance(frame, int) and isinstance(command, int)
        require(fits, f"{key}: item {number}", short_repr(entry), "frame, command and seven params")
        goes_on = _flag(entry, "autoContinue", True, key)
        items.append(_Item(_named(command, number), frame, command, params, jump, goes_on))
    fence = _plan_fence(tree, key)
    notes = ["the fence and the rally points are no part of the route; --fence keeps them"] * bool(fence.zones or fence.rally)
    return _mission(key, items, _home(_member(mission, "plannedHomePosition")), notes)


TRANSECTS = ("survey", "CorridorScan")  # complexItemType, with the waypoints that QGroundControl made
LANDINGS = ("fwLandingPattern", "vtolLandingPattern")  # as NAV_LAND, not flown


def _plan_items(listed: Sequence[Any], key: str) -> Iterator[tuple[int, Any]]:
    """The items of a plan with their numbers from 1 on, those inside of a survey with the number of the survey."""
    for number, entry in enumerate(listed, start=1):
        if _member(entry, "complexItemType") in TRANSECTS:
            inside = _entries(_member(entry, "TransectStyleComplexItem"), "Items", key)
            require(bool(inside), f"{key}: item {number}", f"a {entry['complexItemType']} without items", "a saved plan")
            yield from ((number, item) for item in inside)
        else:
            yield number, entry


class Area(NamedTuple):
    """A zone of a fence in a file: the corners of a polygon, or the centre of a circle."""

    places: list[Place]
    radius: Any  # m; None of a polygon
    exclude: bool
    group: Any = None  # of a zone to stay in


class FencePlaces(NamedTuple):
    """The fence of a file."""

    zones: list[Area]
    rally: list[Place] = []  # noqa: RUF012 - never changed
    home: Home | None = None
    back: Place | None = None  # where a breach sends the aircraft


def read_fence(content: bytes, key: str, suffix: str) -> FencePlaces:
    """The zones and the rally points of a plan of QGroundControl, a QGC WPL 110 or a GeoJSON. Raises ParameterError."""
    if suffix in WPL_ENDINGS:
        fence = _wpl_fence(content, key)
    else:
        tree = _parsed_json(content, key)
        fence = _plan_fence(tree, key) if _member(tree, "fileType") == "Plan" else _json_fence(tree, key)
    require(bool(fence.zones), key, "no zone", "a polygon or a circle of a fence")
    return fence


def _plan_fence(tree: Any, key: str) -> FencePlaces:
    fence = _member(tree, "geoFence")
    zones = []
    for zone in _entries(fence, "polygons", key):
        corners = [_lat_lon(corner) for corner in _listed(_member(zone, "polygon"), key)]
        zones.append(_grouped(Area(corners, None, not _flag(zone, "inclusion", None, key))))
    for zone in _entries(fence, "circles", key):
        circle = _member(zone, "circle")
        inclusion = _flag(zone, "inclusion", None, key)
        zones.append(_grouped(Area([_lat_lon(_member(circle, "center"))], _member(circle, "radius"), not inclusion)))
    rally = [_lat_lon(point, Above.HOME) for point in _entries(_member(tree, "rallyPoints"), "points", key)]
    back = _member(fence, "breachReturn")
    home = _home(_member(_member(tree, "mission"), "plannedHomePosition"))
    return FencePlaces(zones, rally, home, None if back is None else _lat_lon(back, Above.HOME))


def _grouped(area: Area, group: Any = 0) -> Area:
    """A zone of an autopilot, in its group where the aircraft stays in; a plan has the group 0 alone.

    MAVLink, MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION and MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION, parameter 2, Inclusion Group:
    "Vehicle must be inside ALL inclusion zones in a single group, vehicle must be inside at least one group".
    """
    return area if area.exclude else area._replace(group=group)


def _json_fence(tree: Any, key: str) -> FencePlaces:
    """Polygons, whose holes are excluded, and Points with the property `radius`.

    The property `exclude` excludes a zone. Zones with the same property `group` are a group; else each zone is one alone.
    """
    _require_wgs84(tree, key)
    zones: list[Area] = []
    for node, properties in _nodes(tree):
        if node is None:
            continue
        kind = _member(node, "type")
        require(kind in ("Polygon", "MultiPolygon", "Point"), key, f"a {short_repr(kind)}", "Polygons, or Points with a radius")
        coordinates = _listed(_member(node, "coordinates"), key)
        exclude = _flag(properties, "exclude", False, key)
        radius = _member(properties, "radius")
        group = _member(properties, "group")
        if kind == "Point":
            require(radius is not None, key, "a Point without the property radius", "the radius of a circle, m")
            zones.append(Area([_lon_lat(coordinates)], radius, exclude, group))
            continue
        for rings in [coordinates] if kind == "Polygon" else coordinates:
            for k, ring in enumerate(_listed(rings, key)):
                corners = [_lon_lat(position) for position in _listed(ring, key)]
                zones.append(Area(corners, None, True) if k > 0 else Area(corners, None, exclude, group))
    return FencePlaces(zones)


def _wpl_fence(content: bytes, key: str) -> FencePlaces:
    """The polygons, circles, return point and rally points of MAVLink: MAV_CMD_NAV_FENCE_... and MAV_CMD_NAV_RALLY_POINT."""
    items, home = _wpl_items(content, key)
    zones: list[Area] = []
    rally: list[Place] = []
    missing = 0
    back = None
    for item in items:
        latitude, longitude, altitude = item.params[4:7]
        place = Place("fence", latitude, longitude, altitude)
        exclude = item.command in {FENCE_OUT, CIRCLE_OUT}
        if missing or item.command in {FENCE_IN, FENCE_OUT}:
            count = item.params[0]
            fits = item.command in {FENCE_IN, FENCE_OUT} and count in range(3, MOST_CORNERS + 1)
            fits = fits and (not missing or exclude == zones[-1].exclude)
            expected = "corners of a polygon, each with their number, 3 or more"
            require(fits, f"{key}: {item.name}", f"{count:g} corners", expected)
            if not missing:
                zones.append(_grouped(Area([], None, exclude), _group(item, key)))
                missing = int(count)
            same = exclude or _group(item, key) == zones[-1].group
            require(same, f"{key}: {item.name}", f"group {item.params[1]:g}", f"{zones[-1].group}, as of the corners before")
            zones[-1].places.append(place)
            missing -= 1
        elif item.command in {CIRCLE_IN, CIRCLE_OUT}:
            zones.append(_grouped(Area([place], item.params[0], exclude), _group(item, key)))
        elif item.command == RALLY:
            rally.append(place._replace(above=FRAMES.get(item.frame, Above.GROUND)))
        elif item.command == RETURN:
            back = place._replace(altitude=None)
    if missing:
        corners = len(zones[-1].places)
        raise ParameterError(f"{key}: found {corners} of the {corners + missing} corners of a polygon, expected all")
    return FencePlaces(zones, rally, home, back)


def _group(item: _Item, key: str) -> int:
    """The inclusion group of an item; 0 of a zone to keep out of, which has none."""
    if item.command in {FENCE_OUT, CIRCLE_OUT}:
        return 0
    group = float(item.params[1])
    fits = group >= 0.0 and group.is_integer()
    require(fits, f"{key}: {item.name}", f"group {group:g}", "a whole number, 0 or more, in the second parameter")
    return int(group)


MOST_CORNERS = 10_000
# MAV_CMD
RETURN = 5000
FENCE_IN = 5001
FENCE_OUT = 5002
CIRCLE_IN = 5003
CIRCLE_OUT = 5004
RALLY = 5100


def _entries(tree: Any, name: str, key: str) -> list[Any]:
    """A member of a JSON object that is a list; empty where absent."""
    value = _member(tree, name)
    require(value is None or isinstance(value, list), key, f"{name}: {short_repr(value)}", "a list")
    return list(value or ())


def _flag(tree: Any, name: str, absent: bool | None, key: str) -> bool:
    """A member of a JSON object that is true or false, also as 1 or 0; `absent`: its value where the object lacks it."""
    value = absent if _member(tree, name) is None else tree[name]
    require(value in (True, False), key, f"{name}: {short_repr(value)}", "true or false")
    return bool(value)


def _listed(value: Any, key: str) -> list[Any]:
    require(isinstance(value, list) and bool(value), key, short_repr(value), "a list of positions")
    return list(value)


def _lat_lon(position: Any, above: Above = Above.AS_POSE) -> Place:
    """A position of a plan: latitude, longitude and perhaps altitude."""
    fits = isinstance(position, list) and 2 <= len(position) <= 3
    require(fits, "fence", short_repr(position), "latitude and longitude")
    latitude, longitude, *altitude = position
    return Place("fence", latitude, longitude, altitude[0] if altitude else None, above=above)


def _home(position: Any) -> Home | None:
    """The home in latitude, longitude and perhaps altitude; None for anything else."""
    fits = isinstance(position, list) and 2 <= len(position) <= 3
    if not fits or not all(isinstance(value, int | float) for value in position):
        return None
    return Home(position[0], position[1], position[2] if len(position) == 3 else None)


WPL = "QGC WPL"
WPL_COLUMNS = 12


def _read_wpl(content: bytes, key: str, line: str | None = None) -> Places:
    require(line is None, "--line", f"a mission, {key}", "a file with several lines")
    items, home = _wpl_items(content, key)
    note = "" if home is None else f"item 0 is the home, at {home.latitude:.7g},{home.longitude:.7g}, and no waypoint"
    return _mission(key, items, home, [note] * bool(note))


def _wpl_items(content: bytes, key: str) -> tuple[list[_Item], Home | None]:
    encoding = "utf-16" if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    lines = content.decode(encoding, errors="replace").splitlines()
    head = lines[0].strip() if lines else ""
    require(head.startswith(WPL), key, short_repr(head), "QGC WPL 110 in the first line")
    items = list[_Item]()
    home = None
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        numbers = [_number_of(word) for word in words]
        fits = len(words) == WPL_COLUMNS and all(isinstance(value, float) for value in numbers)
        fits = fits and all(isinstance(value, float) and value.is_integer() for value in numbers[:4])
        require(fits, f"{key}: line {number}", short_repr(line.strip()), f"{WPL_COLUMNS} numbers, the first four whole")
        index, _, frame, command, *params = (value for value in numbers[:-1] if isinstance(value, float))
        if index == 0 and frame == 0 and command == WAYPOINT and not items:  # ArduPilot's item 0 is the home
            home = Home(*params[4:7]) if params[4] or params[5] else None
            continue
        items.append(_Item(_named(int(command), int(index)), int(frame), int(command), params, index, numbers[-1] != 0.0))
    return items, home


WPL_ENDINGS = (".waypoints", ".mission", ".txt")
FENCES = (".plan", ".geojson", ".json", *WPL_ENDINGS)
"""Endings of files with a fence."""


FORMATS: Mapping[str, Callable[[bytes, str, str | None], Places]] = MappingProxyType(
    {
        ".geojson": _read_json,
        ".json": _read_json,
        ".kml": _read_kml,
        ".kmz": _read_kmz,
        ".gpx": _read_gpx,
        ".plan": _read_plan,
        **dict.fromkeys(WPL_ENDINGS, _read_wpl),
    }
)
"""Readers by the ending of a file."""
