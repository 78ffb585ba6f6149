# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Deadlines on the monotonic clock."""

import subprocess
import sys
import time

import pytest

from flight_ros.ticker import MAX_SPIN_FRACTION, SPIN_TIME, TIMER_SLACK, Ticker

PERIOD_NS = 10_000_000


def test_a_deadline_is_returned_once_it_has_come_and_once_only() -> None:
    ticker = Ticker(PERIOD_NS, time.monotonic_ns())
    tick = ticker.due()
    assert tick is not None
    assert (tick.number, tick.missed) == (0, 0)
    assert ticker.due() is None
    assert 0.0 < ticker.remaining() <= PERIOD_NS / 1e9


def test_deadlines_that_were_slept_through_are_counted_and_the_newest_is_returned() -> None:
    ticker = Ticker(PERIOD_NS, time.monotonic_ns())
    ticker.due()
    time.sleep(3.5 * PERIOD_NS / 1e9)  # no later than needed; a busy machine may make it longer
    tick = ticker.due()
    assert tick is not None
    assert tick.number >= 3
    assert tick.missed == tick.number - 1
    assert 0 <= tick.late_ns < PERIOD_NS


def test_it_waits_for_the_deadline_and_no_longer_than_it_may() -> None:
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
    assert time.thread_time() < begin + 0.5  # s: a deadline that has passed is not waited for


@pytest.mark.parametrize(("period_ns", "ahead"), [(PERIOD_NS, SPIN_TIME), (1_000_000, MAX_SPIN_FRACTION * 1e-3)])
def test_it_is_awake_before_the_deadline_by_no_more_than_a_share_of_the_period(
    period_ns: int, ahead: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)  # which wakes at once
    monkeypatch.setattr(time, "monotonic_ns", iter(range(0, 10 * period_ns, period_ns // 20)).__next__)
    ticker = Ticker(period_ns, 0)
    ticker.due()
    ticker.wait(1.0)
    assert slept == [pytest.approx(0.95 * period_ns / 1e9 - ahead)]  # it is looked at a second time


@pytest.mark.skipif(not TIMER_SLACK.exists(), reason="no Linux, or no /proc")
def test_the_kernel_is_told_to_wake_the_thread_at_its_deadlines() -> None:
    # in a process of its own, for it lasts; Linux gives 50 us to begin with (prctl(2), PR_SET_TIMERSLACK)
    say = "from flight_ros.ticker import *; disable_timer_slack(); print(TIMER_SLACK.read_text())"
    ran = subprocess.run([sys.executable, "-c", say], check=True, capture_output=True, text=True)
    assert int(ran.stdout) == 1
