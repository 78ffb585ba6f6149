# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Ticks: deadlines on the monotonic clock, overruns, the wait before a deadline."""

import time

from flight_ros.ticker import Ticker

PERIOD_NS = 10_000_000


def test_each_deadline_is_returned_once() -> None:
    period_ns = 100_000_000_000  # longer than any pause of a busy host
    ticker = Ticker(period_ns, time.monotonic_ns())
    tick = ticker.due()
    assert tick is not None
    assert (tick.number, tick.missed) == (0, 0)
    assert ticker.due() is None
    assert 0.0 < ticker.remaining() <= period_ns / 1e9


def test_overrun_returns_newest_deadline_and_counts_missed_ones() -> None:
    ticker = Ticker(PERIOD_NS, time.monotonic_ns())
    ticker.due()
    time.sleep(3.5 * PERIOD_NS / 1e9)  # a busy host may make it longer
    tick = ticker.due()
    assert tick is not None
    assert tick.number >= 3
    assert tick.missed == tick.number - 1
    assert 0 <= tick.late_ns < PERIOD_NS


def test_wait_ends_at_deadline_or_at_limit() -> None:
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


def test_wait_before_a_deadline_takes_no_processor() -> None:
    class Clock:
        now_ns = 0
        looks = 0

        def monotonic_ns(self) -> int:
            self.looks += 1
            return self.now_ns

        def time_ns(self) -> int:
            return self.now_ns

        def sleep(self, duration: float, /) -> None:
            self.now_ns += round(duration * 1e9)

    clock = Clock()
    ticker = Ticker(PERIOD_NS, 0, clock)
    ticker.due()
    clock.looks = 0
    ticker.wait(1.0)
    assert clock.now_ns == PERIOD_NS
    # one look says how long to sleep: a busy-wait looks until the deadline
    assert clock.looks == 1
