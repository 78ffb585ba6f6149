# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that are read at the tick: the newest samples, whatever the sender's rate, and no executor between.

A tick takes what has arrived (about 1 us when nothing has); a storm of messages costs no callbacks, and a clock that is set
back stops nothing.
"""

from typing import Any, NamedTuple

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile

from flight_ros.rclpy_private import take_messages
from flight_ros.topics import Topic


class _NeverExecuted(CallbackGroup):
    """Keeps its members out of every executor's wait set."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        return None


class ReceivedMessage(NamedTuple):
    """A message (or its bytes) and what the middleware says of it; times in ns of the system clock."""

    message: Any
    sent_ns: int
    received_ns: int
    sequence: int  # counts up by one a message of the publisher: a gap is a loss


class PolledSubscription:
    """One subscription, read with `take`."""

    def __init__(self, node: Node, topic: Topic, qos: QoSProfile, *, raw: bool = False) -> None:
        self.topic = topic
        self.qos = qos
        self.entity = node.create_subscription(
            topic.type, topic.name, lambda _: None, qos, callback_group=_NeverExecuted(), raw=raw
        )
        self.name = str(self.entity.topic_name)  # in full

    def take(self, most: int | None = None) -> list[ReceivedMessage]:
        """The messages that have arrived since the last call, oldest first, at most so many, else the queue's depth of them."""
        return [
            ReceivedMessage(
                message, info["source_timestamp"], info["received_timestamp"], info["publication_sequence_number"] or 0
            )
            for message, info in take_messages(self.entity, most or self.qos.depth)
        ]
