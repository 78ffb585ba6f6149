# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Set a deadline for a process, which holds even if a library call blocks the interpreter.

During such a call Python runs no other thread and no signal handler. The default action of a signal
would end the process, but without the exit status. A timer of the kernel therefore starts a thread
of the C library (POSIX timer_create, SIGEV_THREAD), which calls _exit(status).
"""

import ctypes
import faulthandler
import os
import sys
import time
from contextlib import suppress
from typing import Self

from flight_core.rates import NANOSECONDS

SIGEV_THREAD = 2  # linux/bits/sigevent-consts.h
SIGEVENT_SIZE = 64  # size of struct sigevent, bytes
TOLD_AT = 0.9  # fraction of the deadline after which the stacks of the threads go to stderr


class _SignalEvent(ctypes.Structure):
    """The C structure sigevent, with the members that SIGEV_THREAD uses."""

    _fields_ = (
        ("value", ctypes.c_ssize_t),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("padding", ctypes.c_char * (SIGEVENT_SIZE - 32)),
    )


class _TimerTimes(ctypes.Structure):
    """The C structure itimerspec: the period and the first expiry of a timer, s and ns."""

    _fields_ = tuple(
        (name, ctypes.c_long) for name in ("period_s", "period_ns", "first_s", "first_ns")
    )


class Deadline:
    """Ends the process with an exit status after `duration` s, if it is not cancelled before.

    As a context manager, the deadline is cancelled at the end of the block. When it ends the
    process, Python does not clean up, so close files earlier if they must be complete.
    """

    def __init__(self, duration: float, status: int) -> None:
        for stream in filter(None, (sys.stdout, sys.stderr)):
            with suppress(OSError):  # the reader of a pipe may have ended
                stream.flush()
        library = ctypes.CDLL(None, use_errno=True)
        if not hasattr(library, "timer_create"):  # before glibc 2.34
            library = ctypes.CDLL("librt.so.1", use_errno=True)
        leave = ctypes.cast(ctypes.CDLL(None)._exit, ctypes.c_void_p)
        event = _SignalEvent(value=status, notify=SIGEV_THREAD, function=leave)
        self._timer = ctypes.c_void_p()
        self._delete = library.timer_delete
        _require(
            library.timer_create(
                time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(self._timer)
            )
        )
        seconds, nanoseconds = divmod(round(duration * NANOSECONDS), NANOSECONDS)
        first = _TimerTimes(first_s=seconds, first_ns=nanoseconds)
        _require(library.timer_settime(self._timer, 0, ctypes.byref(first), None))
        if sys.stderr is not None:
            faulthandler.dump_traceback_later(TOLD_AT * duration)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.cancel()

    def cancel(self) -> None:
        """Cancel the deadline, so that the process continues."""
        faulthandler.cancel_dump_traceback_later()
        _require(self._delete(self._timer))


def _require(result: int) -> None:
    """Raise OSError if a call of the C library has failed."""
    if result != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
