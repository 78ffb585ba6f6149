# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the engagements of a bridge in a log, from its reports on `bridge/engagement`."""

from collections.abc import Iterable
from typing import Any, NamedTuple

from rosbags.serde.errors import SerdeError

from flight_log.named_vectors import typestore

ENGAGEMENT = "/bridge/engagement"
KEY_VALUE = "diagnostic_msgs/msg/KeyValue"
ENGAGED = "ENGAGED"  # the key of a report


class Engagement(NamedTuple):
    """A span of time in which a bridge was engaged, in ns by the clock of the stamps."""

    start_ns: int
    stop_ns: int | None  # None if the log ends before the engagement does
    reason: str  # why the engagement ended


def engagements_of(reports: Iterable[tuple[int, bytes]]) -> list[Engagement] | None:
    """Return the engagements, in order, from the reports of a bridge.

    A report is a pair of the time of sending, ns, and the message. Returns None if there is no
    report.
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
