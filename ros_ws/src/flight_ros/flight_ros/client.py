# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Base class of clients: nodes of a command that talk to the nodes of a running flight."""

import threading
import time
from collections.abc import Callable
from typing import Any, Self, TypeVar

import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.signals import SignalHandlerOptions

from flight_core.parameters import ParameterError
from flight_ros import transport
from flight_ros.rclpy_private import ARGUMENT_ERRORS
from flight_ros.receiver import Refusals
from flight_ros.subscriptions import PolledSubscription

T = TypeVar("T")

SERVICE_TIMEOUT = 10.0  # s
# s, time after which a wait ends if only aircraft of other namespaces have been found
DISCOVERY_TIMEOUT = 3.0
NODES = ("controller", "guidance", "bridge", "aircraft")  # names of the nodes of one aircraft


def start_middleware() -> None:
    """Start rclpy in the default context.

    Raises ParameterError with the reason if the middleware does not start.
    """
    transport.prepare()
    try:
        # the command handles SIGINT, and not rclpy
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except ARGUMENT_ERRORS as error:
        raise ParameterError(
            f"ROS 2: does not start ({' '.join(str(error).split())}), expected its environment"
        ) from None


class Client:
    """A client with a node in the default context.

    `parent` is another client, whose node this client uses as well. If one of the two is cancelled,
    the waits of both end. Use the client as a context manager, so that the middleware always shuts
    down.
    """

    def __init__(
        self, name: str, namespace: str = "", parent: "Client | None" = None, *, rosout: bool = True
    ) -> None:
        # the first client of a process starts and ends the middleware
        self._started = parent is None and not rclpy.ok()
        if parent is None:
            if self._started:
                start_middleware()
            try:
                node = rclpy.create_node(
                    name, namespace=namespace, start_parameter_services=False, enable_rosout=rosout
                )
            except (NameValidationException, *ARGUMENT_ERRORS) as error:
                self._shut_down()
                key = "--namespace" if isinstance(error, NameValidationException) else "ROS 2"
                raise ParameterError(f"{key}: {' '.join(str(error).split())}") from None
            self._node = node
            self._refused = Refusals(node)
            self._cancelled = threading.Event()
        else:
            self._node = parent._node
            self._refused = parent._refused
            self._cancelled = parent._cancelled

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._node.destroy_node()
        self._shut_down()

    def _shut_down(self) -> None:
        if self._started:
            rclpy.try_shutdown()

    def _decoded(
        self, subscription: PolledSubscription | None, decode: Callable[[bytes], T]
    ) -> list[T]:
        """Return the messages since the last call; [] if there is no subscription."""
        if subscription is None:
            return []
        pairs = self._refused.decoded(subscription, subscription.take(), decode)
        return [message for message, _ in pairs]

    def _spin_until(
        self, condition: Callable[[], bool], message: str, timeout: float = SERVICE_TIMEOUT
    ) -> None:
        begin = time.monotonic()
        while not condition():
            if self._cancelled.is_set():
                raise ParameterError("cancelled by a later request")
            if (waited := time.monotonic() - begin) > min(timeout, DISCOVERY_TIMEOUT) and (
                elsewhere := self._elsewhere()
            ):
                raise ParameterError(
                    f"{message}; aircraft fly in {', '.join(elsewhere)}: --namespace"
                )
            if waited > timeout:
                raise ParameterError(message)
            rclpy.spin_once(self._node, timeout_sec=0.02)

    def _elsewhere(self) -> list[str]:
        """Return the namespaces of the aircraft in the graph, if this namespace has no aircraft.

        The root namespace is "/".
        """
        seen = {
            namespace
            for name, namespace in self._node.get_node_names_and_namespaces()
            if name in NODES
        }
        return [] if self._node.get_namespace() in seen else sorted(seen)

    def _call(self, kind: Any, name: str, request: Any, expected: str = "a flight") -> Any:
        client = self._node.create_client(kind, name)
        try:
            service = f"service {client.srv_name}"
            self._spin_until(
                client.service_is_ready,
                f"{service} not available, expected {expected} in this domain",
            )
            future = client.call_async(request)
            self._spin_until(
                future.done, f"{service}: no response, expected one within {SERVICE_TIMEOUT:g} s"
            )
            return future.result()
        finally:
            self._node.destroy_client(client)
