# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Whom a node listens to, and which of its samples a controller takes where the other half comes late."""

import numpy as np
import pytest

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.rates import nanoseconds
from flight_core.vectors import ChannelError, StampedVector
from flight_ros.publisher_lock import PublisherLock
from rise_di_controller.controller import Controller
from rise_di_controller.guard import Mode

AGE, STRANGE = 100, 1000


def heard(*senders: tuple[str, int]) -> PublisherLock:
    source = PublisherLock()
    for sender, now_ns in senders:
        source.require(sender, now_ns, AGE, STRANGE)
        source.hear(sender, now_ns)
    return source


def test_the_first_one_is_listened_to_and_others_are_refused_while_it_is_heard() -> None:
    source = heard(("/aircraft#1", 0), ("/aircraft#1", 90))
    for other in ("/aircraft#2", "/foreign", ""):
        with pytest.raises(ChannelError, match=f"{other} publishes too, beside /aircraft#1") as raised:
            source.require(other, 190, AGE, STRANGE)
        assert raised.value.reason == "sender"
    source.require("/aircraft#1", 10_000, AGE, STRANGE)  # itself after any silence


def test_a_node_started_again_is_listened_to_after_the_age_limit_a_stranger_later() -> None:
    source = heard(("/aircraft#1", 0))
    source.require("/aircraft#2", AGE + 1, AGE, STRANGE)
    with pytest.raises(ChannelError):
        source.require("/foreign", STRANGE, AGE, STRANGE)
    source.require("/foreign", STRANGE + 1, AGE, STRANGE)
    assert source.silent(AGE + 1, AGE)
    assert not source.silent(AGE, AGE)


def test_a_change_is_told_once() -> None:
    source = PublisherLock()
    assert source.silent(0, AGE)
    assert source.hear("/aircraft#1", 0)
    assert not source.hear("/aircraft#1", 1)
    assert source.hear("/aircraft#2", 2)


@pytest.mark.parametrize(("late", "modes"), [(0.05, {Mode.ENGAGED}), (0.15, {Mode.ENGAGED, Mode.HOLD, Mode.RAMP})])
def test_a_reference_that_comes_late_is_waited_for_up_to_the_age_limit(
    late: float, modes: set[Mode], osprey_gust: Scenario
) -> None:
    """Both at 100 Hz, y_m with a delay from 1 s on; the age limit is 0.1 s, so one is below it and one is beyond."""
    controller, period_ns = Controller(osprey_gust.controller), 10_000_000
    seen, stamps = set(), []
    for k in range(200):
        now_ns = k * period_ns
        controller.take_y(StampedVector(now_ns, np.zeros(4)), now_ns)
        behind_ns = nanoseconds(late) if k >= 100 else 0
        if k < 100 or now_ns - behind_ns >= 100 * period_ns:
            controller.take_y_m(StampedVector(now_ns - behind_ns, np.zeros(4)), now_ns)
        commanded = controller.tick(now_ns)
        seen.add(controller.mode)
        if commanded is not None and controller.mode is Mode.ENGAGED:
            stamps.append(commanded.stamp_ns)
    assert seen == modes
    assert stamps == sorted(set(stamps))
    if late < 0.1:  # each y is flown in its turn, as late as its y_m, which may be extrapolated by one period
        assert 199 * period_ns - stamps[-1] == nanoseconds(late) - period_ns
