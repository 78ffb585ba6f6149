# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute lateness and missed ticks without what delays of the host's scheduler explain."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Intervals = Sequence[tuple[int, int]] | NDArray[np.int64]
"""Begin and end of each, ns."""


def missed_excluding_delays(skipped: Intervals, delays: Intervals, period_ns: int) -> int:
    """Count the missed deadlines that host delays do not explain.

    `skipped` are the times from the first missed deadline to the next tick. The rest of each counts
    in whole periods.
    """
    return int(np.sum(excluding_delays(skipped, delays) // period_ns))


def excluding_delays(intervals: Intervals, delays: Intervals) -> NDArray[np.int64]:
    """Return the length of each interval outside of the host delays, ns, shape (N,).

    `delays` are times in which a core ran none of our processes; they may overlap. All cores count,
    since the scheduler may run the process on any.
    """
    begin, end = np.asarray(intervals, dtype=np.int64).reshape(-1, 2).T
    origin = int(begin.min(initial=np.iinfo(np.int64).max))
    # of the disjoint delays: begins and ends after the origin, and the time in delays until each
    edges = [0]
    total = [0]
    for since, until in sorted(
        (int(begin_ns) - origin, int(end_ns) - origin) for begin_ns, end_ns in delays
    ):
        first = max(since, edges[-1])
        if until > first:
            edges += [first, until]
            total += [total[-1], total[-1] + until - first]
    delayed = [np.interp(instants - origin, edges, total) for instants in (begin, end)]
    result: NDArray[np.int64] = end - begin - np.rint(delayed[1] - delayed[0]).astype(np.int64)
    return result
