# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Keep every use of a private name of rclpy 7.1 in one place.

`tests/ros/flight_ros/test_rclpy_private.py` checks these uses.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from rcl_interfaces.msg import SetParametersResult
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.subscription import Subscription

from flight_core.text import bounded

Participant: TypeAlias = Any  # a node of rclpy's C extension, which belongs to no Node

# the exception of `deserialize_message` for bytes that are not a message of the type
DeserializationError = _rclpy.RMWError

ARGUMENT_ERRORS = (
    ParameterException,
    _rclpy.RCLError,
    _rclpy.RCLInvalidROSArgsError,
    _rclpy.UnknownROSArgsError,
)
"""The exceptions of rclpy for invalid arguments and parameter files."""


def create_participant(name: str, context: Context) -> Participant:
    """Create a node without topics, parameters or services.

    The process then has a DDS participant.
    """
    with context.handle:
        return _rclpy.Node(name, "", context.handle, None, False, False)


def destroy_participant(participant: Participant) -> None:
    """Destroy a participant."""
    participant.destroy_when_not_in_use()


def take_messages(subscription: Subscription, limit: int) -> list[tuple[Any, Any]]:
    """Take at most `limit` messages (or their bytes) with their metadata, oldest first.

    No executor is involved.
    """
    handle = subscription.handle
    kind = subscription.msg_type
    raw = subscription.raw
    messages = []
    with handle:
        for _ in range(limit):
            if (message := handle.take_message(kind, raw)) is None:
                break
            messages.append(message)
    return messages


class WaitSet:
    """Waits for subscriptions of one context, without an executor."""

    def __init__(self, subscriptions: Sequence[Subscription], context: Context) -> None:
        self._handles = [subscription.handle for subscription in subscriptions]
        self._wait_set = _rclpy.WaitSet(len(self._handles), 0, 0, 0, 0, 0, context.handle)

    def wait(self, timeout_ns: int) -> bool:
        """Wait for a message on one of the subscriptions, at most until the timeout.

        Returns whether there is a message.
        """
        wait_set = self._wait_set
        wait_set.clear_entities()
        for handle in self._handles:
            wait_set.add_subscription(handle)
        wait_set.wait(timeout_ns)
        return bool(wait_set.get_ready_entities("subscription"))


def answer_invalid_transitions(node: Node) -> None:
    """Let a lifecycle node answer a request for an invalid transition with success false.

    Without this function, rclpy raises an exception and sends no answer.
    """
    service = node._service_change_state
    change_state = service.callback

    def answer(request: Any, response: Any) -> Any:
        try:
            return change_state(request, response)
        except _rclpy.RCLError as error:
            node.get_logger().error(bounded(f"request rejected: {' '.join(str(error).split())}"))
            response.success = False
            return response

    service.callback = answer


def refuse_foreign_parameters(node: Node) -> None:
    """Let a node refuse a whole request if it has an unknown parameter.

    `ros2 param load` joins the sections of all nodes in a file. Without the refusal, a node would
    take values from the section of another node for names that both nodes have, such as an age
    limit.
    """
    (service,) = (
        service for service in node.services if service.srv_name.endswith("/set_parameters")
    )
    set_parameters = service.callback

    def answer(request: Any, response: Any) -> Any:
        foreign = [
            parameter.name
            for parameter in request.parameters
            if not node.has_parameter(parameter.name)
        ]
        if not foreign:
            return set_parameters(request, response)
        owner = node.get_fully_qualified_name()
        reason = bounded(
            f"found {', '.join(foreign)}, expected parameters of {owner} alone; nothing is set"
        )
        response.results = [
            SetParametersResult(successful=False, reason=reason) for _ in request.parameters
        ]
        return response

    service.callback = answer


def ready_callback(executor: SingleThreadedExecutor) -> Callable[[], None] | None:
    """Return a callback that is ready, without blocking, or None if no callback is ready.

    A call of the result raises the exceptions of the callback.
    """
    try:
        handler, _, _ = executor.wait_for_ready_callbacks(0, None, lambda: False)
    except TimeoutException:
        return None

    def execute() -> None:
        handler()
        handler.result()

    return execute
