# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the messages of a ULog on a card that lost bytes.

Source: PX4 guide, ULog file format. A message begins with its size, 16 bits, and its type.
"""

import struct
from dataclasses import dataclass
from types import MappingProxyType

from flight_log.vehicle_tables import Loss

HEAD = 16  # bytes of magic, version and time at the beginning of a file
MESSAGE = struct.Struct("<HB")  # size and type at the beginning of a message
DATA, SUBSCRIPTION, FLAGS = b"DAB"
LEAST = MappingProxyType(
    {FLAGS: 40, SUBSCRIPTION: 4, DATA: 10}
    | {ord("S"): 8, ord("O"): 2, ord("L"): 9, ord("C"): 11, ord("R"): 2}
    | dict.fromkeys(b"FIMPQ", 3)
)
"""Least number of bytes of a message, by its type."""

LARGEST = 10_000  # bytes of the largest message (pyulog, core.py)
# place of the offsets of appended parts in the message FLAGS
APPENDED = slice(HEAD + MESSAGE.size + 16, HEAD + MESSAGE.size + 40)
# bytes. Fewer than this after the last message are a message that was cut short, and no loss.
TAIL = 528


@dataclass(frozen=True, kw_only=True)
class Messages:
    """The undamaged messages of a ULog as the bytes of another ULog, and what was lost."""

    content: bytes
    loss: Loss | None


def whole_messages(content: bytes) -> Messages:
    """Keep the messages of a ULog that are followed by another message or by its end.

    If no bytes are lost, the content does not change. If the log has appended parts, it does not
    change either, because offsets in the log point to these parts.
    """
    if any(content[APPENDED]) and content[HEAD + 2 : HEAD + 3] == b"B":
        return Messages(content=content, loss=None)
    log = _Log(content)
    parts = [content[:HEAD]]
    # first byte and end of each loss, and the stamp before it, us
    lost: list[tuple[int, int, int]] = []
    here = HEAD
    while here < len(content):
        if end := log.end_of(here):
            log.take(here, end)
            parts.append(content[here:end])
            here = end
            continue
        start = here
        while here < len(content) and not log.end_of(here):
            here += 1
        lost.append((start, here, log.stamp_us))
    if lost and lost[-1][1] == len(content) and lost[-1][1] - lost[-1][0] < TAIL:
        lost.pop()
    if not lost:
        return Messages(content=content, loss=None)
    count = sum(end - start for start, end, _ in lost)
    places = f" at {len(lost)} places" if len(lost) > 1 else ""
    what = f"{count} of {len(content)} bytes{places} hold no message"
    return Messages(content=b"".join(parts), loss=Loss(what, 1000 * lost[0][2], 1000 * lost[-1][2]))


class _Log:
    """What earlier messages of a log tell, by which the next message is recognised."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._sizes: dict[int, int] = {}  # size of the data by subscription; 0 before the first
        self.stamp_us = 0  # stamp of the newest data, us

    def end_of(self, here: int) -> int:
        """Return the end of the message at a place, or 0 if there is no whole message."""
        size = self._size(here)
        end = here + MESSAGE.size + size
        if not size or end > len(self._content):
            return 0
        is_last = len(self._content) - end < MESSAGE.size
        subscribes = self._content[here + 2] == SUBSCRIPTION
        number = self._number(here, 1) if subscribes else None
        return end if is_last or self._size(end, number) else 0

    def _size(self, here: int, subscribed: int | None = None) -> int:
        """Return the size in the head of a message, bytes, or 0 if no message can have such a head.

        `subscribed` is the number of the data to which the previous message subscribes.
        """
        if here + MESSAGE.size + 2 > len(self._content):
            return 0
        size, kind = MESSAGE.unpack_from(self._content, here)
        if not LEAST.get(kind, LARGEST + 1) <= size <= LARGEST:
            return 0
        if kind == DATA:
            number = self._number(here, 0)
            unknown = 0 if number == subscribed else -1
            if self._sizes.get(number, unknown) not in (0, size):
                return 0
        return int(size)

    def _number(self, here: int, place: int) -> int:
        start = here + MESSAGE.size + place
        return int.from_bytes(self._content[start : start + 2], "little")

    def take(self, here: int, end: int) -> None:
        """Take a whole message, and store what it says about later messages."""
        kind = self._content[here + 2]
        if kind == SUBSCRIPTION:
            self._sizes.setdefault(self._number(here, 1), 0)
        elif kind == DATA:
            self._sizes[self._number(here, 0)] = end - here - MESSAGE.size
            start = here + MESSAGE.size + 2
            self.stamp_us = int.from_bytes(self._content[start : start + 8], "little")
