# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test route files: WGS84 against pymap3d, and what each format may and may not contain."""

import io
import json
import math
import sys
import zipfile
from pathlib import Path
from typing import Any

import pymap3d
import pytest
from pymap3d.vincenty import vdist
from pytest import approx
from tests.conftest import refusing

from flight_analysis.closed_loop.scenario_library import find_scenario, with_route
from flight_guidance.routes import route_formats
from flight_guidance.routes.route_file import (
    MAX_DISTANCE,
    SEMI_MAJOR,
    Origin,
    Waypoint,
    local,
    read_fence_file,
    read_route,
    read_route_file,
)
from flight_guidance.steering.path import Arc

ZURICH = Origin(47.4, 8.5)
# Longitude, latitude, altitude.
SQUARE = [(8.5, 47.4, 500.0), (8.52, 47.4, 550.0), (8.52, 47.42, 600.5)]
# North, east.
PLACES = [pymap3d.geodetic2enu(lat, lon, 0.0, *ZURICH, 0.0)[1::-1] for lon, lat, _ in SQUARE]
ROUTE = [
    approx((*place, altitude), abs=1e-6)
    for place, (_, _, altitude) in zip(PLACES, SQUARE, strict=True)
]


def flown(path: Path, content: str | dict[str, Any], origin: Origin | None = ZURICH) -> list[Any]:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return [waypoint[:3] for waypoint in read_route(path, origin)]


def kml(body: str, mode: str = "<altitudeMode>absolute</altitudeMode>", head: str = "") -> str:
    body = body.replace("<coordinates>", f"{mode}<coordinates>")
    return (
        f'<?xml version="1.0"?>{head}<kml '
        f'xmlns="http://www.opengis.net/kml/2.2"><Document>{body}</Document></kml>'
    )


def line(coordinates: Any = SQUARE) -> dict[str, Any]:
    return {"type": "LineString", "coordinates": coordinates}


def point(coordinates: Any, **properties: Any) -> dict[str, Any]:
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": "Point", "coordinates": coordinates},
    }


COORDINATES = "\n".join(f"{lon},{lat},{altitude}" for lon, lat, altitude in SQUARE)
KML_LINE = (
    f"<Placemark><LineString><coordinates>{COORDINATES}</coordinates></LineString></Placemark>"
)
KML_POINTS = "".join(
    f"<Placemark><Point><coordinates>{lon},{lat},{altitude}</coordinates></Point></Placemark>"
    for lon, lat, altitude in SQUARE
)


@pytest.mark.parametrize("latitude", [-89.0, -33.9, 0.0, 47.4, 78.2])
@pytest.mark.parametrize("longitude", [-179.999, 8.5, 179.999])  # beside the date line
def test_north_and_east_of_tangent_plane(latitude: float, longitude: float) -> None:
    """North and east lie in the plane that is tangent to the ellipsoid at the origin."""
    for north, east in ((0.0, 0.0), (1e3, -2e3), (-5e4, 5e4)):
        lat, lon, up = pymap3d.enu2geodetic(east, north, 0.0, latitude, longitude, 0.0)
        expected = pymap3d.geodetic2enu(lat, lon, 0.0, latitude, longitude, 0.0)
        assert local(lat, lon, Origin(latitude, longitude)) == approx(
            (expected[1], expected[0]), abs=1e-6
        )
        # The position on the ground below a point of the plane is closer by up / R of its distance.
        share = 1.0 - up / 6.3e6
        assert local(lat, lon, Origin(latitude, longitude)) == approx(
            (north * share, east * share), abs=0.5
        )


def test_plane_errs_by_4_m() -> None:
    """At the largest distance, lengths in the plane are 4 m shorter than on the ground."""
    lat = 47.4
    lon = 8.5 + math.degrees(MAX_DISTANCE / (SEMI_MAJOR * math.cos(math.radians(47.4))))
    on_ground, _ = vdist(47.4, 8.5, lat, lon)
    assert on_ground - math.hypot(*local(lat, lon, ZURICH)) == approx(4.1, abs=0.1)


@pytest.mark.parametrize(
    "ending, content",
    [
        (".geojson", line()),
        (".json", {"type": "Feature", "properties": None, "geometry": line()}),
        (".geojson", {"type": "FeatureCollection", "features": [point(each) for each in SQUARE]}),
        (".KML", kml(KML_POINTS)),
        (
            ".yaml",
            {
                "route": [
                    {"longitude": lon, "latitude": lat, "altitude": h} for lon, lat, h in SQUARE
                ]
            },
        ),
    ],
)
def test_each_format_holds_the_same_route(ending: str, content: Any, tmp_path: Path) -> None:
    assert flown(tmp_path / f"route{ending}", content) == ROUTE


def test_speed_read_where_format_has_one(tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    path.write_text("route: [[0, 0, 100], [500, 0, 120, 25.0], [900, -10, 120.5, 30]]")
    assert read_route(path) == (
        Waypoint(0, 0, 100),
        Waypoint(500, 0, 120, 25.0),
        Waypoint(900, -10, 120.5, 30),
    )
    path = tmp_path / "r.geojson"
    path.write_text(json.dumps({"features": [point(SQUARE[0]), point(SQUARE[1], V=31.5)]}))
    assert [waypoint.speed for waypoint in read_route(path, ZURICH)] == [None, 31.5]


def gpx(body: str, head: str = "") -> str:
    return (
        f'<?xml version="1.0"?>{head}<gpx version="1.1" '
        f'xmlns="http://www.topografix.com/GPX/1/1">{body}</gpx>'
    )


def gpx_points(kind: str) -> str:
    return "".join(
        f'<{kind} lat="{lat}" lon="{lon}"><ele>{h}</ele></{kind}>' for lon, lat, h in SQUARE
    )


SEGMENTS = """<trk><trkseg><trkpt lat="47.4" lon="8.5"><ele>500</ele></trkpt></trkseg>
<trkseg><trkpt lat="{}" lon="8.5"><ele>500</ele></trkpt><trkpt lat="47.41" lon="8.5"><ele>500</ele></trkpt></trkseg></trk>"""  # noqa: E501 - a text as it is written
RTE, TRK, WPT = (gpx_points(kind) for kind in ("rtept", "trkpt", "wpt"))


def mission_item(
    latitude: float, longitude: float, altitude: float, frame: int = 3, command: int = 16
) -> dict[str, Any]:
    params = [0, 0, 0, None, latitude, longitude, altitude]
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": params}


def plan(
    items: list[dict[str, Any]], home: Any = (47.4, 8.5, 400.0), **more: Any
) -> dict[str, Any]:
    return {
        "fileType": "Plan",
        "mission": {"items": items, "plannedHomePosition": list(home)},
    } | more


def wpl(*rows: tuple[float, ...]) -> str:
    """Return rows of a QGC WPL 110 after the home at 400 m.

    A row has frame, command, latitude, longitude, altitude, and possibly the first two parameters.
    """
    lines = [(*row, 0.0, 0.0)[:7] for row in [(0, 16, 47.4, 8.5, 400.0), *rows]]
    texts = [
        f"{k}\t0\t{frame}\t{command}\t{p}\t{q}\t0\t0\t{a}\t{b}\t{c}\t1"
        for k, (frame, command, a, b, c, p, q) in enumerate(lines)
    ]
    return "\r\n".join(["QGC WPL 110", *texts, ""])


def survey(items: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "type": "ComplexItem",
        "complexItemType": "survey",
        "TransectStyleComplexItem": {"Items": items},
    }


def zipped(**files: str) -> bytes:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in files.items():
            opened.writestr(name.replace("_", "."), content)
    return archive.getvalue()


TRACK = (
    "<gx:Track xmlns:gx='http://www.google.com/kml/ext/2.2'><altitudeMode>absolute</altitudeMode>"
    + "".join(
        f"<when>2026-01-01T00:00:0{k}Z</when><gx:coord>{lon} {lat} {h}</gx:coord>"
        for k, (lon, lat, h) in enumerate(SQUARE)
    )
)
ABSOLUTE = "<altitudeMode>absolute</altitudeMode>"
RING = f"<LinearRing><coordinates>{COORDINATES}</coordinates></LinearRing>"


@pytest.mark.parametrize(
    "name, content",
    [
        ("r.geojson", {"type": "MultiLineString", "coordinates": [SQUARE]}),
        ("r.geojson", {"type": "MultiPoint", "coordinates": SQUARE}),
        ("r.geojson", {"type": "GeometryCollection", "geometries": [line()]}),
        (
            "r.geojson",
            {
                "features": [
                    {"type": "Feature", "geometry": None},
                    point([8.5, 47.4]),
                    {"geometry": line()},
                ]
            },
        ),
        ("r.geojson", line([SQUARE[0], *SQUARE])),  # a double click
        ("r.geojson", line() | {"crs": {"properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}}),
        ("r.kml", kml(f"<Placemark><MultiGeometry>{RING}</MultiGeometry></Placemark>{KML_POINTS}")),
        (
            "r.kml",
            kml(f"<Polygon>{ABSOLUTE}<outerBoundaryIs>{RING}</outerBoundaryIs></Polygon>", mode=""),
        ),
        ("r.kml", kml(f"<Placemark>{TRACK}</gx:Track></Placemark>{KML_POINTS}")),
        # The sign of this line is a model.
        (
            "r.kml",
            kml(f"<Placemark>{TRACK}<Model/></gx:Track></Placemark>"),
        ),
        ("r.kml", kml(KML_LINE.replace(",", ", "))),
        ("r.kmz", zipped(doc_kml=kml(KML_LINE), other_kml="no", images_png="x")),
        ("r.kmz", zipped(route_kml=kml(KML_LINE), **{"__MACOSX/": "", "files/other_kml": "no"})),
        ("r.gpx", gpx(f"{WPT}<rte>{RTE}</rte><trk><trkseg>{TRK}</trkseg></trk>")),
        ("r.gpx", gpx(WPT)),
        ("r.plan", plan([mission_item(lat, lon, h) for lon, lat, h in SQUARE])),
        ("r.plan", plan([survey([mission_item(lat, lon, h) for lon, lat, h in SQUARE])])),
        ("r.json", plan([mission_item(lat, lon, h + 400.0, frame=0) for lon, lat, h in SQUARE])),
        ("r.waypoints", wpl(*((3, 16, lat, lon, h) for lon, lat, h in SQUARE))),
        ("r.txt", wpl(*((3, 16, lat, lon, h) for lon, lat, h in SQUARE)).encode("utf-16")),
    ],
)
def test_files_of_other_programs_hold_same_route(name: str, content: Any, tmp_path: Path) -> None:
    if isinstance(content, bytes):
        (tmp_path / name).write_bytes(content)
        assert [waypoint[:3] for waypoint in read_route(tmp_path / name, ZURICH)] == ROUTE
    else:
        assert flown(tmp_path / name, content) == ROUTE


@pytest.mark.parametrize(
    "name, content, heights",
    [
        ("r.geojson", line([place[:2] for place in SQUARE]), [30.0, 30.0, 30.0]),
        # A path of Google Earth: clampToGround.
        (
            "r.kml",
            kml(KML_LINE, mode=""),
            [30.0, 30.0, 30.0],
        ),
        (
            "r.kml",
            kml(KML_LINE, mode="<altitudeMode>relativeToGround</altitudeMode>"),
            [530.0, 580.0, 630.5],
        ),
        (
            "r.plan",
            plan([mission_item(lat, lon, h) for lon, lat, h in SQUARE]),
            [530.0, 580.0, 630.5],
        ),
    ],
)
def test_altitude_option_fills_what_file_lacks(
    name: str, content: Any, heights: list[float], tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    assert [
        waypoint.altitude for waypoint in read_route_file(path, ZURICH, 30.0).waypoints
    ] == heights


def test_mission_counts_from_sea_where_pose_does(tmp_path: Path) -> None:
    """The home is 400 m above the sea, and is the origin if no origin is given."""
    path = tmp_path / "r.waypoints"
    path.write_text(wpl((3, 16, 47.4, 8.52, 50.0), (0, 16, 47.42, 8.52, 500.0)))
    assert [waypoint.altitude for waypoint in read_route_file(path, above_sea=True).waypoints] == [
        450.0,
        500.0,
    ]
    assert [waypoint.altitude for waypoint in read_route_file(path).waypoints] == [50.0, 100.0]
    assert read_route(path)[0].point == approx(PLACES[1], abs=1e-6)
    # The altitude of the home as the aircraft counts, where nothing else of the flight is known.
    assert [
        waypoint.altitude
        for waypoint in read_route_file(path, ZURICH, 7.0, above_sea=None).waypoints
    ] == [57.0, 107.0]
    with refusing(r"found an altitude above the home, expected --altitude"):
        read_route_file(path, ZURICH, above_sea=None)
    with refusing("expected an origin"):
        read_route_file(path, None, 7.0, above_sea=None)


def test_loiters_of_mission_are_flown_and_further_items_named(tmp_path: Path) -> None:
    path = tmp_path / "r.waypoints"
    rows = [
        (3, 22, 0.0, 0.0, 50.0), (3, 16, 47.4, 8.52, 50.0), (3, 31, 47.41, 8.52, 90.0),
        (3, 18, 47.42, 8.52, 90.0, 2.0),
        (2, 177, 0.0, 0.0, 0.0), (3, 17, 47.43, 8.52, 90.0), (3, 16, 47.44, 8.52, 90.0),
    ]  # fmt: skip
    path.write_text(wpl(*rows))
    route = read_route_file(path)
    assert [(w.altitude, w.departure, w.turns) for w in route.waypoints] == [
        *((50.0, 50.0, 0.0), (50.0, 90.0, 0.0), (90.0, 90.0, 2.0), (90.0, 90.0, 0.0))
    ]
    # A loiter without end is the last orbit.
    home = "item 0 is the home, at 47.4,8.5, and no waypoint"
    assert route.notes == (
        home,
        "not flown: NAV_TAKEOFF (item 1), DO_JUMP (item 5), NAV_WAYPOINT (item 7)",
    )


RADII = [(80.0, False), (-80.0, True), (0.0, None)]
"""Radius of a loiter in m, and whether it is counter-clockwise. MAVLink, MAV_CMD_NAV_LOITER_TURNS,
parameter 3: "If positive loiter clockwise, negative counter-clockwise"."""


@pytest.mark.parametrize(("radius", "left"), RADII)
def test_sign_of_a_loiters_radius_is_its_direction(
    tmp_path: Path, radius: float, left: bool | None
) -> None:
    last = "3\t0\t3\t17\t0\t0\t{}\t0\t47.43\t8.52\t90\t1"
    rows = [
        "0\t0\t0\t16\t0\t0\t0\t0\t47.4\t8.5\t400\t1",
        "1\t0\t3\t18\t2\t0\t{}\t0\t47.41\t8.52\t90\t1",
        "2\t0\t3\t31\t0\t{}\t0\t0\t47.42\t8.52\t120\t1",
        last,
    ]
    path = tmp_path / "r.waypoints"
    path.write_text("\n".join(["QGC WPL 110", *(row.format(radius) for row in rows)]))
    route = read_route_file(path)
    assert [waypoint.left for waypoint in route.waypoints] == [left] * 3
    told = any("circles have the radius of the route, in place of 80 m" in n for n in route.notes)
    assert told == (radius != 0.0)
    item = {
        "type": "SimpleItem",
        "frame": 3,
        "command": 19,
        "params": [60, 0, radius, 0, 47.41, 8.52, 50],
    }
    path = tmp_path / "r.plan"
    path.write_text(json.dumps(plan([item])))
    assert read_route(path)[0].left is left


def test_direction_of_circles_stays_in_files_and_sections(tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    circle = "{{north: {}, east: 0, altitude: 0, turns: 2, left: {}}}"
    path.write_text(
        f"route: [[0, 0, 0], {circle.format(900, 'true')}, {circle.format(1900, 'false')}]"
    )
    waypoints = read_route(path)
    assert [waypoint.left for waypoint in waypoints] == [None, True, False]
    guidance = with_route(find_scenario("osprey_route"), waypoints).guidance
    assert guidance is not None
    legs = guidance.plan(guidance.waypoints()).legs
    radii = [leg.radius for leg in legs if isinstance(leg, Arc)]
    assert [math.copysign(1.0, radius) for radius in radii] == [-1.0, 1.0]
    path.write_text(f"route: [[0, 0, 0], {circle.format(900, '-1')}]")
    with refusing(r"route\[1\].left: found -1, expected true or false"):
        read_route(path)
    path.write_text(
        f"route: [[0, 0, 0], {circle.format(900, 'true')}, {circle.format(900, 'false')}]"
    )
    with refusing(r"route\[1\]: found circles to the left and to the right round one place"):
        read_route(path)


WPL_FENCE = [
    # The polygon has three corners.
    *((3, 5001, *corner, 0.0, 3.0) for corner in ((47.39, 8.49), (47.42, 8.49), (47.42, 8.53))),
    *((3, 5004, 47.41, 8.51, 0.0, 200.0), (3, 5100, 47.401, 8.5, 40.0)),
]
A, B, C, D = ((3, 16, 47.4 + 0.01 * k, 8.52, 50.0) for k in range(4))


def jump(item: int, count: int) -> tuple[float, ...]:
    """Return a row of DO_JUMP.

    The first parameter is the item, and the second is how often it jumps.
    """
    return (2, 177, 0.0, 0.0, 0.0, item, count)


@pytest.mark.parametrize(
    "rows, places, skipped",
    [
        ((A, B, jump(1, 2), C), "ABABABC", ""),  # so often again (MAVLink, MAV_CMD_DO_JUMP)
        ((A, jump(4, -1), B, C), "AC", "NAV_WAYPOINT (item 3)"),
        ((A, B, jump(1, -1), C), "AB", "DO_JUMP (item 3), NAV_WAYPOINT (item 4)"),
        (
            (A, B, (3, 20, 0.0, 0.0, 0.0), C),
            "AB",
            "NAV_RETURN_TO_LAUNCH (item 3), NAV_WAYPOINT (item 4)",
        ),
        ((A, B, (3, 21, 47.43, 8.52, 0.0), C), "AB", "NAV_LAND (item 3), NAV_WAYPOINT (item 4)"),
        # The item loiters where the aircraft is.
        (
            (A, B, (3, 17, 0.0, 0.0, 0.0), C),
            "AB",
            "NAV_WAYPOINT (item 4)",
        ),
    ],
)
def test_mission_is_flown_in_the_order_of_an_autopilot(
    rows: Any, places: str, skipped: str, tmp_path: Path
) -> None:
    path = tmp_path / "r.waypoints"
    path.write_text(wpl(*rows))
    route = read_route_file(path, ZURICH)
    names = {
        local(row[2], row[3], ZURICH): name for row, name in zip((A, B, C, D), "ABCD", strict=True)
    }
    assert "".join(names[waypoint.point] for waypoint in route.waypoints) == places
    assert route.notes[1:] == ((f"not flown: {skipped}",) if skipped else ())


@pytest.mark.parametrize(
    "rows, sentence",
    [
        ((A, B, jump(9, 1)), r"DO_JUMP \(item 3\) to 9.0, expected a jump to an item"),
        ((A, B, jump(1, 1), jump(1, 1)), r"DO_JUMP \(item 3\), a loop inside of a loop"),
        ((A, B, jump(1, 30000)), "more than 20000 items by the repetitions"),
    ],
)
def test_mission_that_is_no_route_is_refused_by_item(
    rows: Any, sentence: str, tmp_path: Path
) -> None:
    with refusing(sentence):
        flown(tmp_path / "r.waypoints", wpl(*rows))


def test_jump_of_plan_names_the_id_of_an_item(tmp_path: Path) -> None:
    """A survey takes an id for each of its items, so that ids and positions in the list differ."""
    items = [
        survey([{**mission_item(47.4 + 0.01 * k, 8.52, 50.0), "doJumpId": 3 + k} for k in range(3)])
    ]
    items.append(
        {
            **mission_item(0, 0, 0, frame=2, command=177),
            "params": [5, 1, 0, 0, 0, 0, 0],
            "doJumpId": 9,
        }
    )
    places = flown(tmp_path / "r.plan", plan(items))
    assert len(places) == 3  # the last one twice is one waypoint
    items.append({**mission_item(47.45, 8.52, 50.0), "doJumpId": 10})
    items[1]["params"][0] = 4
    assert [
        round((north - local(47.4, 8.52, ZURICH)[0]) / 1112.0)
        for north, _, _ in flown(tmp_path / "r.plan", plan(items))
    ] == [*(0, 1, 2, 1, 2, 5)]


@pytest.mark.parametrize(
    "frame, further, refusal",
    [
        (3, {"coordinate": [47.4, 8.52, 50]}, ""),
        (3, {"coordinate": [47.40000001, 8.52, 50.0]}, ""),
        (3, {"coordinate": [47.402, 8.52, 50]}, "expected the same place in both"),
        (3, {"coordinate": [47.4, 8.52, 80]}, "expected the same place in both"),
        (3, {"AltitudeMode": 1, "Altitude": 50, "AMSLAltAboveTerrain": None}, ""),
        (0, {"AltitudeMode": 1, "Altitude": 50}, ""),  # above the sea before version 4
        (0, {"AltitudeMode": 3, "Altitude": 20, "AMSLAltAboveTerrain": 50}, ""),
        (3, {"AltitudeMode": 2, "Altitude": 50}, "found AltitudeMode 2 beside frame 3"),
        (0, {"AltitudeMode": 4, "Altitude": 50}, "found AltitudeMode 4 beside frame 0"),
        (3, {"AltitudeMode": 1, "Altitude": 450}, "found Altitude 450 beside 50"),
    ],
)
def test_item_of_a_plan_states_one_place(
    frame: int, further: dict[str, Any], refusal: str, tmp_path: Path
) -> None:
    """Some programs write a place beside the params.

    If it is not the same place, the item is not flown.
    """
    items = [mission_item(47.4 + 0.01 * k, 8.52, 50.0, frame) for k in range(2)]
    items[0] |= further
    content = plan(items, home=(47.4, 8.5, 0.0))
    if refusal:
        with refusing(refusal):
            flown(tmp_path / "r.plan", content)
    else:
        assert len(flown(tmp_path / "r.plan", content)) == 2


def test_waypoints_at_one_place_are_one(tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    path.write_text(
        "route:\n- [0, 0, 0]\n- [900, 0, 0]\n- {north: 900, east: 0, altitude: 80, turns: 2}\n- "
        "[1800, 0, 80]\n",
    )
    assert read_route(path)[1] == Waypoint(
        north=900.0, east=0.0, altitude=0.0, speed=None, turns=2.0, wait=0.0, leave=80.0
    )
    path.write_text(
        "route: [[0, 0, 0], [900, 0, 0, 26], [900, 0, 0, 27], [900, 900, 0], [0, 900, 0]]",
    )
    # The airspeed is that of the leg before.
    assert [waypoint.speed for waypoint in read_route(path)] == [None, 26.0, 27.0, None]
    circle = "{{north: 900, east: 0, altitude: 0, turns: {}}}"
    path.write_text(
        f"route: [[0, 0, 0], {circle.format(2)}, {circle.format(3)}, [900, 900, 0]]",
    )
    assert read_route(path)[1].turns == 5.0
    path.write_text("route:\n- {north: 0, east: 0, altitude: 0, turns: no}\n")
    with refusing(r"route\[0\].turns: found False, expected a finite number"):
        read_route(path)
    path.write_text("route:\n- {north: 0, east: 0, altitude: 0, turns: -1}\n")
    with refusing(r"route\[0\].turns: found -1, expected at least 0"):
        read_route(path)


@pytest.mark.parametrize(
    "command, sentence",
    [
        (179, "not flown: DO_SET_HOME (item 2)"),
        (82, "NAV_SPLINE_WAYPOINT is flown as a corner with a fillet, and not as a spline"),
        (
            179,
            (
                "heights above the home stay above the first home, and not above the home of "
                "DO_SET_HOME"
            ),
        ),
        (601, "DO_JUMP_TAG repeats items, which are flown once here"),
        (30, "not flown: NAV_CONTINUE_AND_CHANGE_ALT (30) (item 2)"),
        (42702, "not flown: NAV_SCRIPT_TIME (42702) (item 2)"),
        (65000, "not flown: MAV_CMD 65000 (item 2)"),
    ],
)
def test_command_that_is_not_flown_is_named(command: int, sentence: str) -> None:
    items = [mission_item(47.4 + 0.01 * k, 8.52, 50.0) for k in range(3)]
    items[1] |= {"command": command}
    assert (
        sentence
        in route_formats.read_places(json.dumps(plan(items)).encode(), "r.plan", ".plan").notes
    )


def test_command_has_its_number_where_pymavlink_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20", None)
    items = [mission_item(47.4 + 0.01 * k, 8.52, 50.0) for k in range(3)]
    items[1] |= {"command": 42702}
    assert (
        "not flown: MAV_CMD 42702 (item 2)"
        in route_formats.read_places(json.dumps(plan(items)).encode(), "r.plan", ".plan").notes
    )


def test_numbers_with_decimal_commas_are_named(tmp_path: Path) -> None:
    text = wpl((3, 16, 47.41, 8.5, 50.0), (3, 16, 47.42, 8.5, 50.0)).replace("47.41", "47,41")
    with refusing(r"line 3: found .*, expected 12 numbers, .* with a point and no comma: 47,41$"):
        route_formats.read_places(text.encode(), "r.waypoints", ".waypoints")


@pytest.mark.parametrize("place", ["fence", "top"])
def test_fence_of_version_1_is_named(place: str) -> None:
    first = {"polygon": [[47.39, 8.49], [47.42, 8.49], [47.42, 8.53]], "breachReturn": [47.4, 8.5]}
    tree = plan(
        [mission_item(47.41, 8.52, 50.0)], **({"geoFence": first} if place == "fence" else first)
    )
    content = json.dumps(tree).encode()
    assert any(
        "not read: the fence of version 1" in note
        for note in route_formats.read_places(content, "r.plan", ".plan").notes
    )
    with refusing(r"found the fence of version 1 .*, expected one of version 2"):
        route_formats.read_fence(content, "r.plan", ".plan")


CENTRE = {"center": [47.41, 8.51], "radius": 200.0}
PLAN_FENCE: dict[str, Any] = {
    "fileType": "Plan",
    "geoFence": {
        "polygons": [{"polygon": [[47.39, 8.49], [47.42, 8.49], [47.42, 8.53]], "inclusion": True}],
        "circles": [{"circle": CENTRE, "inclusion": False}],
    },
    "rallyPoints": {"points": [[47.5, 8.5, 50.0], [47.401, 8.5, 40.0]]},
    "mission": {"plannedHomePosition": [47.40, 8.50, 450.0], "items": []},
}
GEOJSON_FENCE: dict[str, Any] = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "geometry": {
                "type": "Polygon",
                # A double click.
                "coordinates": [
                    [[8.49, 47.39], [8.49, 47.42], [8.49, 47.42], [8.53, 47.42], [8.49, 47.39]]
                ],
            },
        },
        {
            "type": "Feature",
            "properties": {"radius": 200, "exclude": True},
            "geometry": {"type": "Point", "coordinates": [8.51, 47.41]},
        },
    ],
}


def test_segments_of_track_are_joined(tmp_path: Path) -> None:
    """A gap of 0.003 deg of latitude is 0.18 nautical miles."""
    (tmp_path / "r.gpx").write_text(gpx(SEGMENTS.format(47.403)))
    route = read_route_file(tmp_path / "r.gpx", ZURICH)
    assert len(route.waypoints) == 3
    assert route.notes == ("2 trkseg are one track: a leg joins them over each gap, up to 334 m",)


def named_lines(north: float, name: str) -> str:
    points = "".join(
        f'<trkpt lat="{north + 0.01 * k}" lon="8.5"><ele>500</ele></trkpt>' for k in range(2)
    )
    return f"<trk><name>{name}</name><trkseg>{points}</trkseg></trk>"


@pytest.mark.parametrize("line", ["2", "evening"])
def test_line_of_a_file_with_several_is_chosen(line: str, tmp_path: Path) -> None:
    path = tmp_path / "r.gpx"
    content = gpx(named_lines(47.4, "morning") + named_lines(47.45, "evening") + WPT)
    path.write_text(content)
    route = read_route_file(path, ZURICH, line=line)
    north = pymap3d.geodetic2enu(47.45, 8.5, 0.0, *ZURICH, 0.0)[1]
    assert [waypoint.north for waypoint in route.waypoints] == approx(
        [north, north + 1112.0], abs=1.0
    )
    assert route.notes == ("1 further lines and 3 wpt beside the trk: no part of the route",)
    with refusing(r"found 2 trk, expected one, or --line 1 \(morning\), 2 \(evening\)"):
        read_route_file(path, ZURICH)
    with refusing(r"line: found '3', which names 0 lines, expected --line 1 \(morning\)"):
        read_route_file(path, ZURICH, line="3")
    path = tmp_path / "r.plan"
    path.write_text(json.dumps(plan([])))
    with refusing(r"line: found a mission"):
        read_route_file(path, line=line)


@pytest.mark.parametrize("ending", [".plan", ".geojson", ".waypoints"])
def test_fence_of_file_is_zones_and_home(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"fence{ending}"
    tree = PLAN_FENCE if ending == ".plan" else GEOJSON_FENCE
    path.write_text(wpl(*WPL_FENCE) if ending == ".waypoints" else json.dumps(tree))
    sections = read_fence_file(path, ZURICH)
    field, hole = sections["fence"].values()
    corners = [local(47.39, 8.49, ZURICH), local(47.42, 8.49, ZURICH), local(47.42, 8.53, ZURICH)]
    assert (field["north"], field["east"]) == tuple(
        [corner[k] for corner in corners] for k in (0, 1)
    )
    assert (field["exclude"], hole["exclude"], hole["radius"]) == (False, True, 200.0)
    # The nearest rally point, above the home.
    if ending != ".geojson":
        assert sections["home"] == approx(
            {
                "north": local(47.401, 8.5, ZURICH)[0],
                "east": local(47.401, 8.5, ZURICH)[1],
                "altitude": 40.0,
            }
        )


def test_inclusion_zones_of_an_autopilot_are_one_group(tmp_path: Path) -> None:
    """By MAVLink, an aircraft stays inside all zones of a group.

    A plan has no groups, and PX4 and ArduPilot stay inside all of its zones.
    """
    path = tmp_path / "fence.plan"
    polygon = PLAN_FENCE["geoFence"]["polygons"][0]
    circle = {"circle": CENTRE, "inclusion": True}
    tree = {
        "geoFence": {
            "polygons": [polygon, polygon],
            "circles": [circle, *PLAN_FENCE["geoFence"]["circles"]],
        }
    }
    path.write_text(json.dumps(PLAN_FENCE | tree))
    assert [zone.get("group") for zone in read_fence_file(path)["fence"].values()] == [
        0,
        0,
        0,
        None,
    ]
    path = tmp_path / "fence.geojson"
    path.write_text(json.dumps(GEOJSON_FENCE))
    assert [zone.get("group") for zone in read_fence_file(path, ZURICH)["fence"].values()] == [
        None,
        None,
    ]


def test_home_is_return_point_of_fence_without_rally_points(tmp_path: Path) -> None:
    there = local(47.405, 8.5, ZURICH)
    path = tmp_path / "fence.plan"
    fence = PLAN_FENCE["geoFence"] | {"breachReturn": [47.405, 8.5, 60.0]}
    path.write_text(json.dumps(PLAN_FENCE | {"rallyPoints": {}, "geoFence": fence}))
    assert read_fence_file(path)["home"] == approx(
        {"north": there[0], "east": there[1], "altitude": 60.0}
    )
    path = tmp_path / "fence.waypoints"
    path.write_text(wpl((0, 5000, 47.405, 8.5, 0.0), *WPL_FENCE[:3]))  # which has no altitude
    assert read_fence_file(path, ZURICH)["home"] == approx({"north": there[0], "east": there[1]})


@pytest.mark.parametrize(
    "rows, sentence",
    [
        (WPL_FENCE[:2], "found 2 of the 3 corners of a polygon, expected all"),
        (
            [*WPL_FENCE[:2], WPL_FENCE[4]],
            r"NAV_RALLY_POINT \(item 3\): found 0 corners, expected corners of a polygon",
        ),
        (
            [(3, 5001, 47.39, 8.49, 0.0, math.nan)],
            r"VERTEX_INCLUSION \(item 1\): found nan corners, expected corners",
        ),
    ],
)
def test_polygon_without_all_corners_is_no_smaller_fence(
    rows: Any, sentence: str, tmp_path: Path
) -> None:
    path = tmp_path / "fence.waypoints"
    path.write_text(wpl(*rows))
    with refusing(sentence):
        read_fence_file(path, ZURICH)


def test_zone_that_is_not_told_to_keep_in_or_out_refused(tmp_path: Path) -> None:
    """A text such as "no" is true in many languages, and would turn the fence inside out."""
    path = tmp_path / "fence.geojson"
    path.write_text(json.dumps(GEOJSON_FENCE).replace("true", '"no"'))
    with refusing("exclude: 'no', expected true or false"):
        read_fence_file(path, ZURICH)
    path = tmp_path / "fence.plan"
    path.write_text(json.dumps(PLAN_FENCE).replace('"inclusion"', '"Inclusion"'))
    with refusing("inclusion: None, expected true or false"):
        read_fence_file(path)


def test_fence_is_read_wherever_a_geojson_may_have_it(tmp_path: Path) -> None:
    """A fence may be a collection of geometries, and a Feature may have none.

    RFC 7946 says so in sections 3.1.8 and 3.2.
    """
    path = tmp_path / "fence.geojson"
    polygon = GEOJSON_FENCE["features"][0]["geometry"]
    tree = {
        "features": [
            {"geometry": None},
            {"geometry": {"type": "GeometryCollection", "geometries": [polygon]}},
        ]
    }
    path.write_text(json.dumps(tree))
    assert len(read_fence_file(path, ZURICH)["fence"]["zone_0"]["north"]) == 3
    path.write_text(json.dumps({"type": "FeatureCollection", "features": []}))
    with refusing("found no zone"):
        read_fence_file(path, ZURICH)
    exchanged = polygon | {
        "coordinates": [[position[::-1] for position in polygon["coordinates"][0]]]
    }
    path.write_text(json.dumps(exchanged))
    with refusing("latitude and longitude exchanged, by the origin"):
        read_fence_file(path, ZURICH)


def test_file_without_fence_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.geojson"
    path.write_text(
        json.dumps({"type": "LineString", "coordinates": [[8.5, 47.4], [8.51, 47.4]]}),
    )
    with refusing("found a 'LineString', expected Polygons, or Points with a radius"):
        read_fence_file(path, ZURICH)
    with refusing(r"expected one that ends in \.plan"):
        read_fence_file(tmp_path / "r.kml", ZURICH)


def test_line_cut_at_date_line_is_one(tmp_path: Path) -> None:
    """By RFC 7946, section 3.1.9, a line over the antimeridian is cut there."""
    parts = [[[179.99, 0.0, 1.0], [180.0, 0.0, 1.0]], [[-180.0, 0.0, 1.0], [-179.99, 0.0, 1.0]]]
    (tmp_path / "r.geojson").write_text(
        json.dumps({"type": "MultiLineString", "coordinates": parts})
    )
    waypoints = read_route(tmp_path / "r.geojson", Origin(0.0, 180.0))
    # 0.01 deg of the equator
    assert [round(waypoint.east) for waypoint in waypoints] == [-1113, 1113]


def test_track_is_thinned_within_tolerance(tmp_path: Path) -> None:
    """A track is thinned to the lines from which it is less than the tolerance away.

    Its positions have a distance of 20 m and are up to 4 m beside two lines. The tolerance is 5 m.
    """
    north = [(20.0 * k, 4.0 * math.sin(k), 100.0) for k in range(51)]
    east = [(1000.0, 20.0 * k, 100.0) for k in range(1, 51)]
    path = tmp_path / "r.yaml"
    path.write_text(json.dumps({"route": [*north, *east]}))
    route = read_route_file(path, simplify=5.0)
    assert [waypoint.point for waypoint in route.waypoints] == [
        (0.0, 0.0),
        approx((1000.0, 0.0), abs=5.0),
        (1000.0, 1000.0),
    ]
    assert route.notes == ("3 of 101 positions: the others are within 5 m of the line",)


def test_archive_that_unpacks_to_much_is_refused(tmp_path: Path) -> None:
    (tmp_path / "r.kmz").write_bytes(zipped(doc_kml=" " * 10_000_000))
    with refusing(r"doc\.kml: found more than \d+ bytes"):
        read_route(tmp_path / "r.kmz", ZURICH)


ENTITY = '<!DOCTYPE kml [<!ENTITY a "8.5,47.4,500">]>'


@pytest.mark.parametrize(
    "name, content, sentence",
    [
        (
            "r.abc",
            "",
            (
                r"route: found the file .*r\.abc, expected one that ends in \.geojson, \.json, "
                r"\.kml, .*\.yaml, \.yml"
            ),
        ),
        (
            "r.yaml",
            "route: [[0, 0]]",
            r"route\[0\]: found \[0, 0\], expected \[north, east, altitude\], ",
        ),
        (
            "r.yaml",
            "route: [[0, 0, .nan]]",
            r"route\[0\]\.altitude: found nan, expected a finite number",
        ),
        (
            "r.yaml",
            "route: [[0, 200000, 1]]",
            r"route\[0\]: found 200 km from the origin, expected at most 100 km",
        ),
        ("r.yaml", "route: 5", "found another content, expected the key route alone, with a list"),
        ("r.geojson", "{", r"r\.geojson: not valid JSON .* expected a route file"),
        (
            "r.geojson",
            line([[-171.5, -47.4, 500.0]]),
            r"route\[0\]: found a position on the other half of the Earth, expected one near",
        ),
        (
            "r.geojson",
            line([[47.4, 8.5, 500.0]]),
            "found latitude and longitude exchanged, by the origin",
        ),
        (
            "r.geojson",
            {"features": [line(), line()]},
            "found 2 LineStrings, expected one, or --line 1, 2",
        ),
        (
            "r.geojson",
            {"type": "Curve", "coordinates": SQUARE},
            "no Point, but 1 geometry of the type 'Curve'",
        ),
        (
            "r.geojson",
            line() | {"crs": {"properties": {"name": "urn:ogc:def:crs:EPSG::2056"}}},
            "the coordinate system 'urn:",
        ),
        ("r.kml", kml("<NetworkLink/>"), "found no LineString and no Point, but 1 NetworkLink"),
        (
            "r.gpx",
            gpx(SEGMENTS.format(47.43)),
            r"found a gap of 3\.3 km between two trkseg, expected at most 1 km",
        ),
        (
            "r.gpx",
            gpx('<rte><rtept lat="47.4" lon="8.5"/></rte>'),
            r"route\[0\]: found a rtept without ele, .* --altitude",
        ),
        ("r.plan", {"fileType": "Plan"}, "found no mission with items"),
        (
            "r.plan",
            plan([mission_item(47.4, 8.5, 9.0, frame=10)]),
            "the frame 10, above the ground, expected 0 or 3",
        ),
        (
            "r.plan",
            plan([{"type": "ComplexItem", "complexItemType": "StructureScan"}]),
            "item 1: found a 'StructureScan', expected waypoints, survey or CorridorScan",
        ),
        ("r.txt", "QGC WPL 110\n0 1 2\n", "line 2: found '0 1 2', expected 12 numbers"),
        ("r.kmz", "hello", "cannot be unpacked .*, expected a KMZ archive"),
        (
            "r.kml",
            kml(KML_LINE, mode=""),
            "found a LineString with the altitudeMode 'clampToGround', expected absolute",
        ),
        (
            "r.kml",
            kml("<Point><coordinates>&a;</coordinates></Point>", head=ENTITY),
            "found a document type, expected the XML",
        ),
        # A line that holds nothing is not replaced by marks.
        (
            "r.geojson",
            {"features": [{"geometry": line([])}, point(SQUARE[0]), point(SQUARE[1])]},
            "1 LineString without a position",
        ),
        (
            "r.geojson",
            '{"type": "LineString", "type": "Point", "coordinates": [8.5, 47.4, 1]}',
            "the member 'type' twice",
        ),
        (
            "r.kml",
            kml(KML_POINTS + '<a:height xmlns:a="http://www.dji.com/wpmz/1.0.2">50</a:height>'),
            "a mission of DJI",
        ),
    ],
)
def test_what_is_no_route_refused_with_one_sentence(
    name: str, content: Any, sentence: str, tmp_path: Path
) -> None:
    with refusing(sentence):
        flown(tmp_path / name, content)


def test_latitudes_need_an_origin(tmp_path: Path) -> None:
    with refusing(r"route\[0\]: found a latitude and a longitude, expected an origin"):
        flown(tmp_path / "r.geojson", line(), origin=None)


def test_document_type_refused_before_entities_read(tmp_path: Path) -> None:
    # Nested entities that would expand to a billion characters, and one that would fetch a file of
    # this machine.
    nested = "".join(f'<!ENTITY a{k + 1} "{f"&a{k};" * 10}">' for k in range(9))
    for entities in (f'<!ENTITY a0 "0">{nested}', '<!ENTITY a9 SYSTEM "file:///etc/hostname">'):
        text = kml(
            "<Point><coordinates>&a9;</coordinates></Point>", head=f"<!DOCTYPE kml [{entities}]>"
        )
        with refusing("found a document type"):
            flown(tmp_path / "r.kml", text)
