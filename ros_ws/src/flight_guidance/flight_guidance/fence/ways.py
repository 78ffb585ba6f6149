# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the ways home inside a fence, and the ways back into it from outside.

A map of square cells stores the ways. It is made once for a fence. The map has the shortest ways
over cells that stay inside the fence and, where possible, leave room for a turn. Each cell has an
aim: the place that an aircraft on this way reaches after a distance of about `Fence.radius`. An
aircraft comes home if it always flies straight towards the aim of the cell in which it is.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.vectors import Array, FloatArray, array_namespace
from flight_guidance.fence.zones import Fence, clearance

CELLS_PER_RADIUS = 4
"""Cells per radius: a circle round home has 25 cells around it, and a turn of 180 deg crosses 8."""

MOST_CELLS = 100
"""Largest number of cells along the longer side of the map, so that a large fence takes a
second."""

STEPS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
"""Steps in rows and columns from a cell to its neighbours."""

POINTS = 64
"""Number of points of a line, or of a turn, at which the clearance is computed."""


class Ways(NamedTuple):
    """The ways home on a grid of cells: the aim of each cell, and whether its way home is straight.

    A straight way leads onto the orbit round home. The arrays have shape (rows, columns).
    """

    corner: tuple[float, float]  # north, east of the first cell, m
    cell: float  # m, length of a cell's side
    north: FloatArray  # m, north of the aims
    east: FloatArray  # m, east of the aims
    straight: NDArray[np.bool_]

    def aim(self, fence: Fence, north: Array, east: Array) -> tuple[Array, Array, Array]:
        """Return towards which aims to fly from some places, and whether the way home is straight.

        The aims are north and east, m. A place outside of the grid has the nearest cell as its aim.
        """
        xp = array_namespace(north)
        rows, columns = self.straight.shape
        row_at = (north - self.corner[0]) / self.cell
        column_at = (east - self.corner[1]) / self.cell
        row = xp.clip(xp.round(row_at), 0, rows - 1).astype(np.int32)
        column = xp.clip(xp.round(column_at), 0, columns - 1).astype(np.int32)
        on_map = (abs(row_at - row) < 1.0) & (abs(column_at - column) < 1.0)
        straight = xp.asarray(self.straight)[row, column] & on_map
        orbit_north, orbit_east = onto_orbit(fence, north, east)
        cell_north = self.corner[0] + self.cell * row
        cell_east = self.corner[1] + self.cell * column
        aim_north = xp.where(on_map, xp.asarray(self.north)[row, column], cell_north)
        aim_east = xp.where(on_map, xp.asarray(self.east)[row, column], cell_east)
        return (
            xp.where(straight, orbit_north, aim_north),
            xp.where(straight, orbit_east, aim_east),
            straight,
        )


def onto_orbit(fence: Fence, north: Array, east: Array) -> tuple[Array, Array]:
    """Return where the tangent from a place touches the clockwise orbit round home.

    For a place inside the orbit, the result is the place 1 m ahead along the orbit.
    """
    xp = array_namespace(north)
    x = fence.home[0] - north
    y = fence.home[1] - east
    distance = xp.maximum(xp.hypot(x, y), 1e-6)
    # Home is to the right of the tangent. Inside the orbit the course is perpendicular to the
    # bearing of home.
    offset = xp.asin(xp.minimum(fence.radius / distance, 1.0))
    length = xp.maximum(xp.sqrt(xp.maximum(distance**2 - fence.radius**2, 0.0)), 1.0)
    along = xp.cos(offset) * length / distance
    across = xp.sin(offset) * length / distance
    return north + along * x + across * y, east + along * y - across * x


def line_clearance(
    fence: Fence, north: Array, east: Array, to_north: Array, to_east: Array
) -> Array:
    """Return the least clearance along each of some straight lines, m."""
    share = np.linspace(0.0, 1.0, POINTS).reshape(-1, *(1,) * np.ndim(north))
    on_north = north + share * (to_north - north)
    on_east = east + share * (to_east - east)
    return array_namespace(north).min(clearance(fence.zones, on_north, on_east), axis=0)


@lru_cache(maxsize=64)
def ways(fence: Fence) -> Ways:
    """Compute the ways home inside a fence on a grid of cells.

    A cell is open if the clearance at its centre exceeds half a cell. A way leads from an open cell
    to a neighbour if the circles round their centres, with their clearances as radii, overlap. The
    line between the centres is then inside the fence. The way home is the cheapest one. A metre of
    a way costs 1, or `radius / clearance` where the clearance is smaller than the radius.

    The aim of an open cell is the place on its way home after a distance of about the radius. If
    there is no way home, the way leads to the cell with the largest clearance nearby, where the
    aircraft holds. In a closed cell inside the fence, the way leads away from the border. The aim
    of a cell outside is the nearest cell with a way home.
    """
    north, east, cell = _cells(fence)
    room = clearance(fence.zones, north, east)
    half = cell / 2.0
    is_open = room > half
    home = np.unravel_index(
        np.argmin(np.hypot(north - fence.home[0], east - fence.home[1])), room.shape
    )
    seeds = np.zeros(room.shape, dtype=bool)
    seeds[home] = True
    cost = np.maximum(fence.radius / np.maximum(room, half), 1.0)
    to_go, following = _shortest(seeds, room, cost, cell)
    leads_home = np.isfinite(to_go)
    if (is_cut_off := is_open & ~leads_home).any():
        lost_room = np.where(is_cut_off, room, -math.inf)
        roomiest = is_cut_off & (room >= np.max(_neighbours(lost_room, -math.inf), axis=0))
        _, held = _shortest(roomiest, lost_room, cost, cell)
        following = np.where(is_cut_off, held, following)
    following = np.where(~is_open & (room >= 0.0), _uphill(room), following)
    aim = following
    for _ in range(CELLS_PER_RADIUS - 1):
        aim = following.ravel()[aim]
    aim_north = north.ravel()[aim]
    aim_east = east.ravel()[aim]
    if (outside := room < 0.0).any() and leads_home.any():
        nearest = _nearest(north[outside], east[outside], north[leads_home], east[leads_home])
        aim_north[outside] = north[leads_home][nearest]
        aim_east[outside] = east[leads_home][nearest]
    corner = (float(north[0, 0]), float(east[0, 0]))
    return Ways(
        corner=corner,
        cell=cell,
        north=aim_north,
        east=aim_east,
        straight=_is_straight(fence, north, east, room, cell),
    )


def _cells(fence: Fence) -> tuple[FloatArray, FloatArray, float]:
    """Return the centres of the cells, north and east, m, and the size of a cell, m.

    The cells cover all zones, home and the surroundings.
    """
    sides = list[tuple[float, float]]()
    for axis in ("north", "east"):
        reach = []
        for zone in fence.zones:
            reach += [(value, zone.radius) for value in getattr(zone, axis)]
        reach.append((fence.home[len(sides)], 0.0))
        sides.append(
            (
                min(value - radius for value, radius in reach),
                max(value + radius for value, radius in reach),
            )
        )
    longest = max(most - least for least, most in sides)
    around = 2.0 * fence.radius + 0.1 * longest
    cell = max(fence.radius / CELLS_PER_RADIUS, (longest + 2.0 * around) / MOST_CELLS)
    counts = [math.ceil((most - least + 2.0 * around) / cell) + 1 for least, most in sides]
    north, east = (
        least - around + cell * np.arange(count)
        for (least, _), count in zip(sides, counts, strict=True)
    )
    return *np.meshgrid(north, east, indexing="ij"), cell


def _neighbours(values: FloatArray, fill: float) -> list[FloatArray]:
    """Return the values of the neighbours at STEPS; a neighbour outside of the map has `fill`."""
    padded = np.pad(values, 1, constant_values=fill)
    rows, columns = values.shape
    return [
        padded[1 + row : 1 + row + rows, 1 + column : 1 + column + columns] for row, column in STEPS
    ]


def _uphill(values: FloatArray) -> NDArray[np.intp]:
    """Return the neighbour of each cell towards which the values rise the most.

    If no neighbour of a cell has a larger value, as on a peak, the result is the cell itself.
    """
    slopes = np.gradient(values)
    steepness = np.maximum(np.hypot(*slopes), 1e-6)
    last = np.array(values.shape).reshape(2, 1, 1) - 1
    row, column = np.clip(
        np.indices(values.shape) + np.round(slopes / steepness).astype(np.intp), 0, last
    )
    return np.asarray(row * values.shape[1] + column)


def _shortest(
    seeds: NDArray[np.bool_], room: FloatArray, cost: FloatArray, cell: float
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Find the weighted length of each cell's shortest way to a seed, and the next cell on it.

    For a seed, and for a cell without a way, the next cell is the cell itself. The method of
    Bellman and Ford updates the lengths of all cells at once, until no length changes.
    """
    lengths = [cell * math.hypot(*step) for step in STEPS]
    costs = _neighbours(cost, math.inf)
    rooms = _neighbours(room, -math.inf)
    edges = np.array(
        [
            np.where(room + room_beside > length, length * (cost + cost_beside) / 2.0, math.inf)
            for length, cost_beside, room_beside in zip(lengths, costs, rooms, strict=True)
        ]
    )
    to_go = np.where(seeds, 0.0, math.inf)
    while True:
        through = edges + np.array(_neighbours(to_go, math.inf))
        shorter = np.minimum(to_go, through.min(axis=0))
        if np.array_equal(shorter, to_go):
            break
        to_go = shorter
    cells = np.arange(room.size).reshape(room.shape)
    best = through.argmin(axis=0)
    moves = np.array([row * room.shape[1] + column for row, column in STEPS])
    return to_go, np.where(np.isfinite(to_go) & ~seeds, cells + moves[best], cells)


def _nearest(
    north: FloatArray, east: FloatArray, to_north: FloatArray, to_east: FloatArray
) -> NDArray[np.intp]:
    """Return the index of the nearest place of the second set for each place of the first."""
    rows = [
        np.argmin((to_north - n) ** 2 + (to_east - e) ** 2)
        for n, e in zip(north, east, strict=True)
    ]
    return np.array(rows, dtype=np.intp)


def _is_straight(
    fence: Fence, north: FloatArray, east: FloatArray, room: FloatArray, cell: float
) -> NDArray[np.bool_]:
    """Return whether the line from each cell onto the orbit round home is free.

    The line is free if its clearance is everywhere at least the side of a cell. If an end of the
    line has a smaller clearance, the rest of the line must have at least the clearance of this end.
    """
    to_north, to_east = onto_orbit(fence, north, east)
    at_end = clearance(fence.zones, to_north, to_east)
    bound = np.minimum(np.minimum(room, at_end), cell)
    least = np.full(room.shape, math.inf)
    for share in np.linspace(0.0, 1.0, sum(room.shape)):
        on_line = clearance(
            fence.zones, north + share * (to_north - north), east + share * (to_east - east)
        )
        least = np.minimum(least, on_line)
    return np.asarray((room >= 0.0) & (least >= bound - 1e-6))
