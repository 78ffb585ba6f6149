# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""SIGINT, SIGTERM and SIGHUP as a KeyboardInterrupt at a place that permits one."""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from flight_core.signals import handle_shutdown


@contextmanager
def handle_signals(handler: Any) -> Iterator[None]:
    """Handle the signals of `handle_shutdown` in the block.

    Python permits handlers in the main thread alone.
    """
    before = (
        handle_shutdown(handler) if threading.current_thread() is threading.main_thread() else {}
    )
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


def interrupt(number: int, frame: FrameType | None) -> None:
    """End the flight.

    A second signal would interrupt the clean-up, in which `subprocess` releases a lock of each
    process.
    """
    handle_shutdown(signal.SIG_IGN)
    # The terminal is lost: writing to it is an error.
    if number == signal.SIGHUP:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(nowhere, stream.fileno())
    raise KeyboardInterrupt


class DeferredInterrupt:
    """A signal handler that interrupts outside the blocks of `deferred`.

    A write of the log is a block of `deferred`. With `only_in_pauses` it interrupts in `pause`
    alone: an exception in Python that a module in C has called, such as a message that rclpy makes,
    becomes an error of that module.
    """

    def __init__(self, *, only_in_pauses: bool = False) -> None:
        self._is_deferred = only_in_pauses
        self._pending: tuple[int, FrameType | None] | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Interrupt, or remember the signal where an interrupt is deferred."""
        if self._is_deferred:
            self._pending = number, frame
        else:
            interrupt(number, frame)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Within the block a signal waits for its end."""
        self._is_deferred = True
        try:
            yield
        finally:
            self._is_deferred = False
        self._interrupt_if_pending()

    def pause(self, duration: float) -> None:
        """Sleep for a duration, s. A signal up to its end raises KeyboardInterrupt here."""
        time.sleep(duration)
        self._interrupt_if_pending()

    def _interrupt_if_pending(self) -> None:
        if self._pending is not None:
            interrupt(*self._pending)
