# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Divide the ticks of a course into compiled loops, with or without branches.

A GPU waits for the host at each branch. The phase and the forcing of each tick are known before the
flight. So the ticks can be divided into runs, each with a loop that needs no branch. A CPU is
faster with a single loop that has branches.
"""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from flight_campaign.batch.campaign_course import ENGAGE, Course

RUN = 120
"""Largest number of ticks of a run without branches. If forcing acts at one of its ticks, the whole
run counts as forced."""

UNROLL = 4
"""Least number of ticks in a step of the loop. On one H200, 250,000 flights of 60 s took 3.3 s with
1 tick, and 1.8 s with 4 or 8. The compilation took 3 s with 1 tick, 7 s with 4, and 14 s with 8."""

LONGEST = 20  # number of ticks of the longest pattern; a pattern is compiled tick by tick


class TickKind(NamedTuple):
    """What is known of a tick when the loop is compiled.

    If a property is not known, it is None, and the tick has a branch that depends on it.
    """

    phase: int | None
    is_forced: bool | None  # whether biases, gusts or turbulence act


UNKNOWN = TickKind(None, None)  # branches at the tick depend on both properties


class TickRun(NamedTuple):
    """A run of ticks that one compiled loop computes.

    The kinds of its ticks repeat a pattern. The tuple is hashable.
    """

    length: int  # number of ticks, a multiple of the pattern's length
    pattern: tuple[TickKind, ...]
    patterns_per_step: int  # of the loop


Schedule = Callable[[Course], Iterator[TickRun]]
"""Splits a course into runs."""


def with_branches(course: Course) -> Iterator[TickRun]:
    """Yield a single run for the whole course, with branches at each tick."""
    yield TickRun(len(course.segments.t), (UNKNOWN,), 1)


def without_branches(course: Course) -> Iterator[TickRun]:
    """Split a course into runs of at most RUN ticks.

    Most runs have the same length and the same kinds of ticks, so they share a compiled loop.

    If the phases of a run have no short pattern, for example because of dropouts, its loop branches
    by the phase at every tick.
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
    """Return the shortest pattern that the kinds repeat, or None if it exceeds LONGEST ticks."""
    for length in range(1, min(len(kinds), LONGEST) + 1):
        repeats, rest = divmod(len(kinds), length)
        if not rest and kinds[:length] * repeats == kinds:
            return tuple(kinds[:length])
    return None
