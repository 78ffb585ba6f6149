# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What holds for every aircraft of a box: up to which deviation the loop is stable, and which disk
margins remain.

The deviations are constant in time and the loop is linear: no saturation, no rate limit.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from flight_analysis.closed_loop.loop_margins import LinearLoop
from flight_core.parameters import require
from flight_core.vectors import FloatArray
from rise_di_controller.linear_loop import closed_loop, is_stable
from rise_di_controller.structured_value import Cover, cover
from rise_di_controller.uncertain_loop import UncertainLoop, aircraft_at, parts_of, uncertain_loop
from rise_di_controller.worst_case import first_unstable

LARGEST = 0.99  # part of an entry up to which an unstable aircraft is sought
LEAST_LEVEL = 0.1  # of the bound: a loop stable beyond ten times the box counts as stable to there
WIDEST_DISK = 2.0  # a disk of 2 leaves 180 deg
EXACT = 1.002  # factor on the deviations of an unstable aircraft until the exact loop confirms it
CONFIRMED = 10  # such factors that are tried


class Unstable(NamedTuple):
    """An unstable aircraft."""

    deviation: float  # largest relative deviation of an entry
    frequency: float  # rad/s
    entries: dict[str, float]  # relative deviation by entry


class Guarantee(NamedTuple):
    """What holds for every aircraft of a box; `stable` and `unstable` as parts of each entry."""

    uncertainty: float  # largest relative deviation in the box
    stable: float  # every aircraft within this deviation is stable, at most 1
    frequency: float  # rad/s, of the limit
    unstable: Unstable | None  # the first one found; None up to LARGEST
    inputs: tuple[str, ...]
    disk: FloatArray  # (m,) balanced disk margin that every aircraft of the box has, an input open
    disk_all: float  # with independent disks in all inputs at once
    late: float = 0.0  # s: u is late by an unknown time of 0 to this

    @property
    def holds(self) -> bool:
        """Whether every aircraft of the box is stable."""
        return self.stable >= self.uncertainty


def guarantee(linear: LinearLoop, late: float = 0.0) -> Guarantee:
    """The guarantee for the box of a loop, with u late by an unknown constant time of 0 to `late`,
    s, in each input. Raises ParameterError for a loop without a box.
    """
    box = linear.box
    require(box is not None, "uncertainty", "0", "an uncertainty above 0 for a guarantee")
    assert box is not None  # noqa: S101 - for mypy
    largest = float(np.max(box.part))
    m = len(linear.inputs)
    none = Guarantee(largest, 0.0, 0.0, None, linear.inputs, np.zeros(m), 0.0, late)
    if not is_stable(linear.nominal, linear.law, linear.loop, np.full(m, late / 2.0)):
        return none
    whole = uncertain_loop(linear.nominal, linear.law, linear.loop, box, late)
    parts = parts_of(whole)
    covers = [cover(part, LEAST_LEVEL) for part in parts]
    none_coupled = Cover(LEAST_LEVEL, 0.0, 0)
    limit = max(covers, key=lambda covered: covered.level, default=none_coupled)
    by_entries = {part.entries: covered for part, covered in zip(parts, covers, strict=True)}
    found = none._replace(
        stable=min(float(largest / limit.level), 1.0),
        frequency=limit.peak,
        unstable=_first_unstable(linear, late, by_entries),
    )
    if not found.holds:
        return found
    disk_all = _disk(whole, tuple(range(m)))
    # disks in all inputs at once cover a disk in one
    each = [max(_disk(whole, (i,)), disk_all) for i in range(m)]
    return found._replace(disk=np.array(each), disk_all=disk_all)


def _first_unstable(
    linear: LinearLoop, late: float, covers: Mapping[tuple[int, ...], Cover]
) -> Unstable | None:
    """The first unstable aircraft found, u in time or late by the whole time, near the peaks of
    the covers of its entries.
    """
    every_peak = [covered.peak for covered in covers.values()]
    box = linear.box
    assert box is not None  # noqa: S101 - for mypy
    candidates = []
    for extra in sorted({0.0, late}):
        loop = linear.loop._replace(delay=linear.loop.delay + extra)
        delayed = linear._replace(loop=loop)
        whole = uncertain_loop(linear.nominal, linear.law, loop, box)
        for part in parts_of(whole):
            cover_of_part = covers.get(part.entries)
            peaks = every_peak if cover_of_part is None else [cover_of_part.peak]
            for w in sorted({*peaks, 0.0}):  # a slow divergence hides beside a peak
                reached = first_unstable(part, w, len(box.names), LARGEST / float(box.part.max()))
                confirmed = None if reached is None else _confirmed(delayed, reached[1])
                candidates += [] if confirmed is None else [confirmed]
    return min(candidates, key=lambda each: each.deviation, default=None)


def _disk(whole: UncertainLoop, inputs: tuple[int, ...]) -> float:
    """The disk margin of every aircraft of the box, the least of the parts with some inputs."""
    levels = [cover(part, 1.0 / WIDEST_DISK, disks=True).level for part in parts_of(whole, inputs)]
    return 1.0 / max(levels, default=1.0 / WIDEST_DISK)


def _confirmed(linear: LinearLoop, d: FloatArray) -> Unstable | None:
    """The aircraft of deviations d, a little larger where the exact loop asks for it."""
    box = linear.box
    assert box is not None  # noqa: S101 - for mypy
    still = np.zeros(len(linear.inputs))
    for _ in range(CONFIRMED):
        aircraft = aircraft_at(linear.nominal, box, d)
        if not is_stable(aircraft, linear.law, linear.loop, still):
            matrix = closed_loop(aircraft, linear.law, linear.loop, still)
            z = np.linalg.eigvals(matrix)
            turn = abs(np.angle(z[int(np.argmax(np.abs(z)))]))
            parts = d * box.part
            entries = {
                name: float(part) for name, part in zip(box.names, parts, strict=True) if part
            }
            return Unstable(float(np.abs(parts).max()), turn / linear.loop.period, entries)
        d = EXACT * d
    return None
