# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Missed ticks of a loop, excluding host delays."""

from benchmarks.host_delays import missed_excluding_delays

PERIOD_NS = 2_000_000


def test_a_skip_without_a_host_delay_counts_each_of_its_periods() -> None:
    skipped = [(0, 2 * PERIOD_NS), (10 * PERIOD_NS, 11 * PERIOD_NS + 1)]
    assert missed_excluding_delays(skipped, [], PERIOD_NS) == 3
    assert missed_excluding_delays(skipped, [(2 * PERIOD_NS, 9 * PERIOD_NS)], PERIOD_NS) == 3  # a delay at another time


def test_a_skip_within_a_host_delay_does_not_count() -> None:
    assert missed_excluding_delays([(0, 3 * PERIOD_NS + 1000)], [(-PERIOD_NS, 3 * PERIOD_NS)], PERIOD_NS) == 0


def test_the_rest_of_a_skip_counts_in_whole_periods() -> None:
    assert missed_excluding_delays([(0, 5 * PERIOD_NS)], [(0, 2 * PERIOD_NS)], PERIOD_NS) == 3
    assert missed_excluding_delays([(0, 5 * PERIOD_NS)], [(0, 2 * PERIOD_NS + 1)], PERIOD_NS) == 2


def test_a_delay_of_two_cores_at_once_is_subtracted_once() -> None:
    delays = [(0, 2 * PERIOD_NS), (PERIOD_NS, 3 * PERIOD_NS), (PERIOD_NS, 2 * PERIOD_NS)]
    assert missed_excluding_delays([(0, 5 * PERIOD_NS)], delays[::-1], PERIOD_NS) == 2
