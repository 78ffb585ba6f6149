# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The monitor: the one thing of a running flight that the command line listens to."""

import time
from typing import NamedTuple

import rclpy
from rclpy.signals import SignalHandlerOptions

from flight_core.rates import NANOSECONDS
from flight_core.vectors import ChannelError, FloatArray
from flight_ros import transport
from flight_ros.inbox import Inbox
from flight_ros.messages import from_message
from flight_ros.topics import INTERNALS, LISTEN
from rise_di_controller.guard import Mode


class Seen(NamedTuple):
    """The newest of the controller's internals."""

    t: float  # flight time, s
    mode: Mode
    e: FloatArray


class Monitor:
    """Listens to `internals`. A context manager, so that the middleware is always shut down."""

    def __init__(self, outputs: tuple[str, ...], start_ns: int) -> None:
        transport.prepare()
        # Ctrl-C is for the runner to handle, not for rclpy.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node("monitor", start_parameter_services=False)
        self._inbox = Inbox(self._node, INTERNALS, LISTEN)
        self._wanted = ("mode", *(f"e.{output}" for output in outputs))
        self._start_ns = start_ns

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
                stamp_ns, values = from_message(received.message, self._wanted)
            except ChannelError:
                continue
            seen = Seen((stamp_ns - self._start_ns) / NANOSECONDS, Mode(int(values[0])), values[1:])
        return seen

    def flight_time(self) -> float:
        """Flight time by the clock, s."""
        return (time.time_ns() - self._start_ns) / NANOSECONDS
