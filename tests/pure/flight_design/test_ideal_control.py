# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the ideal control along a manoeuvre, also for an airframe whose hidden motion overflows."""

import warnings

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.plant import dynamics
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.integrators import rk4
from flight_core.outcome import STATUS_ENDED_EARLY, FlightEnded
from flight_design.gains.ideal_control import STEP, manoeuvre, study_airframe

OSPREY = load_airframe("osprey")


def with_alpha_pole(pole: float) -> Airframe:
    """Return the osprey with another damping of alpha, which moves a zero close to `pole`, 1/s."""
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


def test_integral_of_the_rates_keeps_y_on_y_m_in_gusts() -> None:
    gusts = {
        "vertical": {"start": 3.0, "speed": 10.12, "length": 15.24},
        "lateral": {"start": 4.0, "speed": 4.0, "length": 15.24},
    }
    scenario = find_scenario("osprey_gust", 6.0).vary(aircraft={"gusts": gusts})
    study = study_airframe(OSPREY, manoeuvre(scenario, OSPREY), samples=1)
    u = cumulative_trapezoid(study.u_dot[:, 0], dx=STEP, axis=0, initial=0)
    aircraft = scenario.aircraft.plant().aircraft
    x = np.zeros(len(OSPREY.states))
    y = [aircraft.C @ x]
    for k, held in enumerate((u[1:] + u[:-1]) / 2.0):
        x = rk4(lambda t, x, u, _: dynamics.x_dot(t, x, u, aircraft), STEP * k, x, held, None, STEP)
        y.append(aircraft.C @ x)
    model = simulate(scenario)["y_m"]
    y_m = np.column_stack([model[name] for name in OSPREY.outputs])
    # rad/s and m/s, three times what u held for 10 ms leaves. Without the rate of the gusts it is
    # 0.05 in p and more in the others.
    error = np.abs(y - y_m[model.stamp_ns % 10_000_000 == 0]).max(axis=0)
    assert (error < [1e-3, 1e-2, 1e-3, 1e-3]).all(), error
