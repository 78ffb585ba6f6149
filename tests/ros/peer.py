# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide a peer of a node under test.

It publishes y and y_m, subscribes to topics of the node, and calls its services.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from tests.ros.waiting import HANG, LOOK, until

from flight_core.rates import NANOSECONDS, nanoseconds
from flight_ros import transport
from flight_ros.messages import to_message
from flight_ros.topics import PUBLISH

T = TypeVar("T")
OUTPUTS = ("q", "V", "p", "r")
INPUTS = ("elevator", "thrust", "aileron", "rudder")


def stamp_ns(message: Any) -> int:
    """Return the stamp of a message with a header."""
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)


class Peer:
    """A node that runs while `until` waits for a condition.

    `received` holds its messages by topic.
    """

    def __init__(self, context: Context, topics: tuple[str, ...], qos: QoSProfile) -> None:
        self.node = Node("peer", context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)
        self.received: dict[str, list[Any]] = {topic: [] for topic in topics}
        for topic, messages in self.received.items():
            kind = DiagnosticArray if topic == "/diagnostics" else JointState
            self.node.create_subscription(kind, topic, messages.append, qos)
        self._publishers: dict[str, Any] = {}

    def until(
        self,
        condition: Callable[[], T | None],
        because: str,
        *,
        each: Callable[[], object] | None = None,
        timeout: float = HANG,
    ) -> T:
        """Spin until a condition is true, and return its value. `each` is called every 5 ms."""

        def serve() -> None:
            end = time.monotonic() + LOOK
            self._executor.spin_once(timeout_sec=LOOK)
            if each is not None:
                while (rest := end - time.monotonic()) > 0.0:
                    self._executor.spin_once(timeout_sec=rest)
                each()

        return until(condition, because, serve, timeout)

    def last(self, topic: str) -> Any:
        """Return the newest message of a topic, or None before the first."""
        return next(reversed(self.received[topic]), None)

    def send(self, y: float = 0.0, y_m: float = 0.0) -> None:
        """Publish a sample of y and one of y_m, with equal channels and the present stamp."""
        now_ns = time.time_ns()
        for name, value in (("y_m", y_m), ("y", y)):
            self.publish(name, to_message(now_ns, OUTPUTS, np.full(4, value), "peer"))

    def command(self, *u: float, sender: str = "peer", age: float = 0.0) -> None:
        """Publish u with a stamp `age` s ago."""
        self.publish(
            "u", to_message(time.time_ns() - nanoseconds(age), INPUTS, np.array(u), sender)
        )

    def publish(self, topic: str, message: JointState) -> None:
        """Publish a named vector on a topic."""
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(JointState, topic, PUBLISH)
        self._publishers[topic].publish(message)

    def call(
        self, kind: Any, name: str, request: Any, each: Callable[[], None] | None = None
    ) -> Any:
        """Call a service and wait for its answer. Meanwhile `each` is called every 5 ms."""
        client = self.node.create_client(kind, name)
        self.until(client.service_is_ready, f"the service {name}", each=each)
        future = client.call_async(request)
        self.until(future.done, f"an answer of {name}", each=each)
        return future.result()

    def transition(self, number: int) -> bool:
        """Request a transition of the controller, and return whether it succeeded."""
        request = ChangeState.Request(transition=Transition(id=number))
        return bool(self.call(ChangeState, "controller/change_state", request).success)

    def set_parameters(self, **values: object) -> bool:
        """Set parameters of the controller at once, and return whether it accepted them."""
        messages = [
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
        request = SetParametersAtomically.Request(parameters=messages)
        return bool(
            self.call(
                SetParametersAtomically, "controller/set_parameters_atomically", request
            ).result.successful
        )

    def counted(self, key: str, more_than: int = 0) -> bool:
        """Return whether a counter in the received diagnostics has been above a number."""
        values = [
            value
            for array in self.received["/diagnostics"]
            for status in array.status
            for value in status.values
        ]
        return any(value.key == key and int(value.value) > more_than for value in values)

    def modes(self) -> list[int]:
        """Return the sequence of modes in `internals`, without repetitions."""
        modes = [
            int(message.position[message.name.index("mode")])
            for message in self.received["internals"]
        ]
        return [mode for index, mode in enumerate(modes) if index == 0 or modes[index - 1] != mode]

    def u(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return all received inputs, (N, m)."""
        return np.array([message.position for message in self.received["u"]])


@contextmanager
def peer(
    topics: tuple[str, ...] = ("u", "internals", "/diagnostics"), qos: QoSProfile | None = None
) -> Iterator[Peer]:
    """Yield a peer in its own context with subscriptions to these topics."""
    transport.prepare()
    context = Context()
    rclpy.init(context=context)
    node = Peer(context, topics, qos or QoSProfile(depth=100))
    try:
        yield node
    finally:
        node.node.destroy_node()
        context.try_shutdown()
