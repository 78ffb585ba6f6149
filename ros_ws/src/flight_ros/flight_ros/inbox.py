# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that are read at the tick: the newest samples, whatever the sender's rate, and no executor between.

A tick takes what has arrived (about 1 us when nothing has); a storm of messages costs no callbacks, and a clock that is set
back stops nothing.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile

from flight_ros.topics import Topic


class _TakenByHand(CallbackGroup):
    """Keeps its members out of every executor's wait set."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        return None


class Received(NamedTuple):
    """A message (or its bytes) and what the middleware says of it; times in ns of the system clock."""

    message: Any
    sent_ns: int
    received_ns: int
    sequence: int  # counts up by one a message of the publisher: a gap is a loss


class Inbox:
    """One subscription, read with `take`."""

    def __init__(self, node: Node, topic: Topic, qos: QoSProfile, *, raw: bool = False) -> None:
        self.topic = topic
        self.qos = qos
        self._subscription = node.create_subscription(
            topic.type, topic.name, lambda _: None, qos, callback_group=_TakenByHand(), raw=raw
        )

    @property
    def name(self) -> str:
        """The full name of the topic."""
        return str(self._subscription.topic_name)

    def take(self) -> Iterator[Received]:
        """All messages that have arrived since the last call, oldest first, at most the queue's depth of them."""
        subscription = self._subscription
        for _ in range(self.qos.depth):
            with subscription.handle:
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                return
            message, info = taken
            yield Received(
                message, info["source_timestamp"], info["received_timestamp"], info["publication_sequence_number"] or 0
            )
