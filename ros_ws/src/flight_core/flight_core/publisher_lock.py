# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Lock a topic to one publisher, so that samples of a second publisher are ignored.

A message names its publisher in `frame_id`, for example "/controller#4711".
"""

from collections.abc import Callable

from flight_core.rates import NANOSECONDS
from flight_core.vectors import ChannelError, SampleFault

SHARED_NS = NANOSECONDS
"""If the numbers of a publisher go back, two publishers share its name, and no sample under this
name is taken for this time. The time exceeds the age limits of y and u, so that the failsafe
begins."""
FOREVER_NS = 2**63  # longer than any flight


def require_sender(sender: str, expected: str) -> None:
    """Raise ChannelError, reason "sender", for a sample of an unexpected publisher."""
    if sender != expected:
        raise ChannelError(SampleFault.SENDER, f"{sender} ignored: expected {expected}")


class PublisherLock:
    """Takes a topic from its first publisher only, until the samples of this publisher time out.

    After the timeout, it takes the topic from the next publisher. A restarted node, which has the
    same name, can take over earlier than a different node. If the receiving node overruns, this
    time is not seen as silence of the publisher. Otherwise another publisher could take over if the
    node happens to take its sample first after the overrun.

    The middleware numbers the messages of a publisher. If the numbers go back, two publishers use
    the same name. In this case neither is admitted, because either can be forged.

    `timeouts_ns` returns two limits of the age of the last sample. Above the first limit, the same
    node in a new process can take over, and above the second limit a different node.
    """

    def __init__(self, timeouts_ns: Callable[[], tuple[int, int]]) -> None:
        self._timeouts_ns = timeouts_ns
        self.publisher: str | None = None
        self._received_ns = 0
        self._overrun_ns = 0  # sum of the overruns of this node since the last sample
        # number of the last message of the locked publisher, or 0 if it is unknown
        self._sequence = 0
        self._went_back_ns: int | None = None  # instant at which the numbers last went back

    def age_ns(self, now_ns: int) -> int:
        """Return the time since the last sample of the locked publisher, ns."""
        return now_ns - self._received_ns

    def has_timed_out(self, now_ns: int, max_age_ns: int) -> bool:
        """Return whether there is no publisher, or the last sample is older than the age limit."""
        return self.publisher is None or self.age_ns(now_ns) > max_age_ns

    def is_held_by(self, sender: str, now_ns: int) -> bool:
        """Return whether the sender is the locked publisher and has not timed out.

        A publisher has timed out if its last sample is older than the age limit of a restart.
        """
        return sender == self.publisher and not self.has_timed_out(now_ns, self._timeouts_ns()[0])

    def overran(self, duration_ns: int) -> None:
        """Note that this node did not run for a time, which is no silence of the publisher."""
        self._overrun_ns += duration_ns

    def check(self, sender: str, now_ns: int) -> None:
        """Raise ChannelError, reason "sender", for a sample of a second publisher.

        The second publisher can take over after the locked publisher has timed out.
        """
        if sender == self.publisher:
            return
        max_age_ns, takeover_ns = self._timeouts_ns()
        is_restarted = (
            self.publisher is not None
            and sender.partition("#")[0] == self.publisher.partition("#")[0]
        )
        if not self.has_timed_out(
            now_ns - self._overrun_ns, max_age_ns if is_restarted else takeover_ns
        ):
            raise ChannelError(
                SampleFault.SENDER,
                f"conflicting publisher {sender} ignored: already receiving from {self.publisher}",
            )

    def refresh(self, sender: str, now_ns: int) -> bool:
        """Lock to the publisher of a valid sample, and return whether the publisher has changed."""
        has_changed = sender != self.publisher
        if has_changed:
            self._sequence = 0
            self._went_back_ns = None
        self.publisher = sender
        self._received_ns = now_ns
        self._overrun_ns = 0
        return has_changed

    def require_alone(self, sender: str, sequence: int, now_ns: int) -> None:
        """Raise ChannelError, reason "sender", if two publishers send under the locked name.

        After the numbers went back, the name is taken as shared for SHARED_NS. `sequence` is the
        number that the middleware gave the message, or 0 if it is unknown. After a timeout, a lower
        number comes from a restarted publisher. Call this only for samples with a valid stamp and
        content, so that a replay of old messages does not stop the flight.
        """
        if sender != self.publisher:
            return
        is_shared = self._went_back_ns is not None and 0 <= now_ns - self._went_back_ns < SHARED_NS
        if sequence > 0:
            has_gone_back = sequence <= self._sequence
            self._sequence = sequence
            if has_gone_back and (is_shared or self.is_held_by(sender, now_ns)):
                self._went_back_ns = now_ns
                is_shared = True
        if is_shared:
            raise ChannelError(
                SampleFault.SENDER, f"two publishers send under the name {sender}: none is taken"
            )


class LockstepLock(PublisherLock):
    """Takes a topic of a lockstep flight from the publisher of its first message only.

    In lockstep each message is an instant of the flight, so a message of another publisher must be
    ignored. No message is lost, so the numbers of one publisher rise by one each time. Any other
    number belongs to a second publisher under the same name, and only the message with this number
    is refused. If the messages of a topic name no sender, the sender is "".
    """

    def __init__(self) -> None:
        super().__init__(lambda: (FOREVER_NS, FOREVER_NS))

    def require_alone(self, sender: str, sequence: int, now_ns: int) -> None:
        """Raise ChannelError, reason "sender", if the message's number is not the next one."""
        expected = self._sequence + 1
        if self.publisher is None:
            # If a message came before this one, it was refused, so its number does not count.
            self._sequence = 0
        elif self._sequence and sequence not in {0, expected}:
            raise ChannelError(
                SampleFault.SENDER,
                f"message {sequence} under the name {sender or 'of the flight'} ignored: expected "
                f"message {expected}, so a second publisher sends",
            )
        self._sequence = sequence or self._sequence

    def refresh(self, sender: str, now_ns: int) -> bool:
        """Lock to the publisher of a message. Return whether the publisher has changed."""
        has_changed = sender != self.publisher
        self.publisher = sender
        self._received_ns = now_ns
        return has_changed
