# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Tick at a fixed rate with absolute deadlines, without drift.

The ticker runs on the monotonic clock, or in simulated time.
"""

import math
import time
from typing import NamedTuple, Protocol

import numpy as np

# s of busy-wait before a deadline, because the wake-up of a sleeping thread takes 20 to 250 us
SPIN_TIME = 2.5e-4
MAX_SPIN_FRACTION = 0.2  # largest busy-wait, as a fraction of the period and thus of a core


class HostTime(Protocol):
    """The functions of the module `time` with which a node ticks and stamps."""

    def monotonic_ns(self) -> int:
        """Return the present time on the clock that gives the ticks, ns."""

    def time_ns(self) -> int:
        """Return the present time on the clock that stamps the messages, ns."""

    def sleep(self, duration: float, /) -> None:
        """Wait for at most `duration` s."""


class Tick(NamedTuple):
    """A tick that is due, with the deadline that has passed."""

    number: int  # number of periods since the start; after an overrun it skips the missed periods
    previous: int  # number of the previous tick; 0 at the first tick
    late_ns: int  # time from the deadline to the beginning of the tick

    @property
    def missed(self) -> int:
        """Number of periods that an overrun has missed since the previous tick."""
        return max(self.number - self.previous - 1, 0)


class Ticker:
    """Gives the deadlines start + k period, in ns of host.monotonic_ns().

    `host` is the module `time` by default. With `spin`, a wait ends with a busy-wait.
    """

    def __init__(
        self, period_ns: int, start_ns: int, host: HostTime | None = None, *, spin: bool = True
    ) -> None:
        self._host: HostTime = host or time
        self.period_ns = period_ns
        self._spin_time = min(SPIN_TIME, MAX_SPIN_FRACTION * period_ns / 1e9) if spin else 0.0  # s
        self._start_ns = start_ns
        self._last = -1

    def remaining(self) -> float:
        """Return the time to the next deadline in s, negative if it has passed."""
        return (
            self._start_ns + (self._last + 1) * self.period_ns - self._host.monotonic_ns()
        ) / 1e9

    def wait(self, most: float) -> None:
        """Sleep until the next deadline, at most `most` s.

        The last part before the deadline is a busy-wait.
        """
        pause = self.remaining()
        if pause > self._spin_time:
            self._host.sleep(min(pause - self._spin_time, most))
        while 0.0 < self.remaining() <= self._spin_time:
            pass

    def due(self) -> Tick | None:
        """Return the newest passed deadline that was not returned yet, or None if there is none."""
        number, late_ns = divmod(self._host.monotonic_ns() - self._start_ns, self.period_ns)
        if number <= self._last:
            return None
        tick = Tick(number, max(self._last, 0), late_ns)
        self._last = number
        return tick


class TickTimes:
    """Periods and compute times of the ticks since the last report.

    The missed ticks are counted as well, since the start.
    """

    def __init__(self) -> None:
        self._periods: list[int] = []  # ns, periods of the ticks
        self._compute: list[int] = []  # ns, compute times of the ticks
        self._missed = 0
        self._begin_ns: int | None = None

    def begin(self, tick: Tick) -> None:
        """Note that a tick begins."""
        now_ns = time.monotonic_ns()
        if self._begin_ns is not None:
            self._periods.append(now_ns - self._begin_ns)
        self._begin_ns = now_ns
        self._missed += tick.missed

    def end(self) -> None:
        """Note that the present tick has ended."""
        self._compute.append(time.monotonic_ns() - (self._begin_ns or 0))

    def report(self) -> dict[str, object]:
        """Return the missed ticks, and mean, 99th percentile and maximum of both times, s.

        The next report begins with no times.
        """
        report: dict[str, object] = {"missed ticks": self._missed}
        for key, times in (("period", self._periods), ("compute time", self._compute)):
            if times:
                values = np.sort(times) * 1e-9
                # np.percentile would import numpy.ma during a tick
                nearest = math.ceil(0.99 * len(values)) - 1
                report |= {
                    f"{key} mean (s)": f"{values.mean():.6f}",
                    f"{key} p99 (s)": f"{values[nearest]:.6f}",
                    f"{key} max (s)": f"{values[-1]:.6f}",
                }
                times.clear()
        return report
