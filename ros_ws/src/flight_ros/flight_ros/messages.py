# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Named vectors as messages: sensor_msgs/JointState with name = channels, position = values, stamp = the sample's instant."""

from collections.abc import Sequence
from typing import NamedTuple

from builtin_interfaces.msg import Time
from sensor_msgs.msg import JointState

from flight_core.rates import NANOSECONDS
from flight_core.vectors import FloatArray, select


class StampedVector(NamedTuple):
    """A received sample: the instant it belongs to and its values in the order asked for."""

    stamp_ns: int
    value: FloatArray


def to_message(stamp_ns: int, names: Sequence[str], values: FloatArray, frame_id: str) -> JointState:
    """A named vector as a message. `frame_id` carries the publisher's instance."""
    message = JointState()
    message.header.stamp = Time(sec=stamp_ns // NANOSECONDS, nanosec=stamp_ns % NANOSECONDS)
    message.header.frame_id = frame_id
    message.name = list(names)
    message.position = values.tolist()
    return message


def from_message(message: JointState, wanted: Sequence[str]) -> StampedVector:
    """The wanted channels of a message. Raises ChannelError where names, lengths or values do not fit."""
    stamp = message.header.stamp
    return StampedVector(stamp.sec * NANOSECONDS + stamp.nanosec, select(wanted, message.name, message.position))
