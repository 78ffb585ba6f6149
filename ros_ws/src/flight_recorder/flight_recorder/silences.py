# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Warn of silences, in which no message of a topic comes any more although the flight goes on.

A single topic can be silent, or y, y_m and u together.
"""

import sys
from collections import Counter
from collections.abc import Callable, Sequence

from flight_core.rates import NANOSECONDS
from flight_recorder.recorded_topic import RecordedTopic

SILENCE_NS = 3 * NANOSECONDS  # a killed controller is back within 1 s, so this is no restart

# A topic is steady once it has had so many messages at a mean interval up to this length.
STEADY_MESSAGES = 20
STEADY_INTERVAL_NS = NANOSECONDS // 5
TOPIC_SILENCE_NS = NANOSECONDS


class Silences:
    """The silences of the topics in a flight, and their lines in the log.

    A silence gets a warning, and at its end a line that says how long it was. Instants are in the
    time of the flight, in which a pause of /clock is no silence. `inform` and `warn` are functions
    that take a line for the log.
    """

    def __init__(
        self,
        *,
        inform: Callable[[str], object],
        warn: Callable[[str], object],
        count_publishers: Callable[[str], int],
        now_ns: int,
    ) -> None:
        self._inform = inform
        self._warn = warn
        self._count_publishers = count_publishers
        self._lengths_ns: Counter[str] = Counter()  # total length of the ended silences by topic
        self._count = 0  # number of messages of y, y_m and u
        self._counted_ns = now_ns  # when the last of these arrived

    def end(self, topic: RecordedTopic, now_ns: int) -> None:
        """End the silence of a topic, if there is one."""
        if not topic.silent_ns:
            return
        length_ns = now_ns - topic.silent_ns
        topic.silent_ns = 0
        self._lengths_ns[topic.name] += length_ns
        self._inform(f"{topic.name}: received again after {length_ns / NANOSECONDS:.1f} s")

    def warn_of_loop(self, loop: Sequence[RecordedTopic], now_ns: int) -> None:
        """Warn once if y, y_m and u have all stopped.

        Either the publishers have ended, or this process receives nothing. Fast DDS can block the
        receiving threads while it removes a participant that leaves (eProsima/Fast-DDS, issue
        6502).
        """
        count = sum(topic.channel.messages for topic in loop)
        if count != self._count:
            self._count = count
            self._counted_ns = now_ns
        elif count and now_ns - self._counted_ns > SILENCE_NS:
            self._counted_ns = sys.maxsize
            self._warn(
                f"no y, y_m or u for {SILENCE_NS / NANOSECONDS:g} s: if their nodes still "
                "publish, the middleware of this process is blocked: start the recorder again"
            )

    def warn_of_topics(self, steady: Sequence[RecordedTopic], now_ns: int) -> None:
        """Warn of a steady topic that is silent although its publisher still exists.

        This is for a silence in which the other topics go on. A reader can miss a whole topic
        because of a full queue, or because of a forged message of the middleware.
        """
        newest_ns = max((topic.heard_ns for topic in steady), default=0)
        if now_ns - newest_ns >= TOPIC_SILENCE_NS:
            return
        for topic in steady:
            begins = (
                _is_steady(topic)
                and not topic.silent_ns
                and newest_ns - topic.heard_ns >= TOPIC_SILENCE_NS
            )
            if begins and self._count_publishers(topic.name):
                topic.silent_ns = topic.heard_ns
                why = "the publisher has stopped, or this process receives nothing more of it"
                self._warn(f"{topic.name}: no message for 1 s while others go on: {why}")

    def record(self, topics: Sequence[RecordedTopic], now_ns: int) -> dict[str, str]:
        """Return how long each topic was silent, including silences that still last."""
        lasting = {topic.name: now_ns - topic.silent_ns for topic in topics if topic.silent_ns}
        lengths_ns = Counter(self._lengths_ns)
        lengths_ns.update(lasting)
        return {
            name: f"for {length_ns / NANOSECONDS:.1f} s{', to the end' if name in lasting else ''}"
            for name, length_ns in lengths_ns.items()
        }


def _is_steady(topic: RecordedTopic) -> bool:
    """Return whether messages of a topic came so regularly that a pause is a silence."""
    count = topic.channel.messages
    return (
        count >= STEADY_MESSAGES and topic.heard_ns - topic.first_ns <= count * STEADY_INTERVAL_NS
    )
