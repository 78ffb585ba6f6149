# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of a log as named vectors: which topics and types hold any, and how they are read. Needs no ROS.

A topic of samples is as good as always written by one sender with the same channels: its messages then differ in the stamp and
the values alone. So the layout is learnt from one message, and all that share it are read at once.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.serde.errors import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from flight_core.authentication import mac_slice
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_core.vectors import FloatArray

JOINT_STATE = "sensor_msgs/msg/JointState"

STAMP = slice(4, 12)  # int32 seconds and uint32 nanoseconds, behind the 4 bytes of the encapsulation


LONGEST_FLIGHT = 1e9
"""s. What says that more have passed is no flight time."""


class Samples(NamedTuple):
    """N samples with the same k channels."""

    names: tuple[str, ...]
    stamp_ns: NDArray[np.int64]  # (N,), the instant each sample belongs to
    values: FloatArray  # (N, k)


class Decoded(NamedTuple):
    """What some messages hold. Vectors without channels, which say that there is no sample, are left out."""

    samples: list[Samples]
    unreadable: int


Decoder = Callable[[Sequence[bytes]], Decoded]


@cache
def typestore() -> Typestore:
    """The message types of this ROS 2, made once: each takes 20 ms to be read for the first time."""
    return get_typestore(Stores.ROS2_JAZZY)


def decoder(topic: str, type_name: str) -> Decoder | None:
    """What turns messages of a topic, by its full name, of a type into named vectors; None where they are none.

    A decoder is for one topic, whose messages it is given in their order, some at a time.
    """
    return _JointStates() if type_name == JOINT_STATE else None


def flight_start_ns(stamp_ns: int, t: float) -> int | None:
    """The stamp of flight time 0, of a sample of `truth` and its t in s: stamp - t; None where t is no flight time."""
    return stamp_ns - nanoseconds(t) if abs(t) <= LONGEST_FLIGHT else None


class _JointStates:
    """sensor_msgs/JointState with names and positions."""

    def __init__(self) -> None:
        self._store = typestore()
        self._names: tuple[str, ...] = ()
        self._fixed = np.zeros(0, dtype=np.uint8)  # the message learnt from
        self._is_fixed = np.zeros(0, dtype=np.bool_)  # which of its bytes all messages of its layout share
        self._values = slice(0, 0)

    def __call__(self, messages: Sequence[bytes]) -> Decoded:
        if not self._names and messages:
            self._learn(messages[0])
        samples, rest = self._at_once(messages)
        unreadable = 0
        for message in rest:
            try:
                one: Any = self._store.deserialize_cdr(message, JOINT_STATE)
            except SerdeError:
                unreadable += 1
                continue
            if not one.name and not len(one.position):
                continue
            stamp = one.header.stamp
            stamps = np.array([stamp.sec * NANOSECONDS + stamp.nanosec])
            samples.append(Samples(tuple(one.name), stamps, one.position[None]))
        if rest:
            self._learn(rest[-1])
        return Decoded(samples, unreadable)

    def _at_once(self, messages: Sequence[bytes]) -> tuple[list[Samples], list[bytes]]:
        """The samples in messages of the layout that was learnt, and the other messages."""
        size = len(self._fixed)
        fitting = [message for message in messages if len(message) == size] if self._names else []
        rest = [message for message in messages if len(message) != size] if self._names else list(messages)
        if not fitting:
            return [], rest
        table = np.frombuffer(b"".join(fitting), dtype=np.uint8).reshape(-1, size)
        same = (table == self._fixed)[:, self._is_fixed].all(axis=1)
        rest += [message for message, alike in zip(fitting, same, strict=True) if not alike]
        table = table[same]
        stamps = np.ascontiguousarray(table[:, STAMP])
        stamp_ns = stamps.view("<i4")[:, 0] * np.int64(NANOSECONDS) + stamps.view("<u4")[:, 1]
        values = np.ascontiguousarray(table[:, self._values]).view("<f8")
        return [Samples(self._names, stamp_ns, values)] if len(table) else [], rest

    def _learn(self, message: bytes) -> None:
        """Where its values stand: where another message with the same strings has values that stand nowhere else."""
        try:
            one: Any = self._store.deserialize_cdr(message, JOINT_STATE)
        except SerdeError:
            return
        k = len(one.name)
        if k == 0 or len(one.position) != k or len(one.velocity) or len(one.effort) or message[:4] != b"\x00\x01\x00\x00":
            return
        marks: FloatArray = -np.arange(1.0, k + 1.0) * np.pi
        marked = bytes(self._store.serialize_cdr(type(one)(one.header, one.name, marks, one.velocity, one.effort), JOINT_STATE))
        place = marked.index(marks.tobytes())
        if len(marked) != len(message) or message[place : place + 8 * k] != one.position.tobytes():
            return
        self._names, self._values = tuple(one.name), slice(place, place + 8 * k)
        self._fixed = np.frombuffer(message, dtype=np.uint8)
        self._is_fixed = np.ones(len(message), dtype=np.bool_)
        self._is_fixed[STAMP] = self._is_fixed[self._values] = False
        self._is_fixed[mac_slice(message)] = False
