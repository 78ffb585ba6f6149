# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Every private name of rclpy that the stack uses, in one file (rclpy 7.1); checked by tests/ros/test_rclpy_private.py."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

Participant: TypeAlias = Any  # rclpy's own node behind a Node

DeserializationError = _rclpy.RMWError
"""What `deserialize_message` raises for bytes that are no message of the type."""

ARGUMENT_ERRORS = (ParameterException, _rclpy.RCLError, _rclpy.RCLInvalidROSArgsError, _rclpy.UnknownROSArgsError)
"""What rclpy raises for arguments and parameter files that it cannot read."""


def create_participant(name: str, context: Context) -> Participant:
    """A node without topics, parameters or services: the DDS participant of its process alone."""
    with context.handle:
        return _rclpy.Node(name, "", context.handle, None, False, False)


def destroy_participant(participant: Participant) -> None:
    """End it."""
    participant.destroy_when_not_in_use()


def raw_publish(publisher: Publisher) -> Callable[[bytes], None]:
    """The function that publishes a serialised message; Publisher.publish takes two checks more a message."""
    publish: Callable[[bytes], None] = publisher.handle.publish_raw
    return publish


def take_messages(subscription: Subscription, limit: int) -> list[tuple[Any, Any]]:
    """Messages (or their bytes) with what the middleware says of them, oldest first, at most `limit`, without an executor."""
    handle, kind, raw = subscription.handle, subscription.msg_type, subscription.raw
    taken = []
    with handle:
        for _ in range(limit):
            if (one := handle.take_message(kind, raw)) is None:
                break
            taken.append(one)
    return taken


class WaitSet:
    """Waits for subscriptions of one context, without an executor."""

    def __init__(self, subscriptions: Sequence[Subscription], context: Context) -> None:
        self._handles = [subscription.handle for subscription in subscriptions]
        self._wait_set = _rclpy.WaitSet(len(self._handles), 0, 0, 0, 0, 0, context.handle)

    def wait(self, timeout_ns: int) -> bool:
        """Wait until a message has arrived on one of them or the time is over; whether one has."""
        wait_set = self._wait_set
        wait_set.clear_entities()
        for handle in self._handles:
            wait_set.add_subscription(handle)
        wait_set.wait(timeout_ns)
        return bool(wait_set.get_ready_entities("subscription"))


def ready_callback(executor: SingleThreadedExecutor) -> Callable[[], None] | None:
    """A callback that is ready, None where there is none; it does not wait. What the callback raises, its call raises."""
    try:
        handler, _, _ = executor.wait_for_ready_callbacks(0, None, lambda: False)
    except TimeoutException:
        return None

    def execute() -> None:
        handler()
        handler.result()

    return execute
