# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Convert named vectors to messages of sensor_msgs/JointState, and back.

The names of the message are the channels, the positions are the values, and the stamp is the
instant of the sample. The channels are constant during a flight. So the bytes of a message are laid
out once, and each sample changes only the stamp and the values. This is several times faster than
the serialisation by the middleware. The padding is always 0, so equal samples have equal bytes. The
middleware leaves uninitialised memory in the padding between two strings.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from flight_core.rates import NANOSECONDS
from flight_core.vectors import ChannelError, FloatArray, SampleFault, StampedVector, select
from flight_ros.rclpy_private import DeserializationError

# plain CDR, little-endian (DDS Interoperability Wire Protocol 2.2, 10.2)
ENCAPSULATION = b"\x00\x01\x00\x00"
BYTE_ORDERS: Mapping[bytes, Literal["big", "little"]] = MappingProxyType(
    {b"\x00\x00": "big", b"\x00\x01": "little"}
)
STAMP = struct.Struct("<iI")  # seconds and nanoseconds, which follow the encapsulation
STAMP_PLACE = len(ENCAPSULATION)
LENGTH_PLACE = STAMP_PLACE + STAMP.size  # offset of the length of header.frame_id
COUNT = struct.Struct("<I")  # length of a sequence or a string, which precedes its elements
FRAME_ID_PLACE = LENGTH_PLACE + COUNT.size
MAX_SIZE = 16_384
"""Largest size of a message of named vectors, bytes. The longest message of a flight, `internals`
of four channels with an observer, has 1,844."""

NO_CHANNELS: FloatArray = np.zeros(0)


def to_message(
    stamp_ns: int, names: Sequence[str], values: FloatArray, frame_id: str
) -> JointState:
    """Return a named vector as a message; `frame_id` is the name of the publisher's instance."""
    message = JointState()
    message.header.stamp = Time(sec=stamp_ns // NANOSECONDS, nanosec=stamp_ns % NANOSECONDS)
    message.header.frame_id = frame_id
    message.name = list(names)
    message.position = values.tolist()
    return message


def from_message(message: JointState, channels: Sequence[str]) -> StampedVector:
    """Return the stamp, the values of `channels` in this order, and the sender of a message.

    Raises ChannelError for invalid names, lengths or values.
    """
    stamp = message.header.stamp
    value = select(channels, message.name, message.position)
    return StampedVector(stamp.sec * NANOSECONDS + stamp.nanosec, value, message.header.frame_id)


class Encoder:
    """Encodes the samples of a publisher as the bytes of a message.

    Without names, the message has no channels. In lockstep such a message says that there is no
    sample at this instant. The layout is CDR (OMG Common Object Request Broker Architecture, 9.3).
    Each count and each value is aligned to its own size, counted from the end of the encapsulation.
    Padding bytes are 0.
    """

    def __init__(self, names: Sequence[str], frame_id: str) -> None:
        self._bytes = bytearray(ENCAPSULATION + bytes(STAMP.size))
        self._add_string(frame_id)
        self._add_count(len(names))
        for name in names:
            self._add_string(name)
        self._add_count(len(names))
        if names:
            self._align(8)
        self.place = len(self._bytes)  # offset of the values
        self._values = slice(self.place, self.place + 8 * len(names))
        # an empty velocity and an empty effort follow the values
        self._bytes += bytes(8 * len(names) + 2 * COUNT.size)

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
        """Return the message of a sample; the values are in the order of the names."""
        STAMP.pack_into(self._bytes, STAMP_PLACE, *divmod(stamp_ns, NANOSECONDS))
        self._bytes[self._values] = values.tobytes()
        return bytes(self._bytes)


class Decoder:
    """Decodes some channels of the messages of a topic."""

    def __init__(self, channels: Sequence[str]) -> None:
        self._channels = list(channels)
        self._fixed = b""  # the constant bytes of the last publisher's messages
        self._names: list[str] = []
        self._order: list[int] = []
        self._place = 0
        self._sender = ""

    def decode(self, raw: bytes) -> StampedVector | None:
        """Return the sample in a message, or None for a vector without channels.

        Raises ChannelError for an invalid message.
        """
        if not self._fixed or self._fixed_part(raw) != self._fixed:
            message = _message(raw)
            if not message.name and not message.position:
                return None
            sample = from_message(message, self._channels)
            self._learn_layout(message, raw)
            return sample
        seconds, nanoseconds = STAMP.unpack_from(raw, STAMP_PLACE)
        value = np.frombuffer(raw, "<f8", len(self._names), self._place)[self._order]
        # the sum of finite values may overflow
        if not math.isfinite(value.sum()) and not np.isfinite(value).all():
            raise ChannelError(
                SampleFault.FINITE, f"{', '.join(self._channels)} = {value.tolist()} is not finite"
            )
        return StampedVector(seconds * NANOSECONDS + nanoseconds, value, self._sender)

    def _fixed_part(self, raw: bytes) -> bytes:
        end = self._place + 8 * len(self._names)
        return raw[:STAMP_PLACE] + raw[STAMP_PLACE + STAMP.size : self._place] + raw[end:]

    def _learn_layout(self, message: JointState, raw: bytes) -> None:
        encoder = Encoder(message.name, message.header.frame_id)
        stamp = message.header.stamp
        if (
            encoder.encode(stamp.sec * NANOSECONDS + stamp.nanosec, np.array(message.position))
            != raw
        ):
            # An Encoder makes other bytes, for example without velocities or with padding of 0. So
            # the middleware decodes each message of this publisher.
            return
        self._names = list(message.name)
        self._place = encoder.place
        self._sender = message.header.frame_id
        self._order = [self._names.index(name) for name in self._channels]
        self._fixed = self._fixed_part(raw)


class NamedSample(NamedTuple):
    """A sample with the names of its channels."""

    stamp_ns: int
    channels: dict[str, float]
    sender: str


class NamedDecoder:
    """Decodes all channels of the messages of a topic whose channels vary.

    This decoder is several times slower than Decoder.
    """

    def decode(self, raw: bytes) -> NamedSample:
        """Return the sample in a message. Raises ChannelError for an invalid message."""
        message = _message(raw)
        sample = from_message(message, message.name)
        names = list(message.name)
        if len(set(names)) < len(names):
            raise ChannelError(
                SampleFault.NAME, f"each channel expected once among {', '.join(names)}"
            )
        return NamedSample(
            sample.stamp_ns, dict(zip(names, sample.value.tolist(), strict=True)), sample.sender
        )


def sender_of(raw: bytes) -> str | None:
    """Return the publisher of a message that begins with a header.

    Names and values are not decoded. Returns None if the bytes are too short, or are not plain CDR.
    """
    if len(raw) < FRAME_ID_PLACE or (order := BYTE_ORDERS.get(raw[:2])) is None:
        return None
    length = int.from_bytes(raw[LENGTH_PLACE:FRAME_ID_PLACE], order)
    return raw[FRAME_ID_PLACE : FRAME_ID_PLACE + length - 1].decode(errors="replace")


def stamp_of(raw: bytes) -> int:
    """Read the stamp at the beginning of a message, ns.

    Raises ChannelError with the reason "malformed" if the bytes are too short or no plain CDR.
    """
    order = BYTE_ORDERS.get(raw[:2])
    if order is None or len(raw) < LENGTH_PLACE:
        raise ChannelError(
            SampleFault.MALFORMED, f"a message of {len(raw)} bytes, expected a stamp in plain CDR"
        )
    place = STAMP_PLACE + STAMP.size // 2
    seconds = int.from_bytes(raw[STAMP_PLACE:place], order, signed=True)
    return seconds * NANOSECONDS + int.from_bytes(raw[place:LENGTH_PLACE], order)


def instant(stamp_ns: int) -> bytes:
    """Return a message that has only an instant: rosgraph_msgs/Clock, builtin_interfaces/Time."""
    return ENCAPSULATION + STAMP.pack(*divmod(stamp_ns, NANOSECONDS))


def require_size(raw: bytes, limit: int = MAX_SIZE) -> None:
    """Raise ChannelError, reason "size", for a message of more than `limit` bytes."""
    if len(raw) > limit:
        raise ChannelError(
            SampleFault.SIZE, f"a message of {len(raw)} bytes, expected at most {limit}"
        )


def _message(raw: bytes) -> JointState:
    require_size(raw)
    try:
        return deserialize_message(raw, JointState)
    except DeserializationError as error:
        raise ChannelError(SampleFault.MALFORMED, " ".join(str(error).split())) from None
