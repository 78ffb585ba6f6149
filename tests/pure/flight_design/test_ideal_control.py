# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The ideal control of an airframe whose motion beside the outputs overflows."""

import warnings

import pytest

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.outcome import STATUS_ENDED_EARLY, FlightEnded
from flight_design.gains.ideal_control import manoeuvre, study_airframe

OSPREY = load_airframe("osprey")


def with_alpha_pole(pole: float) -> Airframe:
    """The osprey with another damping of alpha, whose zero is then near this pole, 1/s."""
    alpha = list(OSPREY.states).index("alpha")
    rows = [list(row) for row in OSPREY.A]
    rows[alpha][alpha] = pole
    return OSPREY.model_copy(update={"A": tuple(map(tuple, rows))})


def test_what_the_study_computed_is_no_wrong_entry_of_the_user() -> None:
    # Runge-Kutta of order 4 is unstable where pole times step is below -2.785: here it is -4
    airframe = with_alpha_pole(-400.0)
    course = manoeuvre(find_scenario("osprey_servo"), airframe)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(
            FlightEnded, match=r"osprey at 25 m/s: .* a zero at -400 1/s"
        ) as refusal:
            study_airframe(airframe, course, samples=0)
    assert refusal.value.status == STATUS_ENDED_EARLY


def test_a_fast_zero_that_the_steps_follow_has_a_study() -> None:
    airframe = with_alpha_pole(-200.0)
    course = manoeuvre(find_scenario("osprey_servo"), airframe)
    assert study_airframe(airframe, course, samples=0).stable.all()
