# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write and read reports as messages of diagnostic_msgs/DiagnosticArray.

A report has a stamp, a sentence and named values, which are JSON.
"""

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.serialization import deserialize_message, serialize_message

from flight_core.rates import NANOSECONDS
from flight_core.vectors import ChannelError, SampleFault
from flight_ros.messages import require_size
from flight_ros.rclpy_private import DeserializationError

# bytes; the report of a model of eight states with its observer has 10,000
MAX_REPORT_SIZE = 65_536


class Report(NamedTuple):
    """A report: a sentence with a stamp, a sender and named values."""

    stamp_ns: int
    sender: str  # name of the publisher
    sentence: str
    values: Mapping[str, Any] = {}
    is_warning: bool = False  # whether the level is WARN instead of OK


def encode(report: Report, name: str) -> bytes:
    """Return the message of a report; `name` becomes the name of its DiagnosticStatus."""
    message = DiagnosticArray()
    message.header.stamp = Time(
        sec=report.stamp_ns // NANOSECONDS, nanosec=report.stamp_ns % NANOSECONDS
    )
    message.header.frame_id = report.sender
    level = DiagnosticStatus.WARN if report.is_warning else DiagnosticStatus.OK
    values = [KeyValue(key=key, value=json.dumps(value)) for key, value in report.values.items()]
    message.status = [
        DiagnosticStatus(level=level, name=name, message=report.sentence, values=values)
    ]
    return serialize_message(message)


def decode(raw: bytes) -> Report:
    """Return the report in a message. Raises ChannelError, reason "size" or "malformed"."""
    require_size(raw, MAX_REPORT_SIZE)
    try:
        message = deserialize_message(raw, DiagnosticArray)
        (status,) = message.status
        values = {item.key: json.loads(item.value) for item in status.values}
    except (
        DeserializationError,
        ValueError,
        RecursionError,
    ) as error:  # ValueError: json refuses the text, or the message has not exactly one status
        raise ChannelError(SampleFault.MALFORMED, " ".join(str(error).split())) from None
    stamp = message.header.stamp
    sender = message.header.frame_id
    is_warning = status.level != DiagnosticStatus.OK
    return Report(
        stamp.sec * NANOSECONDS + stamp.nanosec, sender, status.message, values, is_warning
    )
