# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define the zones of a fence, and compute the distance from the fence.

The functions take NumPy or JAX arrays of any shape.
"""

import math
from functools import lru_cache, reduce
from itertools import chain
from typing import NamedTuple

import numpy as np

from flight_core.vectors import Array, FloatArray, array_namespace

CHORDS = 180
"""Number of chords that replace a circle if there are several groups. They are off the circle by at
most 0.15 thousandths of the radius."""

SEAM = 1e-3
"""Groups with a gap of at most this between them share a border and are one region, m. The rounding
of positions is smaller."""


class Zone(NamedTuple):
    """A zone of a fence: a polygon, or a circle as a single point with a radius."""

    north: tuple[float, ...]  # m
    east: tuple[float, ...]  # m
    radius: float = 0.0  # m, 0 for a polygon
    exclude: bool = False  # whether the aircraft must keep out of the zone
    # number of the zone's group if the aircraft must stay in a zone of the group; None if the zone
    # is alone
    group: int | None = None


class Fence(NamedTuple):
    """A fence: its zones, and home.

    The aircraft must stay inside all zones of at least one group, and outside each zone with
    `exclude`.
    """

    zones: tuple[Zone, ...]
    home: tuple[float, float] = (0.0, 0.0)  # north, east, m
    radius: float = 0.0  # m, radius of the orbit round home


@lru_cache(maxsize=64)
def _edges(zone: Zone) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the edges of a polygon, as `_border` does, (M,) each."""
    start_north = np.array(zone.north)
    start_east = np.array(zone.east)
    edge_north = np.roll(start_north, -1) - start_north
    edge_east = np.roll(start_east, -1) - start_east
    return start_north, start_east, edge_north, edge_east


def inside(zone: Zone, north: Array, east: Array) -> Array:
    """Return the distance from the border of a zone, m, positive in the polygon or circle."""
    xp = array_namespace(north)
    if zone.radius:
        return zone.radius - xp.hypot(north - zone.north[0], east - zone.east[0])
    start_north, start_east, edge_north, edge_east = _edges(zone)
    distance = _distance(start_north, start_east, edge_north, edge_east, north, east)
    x = north[..., None] - start_north
    y = east[..., None] - start_east
    # An edge that runs east crosses no ray to the east.
    level = np.where(edge_north == 0.0, 1.0, edge_north)
    # Count the edges that a ray to the east crosses, by the even-odd rule.
    crossed = ((x < 0.0) != (x < edge_north)) & (y < x * edge_east / level)
    return xp.where(xp.sum(crossed, axis=-1) % 2 == 1, distance, -distance)


def _distance(
    start_north: FloatArray,
    start_east: FloatArray,
    edge_north: FloatArray,
    edge_east: FloatArray,
    north: Array,
    east: Array,
) -> Array:
    """Return the distance of each place from the nearest edge, m."""
    xp = array_namespace(north)
    x = north[..., None] - start_north
    y = east[..., None] - start_east
    share = xp.clip((x * edge_north + y * edge_east) / (edge_north**2 + edge_east**2), 0.0, 1.0)
    return xp.min(xp.hypot(x - share * edge_north, y - share * edge_east), axis=-1)


def clearance(zones: tuple[Zone, ...], north: Array, east: Array) -> Array:
    """Return the distance from the fence, m, negative outside."""
    xp = array_namespace(north)
    groups = _groups(zones)
    out = [-inside(zone, north, east) for zone in zones if zone.exclude]
    if not groups:
        return reduce(xp.minimum, out)
    stay = _deepest(groups, north, east)
    # A border of one group that lies inside another group does not count.
    if len(groups) > 1:
        stay = xp.where(
            stay >= 0.0, xp.maximum(stay, _distance(*_border(groups), north, east)), stay
        )
    return reduce(xp.minimum, [stay, *out])


def _groups(zones: tuple[Zone, ...]) -> tuple[tuple[Zone, ...], ...]:
    """Return the zones to stay in, one tuple for each group."""
    groups: dict[tuple[int | None, int], tuple[Zone, ...]] = {}
    for k, zone in enumerate(zones):
        if not zone.exclude:
            key = (zone.group, k if zone.group is None else 0)
            groups[key] = (*groups.get(key, ()), zone)
    return tuple(groups.values())


def _deepest(groups: tuple[tuple[Zone, ...], ...], north: Array, east: Array) -> Array:
    """Return how deep a place is inside a group of zones, m; negative outside of all groups.

    The depth in a group is the distance from the nearest border of its zones. If a place is in
    several groups, the largest depth is returned.
    """
    xp = array_namespace(north)
    depths = []
    for group in groups:
        insides = [inside(zone, north, east) for zone in group]
        depths.append(reduce(xp.minimum, insides))
    return reduce(xp.maximum, depths)


@lru_cache(maxsize=64)
def _border(
    groups: tuple[tuple[Zone, ...], ...],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Compute the border of all groups together as M edges.

    Returns the north and east of their starts, and their lengths to the north and to the east, m,
    (M,) each. Each edge of a zone is cut where other edges cross or touch it. A piece belongs to
    the border if only one of its sides is inside.
    """
    groups = tuple(tuple(map(_polygon, group)) for group in groups)
    corners = [np.column_stack([zone.north, zone.east]) for zone in chain.from_iterable(groups)]
    starts = np.concatenate(corners)
    ends = np.concatenate([np.roll(ring, -1, axis=0) for ring in corners])
    pieces = [_cut(start, end, starts, ends) for start, end in zip(starts, ends, strict=True)]
    start, end = (np.concatenate(column) for column in zip(*pieces, strict=True))
    edge = end - start
    middle = (start + end) / 2.0
    shift = (
        SEAM
        * np.column_stack([-edge[:, 1], edge[:, 0]])
        / np.hypot(edge[:, 0], edge[:, 1])[:, None]
    )
    sides = [_deepest(groups, *(middle + side * shift).T) >= 0.0 for side in (1.0, -1.0)]
    on_border = sides[0] != sides[1]
    return start[on_border, 0], start[on_border, 1], edge[on_border, 0], edge[on_border, 1]


def _polygon(zone: Zone) -> Zone:
    """Return a zone as a polygon; a circle becomes a polygon of CHORDS edges."""
    if not zone.radius:
        return zone
    angles = [2.0 * math.pi * k / CHORDS for k in range(CHORDS)]
    north = tuple(zone.north[0] + zone.radius * math.cos(angle) for angle in angles)
    east = tuple(zone.east[0] + zone.radius * math.sin(angle) for angle in angles)
    return zone._replace(north=north, east=east, radius=0.0)


def _cut(
    start: FloatArray, end: FloatArray, starts: FloatArray, ends: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Cut an edge into P pieces, and return their starts and ends, shapes (P, 2).

    The edge is cut where another edge crosses it or begins on it.
    """
    edge = end - start
    edges = ends - starts
    to_start = starts - start
    length = math.hypot(*edge)
    across = edge[0] * edges[:, 1] - edge[1] * edges[:, 0]
    parallel = across == 0.0
    divisor = np.where(parallel, 1.0, across)
    cut_at = (to_start[:, 0] * edges[:, 1] - to_start[:, 1] * edges[:, 0]) / divisor
    along = (to_start[:, 0] * edge[1] - to_start[:, 1] * edge[0]) / divisor
    crosses = ~parallel & (along > 0.0) & (along < 1.0)
    begins_at = to_start @ edge / length**2
    begins = abs(edge[0] * to_start[:, 1] - edge[1] * to_start[:, 0]) < SEAM * length
    cuts = np.concatenate([cut_at[crosses], begins_at[begins]])
    shares = np.unique(np.round([0.0, 1.0, *cuts[(cuts > 0.0) & (cuts < 1.0)]], 12))
    points = start + shares[:, None] * edge
    return points[:-1], points[1:]


def clearance_text(distance: float) -> str:
    """Write a distance of `clearance` in words: "9 m inside of the fence"."""
    return f"{abs(distance):.0f} m {'inside' if distance >= 0.0 else 'outside'} of the fence"
