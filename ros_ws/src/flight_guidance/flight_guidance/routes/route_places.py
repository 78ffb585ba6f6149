# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Hold the positions of a route file before they are validated, and choose the route.

A file may have several lines, of which one is the route.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import chain
from typing import Any, NamedTuple

from flight_core.fields import short_repr
from flight_core.parameters import ParameterError, require

A_ROUTE = "a route file"


class Above(Enum):
    """Above what the altitude of a place is measured."""

    AS_POSE = 0  # the number needs no conversion to the reference of `pose`
    SEA = 1
    HOME = 2
    GROUND = 3


class Place(NamedTuple):
    """A position in a file, before it is validated."""

    key: str  # key of the position, such as "route[0]"
    latitude: Any  # deg
    longitude: Any  # deg
    altitude: Any  # m; None if the file gives no altitude
    speed: Any = None  # m/s
    above: Above = Above.AS_POSE
    altitude_text: str = ""  # text of the file in place of an altitude, for messages
    turns: Any = 0.0  # number of turns round the place
    wait: Any = 0.0  # time on a circle round the place, s
    # Whether the aircraft climbs or sinks to the altitude on a circle round the place, instead of
    # on the way to it.
    climbs: bool = False
    left: bool | None = None  # whether circles are counter-clockwise; None if not given


@dataclass(frozen=True, kw_only=True)
class HomePlace:
    """The home of a mission."""

    latitude: float  # deg
    longitude: float  # deg
    altitude: float | None  # m above the sea


class Places(NamedTuple):
    """The places of the route in a file."""

    places: list[Place]
    notes: tuple[str, ...] = ()  # sentences on content that is not flown
    home: HomePlace | None = None


class Geometry(NamedTuple):
    """A line, or points, in a file."""

    kind: str  # name of the kind of geometry in the format
    places: list[Place]
    name: str = ""  # name that the user gave to it


def one_route(
    key: str, geometries: Sequence[Geometry], others: Sequence[str] = (), line: str | None = None
) -> Places:
    """Return the route of a file: its only line, the line that `line` chooses, or its points.

    The points are the route if the file has no line. `others` are the kinds of geometries in the
    file that cannot be a route. Raises ParameterError if there are any, or if no single route
    remains.
    """
    joined_lines = _joined([geometry for geometry in geometries if geometry.kind not in POINTS])
    lines = [geometry for geometry in joined_lines if geometry.places]
    points = [geometry for geometry in geometries if geometry.kind in POINTS]
    ignored = _counted([point.kind for point in points])
    if (lines and others) or (lines and line is None and len(lines) > 1):
        kinds = _counted([*(geometry.kind for geometry in lines), *others])
        raise ParameterError(
            f"{key}: found {kinds}, expected one, or {'Points alone' if others else _choice(lines)}"
        )
    if line is not None:
        candidates = [
            geometry for k, geometry in enumerate(lines, start=1) if line in (f"{k}", geometry.name)
        ]
        mismatch = f"{short_repr(line)}, which names {len(candidates)} lines"
        require(
            len(candidates) == 1,
            "line",
            mismatch,
            _choice(lines) if lines else "a file with several lines",
        )
        if len(lines) > 1:
            ignored = " and ".join([f"{len(lines) - 1} further lines", *[ignored] * bool(points)])
        lines = candidates
    if lines:
        return Places(
            lines[0].places,
            (f"{ignored} beside the {lines[0].kind}: no part of the route",) if ignored else (),
        )
    has = f", but {_counted(others)}" if others else ""
    require(bool(points) and not others, key, f"no LineString and no Point{has}", "a route")
    mixture = (
        f"{_counted([geometry.kind for geometry in joined_lines])} without a position, "
        f"and {ignored}"
    )
    require(not joined_lines, key, mixture, "a line, or Points alone")
    return Places([*chain.from_iterable(point.places for point in points)])


def _choice(lines: Sequence[Geometry]) -> str:
    """Write the choices of `--line`, as in "--line 1 (north), 2 or 3 (south)"."""
    names = [
        f"{k} ({geometry.name})" if geometry.name else f"{k}"
        for k, geometry in enumerate(lines[:SHOWN], start=1)
    ]
    return f"--line {', '.join(names)}{f' to {len(lines)}' if len(lines) > SHOWN else ''}"


SHOWN = 5
"""Number of lines of a file that a refusal names."""

POINTS = ("Point", "MultiPoint", "wpt")
GPX = ("rte", "trk", "wpt")  # names of elements, which have no plural


def _counted(kinds: Sequence[str]) -> str:
    """Count the kinds of geometry in words, as in "2 LineStrings and 1 Polygon"."""
    counts = []
    for kind, count in Counter(kinds).items():
        noun, *suffix = kind.split(" ", 1)
        counts.append(" ".join([f"{count} {noun}{'s' * (count > 1 and noun not in GPX)}", *suffix]))
    return " and ".join(counts)


def _joined(lines: Sequence[Geometry]) -> list[Geometry]:
    """Join parts of lines that were cut at the antimeridian.

    Source: RFC 7946, section 3.1.9.
    """
    geometries: list[Geometry] = []
    for line in lines:
        may_continue = bool(geometries and geometries[-1].places and line.places)
        end, begin = (geometries[-1].places[-1], line.places[0]) if may_continue else (None, None)
        if end is not None and begin is not None and _is_same_place(end, begin):
            geometries[-1] = geometries[-1]._replace(
                places=[*geometries[-1].places[:-1], *line.places[1:]]
            )
        else:
            geometries.append(line)
    return geometries


def _is_same_place(end: Place, begin: Place) -> bool:
    """Return whether two places are the same position on the antimeridian."""
    try:
        return bool(
            abs(end.longitude) == 180.0
            and (end.longitude, end.latitude) == (-begin.longitude, begin.latitude)
        )
    except TypeError:
        return False


def number_of(text: str | None) -> float | str | None:
    """Return the number in a text, or the text itself if it is no number."""
    try:
        return None if text is None else float(text)
    except ValueError:
        return text


def is_position(value: Any) -> bool:
    """Return whether a value is a list of two or three entries."""
    return isinstance(value, list) and 2 <= len(value) <= 3


def lon_lat(
    position: Any, speed: Any = None, above: Above = Above.AS_POSE, altitude_text: str = ""
) -> Place:
    """Read a position of GeoJSON or KML, which is longitude, latitude and perhaps altitude."""
    require(is_position(position), "route", short_repr(position), "longitude, latitude, altitude")
    longitude, latitude, *altitude = position
    return Place(
        key="route",
        latitude=latitude,
        longitude=longitude,
        altitude=altitude[0] if altitude else None,
        speed=speed,
        above=above,
        altitude_text=altitude_text or short_repr(position),
    )
