# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A fixed rate on the monotonic clock with absolute deadlines: no drift, and no stop while the system clock is set back."""

import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

TIMER_SLACK = Path("/proc/self/timerslack_ns")  # of the main thread; Linux
SPIN_TIME = (
    2.5e-4  # s, by which a thread is awake before its deadline to watch the clock for the rest: waking takes 20 to 250 us
)
MAX_SPIN_FRACTION = 0.2  # of a period, and so of a core, that the watch takes at most


def disable_timer_slack() -> None:
    """Have the main thread woken at its deadlines, not up to 50 us later, which Linux does to save power. Needs no privilege.

    Source: prctl(2), PR_SET_TIMERSLACK. Threads of real-time priority have no slack anyway.
    """
    with suppress(OSError):  # no /proc, or not to be written: ticks are that much later
        TIMER_SLACK.write_text("1", encoding="utf-8")


class Tick(NamedTuple):
    """A deadline that has come."""

    number: int  # counts periods since the start; missed ones are skipped
    previous: int  # number of the tick before, 0 at the first
    late_ns: int  # how long after the deadline the tick began

    @property
    def missed(self) -> int:
        """Periods skipped since the previous tick."""
        return max(self.number - self.previous - 1, 0)


class Ticker:
    """Deadlines start + k period, in ns of time.monotonic_ns()."""

    def __init__(self, period_ns: int, start_ns: int) -> None:
        self.period_ns = period_ns
        self._ahead = min(SPIN_TIME, MAX_SPIN_FRACTION * period_ns / 1e9)  # s
        self._start_ns = start_ns
        self._last = -1

    def remaining(self) -> float:
        """Time to the next deadline in s, negative when it has passed."""
        return (self._start_ns + (self._last + 1) * self.period_ns - time.monotonic_ns()) / 1e9

    def wait(self, most: float) -> None:
        """Sleep until the next deadline, but at most so many s; watch the clock for the last of it."""
        pause = self.remaining()
        if pause > self._ahead:
            time.sleep(min(pause - self._ahead, most))
        while 0.0 < self.remaining() <= self._ahead:
            pass

    def due(self) -> Tick | None:
        """The newest deadline that has come and was not yet returned, else None."""
        number, late_ns = divmod(time.monotonic_ns() - self._start_ns, self.period_ns)
        if number <= self._last:
            return None
        tick = Tick(number, max(self._last, 0), late_ns)
        self._last = number
        return tick
