# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Missed ticks without those that host scheduling delays (steal time) explain; pure."""

from collections.abc import Iterable, Sequence

Intervals = Sequence[tuple[int, int]]  # begin and end of each, monotonic ns


def missed_excluding_delays(skipped: Intervals, delays: Iterable[tuple[int, int]], period_ns: int) -> int:
    """Missed deadlines, excluding host delays.

    `skipped`: from the first missed deadline to the next tick. `delays`: when a core ran none of our processes. All cores
    count, since the scheduler may run the process on any. The rest of each skip counts in whole periods.
    """
    ordered = sorted(delays)
    return sum((until - since - _overlap(since, until, ordered)) // period_ns for since, until in skipped)


def _overlap(since: int, until: int, ordered: Intervals) -> int:
    """Time in [since, until] that lies in any of the intervals; they may overlap."""
    overlap = 0
    for begin, end in ordered:
        length = min(end, until) - max(begin, since)
        if length > 0:
            overlap, since = overlap + length, min(end, until)
    return overlap
