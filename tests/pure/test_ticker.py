# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Ticks: deadlines on the monotonic clock, overruns, the busy-wait before a deadline, requests to Linux's scheduler."""

import os
import platform
import re
import subprocess
import sys
import time

import pytest
from tests.conftest import with_policy

from flight_ros.scheduling import SLICE_NS, THREADS, TIMER_SLACK
from flight_ros.ticker import MAX_SPIN_FRACTION, SPIN_TIME, Ticker

PERIOD_NS = 10_000_000


def test_each_deadline_is_returned_once() -> None:
    period_ns = 100_000_000_000  # longer than any pause of a busy host
    ticker = Ticker(period_ns, time.monotonic_ns())
    tick = ticker.due()
    assert tick is not None
    assert (tick.number, tick.missed) == (0, 0)
    assert ticker.due() is None
    assert 0.0 < ticker.remaining() <= period_ns / 1e9


def test_an_overrun_returns_the_newest_deadline_and_counts_the_missed_ones() -> None:
    ticker = Ticker(PERIOD_NS, time.monotonic_ns())
    ticker.due()
    time.sleep(3.5 * PERIOD_NS / 1e9)  # a busy host may make it longer
    tick = ticker.due()
    assert tick is not None
    assert tick.number >= 3
    assert tick.missed == tick.number - 1
    assert 0 <= tick.late_ns < PERIOD_NS


def test_the_wait_ends_at_the_deadline_or_at_its_limit() -> None:
    begin_ns = time.monotonic_ns()
    ticker = Ticker(PERIOD_NS, begin_ns)
    ticker.due()
    ticker.wait(0.3 * PERIOD_NS / 1e9)
    assert time.monotonic_ns() >= begin_ns + 0.3 * PERIOD_NS
    ticker.wait(PERIOD_NS / 1e9)
    assert time.monotonic_ns() >= begin_ns + PERIOD_NS
    assert ticker.due() is not None
    behind = Ticker(PERIOD_NS, begin_ns - 10 * PERIOD_NS)
    begin = time.thread_time()
    behind.wait(1.0)
    assert behind.due() is not None
    assert time.thread_time() < begin + 0.5  # s: it does not wait for a deadline in the past


@pytest.mark.parametrize(("period_ns", "spin_time"), [(PERIOD_NS, SPIN_TIME), (1_000_000, MAX_SPIN_FRACTION * 1e-3)])
def test_the_busy_wait_before_a_deadline_is_limited_to_a_fraction_of_the_period(
    period_ns: int, spin_time: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)  # returns at once
    monkeypatch.setattr(time, "monotonic_ns", iter(range(0, 10 * period_ns, period_ns // 20)).__next__)
    ticker = Ticker(period_ns, 0)
    ticker.due()
    ticker.wait(1.0)
    assert slept == [pytest.approx(0.95 * period_ns / 1e9 - spin_time)]


@pytest.mark.skipif(not TIMER_SLACK.exists(), reason="no Linux, or no /proc")
def test_the_timer_slack_of_the_thread_is_set_to_its_minimum() -> None:
    # in a process of its own, as the setting lasts; the default of Linux is 50 us (prctl(2), PR_SET_TIMERSLACK)
    code = "from flight_ros.scheduling import *; disable_timer_slack(); print(TIMER_SLACK.read_text())"
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert int(ran.stdout) == 1


def kernel() -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", platform.release())[:2]))


@pytest.mark.skipif(
    kernel() < (6, 12) or not (THREADS.parent / "sched").exists(), reason="needs Linux 6.12, CONFIG_SCHED_DEBUG"
)
@pytest.mark.skipif(os.sched_getscheduler(0) != os.SCHED_OTHER, reason="only the default policy has time slices")
def test_every_thread_of_a_node_has_short_time_slices() -> None:
    code = """
import threading, time
from flight_ros.scheduling import *
threading.Thread(target=time.sleep, args=(0.1,)).start()
request_short_slices()
print([(one / "sched").read_text() for one in THREADS.iterdir()])
"""
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert [int(slice_ns) for slice_ns in re.findall(r"se\.slice\s*:\s*(\d+)", ran.stdout)] == [SLICE_NS, SLICE_NS]


@pytest.mark.parametrize(
    ("policy", "priority"),
    [(("--fifo", "50"), 48), (("--rr", "50"), 48), (("--fifo", "2"), 1), (("--other", "0"), 0)],
    ids=["FIFO", "round robin", "no lower one", "default policy"],
)
def test_a_lowered_real_time_priority_is_that_of_the_threads_that_follow(policy: tuple[str, str], priority: int) -> None:
    code = """
import os, threading
from flight_ros.scheduling import lower_real_time_priority
before = os.sched_getscheduler(0)
lower_real_time_priority(2)
assert os.sched_getscheduler(0) == before
thread = threading.Thread(target=lambda: print(os.sched_getparam(0).sched_priority))
thread.start()
thread.join()
"""
    ran = subprocess.run([*with_policy(*policy), sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert int(ran.stdout) == priority
