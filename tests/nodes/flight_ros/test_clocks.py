# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the clocks of nodes on other hosts: the estimate of offset and delay."""

import random

import pytest
from pytest import approx

from flight_core.rates import nanoseconds
from flight_ros.clocks import AHEAD, HOST, Peers


def exchanged(
    offset: float, there: float, back: float, jitter: float, hosts: tuple[float, float] = (0.0, 0.0)
) -> Peers:
    """Return what a knows about b after six exchanges.

    The clock of b is ahead by the offset, s. Messages take `there` and `back`, s.
    """
    a = Peers("/a", hosts[0])
    b = Peers("/b", hosts[1])
    rng = random.Random(1)  # noqa: S311 - jitter
    b.ahead = offset
    for k in range(6):
        sent = 1000.0 + k
        arrived = sent + there + rng.uniform(0.0, jitter)
        b.receive("/a", nanoseconds(sent), nanoseconds(arrived + offset), a.differences())
        arrived = sent + 0.5 + back + rng.uniform(0.0, jitter)
        a.receive("/b", nanoseconds(sent + 0.5 + offset), nanoseconds(arrived), b.differences())
    return a


@pytest.mark.parametrize("offset", [-0.15, 0.0, 0.05, 3600.0])
def test_offset_and_delay_estimated_both_ways(offset: float) -> None:
    clock = exchanged(offset, 0.010, 0.010, 0.004).clocks()["/b"]
    assert clock.offset == approx(offset, abs=0.002)  # half of the jitter
    assert clock.delay == approx(0.010, abs=0.004)


def test_error_of_offset_is_half_of_difference_of_delays() -> None:
    assert exchanged(0.1, 0.002, 0.012, 0.0).clocks()["/b"].offset == approx(0.1 - 0.005, abs=1e-6)


@pytest.mark.parametrize("offset", [0.0, 0.15])
def test_delays_of_busy_host_shift_no_clock_of_that_host(offset: float) -> None:
    """Between two hosts, 0.002 s one way and 0.202 s back mean that a clock is 0.1 s off."""
    clock = exchanged(offset, 0.002, 0.202, 0.0, (7.0, 7.0)).clocks()["/b"]
    assert clock.offset == approx(offset, abs=1e-9)
    assert clock.delay == approx(0.202)
    assert "set" in clock.advice
    elsewhere = exchanged(offset, 0.002, 0.202, 0.0, (7.0, 8.0)).clocks()["/b"]
    assert elsewhere.offset == approx(offset - 0.1)
    assert "synchronise" in elsewhere.advice


def test_silent_node_forgotten() -> None:
    peers = exchanged(0.1, 0.001, 0.001, 0.0)
    peers.receive("/c", nanoseconds(1020.0), nanoseconds(1020.0), {})
    assert (peers.clocks(), set(peers.differences())) == ({}, {HOST, AHEAD, "/c"})
