# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The monitor: the one thing of a running flight that the command line listens to."""

import os
from typing import NamedTuple

import rclpy
from rclpy.signals import SignalHandlerOptions

from flight_core.parameters import require
from flight_core.vectors import ChannelError, FloatArray
from flight_ros import transport
from flight_ros.inbox import Inbox
from flight_ros.messages import from_message
from flight_ros.topics import INTERNALS, LISTEN, Y_M, Y
from rise_di_controller.guard import Mode

MODES = {float(mode): mode.name for mode in Mode}


class Seen(NamedTuple):
    """The newest of the controller's internals."""

    mode: str
    e: FloatArray


class Monitor:
    """Listens to `internals`. A context manager, so that the middleware is always shut down."""

    def __init__(self, outputs: tuple[str, ...]) -> None:
        transport.prepare()
        # Ctrl-C is for the runner to handle, not for rclpy.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node("monitor", start_parameter_services=False)
        self._inbox = Inbox(self._node, INTERNALS, LISTEN)
        self._wanted = ("mode", *(f"e.{output}" for output in outputs))

    def __enter__(self) -> "Monitor":
        return self

    def __exit__(self, *_: object) -> None:
        self._node.destroy_node()
        rclpy.try_shutdown()

    def newest(self) -> Seen | None:
        """The newest sample since the last call, None where none has come."""
        seen = None
        for received in self._inbox.take():
            try:
                values = from_message(received.message, self._wanted).value
            except ChannelError:
                continue
            seen = Seen(MODES.get(values[0], "?"), values[1:])
        return seen

    def require_nobody_flies(self) -> None:
        """Raise ParameterError where an aircraft or a reference model is already there, which would fly into this flight."""
        for topic in (Y, Y_M):
            count = self._node.count_publishers(topic.name)
            domain = os.environ.get("ROS_DOMAIN_ID", "0")
            found = f"{count} publishers of {topic.name} already"
            require(count == 0, f"ROS_DOMAIN_ID {domain}", found, "a domain of its own for each flight: set ROS_DOMAIN_ID")
