# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the publisher lock of a topic, and which samples a controller uses while y_m is late."""

import numpy as np
import pytest

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.modes import Mode
from flight_core.publisher_lock import SHARED_NS, PublisherLock
from flight_core.rates import nanoseconds
from flight_core.vectors import ChannelError, StampedVector
from rise_di_controller.controller import Controller

MAX_AGE, TAKEOVER = 100, 1000


def locked(*senders: tuple[str, int]) -> PublisherLock:
    """Return a lock after samples of these publishers at these instants."""
    lock = PublisherLock(lambda: (MAX_AGE, TAKEOVER))
    for sender, now_ns in senders:
        lock.check(sender, now_ns)
        lock.refresh(sender, now_ns)
    return lock


def test_conflicting_publisher_ignored_until_timeout() -> None:
    """Samples of a second publisher are ignored until the first one has timed out."""
    lock = locked(("/aircraft#1", 0), ("/aircraft#1", 90))
    for publisher in ("/aircraft#2", "/foreign", ""):
        sentence = f"conflicting publisher {publisher} ignored: already receiving from /aircraft#1"
        with pytest.raises(ChannelError, match=sentence) as ignored:
            lock.check(publisher, 190)
        assert ignored.value.reason == "sender"
    lock.check("/aircraft#1", 10_000)  # the locked publisher itself, after any time


def test_restarted_node_takes_over_earlier() -> None:
    """A restarted node may take over after the age limit, and another node only later."""
    lock = locked(("/aircraft#1", 0))
    lock.check("/aircraft#2", MAX_AGE + 1)
    with pytest.raises(ChannelError):
        lock.check("/foreign", TAKEOVER)
    lock.check("/foreign", TAKEOVER + 1)
    assert lock.has_timed_out(MAX_AGE + 1, MAX_AGE)
    assert not lock.has_timed_out(MAX_AGE, MAX_AGE)


def refused(lock: PublisherLock, now_ns: int, sequence: int, sender: str = "/aircraft#1") -> bool:
    """Return whether a message is refused because two publishers share a name.

    A valid one is taken.
    """
    lock.check(sender, now_ns)
    try:
        lock.require_alone(sender, sequence, now_ns)
    except ChannelError as error:
        return error.reason == "sender" and f"under the name {sender}: none" in str(error)
    lock.refresh(sender, now_ns)
    return False


def test_two_publishers_under_one_name_are_both_refused_until_one_is_left() -> None:
    """Either of the two may be the forged one, so y or u times out and the failsafe begins."""
    lock = locked(("/aircraft#1", 0))
    assert not any(refused(lock, 10 * k, sequence=1000 + k) for k in range(10))
    own, forged = 2000, 1
    step = MAX_AGE // 10
    for now_ns in range(100, 100 + 50 * step, step):
        assert refused(lock, now_ns, forged), "the first forged message, too"
        assert refused(lock, now_ns, own)
        own += 1
        forged += 1
    last_ns = now_ns
    assert refused(lock, last_ns + SHARED_NS - 1, own)
    assert not refused(lock, last_ns + SHARED_NS, own + 1)


def test_forged_message_with_a_larger_number_is_told_by_the_next_true_one() -> None:
    lock = locked(("/aircraft#1", 0))
    assert not refused(lock, 10, 50)
    assert not refused(lock, 20, 9_000_000)
    assert refused(lock, 30, 51)


def test_publisher_that_begins_again_under_its_name_is_one() -> None:
    """A user's aircraft has no process id in its name. It was silent before it began again."""
    lock = locked(("/aircraft#1", 0))
    assert not refused(lock, 10, 50)
    assert not refused(lock, 11 + MAX_AGE, 1)
    assert not refused(lock, 12 + MAX_AGE, 2)


def test_restarted_node_and_a_middleware_without_numbers_share_no_name() -> None:
    lock = locked(("/aircraft#1", 0))
    assert not refused(lock, 10, 50)
    assert not refused(lock, 11 + MAX_AGE, 1, "/aircraft#2")
    assert not refused(lock, 12 + MAX_AGE, 2, "/aircraft#2")
    assert not any(refused(lock, 13 + MAX_AGE + k, 0, "/aircraft#2") for k in range(3))


def test_overrun_of_receiver_is_no_silence_of_publisher() -> None:
    lock = locked(("/aircraft#1", 0))
    lock.overran(5000)
    now_ns = 5000 + TAKEOVER
    with pytest.raises(ChannelError, match="already receiving from /aircraft#1"):
        lock.check("/foreign", now_ns)
    lock.check("/foreign", now_ns + 1)
    assert lock.has_timed_out(now_ns, MAX_AGE)  # its sample is old, whatever the reason
    lock.refresh("/aircraft#1", now_ns)
    lock.check("/foreign", now_ns + TAKEOVER + 1)  # an overrun counts once


def test_a_change_of_publisher_is_returned_once() -> None:
    lock = PublisherLock(lambda: (MAX_AGE, TAKEOVER))
    assert lock.has_timed_out(0, MAX_AGE)
    assert lock.refresh("/aircraft#1", 0)
    assert not lock.refresh("/aircraft#1", 1)
    assert lock.refresh("/aircraft#2", 2)


@pytest.mark.parametrize(
    "late, modes", [(0.05, {Mode.ENGAGED}), (0.15, {Mode.ENGAGED, Mode.HOLD, Mode.RAMP})]
)
def test_delayed_reference_awaited_up_to_age_limit(
    late: float, modes: set[Mode], osprey_gust: Scenario
) -> None:
    """Y and y_m have 100 Hz, and y_m is late from 1 s on.

    The delay is below the age limit of 0.1 s in one case, and above it in the other.
    """
    controller = Controller(osprey_gust.controller)
    period_ns = 10_000_000
    visited = set()
    stamps = []
    for k in range(200):
        now_ns = k * period_ns
        controller.take_y(StampedVector(now_ns, np.zeros(4)), now_ns)
        delay_ns = nanoseconds(late) if k >= 100 else 0
        if k < 100 or now_ns - delay_ns >= 100 * period_ns:
            controller.take_y_m(StampedVector(now_ns - delay_ns, np.zeros(4)), now_ns)
        output = controller.tick(now_ns)
        visited.add(controller.mode)
        if output is not None and controller.mode is Mode.ENGAGED:
            stamps.append(output.stamp_ns)
    assert visited == modes
    assert stamps == sorted(set(stamps))
    # each y is used in order, as late as its y_m, which may be extrapolated by one period
    if late < 0.1:
        assert 199 * period_ns - stamps[-1] == nanoseconds(late) - period_ns
