# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Convert SIGINT, SIGTERM and SIGHUP to a KeyboardInterrupt where it does no harm."""

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
    """Call `handler` for the signals of `handle_shutdown` within a with block.

    Python lets only the main thread set handlers, so in another thread this function changes
    nothing.
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
    """End the flight by a KeyboardInterrupt, and ignore further signals.

    A second signal could interrupt the clean-up while `subprocess` holds the lock of a process.
    """
    handle_shutdown(signal.SIG_IGN)
    # If the terminal is lost, writing to it is an error.
    if number == signal.SIGHUP:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(nowhere, stream.fileno())
    raise KeyboardInterrupt


class DeferredInterrupt:
    """A signal handler that interrupts only outside the blocks of `deferred`.

    For example, a signal waits while the log is written. With `only_in_pauses` a signal interrupts
    only in `pause`. The reason is that a module in C, such as rclpy while it makes a message, can
    call Python code. An interrupt in this code would become an error of the module.
    """

    def __init__(self, *, only_in_pauses: bool = False) -> None:
        self._is_deferred = only_in_pauses
        self._pending: tuple[int, FrameType | None] | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Interrupt at once, or remember the signal while interrupts are deferred."""
        if self._is_deferred:
            self._pending = number, frame
        else:
            interrupt(number, frame)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Make a signal wait until a with block ends."""
        self._is_deferred = True
        try:
            yield
        finally:
            self._is_deferred = False
        self._interrupt_if_pending()

    def pause(self, duration: float) -> None:
        """Sleep for a duration, s. Raises KeyboardInterrupt if a signal comes during this time."""
        time.sleep(duration)
        self._interrupt_if_pending()

    def _interrupt_if_pending(self) -> None:
        if self._pending is not None:
            interrupt(*self._pending)
