# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the schedule of input_scale over dynamic pressure.

The tests cover its equation, bumpless transfer, a flight with a delay, and replay.
"""

from functools import cache

import numpy as np
import pytest
from pytest import approx
from tests.conftest import refusing

from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from rise_di_controller.extensions.schedule import SCALE_RANGE, target_scale
from rise_di_controller.law.control_law import Measurements, TunedLaw

pytestmark = pytest.mark.slow

SPEED = 46.3  # m/s, trim of the c172p
C172P = find_scenario("jsbsim_c172p")  # outputs of the controller: q, p, r, V
FASTER = 16.0  # m/s: 1.81 times the dynamic pressure of the trim


# Gains with 21 deg of phase margin: the loop lacks the margin for 1.8 times the dynamic pressure.
FAST = {
    "k_d": [22.7308, 22.7308, 10.8077],
    "Lambda": [6.05769, 6.05769, 3.07692, 0.0945933],
    "beta": [14.5821, 41.3826, 7.50732, 0.215673],
    "softening": 2.75,
}


def flight(schedule: bool, delay: float, duration: float) -> Scenario:
    """Return the c172p in calm air, which accelerates from 46.3 to 62.3 m/s, with a delayed y."""
    pulse = {"V": {"start": [1.0], "stop": [1000.0], "value": [FASTER]}}
    return C172P.vary(
        flight={"duration": duration},
        aircraft={"gusts": {}, "sensors": {"delay": delay}},
        reference_model={"pulses": pulse, "coordinated_turn": None},
        controller=FAST | ({"schedule": {"speed": SPEED}} if schedule else {}),
    )


@cache
def flown(schedule: bool) -> Tape:
    """Return a flight with y 30 ms late, which ends when it is at rest or in its limit cycle."""
    return simulate(flight(schedule, 0.03, 60.0 if schedule else 35.0))


def law() -> TunedLaw:
    return flight(schedule=True, delay=0.0, duration=1.0).controller.tuned_law()


def y_at(V: float) -> FloatArray:
    return np.array([0.0, 0.0, 0.0, V])


@pytest.mark.parametrize(
    "V, scale",
    [
        (0.0, 1.0),
        (SPEED, 0.3),
        (FASTER, (46.3 / 62.3) ** 2),
        (-10.0, (46.3 / 36.3) ** 2),
        (-SPEED, 3.0),
        (-1e3, 3.0),
        (1e6, 0.3),
    ],
)
def test_scale_is_ratio_of_dynamic_pressures_within_range(V: float, scale: float) -> None:
    assert SCALE_RANGE == (0.3, 3.0)
    assert target_scale(y_at(V), law().params) == approx([scale, scale, scale, 1.0])


def test_change_of_scale_leaves_u_as_it_is() -> None:
    control_law, params = law()
    rng = np.random.default_rng(1)
    zero = np.zeros(4)
    state = control_law.engage(
        Measurements(y=zero, y_m=zero, y_m_dot=zero, u_trim=zero, u_before=zero), params
    )
    for _ in range(20):
        y = 0.01 * rng.normal(size=4)
        state, u = control_law.step(
            state,
            Measurements(y=y, y_m=zero, y_m_dot=zero, u_trim=zero, u_before=zero),
            np.float64(0.01),
            params,
        )
    instant = np.float64(1e-9)
    at_once = params._replace(time=np.float64(1e-9))
    y[3] += FASTER
    # the reference moved too: the same error
    measurements = Measurements(y=y, y_m=y_at(FASTER), y_m_dot=zero, u_trim=zero, u_before=zero)
    state, after = control_law.step(state, measurements, instant, at_once)
    assert state.scale[0] == approx((SPEED / (SPEED + y[3])) ** 2)
    assert after == approx(u, rel=1e-6)


def rms(tape: Tape) -> dict[str, float]:
    """Return the standard deviation of the rates over the last 5 s, mrad/s."""
    last = tape.time("y") > tape.time("y")[-1] - 5.0
    return {name: 1e3 * float(np.std(tape["y"][name][last])) for name in ("q", "p", "r")}


def test_schedule_keeps_delayed_loop_at_rest() -> None:
    """At 1.8 times the dynamic pressure, only the schedule keeps the loop with delay at rest."""
    # Without it, the loop with 30 ms of delay is in a limit cycle of tens of mrad/s in q. The
    # margin at trim is 18 ms.
    assert rms(flown(False))["q"] > 10.0
    tape = flown(True)
    assert max(rms(tape).values()) < 0.1
    assert tape["internals"]["scale.q"][-1] == approx((46.3 / 62.3) ** 2, rel=0.01)
    assert set(tape["internals"]["scale.V"]) == {1.0}


def test_flight_with_schedule_replayed_to_last_bit() -> None:
    scenario = flight(schedule=True, delay=0.03, duration=60.0)
    result = replay(flown(True), scenario.controller)
    assert result.checked.all()
    assert result.is_equal()


@pytest.mark.parametrize("name", ["osprey_observer"])
def test_model_of_trim_beside_schedule_refused(name: str) -> None:
    with refusing(r"schedule: found a feedforward or an observer that holds at the trim speed"):
        find_scenario(name).vary(controller={"schedule": {"speed": 25.0}})


def test_schedule_of_airspeed_alone_refused() -> None:
    """A schedule of V alone is refused.

    The factor of channel V is 1, so nothing would follow the schedule.
    """
    values = flight(schedule=True, delay=0.0, duration=1.0).controller.model_dump()
    place = C172P.controller.outputs.index("V")
    for key in (
        "outputs",
        "inputs",
        "D",
        "input_scale",
        "lag",
        "Lambda",
        "beta",
        "omega",
        "lower",
        "upper",
    ):
        values[key] = values[key][place : place + 1]
    for key in ("k_d", "slew", "allocation"):
        values[key] = () if key == "k_d" else None
    with refusing(r"schedule: found the outputs V, expected V and at least one other output"):
        C172P.rise_di().validate_mapping(values, "controller")
