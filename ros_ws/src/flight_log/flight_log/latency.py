# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the latency of the loop from y to u, from the recorded times of sending."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal

CHANNEL = "y_to_u"
TOPICS = ("y", "u")


class Times(NamedTuple):
    """When the messages of a topic were stamped and when they were sent, ns, (N,) each."""

    stamp_ns: NDArray[np.int64]
    sent_ns: NDArray[np.int64]


def latency(times: Mapping[str, Sequence[Times]]) -> Signal | None:
    """Compute the time from the sending of y to the sending of the u with the same stamp, s.

    The signal has one channel, and the stamps of u. `times` has the times by the full names of the
    topics y and u. Returns None for a log without y or u, and for a log with several aircraft.
    Returns None also if u was sent at the times of y, as in a flight in one process.
    """
    topics = {topic.rpartition("/")[2]: topic for topic in times}
    if len(times) != len(TOPICS) or len(topics) != len(TOPICS) or not all(times.values()):
        return None
    y, u = (_last_of_each(times[topics[name]]) for name in TOPICS)
    stamps, place_y, place_u = np.intersect1d(
        y.stamp_ns, u.stamp_ns, assume_unique=True, return_indices=True
    )
    values = (u.sent_ns[place_u] - y.sent_ns[place_y]) / NANOSECONDS
    return Signal(stamps, (CHANNEL,), values[:, None]) if values.any() else None


def _last_of_each(times: Sequence[Times]) -> Times:
    """Return the times in the order of the stamps; of equal stamps only the last time stays."""
    stamp_ns, sent_ns = (np.concatenate(arrays)[::-1] for arrays in zip(*times, strict=True))
    unique_ns, place = np.unique(stamp_ns, return_index=True)
    return Times(unique_ns, sent_ns[place])
