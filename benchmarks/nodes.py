# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What the nodes of the benchmarks share: opening a node, deadlines, the end on a signal."""

import contextlib
import signal
import threading
import time
from collections.abc import Iterator

import rclpy
from rclpy.context import Context
from rclpy.node import Node

from flight_core.rates import period_ns
from flight_ros import transport
from flight_ros.ticker import Tick, Ticker


@contextlib.contextmanager
def open_node(name: str) -> Iterator[Node]:
    """Open a plain node of rclpy on the stack's transport.

    It has a context of its own and no signal handlers.
    """
    transport.prepare()
    context = Context()
    rclpy.init(context=context)
    node = Node(name, context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        context.try_shutdown()


def ticks(hz: float) -> Iterator[Tick]:
    """Sleep until each deadline, without end."""
    ticker = Ticker(period_ns(hz, "hz"), time.monotonic_ns())
    while True:
        if (pause := ticker.remaining()) > 0:
            time.sleep(pause)
        if (tick := ticker.due()) is not None:
            yield tick


def termination() -> threading.Event:
    """Return an event that SIGTERM and SIGINT set."""
    has_ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: has_ended.set())
    return has_ended
