# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Missed ticks of a loop told from those of the machine."""

from benchmarks.held import missed_by_itself

PERIOD_NS = 2_000_000


def test_a_skip_while_the_machine_ran_counts_each_period_of_it() -> None:
    skipped = [(0, 2 * PERIOD_NS), (10 * PERIOD_NS, 11 * PERIOD_NS + 1)]
    assert missed_by_itself(skipped, [], PERIOD_NS) == 3
    assert missed_by_itself(skipped, [(2 * PERIOD_NS, 9 * PERIOD_NS)], PERIOD_NS) == 3  # held at another time


def test_a_skip_that_the_machine_explains_does_not_count() -> None:
    assert missed_by_itself([(0, 3 * PERIOD_NS + 1000)], [(-PERIOD_NS, 3 * PERIOD_NS)], PERIOD_NS) == 0


def test_what_the_machine_leaves_unexplained_counts_in_whole_periods() -> None:
    assert missed_by_itself([(0, 5 * PERIOD_NS)], [(0, 2 * PERIOD_NS)], PERIOD_NS) == 3
    assert missed_by_itself([(0, 5 * PERIOD_NS)], [(0, 2 * PERIOD_NS + 1)], PERIOD_NS) == 2


def test_time_held_on_two_cores_at_once_is_taken_off_once() -> None:
    held = [(0, 2 * PERIOD_NS), (PERIOD_NS, 3 * PERIOD_NS), (PERIOD_NS, 2 * PERIOD_NS)]
    assert missed_by_itself([(0, 5 * PERIOD_NS)], reversed(held), PERIOD_NS) == 2
