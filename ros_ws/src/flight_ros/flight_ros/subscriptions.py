# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Poll subscriptions: a tick takes the newest messages, whatever the publisher's rate is.

No executor is involved. Polling takes about 1 us if there is no message. A flood of messages causes
no callbacks, and a clock that is set back has no effect.
"""

from typing import Any, NamedTuple

from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from flight_ros.rclpy_private import take_messages
from flight_ros.topics import Topic


class _NeverExecuted(CallbackGroup):
    """A callback group that keeps its subscriptions out of every executor's wait set."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        return None


class ReceivedMessage(NamedTuple):
    """A message, or its bytes, and its metadata; times are in ns of the system clock."""

    message: Any
    sent_ns: int
    received_ns: int
    sequence: int  # the publisher increases it by one for each message, so a gap is a loss


class PolledSubscription:
    """A subscription that is polled by `take`.

    If it is `raw`, its messages are CDR bytes. It has no callbacks of rclpy for publishers that do
    not match, because `EndpointMonitor` reports such publishers. With callbacks, an executor would
    ask for each of these events whenever it looks for a request.
    """

    def __init__(self, node: Node, topic: Topic, qos: QoSProfile, *, raw: bool = False) -> None:
        self.topic = topic
        self.qos = qos
        self.entity = node.create_subscription(
            topic.type,
            topic.name,
            lambda _: None,
            qos,
            callback_group=_NeverExecuted(),
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            raw=raw,
        )
        self.name = str(self.entity.topic_name)  # the full name

    def take(self, most: int | None = None) -> list[ReceivedMessage]:
        """Return the messages since the last call, oldest first.

        The result has at most `most` messages, by default the depth of the queue.
        """
        return [
            ReceivedMessage(
                message,
                info["source_timestamp"],
                info["received_timestamp"],
                info["publication_sequence_number"] or 0,
            )
            for message, info in take_messages(self.entity, most or self.qos.depth)
        ]
