# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Route files: WGS84 against pymap3d, and what each format holds or may not hold."""

import json
import math
from pathlib import Path
from typing import Any

import pymap3d
import pytest
from pymap3d.vincenty import vdist

from flight_core.parameters import ParameterError
from flight_guidance.route_file import FLATTENING, MAX_DISTANCE, SEMI_MAJOR, Origin, Waypoint, local, read_route

pytestmark = pytest.mark.package("flight_guidance")

ZURICH = Origin(47.4, 8.5)
SQUARE = [(8.5, 47.4, 500.0), (8.52, 47.4, 550.0), (8.52, 47.42, 600.5)]  # longitude, latitude, altitude
PLACES = [pymap3d.geodetic2enu(lat, lon, 0.0, *ZURICH, 0.0)[1::-1] for lon, lat, _ in SQUARE]  # north, east
ROUTE = [pytest.approx((*place, altitude), abs=1e-6) for place, (_, _, altitude) in zip(PLACES, SQUARE, strict=True)]


def flown(path: Path, content: str | dict[str, Any], origin: Origin | None = ZURICH) -> list[Any]:
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return [waypoint[:3] for waypoint in read_route(path, origin)]


def kml(body: str, mode: str = "<altitudeMode>absolute</altitudeMode>", head: str = "") -> str:
    body = body.replace("<coordinates>", f"{mode}<coordinates>")
    return f'<?xml version="1.0"?>{head}<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{body}</Document></kml>'


def line(coordinates: Any = SQUARE) -> dict[str, Any]:
    return {"type": "LineString", "coordinates": coordinates}


def point(coordinates: Any, **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": {"type": "Point", "coordinates": coordinates}}


COORDINATES = "\n".join(f"{lon},{lat},{altitude}" for lon, lat, altitude in SQUARE)
KML_LINE = f"<Placemark><LineString><coordinates>{COORDINATES}</coordinates></LineString></Placemark>"
KML_POINTS = "".join(
    f"<Placemark><Point><coordinates>{lon},{lat},{altitude}</coordinates></Point></Placemark>" for lon, lat, altitude in SQUARE
)


@pytest.mark.parametrize("latitude", [-89.0, -33.9, 0.0, 47.4, 78.2])
@pytest.mark.parametrize("longitude", [-179.999, 8.5, 179.999])  # beside the date line
def test_north_and_east_of_tangent_plane(latitude: float, longitude: float) -> None:
    """North and east belong to the plane tangent to the ellipsoid at the origin."""
    for north, east in ((0.0, 0.0), (1e3, -2e3), (-5e4, 5e4)):
        lat, lon, up = pymap3d.enu2geodetic(east, north, 0.0, latitude, longitude, 0.0)
        expected = pymap3d.geodetic2enu(lat, lon, 0.0, latitude, longitude, 0.0)
        assert local(lat, lon, Origin(latitude, longitude)) == pytest.approx((expected[1], expected[0]), abs=1e-6)
        # The position on the ground below a point of the plane is closer by up / R of its distance.
        share = 1.0 - up / 6.3e6
        assert local(lat, lon, Origin(latitude, longitude)) == pytest.approx((north * share, east * share), abs=0.5)


def test_plane_errs_by_4_m() -> None:
    """At the largest distance the plane is 4 m short of the ground."""
    lat, lon = 47.4, 8.5 + math.degrees(MAX_DISTANCE / (SEMI_MAJOR * math.cos(math.radians(47.4))))
    on_ground, _ = vdist(47.4, 8.5, lat, lon)
    assert on_ground - math.hypot(*local(lat, lon, ZURICH)) == pytest.approx(4.1, abs=0.1)


def test_the_ellipsoid_is_wgs84() -> None:
    reference = pymap3d.Ellipsoid.from_name("wgs84")
    assert (reference.semimajor_axis, reference.flattening) == pytest.approx((SEMI_MAJOR, FLATTENING), rel=1e-12)


@pytest.mark.parametrize(
    ("ending", "content"),
    [
        (".geojson", line()),
        (".json", {"type": "Feature", "properties": None, "geometry": line()}),
        (".geojson", {"type": "FeatureCollection", "features": [point([0.0, 0.0, 0.0]), {"geometry": line()}]}),
        (".geojson", {"type": "FeatureCollection", "features": [point(each) for each in SQUARE]}),
        (".kml", kml(KML_LINE)),
        (".KML", kml(KML_POINTS)),
        (".kml", kml(KML_LINE + KML_POINTS)),
        (".yaml", {"route": [{"longitude": lon, "latitude": lat, "altitude": h} for lon, lat, h in SQUARE]}),
    ],
)
def test_each_format_holds_the_same_route(ending: str, content: Any, tmp_path: Path) -> None:
    assert flown(tmp_path / f"route{ending}", content) == ROUTE


def test_speed_read_where_format_has_one(tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    path.write_text("route: [[0, 0, 100], [500, 0, 120, 25.0], [900, -10, 120.5, 30]]", encoding="utf-8")
    assert read_route(path) == (Waypoint(0, 0, 100), Waypoint(500, 0, 120, 25.0), Waypoint(900, -10, 120.5, 30))
    path = tmp_path / "r.geojson"
    path.write_text(json.dumps({"features": [point(SQUARE[0]), point(SQUARE[1], V=31.5)]}), encoding="utf-8")
    assert [waypoint.speed for waypoint in read_route(path, ZURICH)] == [None, 31.5]


def test_points_beside_line_ignored(tmp_path: Path) -> None:
    """Points beside a LineString are no part of the route, and may hold anything."""
    line_alone, both = tmp_path / "r.geojson", tmp_path / "both.geojson"
    line_alone.write_text(json.dumps(line()), encoding="utf-8")
    both.write_text(json.dumps({"features": [point([8.5, 47.4]), line()]}), encoding="utf-8")  # a place without an altitude
    assert read_route(both, ZURICH) == read_route(line_alone, ZURICH)
    marked = tmp_path / "both.kml"
    ground = "<Point><coordinates>8.5,47.4,0</coordinates></Point>"
    marked.write_text(kml(KML_LINE).replace("<Placemark>", f"<Placemark>{ground}</Placemark><Placemark>", 1), encoding="utf-8")
    assert len(read_route(marked, ZURICH)) == len(SQUARE)


ENTITY = '<!DOCTYPE kml [<!ENTITY a "8.5,47.4,500">]>'


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("r.gpx", "", r"route: found the file .*r\.gpx, expected one that ends in \.geojson, \.json, \.kml, \.yaml, \.yml"),
        ("r.yaml", "route: [[0, 0]]", r"route\[0\]: found \[0, 0\], expected \[north, east, altitude\], "),
        ("r.yaml", "route: [[0, 0, .nan]]", r"route\[0\]\.altitude: found nan, expected a finite number"),
        ("r.yaml", "route: [[0, true, 1]]", r"route\[0\]\.east: found True, expected a finite number"),
        ("r.yaml", "route: [[0, 0, 1, 0]]", r"route\[0\]\.V: found 0 m/s, expected a speed above 0"),
        ("r.yaml", "route: [[0, 200000, 1]]", r"route\[0\]: found 200 km from the origin, expected at most 100 km"),
        ("r.yaml", "route: [{latitude: 47.4, longitude: 8.5}]", r"route\[0\]\.altitude: found nothing, expected a"),
        ("r.yaml", "route: [{lat: 47.4}]", r"route\[0\]: found the keys \['lat'\], expected latitude, longitude, altitude"),
        ("r.yaml", "route: 5", "found another content, expected the key route alone, with a list"),
        ("r.yaml", "{route: [], speed: 5}", "found another content, expected the key route alone"),
        ("r.geojson", "{", r"r\.geojson: not valid JSON .* expected a route file"),
        ("r.geojson", line([[8.5, 47.4]]), r"route\[0\]: found \[8\.5, 47\.4\], expected longitude, latitude, altitude"),
        (
            "r.geojson",
            line([[-171.5, -47.4, 500.0]]),
            r"route\[0\]: found a position on the other half of the Earth, expected one near",
        ),
        ("r.geojson", line([[47.4, 8.5, 500.0]]), r"route\[0\]: found 49\d\d km from the origin"),
        ("r.geojson", line([[8.5, 147.4, 1.0]]), r"route\[0\]\.latitude: found 147\.4, expected .* from -90 to 90"),
        ("r.geojson", {"features": [line(), line()]}, "found 2 LineStrings, expected one, or Points alone"),
        ("r.geojson", {"type": "Polygon", "coordinates": [SQUARE]}, "found no LineString and no Point, expected a route"),
        ("r.kml", "<kml>", r"r\.kml: found no element found.*, expected the XML of a KML file"),
        ("r.kml", kml(KML_LINE, mode=""), "found a LineString with the altitudeMode 'clampToGround', expected absolute"),
        ("r.kml", kml("<Point><coordinates>a,b,c</coordinates></Point>"), r"route\[0\]\.latitude: found 'b'"),
        ("r.kml", kml("<Point><coordinates>1,2,3 4,5,6</coordinates></Point>"), "found a Point with 2 positions, expected one"),
        ("r.kml", kml("<Point><coordinates>&a;</coordinates></Point>", head=ENTITY), "found a document type, expected the XML"),
    ],
)
def test_what_is_no_route_refused_with_one_sentence(name: str, content: Any, sentence: str, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=sentence):
        flown(tmp_path / name, content)


def test_latitudes_need_an_origin(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"route\[0\]: found a latitude and a longitude, expected an origin"):
        flown(tmp_path / "r.geojson", line(), origin=None)


def test_document_type_refused_before_entities_read(tmp_path: Path) -> None:
    # Nested entities that would expand to a billion characters, and one that would fetch a file of this machine.
    nested = "".join(f'<!ENTITY a{k + 1} "{f"&a{k};" * 10}">' for k in range(9))
    for entities in (f'<!ENTITY a0 "0">{nested}', '<!ENTITY a9 SYSTEM "file:///etc/hostname">'):
        text = kml("<Point><coordinates>&a9;</coordinates></Point>", head=f"<!DOCTYPE kml [{entities}]>")
        with pytest.raises(ParameterError, match="found a document type"):
            flown(tmp_path / "r.kml", text)
