# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check whether the messages of a link come at their requested rates.

The module reads no clock, because every instant is an argument, in s.
"""

from collections import deque
from collections.abc import Mapping

from flight_core.outcome import Refusal, joined

# s over which messages are counted. A pause of the host for half a second makes no rate slow.
COUNTED = 2.0
MESSAGES = 4  # least number of messages to count, if COUNTED has fewer
GRANTED = 0.7  # share of a requested rate below which a rate is slow
# s for which a rate must be slow to end an engagement. A rate that is requested again recovers
# sooner.
SLOW_ENDS = 2.0
# s after a slow rate in which an engagement is refused. MAVProxy requests its rates every 15 s.
REMEMBERED = 20.0
REPEATED = 1.0  # s, time between two requests of a slow rate
JUDGED = 0.1  # s, time between two judgements of the rates
PAUSE = 0.4  # s; if two judgements are farther apart, the host paused
GAPS = 3  # number of gaps between the newest messages, whose mean gives the present rate


class MessageRates:
    """Counts the messages of each name, and compares their rates with the `requested` rates, Hz."""

    def __init__(self, requested: Mapping[str, float], now: float) -> None:
        self._requested = dict(requested)
        self.begin(now)

    def begin(self, now: float) -> None:
        """Begin to count again, because the autopilot may have started again.

        The caller then requests all rates again.
        """
        self._rates = {name: _Rate(rate, now) for name, rate in self._requested.items()}
        self._last_step = now

    def take(self, name: str, now: float) -> None:
        """Count a message with this name."""
        if (rate := self._rates.get(name)) is not None:
            rate.take(now)

    def step(self, now: float) -> dict[str, float]:
        """Judge the rate of each message, at most once every JUDGED s.

        Returns the rates that must be requested again, Hz, by the name of the message. After a
        pause of the host, nothing is judged, so that the messages of the pause are counted first.
        """
        elapsed = now - self._last_step
        if elapsed < JUDGED:
            return {}
        self._last_step = now
        if elapsed > PAUSE:
            return {}
        return {name: rate.requested for name, rate in self._rates.items() if rate.step(now)}

    def slow(self, now: float) -> dict[str, Refusal]:
        """Say how slow each slow message is, by name.

        A message is slow if it now comes less often than requested. If it has ever come as often as
        requested, it is also slow for a while (REMEMBERED) after its rate has recovered.
        """
        reasons = {name: rate.slowness(name, now) for name, rate in self._rates.items()}
        return {name: reason for name, reason in reasons.items() if reason is not None}

    def lasting(self, now: float) -> Refusal | None:
        """Say which messages have been slow for at least SLOW_ENDS s, or return None."""
        reasons = joined(
            rate.slowness(name, now) for name, rate in self._rates.items() if rate.has_lasted(now)
        )
        return None if reasons is None else Refusal(f"{reasons}; for {SLOW_ENDS:g} s")

    def is_coming(self, name: str, now: float) -> bool:
        """Return whether a message comes at the requested rate."""
        rate = self._rates[name]
        return rate.is_known(now) and rate.slowness(name, now) is None

    def unknown(self, now: float) -> list[str]:
        """Return the names of messages that have not been counted for their full window yet."""
        return [name for name, rate in self._rates.items() if not rate.is_known(now)]


class _Rate:
    """The counted rate of the messages of one name."""

    def __init__(self, requested: float, now: float) -> None:
        self.requested = requested  # Hz
        # s, length of the window in which messages are counted
        self._window = max(COUNTED, MESSAGES / requested)
        self._began = now
        self._instants: deque[float] = deque()  # instants of the messages within the window
        self._lowest = requested  # Hz, lowest rate since the rate became slow
        self._slow_since: float | None = None
        self._was_reached = False
        # Instant at which the rate was last slow, if it had been reached before.
        self._last_slow: float | None = None
        self._repeated: float | None = None  # instant of the last repeated request

    def take(self, now: float) -> None:
        self._instants.append(now)
        self._drop_old(now)

    def is_known(self, now: float) -> bool:
        return now - self._began >= self._window

    def has_lasted(self, now: float) -> bool:
        return self._slow_since is not None and now - self._slow_since >= SLOW_ENDS

    def step(self, now: float) -> bool:
        """Judge the rate, and return whether it must be requested again."""
        if not self.is_known(now):
            return False
        self._drop_old(now)
        rate = len(self._instants) / self._window
        if rate >= GRANTED * self.requested:
            self._was_reached = True
            self._slow_since = None
            return False
        if self._slow_since is None:
            self._slow_since = now
            self._lowest = self.requested
        self._lowest = min(self._lowest, rate, self._present())
        self._last_slow = now if self._was_reached else None
        if self._repeated is not None and now - self._repeated < REPEATED:
            return False
        self._repeated = now
        return True

    def slowness(self, name: str, now: float) -> Refusal | None:
        """Say how slow the messages of a name are, or recently were, or return None."""
        rate = f"at {self._lowest:.2g} Hz, requested are {self.requested:g} Hz"
        if self._slow_since is not None:
            return Refusal(f"{name} comes {rate}")
        if self._last_slow is not None and now - self._last_slow < REMEMBERED:
            return Refusal(f"{name} came {rate}, less than {REMEMBERED:g} s ago")
        return None

    def _drop_old(self, now: float) -> None:
        while self._instants and now - self._instants[0] > self._window:
            self._instants.popleft()

    def _present(self) -> float:
        """Return the mean rate of the newest messages, Hz.

        A count over the whole window would include messages from before the rate fell.
        """
        if len(self._instants) <= GAPS:
            return len(self._instants) / self._window
        return GAPS / max(self._instants[-1] - self._instants[-1 - GAPS], 1e-3)
