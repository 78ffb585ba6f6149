# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Missed ticks of a loop, excluding host delays."""

import math

import numpy as np
from benchmarks.host_delays import missed_excluding_delays
from benchmarks.long_flight import longest_skips, missing, triangle
from benchmarks.view import figures_of_ticks

from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape

PERIOD_NS = 2_000_000


def test_skip_without_host_delay_counts_each_of_periods() -> None:
    skipped = [(0, 2 * PERIOD_NS), (10 * PERIOD_NS, 11 * PERIOD_NS + 1)]
    assert missed_excluding_delays(skipped, [], PERIOD_NS) == 3
    assert missed_excluding_delays(skipped, [(2 * PERIOD_NS, 9 * PERIOD_NS)], PERIOD_NS) == 3  # a delay at another time


def test_skip_within_host_delay_does_not_count() -> None:
    assert missed_excluding_delays([(0, 3 * PERIOD_NS + 1000)], [(-PERIOD_NS, 3 * PERIOD_NS)], PERIOD_NS) == 0


def test_rest_of_skip_counts_in_whole_periods() -> None:
    assert missed_excluding_delays([(0, 5 * PERIOD_NS)], [(0, 2 * PERIOD_NS)], PERIOD_NS) == 3
    assert missed_excluding_delays([(0, 5 * PERIOD_NS)], [(0, 2 * PERIOD_NS + 1)], PERIOD_NS) == 2


def test_delay_of_two_cores_at_once_subtracted_once() -> None:
    delays = [(0, 2 * PERIOD_NS), (PERIOD_NS, 3 * PERIOD_NS), (PERIOD_NS, 2 * PERIOD_NS)]
    assert missed_excluding_delays([(0, 5 * PERIOD_NS)], delays[::-1], PERIOD_NS) == 2


def test_pause_of_second_counts_inside_window_and_not_outside_of_it() -> None:
    deadlines = np.delete(np.arange(0, 4 * NANOSECONDS, PERIOD_NS), slice(501, 1001))  # none from 1.002 s to 2.000 s
    internals = Signal(deadlines, ("age", "late"), np.tile((1e-3, 1e-3), (len(deadlines), 1)))  # a tick 1 ms after its deadline
    inside, outside = (NANOSECONDS // 2, 3 * NANOSECONDS), (3 * NANOSECONDS, 4 * NANOSECONDS)
    for windows, missed in (([inside], 500), ([outside], 0), ([outside, inside], 500)):
        figures = figures_of_ticks(internals, None, PERIOD_NS, windows)
        assert figures["missed ticks"] == missed
        assert math.isclose(figures["late p99 (ms)"], 1.0)
    delay = [(1_002_000_000, 1_502_000_000)]  # of the host, half of the pause
    assert figures_of_ticks(internals, delay, PERIOD_NS)["missed ticks, excluding host delays"] == 250


def test_instants_that_late_tick_skips_are_missing_samples_except_in_host_delays() -> None:
    scenario = triangle(1.0, observer=True)  # y and y_m at 500 Hz, u_m and guidance at 50 Hz
    every = np.arange(0, 100 * PERIOD_NS, PERIOD_NS)
    slow = Signal(every[::10], (), np.zeros((10, 0)))
    y = Signal(np.delete(every, (20, 50, 51)), (), np.zeros((97, 0)))
    tape = Tape({"y": y, "y_m": Signal(every, (), np.zeros((100, 0))), "u_m": slow, "guidance": slow})
    delays = [(int(20.2 * PERIOD_NS), 21 * PERIOD_NS)]  # the late tick 19 or the skipped tick 20
    found = missing(tape, scenario, delays, real_time=True)
    assert found["missing samples"] == {"y": 3, "y_m": 0, "u_m": 0, "guidance": 0}
    assert found["missing samples, excluding host delays"] == {"y": 2, "y_m": 0, "u_m": 0, "guidance": 0}
    (longest,) = longest_skips(tape, scenario, delays)  # of tick 20 less than a period remains
    assert longest["topic"] == "y"
    assert math.isclose(longest["t"], 50 * PERIOD_NS / NANOSECONDS)
    assert math.isclose(longest["length"], 2.5 * PERIOD_NS / NANOSECONDS)  # until half a period after tick 52
