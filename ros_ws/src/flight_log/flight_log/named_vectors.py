# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Decode the messages of a topic as named vectors, without ROS.

The messages of a topic usually have the same sender and the same channels, and differ only in stamp
and values. The decoder learns the byte layout from one message, and then decodes all messages with
this layout together.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.serde.errors import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from flight_core.rates import NANOSECONDS, nanoseconds
from flight_core.vectors import FloatArray

JOINT_STATE = "sensor_msgs/msg/JointState"
JOINT_STATE_TYPES = {
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    JOINT_STATE: "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] "
    "velocity\nfloat64[] effort",
}
"""A JointState and its header, as ROS 2 defines them."""

PATH = "nav_msgs/msg/Path"
WAYPOINT = ("number", "north", "east", "altitude")
"""Channels of a waypoint of a route: its number in the message, and its position, m."""

STAMP = slice(4, 12)  # int32 seconds and uint32 nanoseconds, after the 4 bytes of the encapsulation
SENDER_PLACE = STAMP.stop + 4  # place of header.frame_id, after the 4 bytes of its length
# byte order of plain CDR, by the first two bytes of a message
BYTE_ORDERS: Mapping[bytes, Literal["big", "little"]] = MappingProxyType(
    {b"\x00\x00": "big", b"\x00\x01": "little"}
)
MAX_FLIGHT_TIME = 1e9  # largest value that counts as a flight time, s


@dataclass(frozen=True, kw_only=True)
class Samples:
    """N samples with the same k channels."""

    names: tuple[str, ...]
    stamp_ns: NDArray[np.int64]  # (N,), the instant of each sample
    values: FloatArray  # (N, k)
    sender: str = ""  # name of the publisher with its process, such as "/controller#4711"


class Decoded(NamedTuple):
    """The decoded content of some messages.

    A vector without channels means a missing sample, and is left out.
    """

    samples: list[Samples]
    unreadable: int  # number of messages that could not be decoded


Table = NDArray[np.uint8]
"""Messages of one length, one in each row."""

Decoder = Callable[[Table], Decoded]


@cache
def typestore() -> Typestore:
    """Return the message types of ROS 2 Jazzy. The first call loads them, which takes 70 ms."""
    return get_typestore(Stores.ROS2_JAZZY)


@cache
def joint_state_types() -> Typestore:
    """Return the types JOINT_STATE_TYPES, which suffice for most logs."""
    # The empty store already has Time.
    store = get_typestore(Stores.EMPTY)
    for name, definition in JOINT_STATE_TYPES.items():
        store.register(get_types_from_msg(definition, name))
    return store


def full_name(type_name: str) -> str:
    """Return the full name "pkg/msg/Type" of a message type from its full or short name."""
    return type_name.replace("/", "/msg/") if type_name.count("/") == 1 else type_name


def decoder(type_name: str) -> Decoder | None:
    """Return a decoder for a message type, or None if its messages are no named vectors.

    Use one decoder for each topic. A call takes several messages in their order.
    """
    return _JointStateDecoder() if type_name == JOINT_STATE else None


def tables(messages: Iterable[bytes]) -> Iterator[Table]:
    """Group successive messages of equal length into tables, and keep their order."""
    for size, group in groupby(messages, len):
        messages_of_size = list(group)
        yield np.frombuffer(b"".join(messages_of_size), dtype=np.uint8).reshape(
            len(messages_of_size), size
        )


def stamp_in(data: bytes) -> int:
    """Read the stamp at the beginning of a message, ns."""
    return int.from_bytes(data[STAMP][:4], "little", signed=True) * NANOSECONDS + int.from_bytes(
        data[STAMP][4:], "little"
    )


def stamps_of(table: Table) -> NDArray[np.int64]:
    """Read the stamps at the beginning of messages, ns, shape (N,)."""
    stamps = np.ascontiguousarray(table[:, STAMP])
    return stamps.view("<i4")[:, 0].astype(np.int64) * NANOSECONDS + stamps.view("<u4")[:, 1]


def rows_by_sender(table: Table) -> list[tuple[bytes, NDArray[np.int64] | None]]:
    """List the senders in the headers of messages, as bytes, and the rows of each sender.

    If all rows have the same sender, its rows are given as None. A message without a header in
    plain CDR has the sender b"".
    """
    count = len(table)
    first = _sender(table[0])
    header = np.delete(table[:, : SENDER_PLACE + len(first)], STAMP, axis=1)
    if first and (header == header[0]).all():
        return [(first, None)]
    senders = [_sender(row) for row in table]
    if len({*senders}) == 1:
        return [(first, None)]
    rows: dict[bytes, list[int]] = {}
    for row in range(count):
        rows.setdefault(senders[row], []).append(row)
    return [(sender, np.array(places)) for sender, places in rows.items()]


def _sender(row: NDArray[np.uint8]) -> bytes:
    """Return the bytes of header.frame_id, with the final zero."""
    header = bytes(row[:SENDER_PLACE])
    order = BYTE_ORDERS.get(header[:2])
    if len(header) < SENDER_PLACE or order is None:
        return b""
    length = int.from_bytes(header[STAMP.stop :], order)
    sender = bytes(row[SENDER_PLACE : SENDER_PLACE + length])
    return sender if len(sender) == length and sender.endswith(b"\x00") else b""


def flight_start_ns(stamp_ns: int, t: float) -> int | None:
    """Return the stamp of flight time 0, ns, from the stamp of a `truth` sample at time t, s.

    The result is the stamp minus t, or None if t is too large for a flight.
    """
    return stamp_ns - nanoseconds(t) if abs(t) <= MAX_FLIGHT_TIME else None


def encoded(samples: Samples) -> NDArray[np.uint8]:
    """Serialise samples as sensor_msgs/JointState, one message in each row.

    Velocity and effort are empty. The first message is serialised by its definition. The other
    messages differ from it only in stamp and values.
    """
    store = joint_state_types()
    types: dict[str, Any] = store.types
    header = types["std_msgs/msg/Header"]
    time = types["builtin_interfaces/msg/Time"]
    empty = np.zeros(0)
    marks = _marks(len(samples.names))
    message = types[JOINT_STATE](
        header(time(sec=0, nanosec=0), samples.sender), list(samples.names), marks, empty, empty
    )
    template = bytes(store.serialize_cdr(message, JOINT_STATE))
    rows = np.tile(np.frombuffer(template, dtype=np.uint8), (len(samples.stamp_ns), 1))
    seconds, nanoseconds = np.divmod(samples.stamp_ns, NANOSECONDS)
    rows[:, STAMP] = np.stack([seconds, nanoseconds], axis=1).astype("<u4").view(np.uint8)
    rows[:, _position(template, marks)] = np.ascontiguousarray(samples.values, dtype="<f8").view(
        np.uint8
    )
    return rows


def _marks(k: int) -> FloatArray:
    """Return k values that serve as marks in a serialised message.

    Their bytes occur in no string.
    """
    return np.asarray(-np.arange(1.0, k + 1.0) * np.pi)


def _position(message: bytes, marks: FloatArray) -> slice:
    """Return the place of the marks, and thus of the values, in a message."""
    start = message.index(marks.tobytes())
    return slice(start, start + marks.nbytes)


def decode_routes(table: Table) -> Decoded:
    """Decode routes of nav_msgs/Path in the frame map (east, north, up).

    Each waypoint becomes a sample with the channels WAYPOINT.
    """
    samples = []
    unreadable = 0
    for message in map(bytes, table):
        try:
            route: Any = typestore().deserialize_cdr(message, PATH)
        except SerdeError:
            unreadable += 1
            continue
        points = [stamped_pose.pose.position for stamped_pose in route.poses]
        if points:
            rows = np.array([(k, point.y, point.x, point.z) for k, point in enumerate(points)])
            samples.append(
                Samples(names=WAYPOINT, stamp_ns=np.full(len(rows), stamp_in(message)), values=rows)
            )
    return Decoded(samples, unreadable)


class _JointStateDecoder:
    """A decoder of sensor_msgs/JointState that reads names and positions."""

    def __init__(self) -> None:
        self._store = joint_state_types()
        self._names: tuple[str, ...] = ()
        self._sender = ""
        self._template = np.zeros(0, dtype="<u4")  # the message from which the layout was learnt
        # 255 for each byte that is equal in all messages with this layout, else 0
        self._constant = np.zeros(0, dtype="<u4")
        self._values = slice(0, 0)

    def __call__(self, table: Table) -> Decoded:
        if not self._names and len(table):
            self._learn(bytes(table[0]))
        has_layout = self._has_same_layout(table)
        samples = []
        if has_layout.any():
            rows = table if has_layout.all() else table[has_layout]
            values = np.ascontiguousarray(rows[:, self._values]).view("<f8")
            samples.append(
                Samples(
                    names=self._names, stamp_ns=stamps_of(rows), values=values, sender=self._sender
                )
            )
        unreadable = 0
        unknown = [bytes(message) for message in table[~has_layout]]
        for message in unknown:
            try:
                vector: Any = self._store.deserialize_cdr(message, JOINT_STATE)
            except SerdeError:
                unreadable += 1
                continue
            if not vector.name and not len(vector.position):
                continue
            stamp = vector.header.stamp
            stamps = np.array([stamp.sec * NANOSECONDS + stamp.nanosec])
            samples.append(
                Samples(
                    names=tuple(vector.name),
                    stamp_ns=stamps,
                    values=vector.position[None],
                    sender=vector.header.frame_id,
                )
            )
        if unknown:
            self._learn(unknown[-1])
        return Decoded(samples, unreadable)

    def _has_same_layout(self, table: Table) -> NDArray[np.bool_]:
        """Return a mask of the messages that have the learnt layout."""
        if not self._names or table.shape[1] != self._template.nbytes:
            return np.zeros(len(table), dtype=np.bool_)
        different = table.view("<u4") ^ self._template
        different &= self._constant
        return np.asarray(different.max(axis=1) == 0)

    def _learn(self, message: bytes) -> None:
        """Learn the byte layout of a message.

        Marks are serialised in place of the values, with the same strings. The values of the
        message are at the places that the marks have in the result.
        """
        try:
            vector: Any = self._store.deserialize_cdr(message, JOINT_STATE)
        except SerdeError:
            return
        k = len(vector.name)
        if (
            k == 0
            or len(vector.position) != k
            or len(vector.velocity)
            or len(vector.effort)
            or message[:4] != b"\x00\x01\x00\x00"
        ):
            return
        marks = _marks(k)
        template = bytes(
            self._store.serialize_cdr(
                type(vector)(vector.header, vector.name, marks, vector.velocity, vector.effort),
                JOINT_STATE,
            )
        )
        values = _position(template, marks)
        if len(template) != len(message) or message[values] != vector.position.tobytes():
            return
        self._names = tuple(vector.name)
        self._values = values
        self._sender = vector.header.frame_id
        # A message without velocity and effort ends with the lengths of these two arrays.
        self._template = np.frombuffer(message, dtype="<u4")
        constant = np.full(len(message), 255, dtype=np.uint8)
        constant[STAMP] = constant[self._values] = 0
        self._constant = constant.view("<u4")
