# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Accept the messages of only one autopilot on a MAVLink link.

An autopilot is identified by the address of its packets, and by the time since boot in its
messages.
"""

from flight_core.publisher_lock import PublisherLock
from flight_core.rates import NANOSECONDS
from flight_core.vectors import ChannelError, SampleFault

# autopilots that were switched on within this time cannot be distinguished
CLOCK_TOLERANCE_NS = NANOSECONDS


class AutopilotLock:
    """Admits one autopilot: the first one until it is silent, and then the next one.

    Two autopilots behind the same address are distinguished by the time since boot in their
    messages. In the messages of one autopilot this time never goes back. It advances no faster than
    the clock of this host, except after a message that was late. An autopilot that starts again is
    taken as a second sender at first. Once no message of its earlier run has come for the time of a
    silence, the lock admits the new run.
    """

    def __init__(self, silence_ns: int) -> None:
        self._silence_ns = silence_ns
        self._addresses, self._starts = self._new_lock(), self._new_lock()
        self._newest_ns = 0  # the largest time since boot
        # The earliest instant of the boot that the messages so far imply. It comes from the message
        # with the least delay.
        self._boot_ns = 0

    def _new_lock(self) -> PublisherLock:
        # Neither an address nor an instant of boot tells a restart from another autopilot, so the
        # limit for a restart is that for another autopilot.
        limits_ns = (self._silence_ns, self._silence_ns)
        return PublisherLock(lambda: limits_ns)

    @property
    def address(self) -> str | None:
        """Address of the admitted autopilot, or None before the first message."""
        return self._addresses.publisher

    def overran(self, duration_ns: int) -> None:
        """Exclude from the silence of a sender a time, ns, in which this receiver did not run."""
        self._addresses.overran(duration_ns)
        self._starts.overran(duration_ns)

    def check(self, address: str, since_boot_ns: int | None, now_ns: int) -> None:
        """Refuse a message of a second sender as long as the first one is not silent.

        If the message is refused, raises ChannelError with the reason "sender". `since_boot_ns` is
        None for a message without the time since boot.
        """
        try:
            self._addresses.check(address, now_ns)
        except ChannelError:
            sentence = (
                f"a second sender, {address}, sends as the autopilot: {self.address} was "
                "first and is taken alone"
            )
            raise ChannelError(SampleFault.SENDER, sentence) from None
        if since_boot_ns is None or address != self.address:
            return
        try:
            self._starts.check(self._start(since_boot_ns, now_ns), now_ns)
        except ChannelError:
            sentence = (
                f"the time since boot from {address} jumps: a second autopilot sends "
                "there, or it has started again"
            )
            raise ChannelError(SampleFault.SENDER, sentence) from None

    def refresh(self, address: str, since_boot_ns: int | None, now_ns: int) -> bool:
        """Note a message that `check` has admitted, and lock to its sender.

        Returns whether the sender is new, or has started again.
        """
        is_new_sender = self._addresses.refresh(address, now_ns)
        if is_new_sender:
            self._starts = self._new_lock()
        if since_boot_ns is None:
            return is_new_sender
        had_start = self._starts.publisher is not None
        boot_ns = now_ns - since_boot_ns
        if self._starts.refresh(self._start(since_boot_ns, now_ns), now_ns):
            self._newest_ns = since_boot_ns
            self._boot_ns = boot_ns
            return is_new_sender or had_start
        self._newest_ns, self._boot_ns = (
            max(self._newest_ns, since_boot_ns),
            min(self._boot_ns, boot_ns),
        )
        return is_new_sender

    def _start(self, since_boot_ns: int, now_ns: int) -> str:
        """Return a name for the run in which the autopilot sent a message.

        A run lasts from one boot to the next. If the time since boot continues the time of the
        locked run, the result is the name of the locked run. If it does not, the result is a new
        name, made from the instant of boot.
        """
        boot_ns = now_ns - since_boot_ns
        is_same_run = (
            since_boot_ns >= self._newest_ns - CLOCK_TOLERANCE_NS
            and boot_ns >= self._boot_ns - CLOCK_TOLERANCE_NS
        )
        if self._starts.publisher is not None and is_same_run:
            return self._starts.publisher
        return str(boot_ns)
