# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Message authentication code (MAC) of a named vector, and replay protection by its stamp.

    mac = the first 128 bits of HMAC-SHA256(key, topic || 0 || message with the digits of the mac as "0")

Source: RFC 2104; section 5 allows a truncation to half the output. The code covers the full topic name, the stamp, the
publisher's instance, the channel names, the values and every other byte of the CDR. It follows the instance in header.frame_id
as text: "/controller#4711;mac=" and 32 hexadecimal digits. A reader without a key reads the message as one without a code.
"""

import hmac
import os
import stat
import struct
from collections.abc import Iterator
from contextlib import contextmanager

from flight_core.files import open_nonblocking
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FUTURE, ChannelError, require_newer

KEY_BYTES = 32
MARK = ";mac="
DIGITS = 32  # of 4 bits each
BLANK = MARK + "0" * DIGITS
LENGTH = struct.Struct("<I")
LENGTH_PLACE = 12  # of header.frame_id: it follows the encapsulation (4 bytes) and the stamp (8)
TEXT_PLACE = LENGTH_PLACE + LENGTH.size
MOST_AHEAD = 10_000  # refused stamps that are remembered for each topic: 1 MB
EXPECTED = f"a file of {KEY_BYTES} bytes that its owner alone can read (chmod 600)"


def read_key(path: str, key: str) -> bytes:
    """The secret key in a file; `key` names the parameter. Raises ParameterError for a file other than EXPECTED."""
    try:
        with open_nonblocking(path) as stream:
            status = os.fstat(stream.fileno())
            require(stat.S_ISREG(status.st_mode), key, f"{path}, which is not a regular file", EXPECTED)
            mode = stat.S_IMODE(status.st_mode)
            require(mode & 0o077 == 0, key, f"{path} with mode {mode:04o}", EXPECTED)
            secret = stream.read(KEY_BYTES + 1)
    except OSError as error:
        raise ParameterError(f"{key}: {path} cannot be read ({error.strerror}), expected {EXPECTED}") from None
    size = f"{len(secret)}" if len(secret) <= KEY_BYTES else f"more than {KEY_BYTES}"
    require(len(secret) == KEY_BYTES, key, f"{path} of {size} bytes", EXPECTED)
    return secret


def instance(frame_id: str) -> str:
    """The instance of the publisher in `header.frame_id`, without the message authentication code."""
    return frame_id.partition(MARK)[0]


def mac_slice(message: bytes | bytearray) -> slice:
    """Slice of a message that holds the digits of its code; an empty slice behind the instance where it has no code."""
    if len(message) < TEXT_PLACE:
        return slice(0, 0)
    end = TEXT_PLACE + LENGTH.unpack_from(message, LENGTH_PLACE)[0] - 1  # the text ends with a zero
    begin = end - DIGITS
    mark = begin - len(MARK)
    signed = mark >= TEXT_PLACE and message[mark:begin] == MARK.encode()
    return slice(begin, end) if signed else slice(end, end)


class MessageAuthenticator:
    """Computes and checks the message authentication codes of one topic, given by its full name.

    Replay protection: a sample must be newer than `since_ns` and than the last sample that was taken. None switches it off,
    for lockstep, where stamps begin at 0.
    """

    def __init__(self, key: bytes, topic: str, since_ns: int | None) -> None:
        self._topic_hmac = hmac.new(key, topic.encode() + b"\x00", "sha256")
        self._last_ns = since_ns
        self._ahead: dict[int, None] = {}  # stamps of samples that were refused as ahead of the clock, the oldest first

    def mac(self, blank: bytes) -> bytes:
        """The digits of the code of a message, in which they are still "0"."""
        code = self._topic_hmac.copy()
        code.update(blank)
        return code.hexdigest()[:DIGITS].encode()

    def check(self, message: bytes) -> None:
        """Raise ChannelError, reason "mac", unless the message has the code of this key and topic."""
        place = mac_slice(message)
        digits = message[place]
        if len(digits) != DIGITS:
            raise ChannelError("mac", "no message authentication code")
        if not hmac.compare_digest(digits, self.mac(message[: place.start] + b"0" * DIGITS + message[place.stop :])):
            raise ChannelError("mac", "wrong message authentication code: another key, another topic or a changed message")

    @contextmanager
    def once(self, stamp_ns: int) -> Iterator[None]:
        """Within it a sample is taken. Raises ChannelError, reason "order", for a stale or replayed message.

        Its stamp counts only where the block ends without an exception: a sample that is refused, as that of a second
        publisher, must not make those of the first one stale. One that is refused as "future" stays refused when its time
        comes: the last MOST_AHEAD stamps are remembered.
        """
        if self._last_ns is None:
            yield
            return
        require_newer(stamp_ns, self._last_ns, "stale or replayed message")
        if stamp_ns in self._ahead:
            raise ChannelError("order", "replayed message: refused before as ahead of the clock")
        try:
            yield
        except ChannelError as error:
            if error.reason == FUTURE:
                self._ahead[stamp_ns] = None
                if len(self._ahead) > MOST_AHEAD:
                    del self._ahead[next(iter(self._ahead))]
            raise
        self._last_ns = stamp_ns
