# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Ask Linux's scheduler for settings with which fewer ticks of a node are late.

No request needs a privilege. If Linux refuses a request, nothing changes.
"""

import ctypes
import os
import platform
import struct
from contextlib import suppress
from pathlib import Path

TIMER_SLACK = Path("/proc/self/timerslack_ns")  # timer slack of the main thread, on Linux
THREADS = Path("/proc/self/task")
REAL_TIME = (os.SCHED_FIFO, os.SCHED_RR)
SLICE_NS = 100_000  # the shortest slice of Linux; its default is 0.7 ms (1 + log2(cores))
# numbers of the system call, for which glibc has no function before 2.41
SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
# members of struct sched_attr: size, policy, flags, nice, priority, runtime, deadline, period
ATTRIBUTES = "=IIQiIQQQ"


def compute_in_one_thread() -> None:
    """Let the linear algebra of this process, and of its child processes, use one thread.

    Call this before NumPy is imported, because OpenBLAS reads the number of threads only once. The
    matrices here have at most some hundred rows. For such matrices two threads take longer than
    one, because each waits for the other, and on a busy host they take several times as long. With
    one thread, the last bits of a result also do not depend on the number of processors. If the
    user has set a number of threads, it stays.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def lower_real_time_priority(levels: int) -> None:
    """Lower the priority of every thread of a process with a real-time priority (chrt).

    If the calling thread has such a priority, every thread of this process gets this priority less
    `levels`, but at least 1. Threads that are started later inherit it.
    Processes of equal priority do not preempt each other. Compression in the recorder would
    therefore delay a tick of the law by milliseconds, and a tick of the law would delay y_m by up
    to 3 ms. Rate-monotonic priorities, lower for longer periods, are the optimal fixed priorities.
    Source: sched(7); C. L. Liu and J. W. Layland, Journal of the ACM 20(1), 1973, theorem 2.
    """
    if (policy := os.sched_getscheduler(0)) in REAL_TIME:
        _schedule_threads(
            policy,
            max(os.sched_getparam(0).sched_priority - levels, os.sched_get_priority_min(policy)),
        )


def leave_real_time_priority() -> None:
    """Give every thread of a process with a real-time priority (chrt) the default policy.

    Nothing changes if the calling thread has no such priority. A command that starts and watches
    nodes of real-time priority calls this, so that its wake-ups and garbage collections do not
    delay ticks.
    """
    if os.sched_getscheduler(0) in REAL_TIME:
        _schedule_threads(os.SCHED_OTHER, 0)


def _schedule_threads(policy: int, priority: int) -> None:
    for path in THREADS.iterdir():  # importing rclpy starts further threads
        with suppress(ProcessLookupError):  # the thread has ended
            os.sched_setscheduler(int(path.name), policy, os.sched_param(priority))


def disable_timer_slack() -> None:
    """Set the timer slack of the main thread to the minimum.

    The timer slack is the time by which Linux can delay a wake-up to save power, 50 us by default.
    Threads of real-time priority have none. Source: prctl(2), PR_SET_TIMERSLACK.
    """
    with suppress(OSError):  # /proc is missing or read-only: ticks keep the slack
        TIMER_SLACK.write_text("1", encoding="utf-8")


def request_short_slices() -> None:
    """Ask for time slices of SLICE_NS for every thread of this process.

    When a thread with a shorter slice wakes, it runs before a running thread with a longer one. The
    share of a core that each thread gets stays the same. Linux before 6.12 ignores the request. If
    the user has chosen a policy (chrt), the policy is kept. Sources: sched_setattr(2), and the
    kernel's documentation, scheduler/sched-eevdf (latency-sensitive tasks).
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
                attributes = struct.pack(
                    ATTRIBUTES, size, os.SCHED_OTHER, 0, nice, 0, SLICE_NS, 0, 0
                )
                ctypes.CDLL(None).syscall(number, thread, attributes, 0)
