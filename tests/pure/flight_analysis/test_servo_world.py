# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the osprey with servos agrees with a prototype of this law to 10 %.

The prototype is another program with the same equations. y, y_m and the law run at 100 Hz, topics
take no time, and the softened sign is three total lags wide. The prototype's figures have two or
three digits, so rounding takes up to 5 % of the 10 %. Errors are true errors over 60 s, q, V, p, r
in mrad/s, m/s.
"""

from typing import Any

import numpy as np
import pytest
from pytest import approx
from tests.closed_loop import PROTOTYPE_SERVO, error
from tests.pure.rise_di_controller.test_saturation import last_beyond, pulse, state, with_stops

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics.errors import error_metrics

pytestmark = pytest.mark.slow

# the law is then a PI controller
NO_SIGN = {"beta": [1e-9 * beta for beta in PROTOTYPE_SERVO.rise_di().beta]}
LITERAL = {"sign": "literal"}
CALM: dict[str, Any] = {"gusts": {}}
GYRO = {"sensors": {"noise": [0.02, 0.0, 0.02, 0.02]}}  # rad/s rms per sample
# actuators lead by half an integration step, which changes the size of a limit cycle
FINE = {"step": 0.001}


def servo_scenario(
    aircraft: dict[str, Any], controller: dict[str, Any], duration: float
) -> Scenario:
    """Return osprey_servo with the gains and under the conditions of the prototype."""
    return PROTOTYPE_SERVO.vary(
        flight={"duration": duration},
        aircraft={"rate": 100.0, "step": 0.005, "sensors": {}} | aircraft,
        reference_model={"rate": 100.0},
        controller={"rate": 100.0, "delay": 0.0, "softening": 3.0} | controller,
    )


@pytest.mark.parametrize(
    "aircraft, controller, rms, duration",
    [
        pytest.param({}, {}, (7.6, 0.088, 9.9, 6.4), 60.0, id="soft, gusts"),
        pytest.param({}, NO_SIGN, (13.7, 0.178, 22.2, 14.0), 60.0, id="PI, gusts"),
        pytest.param(
            CALM | FINE,
            LITERAL,
            (13.0, 0.179, 16.8, 18.4),
            60.0,
            id="literal, calm: a limit cycle",
        ),
        # the noise is stationary: half a flight has its rms
        pytest.param(CALM | GYRO, {}, (7.2,), 30.0, id="soft, noisy gyros"),
    ],
)
def test_a_flight_agrees_with_the_prototype(
    aircraft: dict[str, Any],
    controller: dict[str, Any],
    rms: tuple[float, ...],
    duration: float,
) -> None:
    errors = error(simulate(servo_scenario(aircraft, controller, duration)))
    units = (1e3, 1.0, 1e3, 1e3)
    measured = [
        unit * error_metrics(errors[name]).rms
        for unit, name in zip(units, ("q", "V", "p", "r"), strict=True)
    ]
    assert measured[: len(rms)] == approx(rms, rel=0.1)


def test_integrator_windup_and_anti_windup_of_thrust_agree_with_prototype() -> None:
    # Thrust +-15 %, V +4 m/s from 10 s to 30 s as in the manoeuvre of the scenario. The prototype:
    # 677 % commanded, undershoot 1.42 m/s, 12.6 s to within 0.1 m/s, rms 0.96 m/s; with anti-windup
    # (conditional integration) 60 %, 0.00, 4.1, 0.44. Measured 681, 1.41, 12.5, 0.946 and 60.6,
    # 0.001, 4.08, 0.438.
    back = 30.0
    metrics = {}
    for guarded in (False, True):
        scenario = with_stops("thrust", 0.15, guarded=guarded)
        tape = simulate(
            scenario.vary(
                flight={"duration": 60.0}, reference_model={"pulses": {"V": pulse(10.0, back, 4.0)}}
            )
        )
        e = error(tape)["V"]
        t = tape.time("truth")
        metrics[guarded] = [
            100.0 * np.abs(tape["internals"]["u_free.thrust"]).max(),
            -state(tape, "V")[t > back].min(),
            last_beyond(t, e, 0.1) - back,
            np.sqrt(np.mean(e**2)),
        ]
    assert metrics[False] == approx([677, 1.42, 12.6, 0.96], rel=0.1)
    assert metrics[True][0::2] == approx([60, 4.1], rel=0.1)
    assert metrics[True][1] < 0.005  # the prototype: 0.00
    assert metrics[True][3] == approx(0.44, rel=0.1)
