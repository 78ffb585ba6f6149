# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a receiver checks size and publisher before it decodes.

It refuses, counts and logs what does not fit.
"""

from typing import Any

import numpy as np
import pytest
from tests.joint_states import JOINT_STATE, STORE, vector

from flight_core.outcome import Refusal
from flight_core.publisher_lock import LockstepLock, PublisherLock
from flight_core.vectors import ChannelError, SampleFault, StampedVector
from flight_ros import messages
from flight_ros.messages import MAX_SIZE, Decoder, Encoder, NamedDecoder, require_size
from flight_ros.receiver import Receiver, Refusals
from flight_ros.subscriptions import PolledSubscription, ReceivedMessage
from flight_ros.topics import Y

NAMES = ("q", "V")
MAX_AGE, TAKEOVER = 100, 1000  # ns


class Topic(PolledSubscription):
    """A subscription without middleware, which is also the node that logs."""

    def __init__(self) -> None:
        self.topic = Y
        self.name = "/y"
        self.messages: list[bytes] = []
        self.numbers: list[int] = []
        self.lines: list[tuple[str, str]] = []

    def take(self, most: int | None = None) -> list[ReceivedMessage]:
        """Return the messages, without metadata."""
        taken = self.messages[:most]
        self.messages = self.messages[most or len(self.messages) :]
        numbers = self.numbers or [0] * len(taken)
        self.numbers = self.numbers[len(taken) :]
        return [
            ReceivedMessage(message, 0, 0, number)
            for message, number in zip(taken, numbers, strict=True)
        ]

    def get_logger(self) -> Any:
        """Return itself."""
        return self

    def error(self, line: str) -> None:
        """Keep a line."""
        self.lines.append(("error", line))

    def warning(self, line: str) -> None:
        """Keep a line."""
        self.lines.append(("warning", line))


class Setup:
    """A receiver with what it decoded and took. With `locked` None, it has the lock of lockstep."""

    def __init__(
        self, *, locked: bool | None = True, max_age: int | None = None, max_size: int | None = None
    ) -> None:
        self.topic = Topic()
        self.refusals = Refusals(self.topic)
        self.decoded: list[bytes] = []
        self.taken: list[StampedVector] = []
        self._decoder = Decoder(NAMES)
        locks = {True: PublisherLock(lambda: (MAX_AGE, TAKEOVER)), None: LockstepLock()}
        lock = locks.get(locked)
        max_age_ns = None if max_age is None else lambda: max_age
        self.receiver = Receiver(
            self.topic,
            self.refusals,
            self.decode,
            self.take,
            lock=lock,
            max_age_ns=max_age_ns,
            max_size=max_size,
        )

    def decode(self, raw: bytes) -> StampedVector | None:
        """Decode a message and remember the bytes."""
        self.decoded.append(raw)
        return self._decoder.decode(raw)

    def take(self, sample: StampedVector, now_ns: int) -> None:
        """Take a sample with q of at most 1."""
        if sample.value[0] > 1.0:
            raise ChannelError(SampleFault.BOUNDS, "beyond")
        self.taken.append(sample)

    def poll(self, *messages: bytes, now_ns: int = 0, limit: int | None = None) -> list[bool]:
        """Poll after these messages have arrived."""
        self.topic.messages += messages
        return self.receiver.poll(now_ns, limit)


def message(
    sender: str = "/aircraft#1", stamp_ns: int = 0, q: float = 0.5, names: tuple[str, ...] = NAMES
) -> bytes:
    return Encoder(names, sender).encode(stamp_ns, np.array([q, *np.zeros(len(names) - 1)]))


def of_size(size: int, sender: str = "/aircraft#1") -> bytes:
    """A message of as many channels as the size takes."""
    raw = message(sender, names=tuple(f"c{k}" for k in range(size // 20)))
    return raw + bytes(size - len(raw))


def test_valid_sample_is_taken() -> None:
    setup = Setup()
    empty = Encoder((), "/aircraft#1").encode(0, np.zeros(0))
    assert setup.poll(message(), empty) == [True, True]
    assert [(sample.sender, sample.value.tolist()) for sample in setup.taken] == [
        ("/aircraft#1", [0.5, 0.0])
    ]
    assert not setup.refusals.counts


def test_poll_has_a_limit() -> None:
    setup = Setup()
    assert setup.poll(message(), message(), message(), limit=1) == [True]
    assert setup.poll() == [True, True]


@pytest.mark.parametrize("size", [MAX_SIZE + 1, 1_200_000])
@pytest.mark.parametrize("sender", ["/aircraft#1", "/foreign"])
def test_long_message_is_not_decoded(size: int, sender: str) -> None:
    setup = Setup()
    assert setup.poll(of_size(size, sender)) == [False]
    assert setup.receiver.receive() == []
    setup.topic.messages.append(of_size(size, sender))
    assert setup.receiver.receive() == []  # in lockstep
    assert setup.decoded == []
    assert setup.refusals.counts == {"y: size": 2}
    # one line, for it is the same topic and reason
    assert setup.topic.lines == [
        ("warning", f"/y: sample refused: a message of {size} bytes, expected at most {MAX_SIZE}")
    ]


def test_long_message_under_the_name_of_the_publisher_is_not_decoded() -> None:
    """The cost of decoding grows with the length: 16 kB cost 22 times as much as a right message.

    After a time-out, the next publisher may have other channels.
    """
    setup = Setup()
    right = message()
    longer = message(names=(*NAMES, "alpha"))
    too_long = longer + bytes(len(longer) + 1)
    assert setup.poll(right, longer, right, too_long, of_size(MAX_SIZE)) == [
        True,
        True,
        True,
        False,
        False,
    ]
    assert len(setup.decoded) == 3
    assert setup.refusals.counts == {"y: size": 2}
    assert setup.topic.lines[0][1].endswith(f"bytes, expected at most {2 * len(longer)}")
    assert setup.poll(too_long[:-1]) == [True]
    wide = message(names=(*NAMES, *(f"c{k}" for k in range(40))))
    assert setup.poll(wide, now_ns=MAX_AGE) == [False]
    assert setup.poll(wide, now_ns=MAX_AGE + 1) == [True]


def test_report_may_be_much_longer_than_the_one_before() -> None:
    """A learner without a model sends reports of 300 bytes.

    Half a timeout later, it sends a proposal of 10,000 bytes.
    """
    right = message()
    long = message(names=(*NAMES, *(f"c{k}" for k in range(800))))
    setup = Setup(max_size=len(long))
    assert setup.poll(right, long, long + bytes(1)) == [True, True, False]


def test_size_limit_is_inclusive() -> None:
    require_size(bytes(MAX_SIZE))
    with pytest.raises(ChannelError, match=f"a message of {MAX_SIZE + 1} bytes"):
        require_size(bytes(MAX_SIZE + 1))


@pytest.mark.parametrize("decoder", [Decoder(NAMES), NamedDecoder()])
def test_no_client_decodes_long_message(
    decoder: Decoder | NamedDecoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A command that waits for a topic has no receiver, so its decoder must check the size."""
    monkeypatch.setattr(messages, "deserialize_message", None)
    with pytest.raises(ChannelError, match="a message of 1200000 bytes"):
        decoder.decode(of_size(1_200_000))


def big_endian(sender: str) -> bytes:
    """Return a message of NAMES in the big-endian encoding of CDR."""
    made = STORE.deserialize_cdr(vector(0, NAMES, (0.5, 0.0), sender), JOINT_STATE)
    return bytes(STORE.serialize_cdr(made, JOINT_STATE, little_endian=False))


FOREIGN = [
    message("/foreign"),
    of_size(MAX_SIZE, "/foreign"),
    message("/foreign", names=("a",)),
    big_endian("/foreign"),
]


@pytest.mark.parametrize("raw", FOREIGN)
def test_conflicting_publisher_is_not_decoded(raw: bytes) -> None:
    setup = Setup()
    assert setup.poll(message(), raw) == [True, False]
    assert len(setup.decoded) == 1
    assert setup.refusals.counts == {"y: sender": 1}
    sentence = "conflicting publisher /foreign ignored: already receiving from /aircraft#1"
    assert setup.topic.lines == [("error", f"/y: sample refused: {sentence}")]
    assert setup.refusals.last["/y"][1] == sentence
    assert setup.refusals.pop_conflict() == Refusal(f"/y: {sentence}")
    assert setup.refusals.pop_conflict() is None
    # the first one has timed out
    assert setup.poll(message("/foreign"), now_ns=TAKEOVER + 1) == [True]


def test_big_endian_publisher_is_taken() -> None:
    setup = Setup()
    assert setup.poll(big_endian("/aircraft#1"), message()) == [True, True]


@pytest.mark.parametrize(
    "encapsulation", [b"\x00\x02", b"\x00\x03", b"\x00\x07", b"\x00\x0b", b"\xff\xff"]
)
def test_message_of_another_encoding_is_not_decoded(encapsulation: bytes) -> None:
    """PL_CDR and XCDR2 have the publisher in another place."""
    setup = Setup()
    assert setup.poll(encapsulation + message()[2:]) == [False]
    assert setup.decoded == []
    assert setup.refusals.counts == {"y: malformed": 1}


def test_without_lock_each_publisher_is_taken() -> None:
    setup = Setup(locked=False)
    assert setup.poll(message("/one"), message("/two")) == [True, True]


@pytest.mark.parametrize(
    "raw, reason",
    [
        (b"", "malformed"),
        (message()[:30], "malformed"),
        (message(names=("q", "x")), "name"),
        (message(q=np.nan), "finite"),
        (message(q=2.0), "bounds"),
    ],
)
def test_invalid_message_does_not_lock(raw: bytes, reason: str) -> None:
    setup = Setup()
    assert setup.poll(raw) == [False]
    assert setup.refusals.counts == {f"y: {reason}": 1}
    assert setup.poll(message("/second")) == [True]


@pytest.mark.parametrize(
    "stamp_ns, reason", [(-101, "old"), (101, "future"), (-100, ""), (100, "")]
)
def test_stamps_are_limited_both_ways(stamp_ns: int, reason: str) -> None:
    setup = Setup(max_age=MAX_AGE)
    assert setup.poll(message(stamp_ns=stamp_ns)) == [not reason]
    assert setup.refusals.counts == ({f"y: {reason}": 1} if reason else {})


def lockstep(setup: Setup, *messages: tuple[bytes, int]) -> list[int | None]:
    """Return the stamps of the instants for messages with these numbers.

    An instant without a sample gives None.
    """
    setup.topic.messages += [raw for raw, _ in messages]
    setup.topic.numbers += [number for _, number in messages]
    return [sample and sample.stamp_ns for sample in setup.receiver.receive()]


EMPTY = Encoder((), "/aircraft#1").encode(0, np.zeros(0))
NO_INSTANTS = {
    "no bytes": (b"", 1, "malformed"),
    "two bytes": (b"\x00\x01", 1, "malformed"),
    "a header without a sender": (message()[:12], 1, "malformed"),
    "a foreign sample": (message("/foreign"), 1, "sender"),
    "foreign bytes": (message("/foreign")[:40], 1, "sender"),
    "no channels and no sender": (Encoder((), "").encode(0, np.zeros(0)), 1, "sender"),
    "another encoding": (b"\x00\x07" + message()[2:], 1, "malformed"),
    "a long message": (of_size(MAX_SIZE + 1), 1, "size"),
    "a sample under the name of the flight": (message(), 1, "sender"),
    "no channels under the name of the flight": (EMPTY, 70, "sender"),
    "bytes under the name of the flight": (message()[:60], 1, "sender"),
}


@pytest.mark.parametrize("raw, number, reason", NO_INSTANTS.values(), ids=NO_INSTANTS)
def test_message_of_a_foreign_publisher_is_no_instant_of_a_lockstep_flight(
    raw: bytes, number: int, reason: str
) -> None:
    """Each message of the flight's publisher is an instant, and other messages are ignored."""
    setup = Setup(locked=None, max_age=MAX_AGE)
    own = [(message(stamp_ns=10 * k), 7 + k) for k in range(4)]
    assert lockstep(setup, own[0], (raw, number), own[1]) == [0, 10]
    assert lockstep(setup, (raw, number)) == []
    assert lockstep(setup, own[2], own[3]) == [20, 30]
    assert setup.refusals.counts == {f"y: {reason}": 2}


@pytest.mark.parametrize(
    "raw",
    [b"", message()[:50], message("/foreign", stamp_ns=2 * MAX_AGE), message("/foreign", q=np.nan)],
)
def test_invalid_message_before_a_lockstep_flight_is_no_instant(raw: bytes) -> None:
    setup = Setup(locked=None, max_age=MAX_AGE)
    assert lockstep(setup, (raw, 3), (EMPTY, 1), (message(stamp_ns=10), 2)) == [None, 10]


def test_refused_content_of_the_flights_publisher_is_an_instant_without_a_sample() -> None:
    setup = Setup(locked=None, max_age=MAX_AGE)
    refused = message(stamp_ns=10, q=np.nan)
    found = lockstep(setup, (message(), 1), (refused, 2), (message(stamp_ns=20), 3))
    assert found == [0, None, 20]
    assert setup.refusals.counts == {"y: finite": 1}


def test_polled_topic_of_a_lockstep_flight_is_locked_by_a_message_without_channels() -> None:
    """This is so for u, because the controller says at each instant that there is none yet."""
    setup = Setup(locked=None, max_age=MAX_AGE)
    foreign = [message("/foreign"), Encoder((), "").encode(0, np.zeros(0))]
    assert setup.poll(EMPTY, *foreign, message(), *foreign) == [
        True,
        False,
        False,
        True,
        *[False] * 2,
    ]
    later = message("/foreign", stamp_ns=10**9)
    assert setup.poll(later, now_ns=10**9) == [False]  # it never times out
    assert len(setup.taken) == 1


def test_received_sample_is_accepted_as_polled() -> None:
    """In lockstep, all messages are decoded, and then accepted at their instants."""
    setup = Setup(max_age=MAX_AGE)
    setup.topic.messages += [message(), b"", message("/foreign"), message(stamp_ns=500)]
    samples = setup.receiver.receive()
    # bytes and the foreign sample are no instant
    assert [sample is None for sample in samples] == [False, False]
    for sample in samples:
        if sample is not None:
            setup.receiver.accept(sample, 0)
    assert len(setup.taken) == 1
    assert setup.refusals.counts == {"y: malformed": 1, "y: sender": 1, "y: future": 1}
