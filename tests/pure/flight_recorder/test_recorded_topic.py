# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test what a recorder knows about a topic: lost messages, and silences while others go on."""

from collections.abc import Iterable
from itertools import count
from typing import Any

from flight_core.rates import NANOSECONDS
from flight_recorder.recorded_topic import RecordedTopic
from flight_recorder.silences import Silences


class Channel:
    """A channel of a bag that only counts its messages."""

    def __init__(self) -> None:
        self.messages = 0


def recorded(name: str = "/y", *, is_foreign: bool = False) -> RecordedTopic:
    channel: Any = Channel()
    return RecordedTopic(name=name, is_foreign=is_foreign, channel=channel)


def lost(topic: RecordedTopic, messages: Iterable[tuple[int, str]]) -> list[int]:
    """Return how many messages were lost before each of these.

    A message is given by its sequence and its publisher.
    """
    return [
        0 if topic.is_next(sequence) else topic.lost_before(sequence, publisher)
        for sequence, publisher in messages
    ]


def test_gap_in_the_sequence_of_one_publisher_is_a_loss() -> None:
    messages = [(5, "/aircraft#1"), (6, "/aircraft#1"), (9, "/aircraft#1"), (10, "/aircraft#1")]
    assert lost(recorded(), messages) == [0, 0, 2, 0]


def test_restarted_publisher_has_lost_nothing() -> None:
    messages = [(5, "/aircraft#1"), (6, "/aircraft#1"), (1, "/aircraft#2"), (4, "/aircraft#2")]
    assert lost(recorded(), messages) == [0, 0, 0, 2]


def test_interleaved_sequences_of_one_name_are_no_loss() -> None:
    """Two publishers have this name, so the sequence goes back, and no gap counts from then on."""
    messages = [(number, "/aircraft#0") for pair in zip(count(9), range(3)) for number in pair]
    assert lost(recorded(), messages[:2]) == [0, 0]
    assert lost(recorded(), messages) == [0] * len(messages)


def test_foreign_topic_names_no_publisher_and_loses_nothing() -> None:
    assert lost(recorded(is_foreign=True), [(5, ""), (9, "")]) == [0, 0]


class Flight:
    """Two topics at 10 Hz, and the lines of the log about their silences."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.topics = [recorded("/y"), recorded("/y_m")]
        self.now_ns = NANOSECONDS
        self.silences = Silences(
            inform=self.lines.append,
            warn=self.lines.append,
            count_publishers=lambda _: 1,
            now_ns=self.now_ns,
        )

    def fly(self, duration: float, *names: str) -> None:
        """Fly for a duration, s, in which only these topics have messages."""
        for _ in range(round(10.0 * duration)):
            self.now_ns += NANOSECONDS // 10
            for topic in self.topics:
                if topic.name in names:
                    topic.channel.messages += 1
                    topic.hear(self.now_ns, self.now_ns)
                    self.silences.end(topic, self.now_ns)
            self.silences.warn_of_topics(self.topics, self.now_ns)
            self.silences.warn_of_loop(self.topics, self.now_ns)


def test_topic_that_stops_while_another_goes_on_is_told_with_its_length() -> None:
    flight = Flight()
    flight.fly(3.0, "/y", "/y_m")
    flight.fly(2.0, "/y_m")
    assert [line.partition(":")[0] for line in flight.lines] == ["/y"]
    flight.fly(0.5, "/y", "/y_m")
    assert flight.lines[1:] == ["/y: received again after 2.1 s"]
    assert flight.silences.record(flight.topics, flight.now_ns) == {"/y": "for 2.1 s"}


def test_silence_that_lasts_is_recorded_to_the_end() -> None:
    flight = Flight()
    flight.fly(3.0, "/y", "/y_m")
    flight.fly(2.0, "/y_m")
    record = flight.silences.record(flight.topics, flight.now_ns)
    assert record == {"/y": "for 2.0 s, to the end"}


def test_end_of_all_topics_is_one_line_and_no_silence_of_a_topic() -> None:
    flight = Flight()
    flight.fly(3.0, "/y", "/y_m")
    flight.fly(9.0)
    assert len(flight.lines) == 1
    assert flight.lines[0].startswith("no y, y_m or u for 3 s")
    assert flight.silences.record(flight.topics, flight.now_ns) == {}
