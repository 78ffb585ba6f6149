# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Named vectors as messages: sensor_msgs/JointState with name = channels, position = values, stamp = the sample's instant.

Channels do not change during a flight. So a message is laid out once, and each sample then only changes the stamp and the
values inside those bytes: several times faster than the middleware's own serialisation, and repeatable to the byte, which that
one is not: it leaves what was in memory between two strings.
"""

import math
import struct
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from flight_core.authentication import BLANK, MARK, MessageAuthenticator, mac_slice
from flight_core.rates import NANOSECONDS
from flight_core.vectors import ChannelError, FloatArray, StampedVector, select
from flight_ros.rclpy_private import DeserializationError

ENCAPSULATION = b"\x00\x01\x00\x00"  # plain CDR, little-endian (DDS Interoperability Wire Protocol 2.2, 10.2)
STAMP = struct.Struct("<iI")  # seconds and nanoseconds, right behind the encapsulation
STAMP_PLACE = len(ENCAPSULATION)
COUNT = struct.Struct("<I")  # of a sequence or a string, in front of it
NO_CHANNELS: FloatArray = np.zeros(0)


def to_message(stamp_ns: int, names: Sequence[str], values: FloatArray, frame_id: str) -> JointState:
    """A named vector as a message. `frame_id` carries the publisher's instance."""
    message = JointState()
    message.header.stamp = Time(sec=stamp_ns // NANOSECONDS, nanosec=stamp_ns % NANOSECONDS)
    message.header.frame_id = frame_id
    message.name = list(names)
    message.position = values.tolist()
    return message


def from_message(message: JointState, wanted: Sequence[str]) -> StampedVector:
    """The wanted channels of a message. Raises ChannelError where names, lengths or values do not fit."""
    stamp = message.header.stamp
    value = select(wanted, message.name, message.position)
    return StampedVector(stamp.sec * NANOSECONDS + stamp.nanosec, value, _instance(message.header.frame_id))


class Encoder:
    """Samples of one publisher as the bytes of a message; without names: vectors without channels.

    In lockstep the latter say that there is no sample at an instant. Layout by CDR (OMG Common Object Request Broker
    Architecture, 9.3): each value stands at a multiple of its size behind the encapsulation, with zeros in between. With a
    `authenticator` each message is signed, behind `frame_id`.
    """

    def __init__(self, names: Sequence[str], frame_id: str, authenticator: MessageAuthenticator | None = None) -> None:
        self._authenticator = authenticator
        self._bytes = bytearray(ENCAPSULATION + bytes(STAMP.size))
        self._add_string(frame_id + BLANK if authenticator is not None else frame_id)
        self._mac = mac_slice(self._bytes)
        self._add_count(len(names))
        for name in names:
            self._add_string(name)
        self._add_count(len(names))
        if names:
            self._align(8)
        self.place = len(self._bytes)  # of the values
        self._values = slice(self.place, self.place + 8 * len(names))
        self._bytes += bytes(8 * len(names) + 2 * COUNT.size)  # and no velocity, no effort

    def _align(self, size: int) -> None:
        self._bytes += bytes(-(len(self._bytes) - len(ENCAPSULATION)) % size)

    def _add_count(self, count: int) -> None:
        self._align(COUNT.size)
        self._bytes += COUNT.pack(count)

    def _add_string(self, text: str) -> None:
        encoded = text.encode() + b"\x00"
        self._add_count(len(encoded))
        self._bytes += encoded

    def encode(self, stamp_ns: int, values: FloatArray) -> bytes:
        """One sample, values in the order of the names."""
        STAMP.pack_into(self._bytes, STAMP_PLACE, *divmod(stamp_ns, NANOSECONDS))
        self._bytes[self._values] = values.tobytes()
        message = bytes(self._bytes)
        if self._authenticator is None:
            return message
        return message[: self._mac.start] + self._authenticator.mac(message) + message[self._mac.stop :]


class Decoder:
    """Bytes of one topic as samples: the wanted channels, by name. With an `authenticator`: only signed, new ones."""

    def __init__(self, wanted: Sequence[str], authenticator: MessageAuthenticator | None = None) -> None:
        self._wanted = list(wanted)
        self._authenticator = authenticator
        self._fixed = b""  # what does not change between the samples of the last sender
        self._names: list[str] = []
        self._order: list[int] = []
        self._place = 0
        self._mac = slice(0, 0)
        self._sender = ""

    def decode(self, raw: bytes) -> StampedVector | None:
        """The sample, None for a vector without channels. Raises ChannelError where it cannot be used."""
        if self._authenticator is None:
            return self._decode(raw)
        self._authenticator.check(raw)
        if (sample := self._decode(raw)) is not None:
            self._authenticator.accept(sample.stamp_ns)
        return sample

    def _decode(self, raw: bytes) -> StampedVector | None:
        if not self._fixed or self._fixed_part(raw) != self._fixed:
            message = _message(raw)
            if not message.name and not message.position:
                return None
            sample = from_message(message, self._wanted)
            self._learn(message, raw)
            return sample
        seconds, nanoseconds = STAMP.unpack_from(raw, STAMP_PLACE)
        value = np.frombuffer(raw, "<f8", len(self._names), self._place)[self._order]
        if not math.isfinite(value.sum()) and not np.isfinite(value).all():  # a sum of finite values may overflow
            raise ChannelError("finite", f"{', '.join(self._wanted)} = {value.tolist()} is not finite")
        return StampedVector(seconds * NANOSECONDS + nanoseconds, value, self._sender)

    def _fixed_part(self, raw: bytes) -> bytes:
        mac, end = self._mac, self._place + 8 * len(self._names)
        return raw[:STAMP_PLACE] + raw[STAMP_PLACE + STAMP.size : mac.start] + raw[mac.stop : self._place] + raw[end:]

    def _learn(self, message: JointState, raw: bytes) -> None:
        encoder = Encoder(message.name, message.header.frame_id)
        stamp = message.header.stamp
        if encoder.encode(stamp.sec * NANOSECONDS + stamp.nanosec, np.array(message.position)) != raw:
            return  # it holds more than a named vector; it is read the long way
        self._names, self._place, self._mac = list(message.name), encoder.place, mac_slice(raw)
        self._sender = _instance(message.header.frame_id)
        self._order = [self._names.index(name) for name in self._wanted]
        self._fixed = self._fixed_part(raw)


def _instance(frame_id: str) -> str:
    """The publisher's instance, without the code that it signs with."""
    return frame_id.partition(MARK)[0]


def stamp_of(raw: bytes) -> int:
    """The instant that a message with nothing in front of its stamp belongs to, ns."""
    seconds, nanoseconds = STAMP.unpack_from(raw, STAMP_PLACE)
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def instant(stamp_ns: int) -> bytes:
    """An instant as a message that holds nothing else: rosgraph_msgs/Clock, builtin_interfaces/Time."""
    return ENCAPSULATION + STAMP.pack(*divmod(stamp_ns, NANOSECONDS))


def _message(raw: bytes) -> JointState:
    try:
        return deserialize_message(raw, JointState)
    except DeserializationError as error:
        raise ChannelError("malformed", " ".join(str(error).split())) from None
