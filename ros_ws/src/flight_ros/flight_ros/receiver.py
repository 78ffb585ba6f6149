# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Receive the samples of a topic, which are checked and taken at a tick.

Refused samples are counted and logged.
"""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import Generic, Protocol, TypeVar

import numpy as np
from rclpy.node import Node

from flight_core.outcome import Refusal
from flight_core.publisher_lock import LockstepLock, PublisherLock
from flight_core.rates import NANOSECONDS
from flight_core.vectors import ChannelError, SampleFault, require_not_future, require_not_old
from flight_ros.messages import MAX_SIZE, require_size, sender_of, stamp_of
from flight_ros.subscriptions import PolledSubscription, ReceivedMessage
from flight_ros.throttle import Throttle
from flight_ros.topics import Topic

# time between two log lines on refused samples of the same topic and reason
LOG_PERIOD_NS = 2 * NANOSECONDS
GROWTH = 2
"""Largest permitted size of a message, divided by the size of the longest valid message so far. A
publisher may leave channels out, so a longer message can follow. For example, a bridge leaves out
the channels of a pose that are not fresh, and three of seven channels have half of the bytes."""

RECENT = 9  # number of samples from which the median interval is taken
# number of samples that must fit into an age limit, so that one may be late and one may be lost
FEWEST = 3


class Sample(Protocol):
    """The properties of a decoded message that a receiver uses."""

    @property
    def stamp_ns(self) -> int:
        """Instant to which the sample belongs."""

    @property
    def sender(self) -> str:
        """Name of the publisher."""


S = TypeVar("S", bound=Sample)
T = TypeVar("T")


class Source(Protocol):
    """A source of samples: the topic, and its full name."""

    topic: Topic
    name: str


class Refusals:
    """The refused samples of a node."""

    def __init__(
        self, node: Node, clock_of: Callable[[str], str | None] = lambda sender: None
    ) -> None:
        # returns the end of a sentence on a stamp if the sender's clock differs
        self.clock_of = clock_of
        self.counts: Counter[str] = Counter()  # number of refusals by "topic: reason"
        # by full topic name: the instant of the last refusal on the monotonic clock, and its
        # sentence
        self.last: dict[str, tuple[int, str]] = {}
        self._node = node
        self._throttle = Throttle(LOG_PERIOD_NS)
        self._conflict: Refusal | None = None

    def add(self, subscription: Source, reason: SampleFault, sentence: str) -> None:
        """Count a refused sample, and log at most one in 2 s for each topic and reason.

        A conflicting publisher is an ERROR in the log and in the diagnostics.
        """
        key = f"{subscription.topic.name}: {reason}"
        self.counts[key] += 1
        self.last[subscription.name] = time.monotonic_ns(), sentence
        if reason is SampleFault.SENDER:
            self._conflict = Refusal(f"{subscription.name}: {sentence}")
        if not self._throttle.is_due(key):
            return
        if reason is SampleFault.SENDER:
            self._node.get_logger().error(f"{subscription.name}: sample refused: {sentence}")
        else:
            self._node.get_logger().warning(f"{subscription.name}: sample refused: {sentence}")

    def decoded(
        self,
        source: Source,
        messages: Iterable[ReceivedMessage],
        decode: Callable[[bytes], T],
    ) -> list[tuple[T, ReceivedMessage]]:
        """Decode messages, and return them with their metadata.

        A message is refused if `decode` raises ChannelError.
        """
        pairs = []
        for received in messages:
            try:
                pairs.append((decode(received.message), received))
            except ChannelError as error:
                self.add(source, error.reason, str(error))
        return pairs

    def stamps(
        self,
        source: Source,
        messages: Iterable[ReceivedMessage],
        lock: LockstepLock | None = None,
    ) -> list[int]:
        """Return the stamps at the beginning of messages, ns.

        A message without a stamp is refused. With a `lock`, messages of a second publisher are
        refused too.
        """
        stamps = []
        for stamp_ns, received in self.decoded(source, messages, stamp_of):
            if lock is not None:
                try:
                    lock.require_alone("", received.sequence, 0)
                except ChannelError as error:
                    self.add(source, error.reason, str(error))
                    continue
                lock.refresh("", 0)
            stamps.append(stamp_ns)
        return stamps

    def since(self, subscription: PolledSubscription, begin_ns: int) -> Refusal | None:
        """Return the last refusal of a topic since an instant of the monotonic clock.

        The text states the age of the refusal, and how often it occurred.
        """
        if subscription.name not in self.last:
            return None
        refused_ns, sentence = self.last[subscription.name]
        if refused_ns < begin_ns:
            return None
        count = sum(
            n for key, n in self.counts.items() if key.startswith(f"{subscription.topic.name}: ")
        )
        age = (time.monotonic_ns() - refused_ns) / NANOSECONDS
        return Refusal(f"{count} samples refused, the last {age:.1f} s ago: {sentence}")

    def pop_conflict(self) -> Refusal | None:
        """Return the refusal of the last conflicting publisher since the previous call."""
        conflict, self._conflict = self._conflict, None
        return conflict


class Receiver(Generic[S]):
    """The samples of a topic, which pass checks of size, publisher, content and stamp.

    The cheap checks come first. A message that is too long, or from a conflicting publisher, is
    refused before names and values are decoded. So a flood of such messages costs no more than
    valid messages. A message of the locked publisher is too long if it exceeds GROWTH times the
    longest valid message. This limit lasts until the publisher times out.

    `decode` returns None for a vector without channels. `take` gets a sample and the present
    instant. `lock` admits one publisher at a time; None admits all publishers. `max_age_ns` limits
    the age of a stamp and how far the stamp may be ahead of the clock; it is None if the sender
    does not have the clock of the flight. `max_size`, in bytes, is for a topic of reports, whose
    lengths differ by more than GROWTH; it is None for a topic of samples. `decode` and `take`
    refuse a message by a ChannelError.
    """

    def __init__(
        self,
        subscription: PolledSubscription,
        refusals: Refusals,
        decode: Callable[[bytes], S | None],
        take: Callable[[S, int], None],
        *,
        max_age_ns: Callable[[], int] | None,
        lock: PublisherLock | None = None,
        max_size: int | None = None,
    ) -> None:
        self.subscription = subscription
        self.lock = lock
        self._max_size = max_size or MAX_SIZE
        self._grows = max_size is not None
        self._longest = 0  # bytes, length of the longest valid message
        self._stamps_ns = deque[int](maxlen=RECENT)  # stamps of the last samples
        self._refusals = refusals
        self._decode = decode
        self._take = take
        self._max_age_ns = max_age_ns

    @property
    def name(self) -> str:
        """Full name of the topic."""
        return self.subscription.name

    def poll(self, now_ns: int, limit: int | None = None) -> list[bool]:
        """Take the messages since the last call, at most `limit`.

        Returns whether each message was valid.
        """
        return [
            self.take_message(received.message, now_ns, received.sequence)
            for received in self.subscription.take(limit)
        ]

    def take_message(self, raw: bytes, now_ns: int, sequence: int = 0) -> bool:
        """Check and take a message, and return whether it was valid.

        `sequence` is the same as for `PublisherLock.require_alone`.
        """
        try:
            sender = self._require_publisher(raw, now_ns)
            if isinstance(self.lock, LockstepLock):
                self._require_next(raw, now_ns, sender, sequence)
                sequence = 0
            if (sample := self._decode(raw)) is not None:
                self._accept(sample, now_ns, sequence)
                self._longest = max(self._longest, len(raw))
            elif isinstance(self.lock, LockstepLock):
                self.lock.refresh(sender, now_ns)
        except ChannelError as error:
            self._refusals.add(self.subscription, error.reason, str(error))
            return False
        return True

    def _require_publisher(self, raw: bytes, now_ns: int) -> str:
        """Return the sender of a message, or "" if the topic has no lock.

        Raises ChannelError if the message is too long, or comes from a conflicting publisher.
        """
        require_size(raw, self._max_size)
        if self.lock is None:
            return ""
        if (sender := sender_of(raw)) is None:
            raise ChannelError(SampleFault.MALFORMED, "a message without a header in plain CDR")
        self.lock.check(sender, now_ns)
        if (
            not self._grows
            and 0 < GROWTH * self._longest < len(raw)
            and self.lock.is_held_by(sender, now_ns)
        ):
            require_size(raw, GROWTH * self._longest)
        return sender

    def slowness(self, max_age_ns: int) -> Refusal | None:
        """Return a refusal if samples come too slowly: fewer than FEWEST fit into the age limit."""
        if (
            len(self._stamps_ns) < RECENT
            or (period_ns := float(np.median(np.diff(self._stamps_ns)))) <= 0.0
        ):
            return None
        fit = max_age_ns / period_ns
        max_age = max_age_ns / NANOSECONDS
        mend = (
            f"send {FEWEST / max_age:.3g} a second or more, or set max_age to "
            f"{FEWEST * period_ns / NANOSECONDS:.2g} or more"
        )
        slow = (
            f"{NANOSECONDS / period_ns:.3g} samples a second, of which {fit:.1f} fit into "
            f"max_age = {max_age:g} s"
        )
        return Refusal(f"{slow}: {mend}") if fit < FEWEST else None

    def receive(self) -> list[S | None]:
        """Return the decoded messages of the flight's publisher in lockstep, for `accept`.

        Each message of this publisher stands for an instant. None means an instant without a
        sample, because the publisher sent no channels or invalid content. A message of any other
        publisher has no effect.
        """
        samples: list[S | None] = []
        for received in self.subscription.take():
            try:
                sender = self._require_publisher(received.message, 0)
                self._require_next(received.message, 0, sender, received.sequence)
            except ChannelError as error:
                self._refusals.add(self.subscription, error.reason, str(error))
                continue
            try:
                sample = self._decode(received.message)
            except ChannelError as error:
                self._refusals.add(self.subscription, error.reason, str(error))
                # The flight's publisher is not known before the first valid message.
                if self.lock is None or self.lock.publisher is None:
                    continue
                sample = None
            if self.lock is not None:
                self.lock.refresh(sender, 0)
            samples.append(sample)
        return samples

    def _require_next(self, raw: bytes, now_ns: int, sender: str, sequence: int) -> None:
        """Check that a lockstep message is the next one of the flight's publisher.

        Raises ChannelError if it is not. The first message must have a stamp of the flight.
        """
        if self.lock is None:
            return
        if self.lock.publisher is None:
            self._require_stamp(stamp_of(raw), now_ns, sender)
        self.lock.require_alone(sender, sequence, now_ns)

    def accept(self, sample: S, now_ns: int) -> None:
        """Check and take a decoded sample."""
        try:
            self._accept(sample, now_ns)
        except ChannelError as error:
            self._refusals.add(self.subscription, error.reason, str(error))

    def _accept(self, sample: S, now_ns: int, sequence: int = 0) -> None:
        if self.lock is not None:
            self.lock.check(sample.sender, now_ns)
        self._require_stamp(sample.stamp_ns, now_ns, sample.sender)
        if self.lock is not None:
            self.lock.require_alone(sample.sender, sequence, now_ns)
        self._take(sample, now_ns)
        self._stamps_ns.append(sample.stamp_ns)
        if self.lock is not None:
            self.lock.refresh(sample.sender, now_ns)

    def _require_stamp(self, stamp_ns: int, now_ns: int, sender: str) -> None:
        """Check that a stamp is not farther from the present than the age limit, if there is one.

        Raises ChannelError if it is.
        """
        if self._max_age_ns is None:
            return
        max_age_ns = self._max_age_ns()
        try:
            require_not_future(stamp_ns, now_ns, max_age_ns)
            require_not_old(stamp_ns, now_ns, max_age_ns)
        except ChannelError as error:
            end = self._refusals.clock_of(sender) or ""
            raise ChannelError(error.reason, f"{error}{end}") from None
