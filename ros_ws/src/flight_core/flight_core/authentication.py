# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples that prove where they are from: a keyed code (MAC) inside the message of a named vector.

    mac = the first 128 bits of HMAC-SHA256(key, topic || 0 || message with the digits of the mac as "0")

(RFC 2104; a truncation to no less than half the output, section 5 there.) So it covers the topic in full, the stamp, the
publisher's instance, the names, the values and every other byte of the CDR. It stands as text behind the instance in
header.frame_id, "/controller#4711;mac=" and 32 hexadecimal digits: readers that know nothing of it read the message as before.
"""

import hmac
import os
import stat
import struct

from flight_core.files import open_nonblocking
from flight_core.parameters import ParameterError, require
from flight_core.rates import seconds
from flight_core.vectors import ChannelError

KEY_BYTES = 32
MARK = ";mac="
DIGITS = 32  # of 4 bits each
BLANK = MARK + "0" * DIGITS
LENGTH = struct.Struct("<I")
LENGTH_PLACE = 12  # of header.frame_id: behind the encapsulation (4 bytes) and the stamp (8)
TEXT_PLACE = LENGTH_PLACE + LENGTH.size
EXPECTED = f"a file of {KEY_BYTES} bytes that its owner alone can read (chmod 600)"


def read_key(path: str, key: str) -> bytes:
    """The secret in a file; `key` names the parameter. Raises ParameterError where it is not as EXPECTED says."""
    try:
        with open_nonblocking(path) as stream:
            status = os.fstat(stream.fileno())
            require(stat.S_ISREG(status.st_mode), key, f"{path}, which is no file", EXPECTED)
            mode = stat.S_IMODE(status.st_mode)
            require(mode & 0o077 == 0, key, f"{path} with mode {mode:04o}", EXPECTED)
            secret = stream.read(KEY_BYTES + 1)
    except OSError as error:
        raise ParameterError(f"{key}: {path} cannot be read ({error.strerror}), expected {EXPECTED}") from None
    size = f"{len(secret)}" if len(secret) <= KEY_BYTES else f"more than {KEY_BYTES}"
    require(len(secret) == KEY_BYTES, key, f"{path} of {size} bytes", EXPECTED)
    return secret


def mac_slice(message: bytes | bytearray) -> slice:
    """Where the digits of the mac stand in a message; an empty place behind the instance where there is none."""
    if len(message) < TEXT_PLACE:
        return slice(0, 0)
    end = TEXT_PLACE + LENGTH.unpack_from(message, LENGTH_PLACE)[0] - 1  # the text ends with a zero
    begin = end - DIGITS
    mark = begin - len(MARK)
    signed = mark >= TEXT_PLACE and message[mark:begin] == MARK.encode()
    return slice(begin, end) if signed else slice(end, end)


class MessageAuthenticator:
    """Signs and checks the messages of one topic, by its full name.

    `since_ns`: samples have to be newer than this, and than the last one that was let in, so that what was overheard cannot be
    sent again; None does without, for lockstep, where stamps begin at 0.
    """

    def __init__(self, key: bytes, topic: str, since_ns: int | None) -> None:
        self._begun = hmac.new(key, topic.encode() + b"\x00", "sha256")
        self._last_ns = since_ns

    def mac(self, blank: bytes) -> bytes:
        """The digits that belong into a message in which they are "0"."""
        code = self._begun.copy()
        code.update(blank)
        return code.hexdigest()[:DIGITS].encode()

    def check(self, message: bytes) -> None:
        """Raise ChannelError, reason "mac", unless the message was signed with this key, for this topic."""
        place = mac_slice(message)
        digits = message[place]
        if len(digits) != DIGITS:
            raise ChannelError("mac", "it is not signed, and a key is asked for")
        if not hmac.compare_digest(digits, self.mac(message[: place.start] + b"0" * DIGITS + message[place.stop :])):
            raise ChannelError("mac", "it is signed with another key or for another topic, or was changed")

    def accept(self, stamp_ns: int) -> None:
        """Raise ChannelError, reason "order", for a stamp that is not newer than the last one; it is the last one then."""
        if self._last_ns is None:
            return
        if stamp_ns <= self._last_ns:
            late = seconds(self._last_ns - stamp_ns)
            raise ChannelError("order", f"stamp {late:g} s before the last one, or the start: signed samples come once")
        self._last_ns = stamp_ns
