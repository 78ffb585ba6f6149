# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the lock of a MAVLink link to one autopilot, by address and time since boot."""

import pytest

from autopilot_bridge.autopilot_lock import AutopilotLock
from flight_core.rates import nanoseconds
from flight_core.vectors import ChannelError

SILENCE = 3.0  # s
FIRST, SECOND = "10.0.0.1:14550", "10.0.0.2:14550"


class Sequence:
    """A lock and the messages that it accepts."""

    def __init__(self) -> None:
        self.lock = AutopilotLock(nanoseconds(SILENCE))

    def takes(self, now: float, since_boot: float | None, address: str = FIRST) -> bool:
        """Take a message if the lock accepts it.

        Returns whether the autopilot is another one, or has started again.
        """
        message = address, None if since_boot is None else nanoseconds(since_boot), nanoseconds(now)
        self.lock.check(*message)
        return self.lock.refresh(*message)

    def refuses(self, now: float, since_boot: float | None, address: str = FIRST) -> str:
        """Return the sentence with which the lock refuses a message."""
        with pytest.raises(ChannelError) as error:
            self.takes(now, since_boot, address)
        assert error.value.reason == "sender"
        return str(error.value)


def test_first_address_is_taken_until_it_is_silent_then_the_next_one() -> None:
    sequence = Sequence()
    assert sequence.takes(10.0, 5.0)
    assert sequence.refuses(12.9, 7.9, SECOND) == (
        f"a second sender, {SECOND}, sends as the autopilot: {FIRST} was first and is taken alone"
    )
    # A message without the time since boot counts for the address.
    assert not sequence.takes(13.0, None)
    sequence.refuses(16.0, None, SECOND)
    assert sequence.takes(16.001, 80.0, SECOND)  # with a clock of its own
    sequence.refuses(16.1, 11.1, FIRST)
    assert not sequence.takes(16.2, 80.2, SECOND)


def test_late_messages_of_one_clock_are_taken() -> None:
    """A link that stalls delays its messages by any time, and then delivers them at once."""
    sequence = Sequence()
    sequence.takes(10.0, 5.0)
    for now, since_boot in ((11.0, 6.0), (18.0, 6.1), (18.0, 13.0), (18.1, 12.9)):
        assert not sequence.takes(now, since_boot)


@pytest.mark.parametrize("drift", [-1e-3, 1e-3])
def test_clock_that_drifts_stays_that_of_the_autopilot(drift: float) -> None:
    """A crystal drifts by less than 1e-4.

    In an hour, 1e-3 is 3.6 s, which is more than the tolerance of a jump.
    """
    sequence = Sequence()
    sequence.takes(0.0, 100.0)
    assert not any(
        sequence.takes(now, 100.0 + (1.0 + drift) * now) for now in map(float, range(1, 3600))
    )


@pytest.mark.parametrize("since_boot", [0.0, 3.9, 7.2, 400.0])
def test_another_clock_at_the_address_is_refused(since_boot: float) -> None:
    """The other clock is behind or ahead by more than the tolerance of 1 s.

    The next message is due at 6.1 s.
    """
    sequence = Sequence()
    sequence.takes(10.0, 5.0)
    assert sequence.refuses(11.1, since_boot) == (
        f"the time since boot from {FIRST} jumps: a second autopilot sends there, or it has "
        "started again"
    )
    assert not sequence.takes(11.2, 6.2)


def test_autopilot_that_has_started_again_is_taken_after_the_silence_of_its_clock_before() -> None:
    sequence = Sequence()
    sequence.takes(100.0, 60.0)
    sequence.refuses(101.0, 0.5)
    assert not sequence.takes(102.5, None)  # its heartbeat does not tell the start
    sequence.refuses(103.0, 2.5)
    assert sequence.takes(103.001, 2.501)
    sequence.refuses(103.1, 63.1)  # messages of the start before


def test_overrun_of_the_receiver_is_no_silence() -> None:
    sequence = Sequence()
    sequence.takes(10.0, 5.0)
    sequence.lock.overran(nanoseconds(60.0))
    sequence.refuses(70.0, 65.0, SECOND)
    sequence.refuses(70.0, 0.0)
    assert not sequence.takes(70.0, 65.0)


def test_next_autopilot_is_not_measured_by_the_clock_of_the_one_before() -> None:
    sequence = Sequence()
    sequence.takes(10.0, 5.0)
    sequence.lock.overran(nanoseconds(60.0))
    assert sequence.takes(73.1, None, SECOND)
    assert not sequence.takes(73.2, 500.0, SECOND)
