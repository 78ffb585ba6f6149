# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The engagements of a bridge in a log, by the reports of the bridge on `bridge/engagement`."""

from collections.abc import Iterable
from typing import Any, NamedTuple

from rosbags.serde.errors import SerdeError

from flight_log.named_vectors import typestore

ENGAGEMENT = "/bridge/engagement"
KEY_VALUE = "diagnostic_msgs/msg/KeyValue"
ENGAGED = "ENGAGED"  # the key of a report


class Engagement(NamedTuple):
    """A span in which an autopilot was engaged. Times in ns, by the clock of the stamps."""

    start_ns: int
    stop_ns: int | None  # None if the log ends before
    reason: str  # why it ended


def engagements_of(reports: Iterable[tuple[int, bytes]]) -> list[Engagement] | None:
    """Return the engagements, in order, from the reports of a bridge; None if there is none.

    A report is the time of sending and the message.
    """
    spans: list[Engagement] | None = None
    for sent_ns, data in reports:
        try:
            report: Any = typestore().deserialize_cdr(data, KEY_VALUE)
        except SerdeError:
            continue
        spans = spans or []
        is_open = bool(spans) and spans[-1].stop_ns is None
        if report.key == ENGAGED and not is_open:
            spans.append(Engagement(sent_ns, None, ""))
        elif report.key != ENGAGED and is_open:
            spans[-1] = spans[-1]._replace(stop_ns=sent_ns, reason=report.value)
    return spans
