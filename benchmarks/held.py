# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Ticks that were missed, told apart from those that the machine took: pure."""

from collections.abc import Iterable, Sequence

Intervals = Sequence[tuple[int, int]]
"""Begin and end of each, monotonic ns."""


def missed_by_itself(skipped: Intervals, held: Iterable[tuple[int, int]], period_ns: int) -> int:
    """Deadlines missed, less those for which the machine accounts.

    `skipped`: each from the first deadline missed until the tick that came at last. `held`: when a core of the machine ran
    nothing of ours, on whichever core, for the scheduler may have put the process on any. What is left of a skip, in whole
    periods, counts.
    """
    ordered = sorted(held)
    return sum((until - since - _shared(since, until, ordered)) // period_ns for since, until in skipped)


def _shared(since: int, until: int, ordered: Intervals) -> int:
    """Time in [since, until] that lies in any of the intervals, which may overlap."""
    shared = 0
    for begin, end in ordered:
        length = min(end, until) - max(begin, since)
        if length > 0:
            shared, since = shared + length, min(end, until)
    return shared
