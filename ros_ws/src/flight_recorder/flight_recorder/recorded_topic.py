# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Keep a record of a topic's received messages, and count the lost ones."""

from dataclasses import dataclass, field

from flight_log.bag import BagChannel


@dataclass(kw_only=True)
class RecordedTopic:
    """A topic and its channel in the bag."""

    name: str  # full name
    # whether nodes outside of the stack publish the topic; their messages do not name the publisher
    is_foreign: bool
    channel: BagChannel
    publishers: int = 0  # number of publishers at the last check
    first_ns: int = 0  # monotonic time at which the first message was received
    heard_ns: int = 0  # monotonic time at which the last message was received
    stamp_ns: int = -1  # stamp of the last message
    sent_ns: int = 0  # time of sending of the last message
    silent_ns: int = 0  # when a silence began; 0 without a silence
    _next_sequence: int = field(default=0, init=False)  # 0 before the first message
    _publisher: str | None = field(default=None, init=False)  # publisher of the last message
    # Whether the sequence numbers of a publisher's name went back, so that a second or a new
    # publisher has this name.
    _is_shared: bool = field(default=False, init=False)

    def hear(self, sent_ns: int, now_ns: int) -> None:
        """Note when the newest message was sent, and when it was received."""
        self.first_ns = self.first_ns or now_ns
        self.heard_ns = now_ns
        self.sent_ns = sent_ns

    def is_next(self, sequence: int) -> bool:
        """Return whether a message is the next one after the last, as far as its number shows.

        The sequence number shows nothing if the topic is foreign, or if two publishers have the
        same name.
        """
        if not self.is_foreign and not self._is_shared and sequence != self._next_sequence:
            return False
        self._next_sequence = sequence + 1
        return True

    def lost_before(self, sequence: int, publisher: str | None) -> int:
        """Return how many messages were lost before a message that does not continue the sequence.

        The sequence numbers of several publishers interleave, so a gap between two publishers is no
        loss.
        """
        gap = sequence - self._next_sequence
        is_same = publisher == self._publisher
        self._next_sequence = sequence + 1
        self._publisher = publisher
        self._is_shared = is_same and gap < 0
        return max(gap, 0) if is_same else 0
