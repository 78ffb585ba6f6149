# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Latency of the loop from y to u, by the times at which the log says that they were sent."""

from pathlib import Path

import numpy as np

from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal
from flight_log.named_vectors import JOINT_STATE, STAMP, stamp_of
from flight_log.rosbag2_metadata import bag_files
from flight_log.stored_messages import stored_messages

CHANNEL = "y_to_u"


def latency(run: Path) -> Signal | None:
    """Time from the sending of a y to the sending of the u with its stamp, s: one channel, by the stamps of u.

    None when the log does not hold it: it is not a bag of MCAP files, it holds several aircraft, or all times are equal, as
    in a flight in one process.
    """
    sent: dict[str, dict[int, int]] = {}  # by full topic name: time of sending by stamp, ns
    for message in stored_messages(run) if bag_files(run) else ():
        sample = message.type_name == JOINT_STATE and len(message.data) >= STAMP.stop
        if sample and message.topic.rpartition("/")[2] in ("y", "u"):
            sent.setdefault(message.topic, {})[stamp_of(message.data)] = message.sent_ns
    topics = {topic.rpartition("/")[2]: topic for topic in sent}
    if len(sent) != 2 or len(topics) != 2:
        return None
    y, u = sent[topics["y"]], sent[topics["u"]]
    stamps = sorted(stamp for stamp in u if stamp in y)
    values = np.array([(u[stamp] - y[stamp]) / NANOSECONDS for stamp in stamps])
    return Signal(np.array(stamps, dtype=np.int64), (CHANNEL,), values[:, None]) if values.any() else None
