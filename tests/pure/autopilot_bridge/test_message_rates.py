# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the rates of a link's messages: which are slow, and what follows.

A slow rate is requested again, prevents an engagement, and ends one. The tests set the time.
"""

import numpy as np
import pytest

from autopilot_bridge.message_rates import MessageRates
from flight_core.outcome import Refusal

# The highest and the lowest rate of the map ardupilot_mavlink.
REQUESTED = {"ATTITUDE": 40.0, "EXTENDED_SYS_STATE": 2.0}


class Stream:
    """Messages with regular intervals, and what is requested again, by the instant."""

    def __init__(self) -> None:
        self.rates = MessageRates(REQUESTED, 0.0)
        self.now = 0.0
        self.again: list[tuple[float, dict[str, float]]] = []
        self._due = dict.fromkeys(REQUESTED, 0.0)

    def run(self, until: float, **hz: float) -> "Stream":
        """Run to an instant, with rates that differ from the requested ones."""
        present = {**REQUESTED, **hz}
        for name, rate in present.items():
            self._due[name] = min(self._due[name], self.now + 1.0 / rate)
        for now in np.arange(self.now, until, 0.005).tolist():
            for name, rate in present.items():
                if now >= self._due[name]:
                    self.rates.take(name, now)
                    self._due[name] += 1.0 / rate
            if again := self.rates.step(now):
                self.again.append((now, again))
        self.now = until
        return self


def test_rates_are_unknown_for_two_seconds_and_then_as_requested() -> None:
    stream = Stream().run(1.9)
    assert stream.rates.unknown(1.9) == list(REQUESTED)
    stream.run(60.0)
    assert stream.rates.unknown(60.0) == []
    assert (stream.again, stream.rates.slow(60.0), stream.rates.lasting(60.0)) == ([], {}, None)


def test_rate_that_a_ground_station_takes_is_requested_again_and_ends_no_engagement() -> None:
    """The new request restores a rate that fell from 40 to 4 Hz.

    The count over 2 s is below 70 % after 2 s (1 - 0.7) / (1 - 0.1) = 0.67 s.
    """
    stream = Stream().run(10.0)
    stream.run(10.8, ATTITUDE=4.0)
    ((instant, requested),) = stream.again
    # A message of the 4 Hz is 0.25 s, a judgement 0.1 s.
    assert instant == pytest.approx(10.67, abs=0.15)
    assert requested == {"ATTITUDE": 40.0}
    assert stream.rates.slow(10.8) == {
        "ATTITUDE": Refusal("ATTITUDE comes at 4 Hz, requested are 40 Hz")
    }
    for end in np.arange(10.9, 20.0, 0.1).tolist():
        assert stream.run(end).rates.lasting(end) is None
    assert len(stream.again) <= 2
    came = {"ATTITUDE": Refusal("ATTITUDE came at 4 Hz, requested are 40 Hz, less than 20 s ago")}
    assert stream.rates.slow(20.0) == came
    # Longer than the 15 s after which MAVProxy takes it again.
    assert stream.run(30.0).rates.slow(30.0) == came
    assert stream.run(33.0).rates.slow(33.0) == {}


def test_rate_that_stays_low_is_requested_each_second_and_ends_the_engagement() -> None:
    stream = Stream().run(10.0)
    first = next(
        end
        for end in np.arange(10.0, 15.0, 0.05).tolist()
        if stream.run(end, ATTITUDE=4.0).rates.lasting(end)
    )
    assert first == pytest.approx(10.67 + 2.0, abs=0.2)
    assert (
        str(stream.rates.lasting(first)) == "ATTITUDE comes at 4 Hz, requested are 40 Hz; for 2 s"
    )
    assert np.diff([instant for instant, _ in stream.again]) == pytest.approx(1.0, abs=0.11)


@pytest.mark.parametrize("part, is_slow", [(0.75, False), (0.65, True)])  # the bound is 0.7
def test_bound_of_slow_rate(part: float, is_slow: bool) -> None:
    stream = Stream().run(10.0).run(20.0, ATTITUDE=part * 40.0)
    assert bool(stream.rates.slow(20.0)) is is_slow
    assert bool(stream.rates.lasting(20.0)) is is_slow


def test_rate_that_was_never_granted_is_slow_until_it_comes_and_not_remembered() -> None:
    stream = Stream().run(10.0, ATTITUDE=10.0)
    assert stream.rates.slow(10.0) == {
        "ATTITUDE": Refusal("ATTITUDE comes at 10 Hz, requested are 40 Hz")
    }
    assert stream.run(13.0).rates.slow(13.0) == {}


def test_lost_message_of_two_a_second_is_no_slow_rate() -> None:
    stream = Stream().run(10.0)
    stream._due["EXTENDED_SYS_STATE"] += 0.5
    assert stream.run(20.0).rates.slow(20.0) == {}


def test_host_that_pauses_for_a_second_counts_what_came_meanwhile() -> None:
    stream = Stream().run(10.0)
    for _ in range(40):
        stream.rates.take("ATTITUDE", 11.0)  # read at once
        stream.rates.step(11.0)
    for _ in range(2):
        stream.rates.take("EXTENDED_SYS_STATE", 11.0)
    stream.now = 11.0
    stream._due = dict.fromkeys(REQUESTED, 11.0)
    assert stream.run(20.0).again == []
    assert stream.rates.slow(20.0) == {}


def test_autopilot_that_starts_again_begins_with_unknown_rates() -> None:
    stream = Stream().run(10.0).run(14.0, ATTITUDE=4.0)
    stream.rates.begin(14.0)
    assert stream.rates.slow(14.0) == {}
    assert stream.rates.unknown(14.0) == list(REQUESTED)


def test_message_without_a_request_is_not_counted() -> None:
    stream = Stream().run(10.0)
    stream.rates.take("VFR_HUD", 10.0)
    assert stream.rates.is_coming("ATTITUDE", 10.0)
