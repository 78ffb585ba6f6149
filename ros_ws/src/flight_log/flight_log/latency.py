# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Latency of the loop from y to u, by the times at which the log says that they were sent."""

from collections.abc import Mapping

import numpy as np

from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal

CHANNEL = "y_to_u"
TOPICS = ("y", "u")


def latency(sent: Mapping[str, Mapping[int, int]]) -> Signal | None:
    """Time from the sending of a y to the sending of the u with its stamp, s: one channel, by the stamps of u.

    `sent` holds the times of sending by stamp, ns, by the full names of all topics y and u. None when the log does not hold
    it: it holds no y or no u, or several aircraft, or all times are equal, as in a flight in one process.
    """
    topics = {topic.rpartition("/")[2]: topic for topic in sent}
    if len(sent) != len(TOPICS) or len(topics) != len(TOPICS):
        return None
    y, u = (sent[topics[name]] for name in TOPICS)
    stamps = sorted(stamp for stamp in u if stamp in y)
    values = np.array([(u[stamp] - y[stamp]) / NANOSECONDS for stamp in stamps])
    return Signal(np.array(stamps, dtype=np.int64), (CHANNEL,), values[:, None]) if values.any() else None
