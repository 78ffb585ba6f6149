# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test what a flight in real time needs from a host, and what the host can give."""

import os

import pytest

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_bringup.host import cores_given, processes_of, shortage


@pytest.mark.parametrize(
    ("name", "composed", "processes"),
    [
        # recorder, controller, aircraft, reference model
        ("osprey_servo", False, 4),
        ("osprey_route", False, 5),
        # The learner only searches now and then.
        ("osprey_learn", False, 4),
        ("osprey_route", True, 1),
    ],
)
def test_as_many_processes_spin_as_compute_all_the_time(
    name: str, composed: bool, processes: int
) -> None:
    scenario = find_scenario(name)
    assert processes_of(scenario, composed=composed) == processes
    asked = []
    shortage([scenario, scenario], lambda count: asked.append(count) or 0.0, composed=composed)  # type: ignore[func-returns-value]
    assert asked == [2 * processes], "all aircraft of a fleet fly at once"


def test_two_idle_cores_are_enough_for_four_processes_and_half_a_core_is_not() -> None:
    """On two idle cores, 60 s of osprey_servo took 79 s of processor, which is 1.3 cores.

    On a host that gave 0.44 to 0.52 of a core, four flights out of four lost samples.
    """
    scenario = find_scenario("osprey_servo")
    assert shortage([scenario], lambda _: 1.9) is None
    assert str(shortage([scenario], lambda _: 0.52)) == (
        "gives 0.52 of the 1.4 cores that a flight in real time needs"
    )
    assert "gives 1.39 of the 1.4 cores" in str(shortage([scenario], lambda _: 1.39))


def test_host_gives_no_more_than_its_cores_and_no_more_than_is_asked_for() -> None:
    given = cores_given(3)
    # A clock of ticks may show a hundredth more than there is.
    assert 0.0 < given <= 1.02 * min(len(os.sched_getaffinity(0)), 3)
