# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test an aircraft whose A, B and trim follow its airspeed.

At each speed, it is the airframe at that speed.
"""

import numpy as np
import pytest
from pytest import approx
from tests.conftest import refusing

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.airframes.airspeed import at_speed, level_flight
from aircraft_sim.plant.plant import aircraft_at, initial_state
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_campaign.batch.campaign_course import build_course
from flight_core.vectors import FloatArray

OSPREY = load_airframe("osprey")
SCENARIO = find_scenario("osprey_servo").vary(
    aircraft={"over_airspeed": "thrust", "gusts": {}, "rate": 100.0, "step": 0.01},
    reference_model={"rate": 100.0},
)
PLANT = SCENARIO.aircraft.plant()


def x_dot(x: FloatArray, u: FloatArray) -> FloatArray:
    aircraft = aircraft_at(0, PLANT, x)
    assert aircraft.trim is not None
    return np.asarray(
        aircraft.A @ x + aircraft.gravity @ np.sin(x) + aircraft.B @ u + aircraft.trim
    )


@pytest.mark.parametrize("ratio", [0.7, 1.0, 1.4])
def test_small_motion_about_level_flight_is_that_of_the_airframe_of_the_speed(ratio: float) -> None:
    x, u = level_flight(OSPREY, ratio, "thrust")
    assert x_dot(x, u) == approx(np.zeros(8), abs=1e-9)
    near = 1e-4
    of_x = np.array(
        [x_dot(x + near * unit, u) - x_dot(x - near * unit, u) for unit in np.eye(8)]
    ).T / (2.0 * near)
    after = at_speed(OSPREY, ratio, "thrust")
    # The trims are 0.05 V0 apart and integrated in 20 steps: 1e-3 of the largest entry of V.
    assert of_x == approx(after.matrix_a() + after.matrix_gravity() * np.cos(x), abs=2e-3)


def test_slow_flight_needs_more_incidence_and_less_thrust() -> None:
    """Lift grows with V^2 and equals the weight.

    With A[alpha,V] = -2 g / V^2, the incidence alpha - alpha_0 that gives the lift is proportional
    to V^-2.
    """
    (slow, at_slow), (fast, at_fast) = (
        level_flight(OSPREY, ratio, "thrust") for ratio in (0.8, 1.25)
    )
    alpha = OSPREY.index("alpha")
    V0 = OSPREY.speed
    # The slope is that of the trim, per rad.
    lift = -OSPREY.matrix_a()[alpha, 0] * V0 / -OSPREY.matrix_a()[alpha, alpha] / 2.0
    for x, ratio in ((slow, 0.8), (fast, 1.25)):
        assert x[alpha] == approx(lift * (ratio**-2.0 - 1.0), rel=0.1)  # the elevator has lift too
    thrust = list(OSPREY.inputs).index("thrust")
    assert at_slow[thrust] < 0.0 < at_fast[thrust]


def test_flight_to_another_speed_ends_in_its_trim() -> None:
    pulse = {"V": {"start": [1.0], "stop": [100.0], "value": [4.0]}}
    tape = simulate(
        SCENARIO.vary(
            flight={"duration": 30.0}, reference_model={"pulses": pulse, "coordinated_turn": None}
        )
    )
    last = {
        name: tape["truth"][name][-1]
        for name in ("x.V", "x.alpha", "x.theta", "x.q", "actuator.thrust")
    }
    x, _ = level_flight(OSPREY, 1.16, "thrust")
    assert last["x.V"] == approx(4.0, abs=0.02)
    # q is held at 0, and theta where it is.
    assert last["x.alpha"] == approx(x[OSPREY.index("alpha")], abs=2e-3)
    assert last["actuator.thrust"] > 0.1


def test_what_the_trim_speed_alone_has_is_refused() -> None:
    with refusing(
        r"^aircraft\.over_airspeed: found elevators, expected an input: elevator, thrust"
    ):
        SCENARIO.vary(aircraft={"over_airspeed": "elevators"})
    with refusing(r"^aircraft\.over_airspeed: found kinematics euler beside it"):
        SCENARIO.vary(aircraft={"kinematics": "euler"})
    with refusing(r"^aircraft\.over_airspeed: found a drift beside it"):
        SCENARIO.vary(aircraft={"drift": {"start": 1.0, "A": 0.1}})
    with refusing(
        r"^aircraft\.over_airspeed: found 'thrust', expected none: flights of many at once do not"
    ):
        build_course(SCENARIO)
    assert initial_state(PLANT).x == approx(np.zeros(8))
