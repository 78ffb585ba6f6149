# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A recorded topic: what has come, and how many messages of its publisher were lost."""

from dataclasses import dataclass, field

from flight_log.bag import BagChannel


@dataclass(kw_only=True)
class RecordedTopic:
    """A topic and its channel in the bag. A message of a foreign topic names no publisher."""

    name: str  # in full
    is_foreign: bool
    channel: BagChannel
    publishers: int = 0  # number of publishers at the last check
    first_ns: int = 0  # monotonic time of the first and the last message
    heard_ns: int = 0
    stamp_ns: int = -1  # of the last message
    sent_ns: int = 0  # time of sending of the last message
    silent_ns: int = 0  # begin of a silence; 0 without a silence
    _next_sequence: int = field(default=0, init=False)  # 0 before the first message
    _publisher: str | None = field(default=None, init=False)  # of the last message
    # The sequence of a name went back: a second publisher has that name, or a new one.
    _is_shared: bool = field(default=False, init=False)

    def hear(self, sent_ns: int, now_ns: int) -> None:
        """Note when the newest message was sent, and when it came."""
        self.first_ns = self.first_ns or now_ns
        self.heard_ns = now_ns
        self.sent_ns = sent_ns

    def continues(self, sequence: int) -> bool:
        """Return whether a message is the next one, as far as its sequence can tell."""
        if not self.is_foreign and not self._is_shared and sequence != self._next_sequence:
            return False
        self._next_sequence = sequence + 1
        return True

    def lost_before(self, sequence: int, publisher: str | None) -> int:
        """Return how many messages were lost before one that does not continue the sequence.

        The sequences of several publishers interleave, so that a gap between publishers is no loss.
        """
        gap = sequence - self._next_sequence
        is_same = publisher == self._publisher
        self._next_sequence = sequence + 1
        self._publisher = publisher
        self._is_shared = is_same and gap < 0
        return max(gap, 0) if is_same else 0
