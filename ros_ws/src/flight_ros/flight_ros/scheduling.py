# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a node asks of Linux's scheduler, so that its ticks are less late.

No privilege is needed. Where Linux refuses, ticks are as they are without it.
"""

import ctypes
import os
import platform
import struct
from contextlib import suppress
from pathlib import Path

TIMER_SLACK = Path("/proc/self/timerslack_ns")  # of the main thread; Linux
THREADS = Path("/proc/self/task")
SLICE_NS = 100_000  # the shortest that Linux accepts; by default 0.7 ms times 1 + log2 of the cores
SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}  # numbers of the system call; glibc has no function for it before 2.41
ATTRIBUTES = "=IIQiIQQQ"  # struct sched_attr: size, policy, flags, nice, priority, runtime, deadline, period


def disable_timer_slack() -> None:
    """Set the timer slack of the main thread to its minimum. By default Linux delays a wake-up by up to 50 us to save power.

    Source: prctl(2), PR_SET_TIMERSLACK. Threads of real-time priority have no timer slack.
    """
    with suppress(OSError):  # /proc is missing or read-only: ticks keep the slack
        TIMER_SLACK.write_text("1", encoding="utf-8")


def request_short_slices() -> None:
    """Ask for time slices of SLICE_NS for all threads of this process.

    A thread that wakes up goes before a running one with a longer slice. Its share of a core is unchanged. Linux before 6.12
    ignores it. A policy that the user has chosen (chrt) is kept.
    Source: sched_setattr(2); the kernel's documentation, scheduler/sched-eevdf (latency-sensitive tasks).
    """
    number = SCHED_SETATTR.get(platform.machine())
    if number is None or not THREADS.is_dir():
        return
    for path in THREADS.iterdir():
        thread = int(path.name)
        with suppress(OSError):  # the thread has ended
            if os.sched_getscheduler(thread) == os.SCHED_OTHER:
                nice = os.getpriority(os.PRIO_PROCESS, thread)
                size = struct.calcsize(ATTRIBUTES)
                wanted = struct.pack(ATTRIBUTES, size, os.SCHED_OTHER, 0, nice, 0, SLICE_NS, 0, 0)
                ctypes.CDLL(None).syscall(number, thread, wanted, 0)
