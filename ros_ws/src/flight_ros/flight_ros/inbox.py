# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that are read at the tick: the newest samples, whatever the sender's rate, and no executor between.

A tick takes what has arrived (about 1 us when nothing has); a storm of messages costs no callbacks, and a clock that is set
back stops nothing.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from rclpy.callback_groups import CallbackGroup
from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
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
        self.name = str(self._subscription.topic_name)  # in full

    @property
    def handle(self) -> Any:
        """The middleware's subscription, for a wait set."""
        return self._subscription.handle

    def take(self, most: int | None = None) -> list[Received]:
        """The messages that have arrived since the last call, oldest first, at most so many, else the queue's depth of them."""
        handle, kind, raw = self._subscription.handle, self._subscription.msg_type, self._subscription.raw
        received = []
        with handle:
            for _ in range(most or self.qos.depth):
                if (taken := handle.take_message(kind, raw)) is None:
                    break
                message, info = taken
                received.append(
                    Received(
                        message, info["source_timestamp"], info["received_timestamp"], info["publication_sequence_number"] or 0
                    )
                )
        return received


class Waiter:
    """Waits for several inboxes at once, of one context."""

    def __init__(self, inboxes: Sequence[Inbox], context: Context) -> None:
        self._handles = [inbox.handle for inbox in inboxes]
        self._wait_set = _rclpy.WaitSet(len(inboxes), 0, 0, 0, 0, 0, context.handle)

    def wait(self, timeout_ns: int) -> bool:
        """Until something has come into one of the inboxes, or the time is over; whether something has."""
        wait_set = self._wait_set
        wait_set.clear_entities()
        for handle in self._handles:
            wait_set.add_subscription(handle)
        wait_set.wait(timeout_ns)
        return bool(wait_set.get_ready_entities("subscription"))
