# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""How the loop over the ticks of a course is compiled: with branches, or in runs of known ticks.

A GPU waits for the host at each branch. Phase and forcing are known before the flight, so each run
of ticks has a loop without a branch. A CPU is faster with one loop.
"""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from flight_campaign.batch.campaign_course import ENGAGE, Course

RUN = 120
"""Ticks of a run. A run is forced if a tick of it is."""

UNROLL = 4
"""Ticks of a step of the loop. On one H200, 250,000 aircraft of 60 s took 3.3 s with 1, 1.8 s with
4 and with 8, which compile for 3, 7 and 14 s."""

LONGEST = 20  # ticks of a pattern, which is compiled tick by tick


class TickKind(NamedTuple):
    """What is known of a tick when the loop is compiled; None: a branch asks at the tick."""

    phase: int | None
    forced: bool | None  # whether biases, gusts or turbulence act


UNKNOWN = TickKind(None, None)  # a branch asks for both at the tick


class TickRun(NamedTuple):
    """Ticks in one loop: a pattern of kinds again and again. Hashable."""

    length: int  # ticks, a multiple of the pattern
    pattern: tuple[TickKind, ...]
    unroll: int  # patterns a step of the loop


Schedule = Callable[[Course], Iterator[TickRun]]
"""The runs of a course."""


def with_branches(course: Course) -> Iterator[TickRun]:
    """One loop, whose branches ask at each tick."""
    yield TickRun(len(course.segments.t), (UNKNOWN,), 1)


def without_branches(course: Course) -> Iterator[TickRun]:
    """Split a course into runs of at most RUN ticks: few loops are compiled, each used often.

    A run whose phases have no short pattern, for example because of dropouts, branches by the phase
    at every tick.
    """
    phase = course.segments.phase
    ticks = len(phase)
    is_forced = (course.segments.forcing != 0.0).any(axis=1)
    engaging = np.flatnonzero(phase == ENGAGE)
    cuts = np.unique([0, *engaging, *(engaging + 1), ticks])
    for begin, end in pairwise(cuts.tolist()):
        for first in range(begin, end, RUN):
            run = slice(first, min(first + RUN, end))
            forced = bool(is_forced[run].any())
            kinds = [TickKind(int(phase_of_tick), forced) for phase_of_tick in phase[run]]
            pattern = _pattern(kinds) or (TickKind(None, forced),)
            yield TickRun(len(kinds), pattern, max(UNROLL // len(pattern), 1))


def _pattern(kinds: list[TickKind]) -> tuple[TickKind, ...] | None:
    """Return the shortest pattern that the kinds repeat; None if it is longer than LONGEST."""
    for length in range(1, min(len(kinds), LONGEST) + 1):
        repeats, rest = divmod(len(kinds), length)
        if not rest and kinds[:length] * repeats == kinds:
            return tuple(kinds[:length])
    return None
