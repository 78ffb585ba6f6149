# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A fixed rate on the monotonic clock with absolute deadlines: no drift, and no stop while the system clock is set back."""

import time
from typing import NamedTuple


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
        self._start_ns = start_ns
        self._last = -1

    def remaining(self) -> float:
        """Time to the next deadline in s, negative when it has passed."""
        return (self._start_ns + (self._last + 1) * self.period_ns - time.monotonic_ns()) / 1e9

    def due(self) -> Tick | None:
        """The newest deadline that has come and was not yet returned, else None."""
        number, late_ns = divmod(time.monotonic_ns() - self._start_ns, self.period_ns)
        if number <= self._last:
            return None
        tick = Tick(number, max(self._last, 0), late_ns)
        self._last = number
        return tick
