# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test ticks: deadlines on the monotonic clock, overruns, and the busy-wait before a deadline."""

import time

import pytest

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


@pytest.mark.parametrize(
    "period_ns, spin_time", [(PERIOD_NS, SPIN_TIME), (1_000_000, MAX_SPIN_FRACTION * 1e-3)]
)
def test_busy_wait_before_deadline_limited_to_fraction_of_period(
    period_ns: int, spin_time: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)  # returns at once
    monkeypatch.setattr(
        time, "monotonic_ns", iter(range(0, 10 * period_ns, period_ns // 20)).__next__
    )
    ticker = Ticker(period_ns, 0)
    ticker.due()
    ticker.wait(1.0)
    assert slept == [pytest.approx(0.95 * period_ns / 1e9 - spin_time)]
