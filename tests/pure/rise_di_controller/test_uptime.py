# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test a month of uptime, and stamps of any year.

Times are whole nanoseconds, so that u does not depend on when a flight began.
"""

import numpy as np
import pytest

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import FloatArray, StampedVector
from rise_di_controller.controller import Controller

MONTH = 2_592_000  # s
LATEST = 2**31 - 1  # s: the last second of a stamp of ROS 2


def flown(scenario: str, start: int) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return the values of u and of the internals over two seconds that begin at `start`, in s.

    There is a failsafe in between.
    """
    parameters = find_scenario(scenario).controller
    controller = Controller(parameters)
    period = nanoseconds(1.0 / parameters.rate)
    u = []
    internals = []
    for k in range(200):
        t_ns = nanoseconds(start) + k * period
        if not 80 <= k < 100:  # longer than the age limit
            values = 0.01 * np.sin(0.1 * k + np.arange(len(parameters.measured)))
            controller.take_y(StampedVector(t_ns, values), t_ns)
            controller.take_y_m(StampedVector(t_ns, np.zeros(len(parameters.outputs))), t_ns)
        if (output := controller.tick(t_ns)) is not None:
            u.append(output.u)
            internals.append(output.internals)
    return u, internals


@pytest.mark.parametrize("scenario", ["osprey_servo", "osprey_observer"])
@pytest.mark.parametrize("start", [MONTH, LATEST])
def test_no_bit_of_u_depends_on_the_uptime(scenario: str, start: int) -> None:
    for late, early in zip(flown(scenario, start), flown(scenario, 0), strict=True):
        np.testing.assert_array_equal(late, early)


def test_flight_time_of_a_month_keeps_its_nanoseconds() -> None:
    """Flight times keep their nanoseconds for 104 days.

    float64 has 53 bits, and 2^53 ns are 104 days.
    """
    of_ticks = MONTH * 10**9 + np.arange(1000, dtype=np.int64) * 999_983
    assert [nanoseconds(seconds(int(t_ns))) for t_ns in of_ticks] == of_ticks.tolist()
