# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read routes from KML, KMZ (OGC 12-007r2) and GPX (GPX 1.1 schema)."""

import io
import math
import re
import zipfile
import zlib
from collections.abc import Sequence
from itertools import chain, pairwise
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

from flight_core.fields import short_repr
from flight_core.files import MAX_FILE_BYTES, limited
from flight_core.parameters import ParameterError, require
from flight_guidance.routes.route_places import (
    A_ROUTE,
    Above,
    Geometry,
    Place,
    Places,
    lon_lat,
    number_of,
    one_route,
)


class _NoDoctype(TreeBuilder):
    """An XML tree builder that refuses a document type, the only place where entities are declared.

    So no entity is ever expanded or fetched.
    """

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ParseError("a document type")


def _parsed_xml(content: bytes, key: str, kind: str) -> Element:
    parser = XMLParser(target=_NoDoctype())  # noqa: S314 - nothing can be expanded without a document type
    try:
        parser.feed(content)
        root: Element = parser.close()
    except (ParseError, ValueError, LookupError) as error:
        # ValueError and LookupError come from an unknown or wrong encoding.
        raise ParameterError(f"{key}: found {error}, expected the XML of {kind}") from None
    return root


def _kind(element: Element) -> str:
    """Return the name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2]


KML_LINES = ("LineString", "LinearRing", "Track")
KML_OTHERS = ("Model", "NetworkLink")  # elements whose geometry is in another file
KML_VIEWS = ("Tour", "GroundOverlay", "PhotoOverlay", "ScreenOverlay")  # elements without geometry
# part of the namespace of DJI's missions, which have elements of DJI for heights and speeds
DJI = "dji.com/wpmz"
KML_MODES = {
    "absolute": Above.AS_POSE,
    "relativeToGround": Above.GROUND,
    "clampToGround": Above.GROUND,
}


def read_kml(content: bytes, key: str, line: str | None = None) -> Places:
    """Read the route of a KML file."""
    root = _parsed_xml(content, key, "a KML file")
    elements = [*root.iter()]
    way_out = (
        "a KML without it, a GeoJSON or a plan of QGroundControl: its heights and speeds "
        "are not read"
    )
    require(
        not any(DJI in str(element.tag) for element in elements),
        key,
        "a mission of DJI (WPML)",
        way_out,
    )
    kinds = [(_kind(element), element) for element in elements]
    has_line = any(kind in KML_LINES for kind, _ in kinds)
    polygons = _outer_elements(kinds, "Polygon")
    tracks = _outer_elements(kinds, "Track")
    marks = _outer_elements(kinds, "Placemark")
    # A Model in a Track is only a symbol.
    others = [kind for kind, element in kinds if kind in KML_OTHERS and element not in tracks]
    geometries: list[Geometry] = []
    for kind, element in kinds:
        if kind == "Point" and has_line:
            # only a mark beside the line; its altitude does not matter
            geometries.append(Geometry(kind, []))
        elif kind in (*KML_LINES, "Point"):
            # The altitudeMode of a Polygon holds for its rings.
            name = _text(marks.get(element), "name") or ""
            geometries.append(
                Geometry(kind, _kml_places(key, kind, element, polygons.get(element)), name.strip())
            )
    if not geometries:
        others += [kind for kind, _ in kinds if kind in KML_VIEWS]
    return one_route(key, geometries, others, line)


def _outer_elements(kinds: Sequence[tuple[str, Element]], outer: str) -> dict[Element, Element]:
    """Map each element inside an element of the kind `outer` to this outer element."""
    outers: dict[Element, Element] = {}
    for kind, element in kinds:
        if kind == outer:
            outers |= dict.fromkeys(element.iter(), element)
    return outers


def _text(parent: Element | None, kind: str) -> str | None:
    """Return the text of the first child of a kind, or None if there is none."""
    return next(
        (child.text for child in (() if parent is None else parent) if _kind(child) == kind), None
    )


def _kml_places(key: str, kind: str, element: Element, polygon: Element | None) -> list[Place]:
    children = chain(() if polygon is None else polygon, element)
    texts = {_kind(child): child.text or "" for child in children}
    mode = texts.get("altitudeMode", "clampToGround").strip()  # the default of KML
    mode_text = f"a {kind} with the altitudeMode {short_repr(mode)}"
    require(
        mode in KML_MODES, key, mode_text, "absolute, for the height of the ground is not known"
    )
    if kind == "Track":
        tuples = [(child.text or "").split() for child in element if _kind(child) == "coord"]
    else:
        tuples = [
            text.split(",")
            for text in re.sub(r"\s*,\s*", ",", texts.get("coordinates", "")).split()
        ]
    require(
        kind != "Point" or len(tuples) == 1, key, f"a Point with {len(tuples)} positions", "one"
    )
    # clampToGround ignores the altitude.
    if mode == "clampToGround":
        tuples = [[*position[:2], "0"] for position in tuples]
    return [
        lon_lat(list(map(number_of, position)), None, KML_MODES[mode], mode_text)
        for position in tuples
    ]


def read_kmz(content: bytes, key: str, line: str | None = None) -> Places:
    """Read the route in the KML file of a KMZ archive, which is doc.kml or the only KML file.

    Files in the root of the archive come before those in folders (OGC 12-007r2, Annex C).
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            names = [name for name in archive.namelist() if name.lower().endswith(".kml")]
            names = [name for name in names if "/" not in name] or names
            if "doc.kml" in names:
                names = ["doc.kml"]
            file_name = names[0] if len(names) == 1 else ""
            method = archive.getinfo(file_name).compress_type if file_name else zipfile.ZIP_STORED
            require(
                method in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED},
                key,
                f"the compression {method}",
                "deflate, as in a KMZ",
            )
            inside = archive.open(file_name).read(MAX_FILE_BYTES + 1) if file_name else b""
    except ParameterError:
        raise
    except (
        zipfile.BadZipFile,
        zlib.error,
        NotImplementedError,
        RuntimeError,
        EOFError,
        OSError,
        ValueError,
    ) as error:
        raise ParameterError(
            f"{key}: cannot be unpacked ({error}), expected a KMZ archive"
        ) from None
    require(bool(file_name), key, f"{len(names)} .kml files and no doc.kml", "one")
    return read_kml(limited(inside, f"{key}: {file_name}", A_ROUTE), key, line)


EARTH_RADIUS = 6371e3
"""Mean radius R_1 of the Earth by GRS80, m."""

LARGEST_GAP = 1000.0
"""Largest gap over which the segments of a track are joined, m. GPX begins a new segment when the
receiver has lost its satellites."""


def read_gpx(content: bytes, key: str, line: str | None = None) -> Places:
    """Read the route (rte) of a GPX file, or else its track (trk), or else its waypoints (wpt).

    `line` chooses one of all routes and tracks.
    """
    root = _parsed_xml(content, key, "a GPX file")
    marks = _gpx_places(root, "wpt")
    routes = [
        (element, _gpx_segments(element, "rte"))
        for element in root.iter()
        if _kind(element) == "rte"
    ]
    tracks = [
        (element, _gpx_segments(element, "trk"))
        for element in root.iter()
        if _kind(element) == "trk"
    ]
    if line is not None or not any(segments for _, segments in routes):
        geometries = routes + tracks
    else:
        geometries = routes
    # Lines and marks become geometries; everything else is named in the notes.
    lines = [
        Geometry(_kind(element), [*chain(*segments)], (_text(element, "name") or "").strip())
        for element, segments in geometries
    ]
    require(
        bool(lines or marks), key, f"no rte, no trk and no wpt in {_kind(root)}", "a route in gpx"
    )
    route = one_route(key, [*lines, *(Geometry("wpt", [place]) for place in marks)], (), line)
    notes = [*route.notes]
    if geometries == routes and any(segments for _, segments in tracks):
        notes.append(f"{len(tracks)} trk beside the rte: no part of the route")
    if shapes := sum(_kind(element) == "rpt" for element in root.iter()):
        notes.append(f"{shapes} rpt of extensions: no part of the route")
    # Join the segments of the track that is flown, unless a gap is too wide.
    segments = next(
        (segments for _, segments in geometries if [*chain(*segments)] == route.places), []
    )
    gaps = [_gap(before[-1], after[0]) for before, after in pairwise(segments)]
    widest = max(gaps, default=0.0)
    fits = widest <= LARGEST_GAP
    require(
        fits,
        key,
        f"a gap of {widest / 1e3:.1f} km between two trkseg",
        f"at most {LARGEST_GAP / 1e3:g} km within a track",
    )
    if gaps:
        notes.append(
            f"{len(segments)} trkseg are one track: a leg joins them over each gap, up to "
            f"{widest:.0f} m"
        )
    return route._replace(notes=tuple(notes))


def _gpx_segments(line: Element, kind: str) -> list[list[Place]]:
    """Return the segments of a track that have positions; a route is a single segment."""
    parts = [line] if kind == "rte" else [element for element in line if _kind(element) == "trkseg"]
    return [places for element in parts if (places := _gpx_places(element, f"{kind}pt"))]


def _gap(end: Place, begin: Place) -> float:
    """Return the distance between two near positions on a sphere, m.

    The distance is 0 if a position is not valid, because such a position is refused later.
    """
    values = (end.latitude, end.longitude, begin.latitude, begin.longitude)
    if not all(isinstance(value, float) and math.isfinite(value) for value in values):
        return 0.0
    north = begin.latitude - end.latitude
    east = math.remainder(begin.longitude - end.longitude, 360.0) * math.cos(
        math.radians(end.latitude)
    )
    return EARTH_RADIUS * math.radians(math.hypot(north, east))


def _gpx_places(parent: Element, kind: str) -> list[Place]:
    places = []
    for element in (child for child in parent if _kind(child) == kind):
        latitude, longitude = (number_of(element.get(name)) for name in ("lat", "lon"))
        height = _text(element, "ele")
        places.append(
            Place(
                "route",
                latitude,
                longitude,
                number_of(height),
                altitude_text=f"a {kind} without ele",
            )
        )
    return places
