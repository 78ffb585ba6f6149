# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read missions and fences from files: QGroundControl plans, QGC WPL 110, and GeoJSON fences.

Sources: QGroundControl guide, Plan File Format; MAVLink guide, File Formats.
"""

import codecs
import re
from collections.abc import Iterator, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from flight_core.fields import short_repr
from flight_core.parameters import ParameterError, require
from flight_guidance.routes.mission import FRAMES, LAND, WAYPOINT, Item, mission_route, named
from flight_guidance.routes.route_json import (
    as_list,
    entries,
    flag,
    member,
    nodes,
    parsed_json,
    require_wgs84,
)
from flight_guidance.routes.route_places import (
    Above,
    HomePlace,
    Place,
    Places,
    is_position,
    lon_lat,
    number_of,
)

FENCE_NOTE = "the fence and the rally points of the plan are no part of the route"


def read_plan(content: bytes, key: str, line: str | None = None) -> Places:
    """Read the mission in the content of a QGroundControl plan."""
    return read_plan_tree(parsed_json(content, key), key, line)


def read_plan_tree(tree: Any, key: str, line: str | None) -> Places:
    """Read the mission of a QGroundControl plan that is already parsed."""
    require(line is None, "line", f"a mission, {key}", "a file with several lines")
    mission = member(tree, "mission")
    rows = member(mission, "items")
    require(isinstance(rows, list), key, "no mission with items", "a plan of QGroundControl")
    items = [
        _plan_item(entry, number, f"{key}: item {number}")
        for number, entry in _plan_items(rows or (), key)
    ]
    fence = plan_fence(tree, key)
    notes = [FENCE_NOTE] * bool(fence.zones or fence.rally)
    notes += [f"not read: {FIRST_FENCE}"] * has_first_fence(tree)
    return mission_route(key, items, home_of(member(mission, "plannedHomePosition")), notes)


def _plan_item(entry: Any, number: int, key: str) -> Item:
    kind = member(entry, "complexItemType") or member(entry, "type")
    jump = number if (jump_id := member(entry, "doJumpId")) is None else jump_id
    require(isinstance(jump, int | float), key, f"doJumpId: {short_repr(jump)}", "a number")
    if kind in LANDINGS:
        return Item(
            name=f"{kind} (item {number})", frame=0, command=LAND, params=[None] * 7, number=jump
        )
    expected = f"waypoints, {' or '.join(TRANSECTS)} with their items, {' or '.join(LANDINGS)}"
    require(kind == "SimpleItem", key, f"a {short_repr(kind)}", expected)
    params = member(entry, "params")
    frame = member(entry, "frame")
    command = member(entry, "command")
    numbers = isinstance(params, list) and all(
        value is None or isinstance(value, int | float) for value in params
    )
    fits = numbers and len(params) == 7 and isinstance(frame, int) and isinstance(command, int)
    require(fits, key, short_repr(entry), "frame, command and seven params")
    _require_one_place(entry, params, frame, key)
    return Item(
        name=named(command, number),
        frame=frame,
        command=command,
        params=params,
        number=jump,
        goes_on=flag(entry, "autoContinue", True, key),
    )


SAME_ANGLE = 1e-6  # deg, about 0.1 m, because programs write six digits or more
SAME_ALTITUDE = 0.01  # m
FRAMES_OF_MODES = MappingProxyType({2: (0, 5), 3: (0, 5), 4: (10, 11)})
"""Permitted frames by AltitudeMode of QGroundControl: 2 is above the sea, 3 above the sea by a
model of the terrain, 4 above the terrain. 0 and 1 are left out, because they had another meaning
before version 4."""


def _require_one_place(entry: Any, params: Sequence[Any], frame: int, key: str) -> None:
    """Check that an item of a mission gives its place only once, or always the same place.

    QGroundControl reads only the params. Other programs also write `coordinate`, or change only one
    of the two. Raises ParameterError if they differ.
    """
    latitude, longitude, altitude = params[4:7]
    coordinate = member(entry, "coordinate")
    if is_position(coordinate) and None not in (latitude, longitude):
        near = [SAME_ANGLE, SAME_ANGLE, SAME_ALTITUDE]
        same = all(
            stated is None or value is None or abs(stated - value) <= most
            for stated, value, most in zip(coordinate, params[4:7], near, strict=False)
        )
        found = f"coordinate {short_repr(coordinate)} beside {short_repr(params[4:7])} in params"
        require(same, key, found, "the same place in both")
    mode = member(entry, "AltitudeMode")
    fits = frame in FRAMES_OF_MODES.get(mode, (frame,)) if isinstance(mode, int) else True
    require(fits, key, f"AltitudeMode {mode} beside frame {frame}", "the same reference in both")
    stated = [
        value
        for name in ("Altitude", "AMSLAltAboveTerrain")
        if isinstance(value := member(entry, name), int | float)
    ]
    same = (
        not stated
        or altitude is None
        or any(abs(value - altitude) <= SAME_ALTITUDE for value in stated)
    )
    found = f"Altitude {' and '.join(f'{value:g}' for value in stated)} beside {altitude} in params"
    require(same, key, found, "the same altitude in both")


FIRST_FENCE = (
    "the fence of version 1 (polygon, breachReturn): save the plan again with "
    "QGroundControl, whose fence is of version 2"
)


def has_first_fence(tree: Any) -> bool:
    """Return whether the fence of a plan has version 1: a polygon, but no list of polygons."""
    fence = member(tree, "geoFence")
    return (
        any(member(place, "polygon") is not None for place in (fence, tree))
        and member(fence, "polygons") is None
    )


# Values of complexItemType of items that contain the waypoints made by QGroundControl.
TRANSECTS = ("survey", "CorridorScan")
LANDINGS = ("fwLandingPattern", "vtolLandingPattern")  # they are not flown, like NAV_LAND


def _plan_items(rows: Sequence[Any], key: str) -> Iterator[tuple[int, Any]]:
    """Yield the items of a plan with their numbers from 1 on.

    Items inside a survey have the number of the survey.
    """
    for number, entry in enumerate(rows, start=1):
        if member(entry, "complexItemType") in TRANSECTS:
            inside = entries(member(entry, "TransectStyleComplexItem"), "Items", key)
            require(
                bool(inside),
                f"{key}: item {number}",
                f"a {entry['complexItemType']} without items",
                "a saved plan",
            )
            yield from ((number, item) for item in inside)
        else:
            yield number, entry


WPL = "QGC WPL"
WPL_COLUMNS = 12
COMMA = re.compile(r"-?\d+,\d+")  # a number with a decimal comma, as some languages write it


def read_wpl(content: bytes, key: str, line: str | None = None) -> Places:
    """Read the mission of a QGC WPL 110."""
    require(line is None, "line", f"a mission, {key}", "a file with several lines")
    items, home = wpl_items(content, key)
    if home is None:
        note = ""
    else:
        note = f"item 0 is the home, at {home.latitude:.7g},{home.longitude:.7g}, and no waypoint"
    return mission_route(key, items, home, [note] * bool(note))


def wpl_items(content: bytes, key: str) -> tuple[list[Item], HomePlace | None]:
    """Read the items of a QGC WPL 110, and the home from its item 0."""
    encoding = (
        "utf-16" if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    )
    lines = content.decode(encoding, errors="replace").splitlines()
    head = lines[0].strip() if lines else ""
    require(head.startswith(WPL), key, short_repr(head), "QGC WPL 110 in the first line")
    items = list[Item]()
    home = None
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        numbers = [number_of(word) for word in words]
        fits = len(words) == WPL_COLUMNS and all(isinstance(value, float) for value in numbers)
        fits = fits and all(
            isinstance(value, float) and value.is_integer() for value in numbers[:4]
        )
        with_comma = (
            f", with a point and no comma: {commas[0]}" if (commas := COMMA.findall(line)) else ""
        )
        expected = f"{WPL_COLUMNS} numbers, the first four whole{with_comma}"
        require(fits, f"{key}: line {number}", short_repr(line.strip()), expected)
        index, _, frame, command, *params = (
            value for value in numbers[:-1] if isinstance(value, float)
        )
        # in files for ArduPilot, item 0 is the home
        if index == 0 and frame == 0 and command == WAYPOINT and not items:
            home = (
                HomePlace(latitude=params[4], longitude=params[5], altitude=params[6])
                if params[4] or params[5]
                else None
            )
            continue
        items.append(
            Item(
                name=named(int(command), int(index)),
                frame=int(frame),
                command=int(command),
                params=params,
                number=index,
                goes_on=numbers[-1] != 0.0,
            )
        )
    return items, home


class Area(NamedTuple):
    """A zone of a fence as a file gives it: the corners of a polygon, or the centre of a circle."""

    places: list[Place]
    radius: Any  # m; None for a polygon
    exclude: bool
    group: Any = None  # group of a zone to stay in


class FencePlaces(NamedTuple):
    """The zones, rally points and return point that a fence file contains."""

    zones: list[Area]
    rally: list[Place] = []  # noqa: RUF012 - never changed
    home: HomePlace | None = None
    back: Place | None = None  # the place to which a breach sends the aircraft


def plan_fence(tree: Any, key: str) -> FencePlaces:
    """Read the fence of a plan of QGroundControl, version 2."""
    fence = member(tree, "geoFence")
    zones = []
    for zone in entries(fence, "polygons", key):
        corners = [lat_lon(corner) for corner in as_list(member(zone, "polygon"), key)]
        zones.append(_grouped(Area(corners, None, not flag(zone, "inclusion", None, key))))
    for zone in entries(fence, "circles", key):
        circle = member(zone, "circle")
        inclusion = flag(zone, "inclusion", None, key)
        zones.append(
            _grouped(
                Area([lat_lon(member(circle, "center"))], member(circle, "radius"), not inclusion)
            )
        )
    rally = [
        lat_lon(point, Above.HOME) for point in entries(member(tree, "rallyPoints"), "points", key)
    ]
    back = member(fence, "breachReturn")
    home = home_of(member(member(tree, "mission"), "plannedHomePosition"))
    return FencePlaces(zones, rally, home, None if back is None else lat_lon(back, Above.HOME))


def _grouped(area: Area, group: Any = 0) -> Area:
    """Put a zone into a group of zones, unless the aircraft must keep out of the zone.

    In a plan every zone is in group 0. Source: MAVLink, MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
    and MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION, parameter 2, Inclusion Group: "Vehicle must be inside
    ALL inclusion zones in a single group, vehicle must be inside at least one group".
    """
    return area if area.exclude else area._replace(group=group)


def json_fence(tree: Any, key: str) -> FencePlaces:
    """Read a fence of polygons and circles; circles are Points with the property `radius`.

    The aircraft must keep out of holes of a polygon, and of zones with the property `exclude`.
    Zones with the same property `group` form a group. A zone without this property is a group by
    itself.
    """
    require_wgs84(tree, key)
    zones: list[Area] = []
    for node, properties in nodes(tree):
        if node is None:
            continue
        kind = member(node, "type")
        require(
            kind in ("Polygon", "MultiPolygon", "Point"),
            key,
            f"a {short_repr(kind)}",
            "Polygons, or Points with a radius",
        )
        coordinates = as_list(member(node, "coordinates"), key)
        exclude = flag(properties, "exclude", False, key)
        radius = member(properties, "radius")
        group = member(properties, "group")
        if kind == "Point":
            require(
                radius is not None,
                key,
                "a Point without the property radius",
                "the radius of a circle, m",
            )
            zones.append(Area([lon_lat(coordinates)], radius, exclude, group))
            continue
        for rings in [coordinates] if kind == "Polygon" else coordinates:
            for k, ring in enumerate(as_list(rings, key)):
                corners = [lon_lat(position) for position in as_list(ring, key)]
                zones.append(
                    Area(corners, None, True) if k > 0 else Area(corners, None, exclude, group)
                )
    return FencePlaces(zones)


def wpl_fence(content: bytes, key: str) -> FencePlaces:
    """Read the polygons, circles, return point and rally points in a QGC WPL 110 file.

    They are the items with the commands MAV_CMD_NAV_FENCE_... and MAV_CMD_NAV_RALLY_POINT.
    """
    items, home = wpl_items(content, key)
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
            is_same_group = exclude or _group(item, key) == zones[-1].group
            require(
                is_same_group,
                f"{key}: {item.name}",
                f"group {item.params[1]:g}",
                f"{zones[-1].group}, as of the corners before",
            )
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
        raise ParameterError(
            f"{key}: found {corners} of the {corners + missing} corners of a polygon, expected all"
        )
    return FencePlaces(zones, rally, home, back)


def _group(item: Item, key: str) -> int:
    """Return the inclusion group of an item, or 0 for a zone to keep out of, which has no group."""
    if item.command in {FENCE_OUT, CIRCLE_OUT}:
        return 0
    group = float(item.params[1])
    fits = group >= 0.0 and group.is_integer()
    require(
        fits,
        f"{key}: {item.name}",
        f"group {group:g}",
        "a whole number, 0 or more, in the second parameter",
    )
    return int(group)


def lat_lon(position: Any, above: Above = Above.AS_POSE) -> Place:
    """Read a position in a plan: a list of latitude, longitude and perhaps altitude.

    `above` says above what the altitude is measured.
    """
    require(is_position(position), "fence", short_repr(position), "latitude and longitude")
    latitude, longitude, *altitude = position
    return Place("fence", latitude, longitude, altitude[0] if altitude else None, above=above)


def home_of(position: Any) -> HomePlace | None:
    """Read the home from latitude, longitude and perhaps altitude.

    Returns None for anything else.
    """
    if not is_position(position) or not all(isinstance(value, int | float) for value in position):
        return None
    return HomePlace(
        latitude=position[0],
        longitude=position[1],
        altitude=position[2] if len(position) == 3 else None,
    )


MOST_CORNERS = 10_000
# MAV_CMD
RETURN = 5000
FENCE_IN = 5001
FENCE_OUT = 5002
CIRCLE_IN = 5003
CIRCLE_OUT = 5004
RALLY = 5100
