# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find how near the aircraft of a fleet came to each other."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from flight_analysis.metrics.errors import best_pose
from flight_core.outcome import Aim, Shortfall
from flight_core.rates import seconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray

SEPARATION = 22.0
"""Default of the least distance of two aircraft, m. It is the sum of the spans of two Cessna 172,
11.0 m each (Cessna 172S specifications), which are the widest shipped aircraft."""

PLACE = ("north", "east", "altitude")  # m


class Track(NamedTuple):
    """Where an aircraft was: its positions over time in the channels of PLACE."""

    start_ns: int  # stamp of t = 0 of this aircraft's flight
    place: Signal
    # origin of the map, from which the positions are measured
    origin: tuple[float, ...] | None = None


@dataclass(frozen=True, kw_only=True, order=True)
class Approach:
    """The least distance of two aircraft, m, and the stamp at which it occurred."""

    distance: float
    at_ns: int


def place_of(tape: Tape) -> Signal | None:
    """Return where an aircraft was: the true position if it is logged, else the measured one.

    Returns None if there is no pose.
    """
    pose = best_pose(tape)
    if pose is None or not set(PLACE) <= set(pose.names):
        return None
    return Signal(pose.stamp_ns, PLACE, np.column_stack([pose[name] for name in PLACE]))


def approach(first: Signal, second: Signal) -> Approach | None:
    """Return the least distance of two aircraft, or None if they have no time in common.

    Between two samples each aircraft is taken to move in a straight line. Let d_0 and d_1 be the
    differences of the two positions at the ends of such an interval, and v = d_1 - d_0. The
    aircraft are nearest at the fraction -d_0 v / v^2 of the interval, if this lies between 0 and 1.
    """
    begin_ns = max(int(first.stamp_ns[0]), int(second.stamp_ns[0]))
    end_ns = min(int(first.stamp_ns[-1]), int(second.stamp_ns[-1]))
    if begin_ns > end_ns:
        return None
    stamps = np.union1d(first.stamp_ns, second.stamp_ns)
    stamps = np.union1d(
        stamps[(stamps >= begin_ns) & (stamps <= end_ns)], np.array([begin_ns, end_ns])
    )
    # Times count from an instant of the flight, because float64 does not resolve 1 ns in a time of
    # day.
    t = (stamps - begin_ns).astype(float)
    d = _at(first, t, begin_ns) - _at(second, t, begin_ns)
    v = np.diff(d, axis=0)
    square = np.sum(v * v, axis=1)
    projection = -np.sum(d[:-1] * v, axis=1)
    part = np.clip(np.divide(projection, square, out=np.zeros_like(square), where=square > 0), 0, 1)
    nearest = np.append(np.linalg.norm(d[:-1] + part[:, None] * v, axis=1), np.linalg.norm(d[-1]))
    k = int(np.argmin(nearest))
    at_ns = int(stamps[k]) + (round(part[k] * float(t[k + 1] - t[k])) if k < len(part) else 0)
    return Approach(distance=float(nearest[k]), at_ns=at_ns)


def _at(signal: Signal, t: FloatArray, begin_ns: int) -> FloatArray:
    """Interpolate the positions to the times t, (N, 3), where t is in ns since `begin_ns`."""
    own = (signal.stamp_ns - begin_ns).astype(float)
    return np.column_stack([np.interp(t, own, signal[name]) for name in PLACE])


def separation_shortfalls(tracks: Mapping[str, Track], least: float) -> dict[str, Shortfall]:
    """Return the shortfall of each aircraft that came nearer to another one than `least`, m.

    Aircraft are not compared if their maps have different origins.
    """
    near: dict[str, dict[str, Approach]] = {}
    for names in combinations(tracks, 2):
        first, second = (tracks[name] for name in names)
        found = approach(first.place, second.place) if first.origin == second.origin else None
        if found is not None and found.distance < least:
            for name, companion in (names, names[::-1]):
                near.setdefault(name, {})[companion] = found
    shortfalls = {}
    for name, approaches in near.items():
        other, closest = min(approaches.items(), key=lambda pair: pair[1])
        time = seconds(closest.at_ns - tracks[name].start_ns)
        more = f", nearer than that to {len(approaches)} aircraft" if len(approaches) > 1 else ""
        shortfalls[name] = Shortfall(
            aim=Aim.SEPARATION,
            sentence=f"{closest.distance:.3g} m from {other} at t = {time:.2f} s, "
            f"{least:g} m asked{more}",
            figures={
                "other": other,
                "distance": closest.distance,
                "time": time,
                "least": least,
                "count": len(approaches),
            },
        )
    return shortfalls
