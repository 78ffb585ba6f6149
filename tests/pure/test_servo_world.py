# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The osprey with servos, noise, delay and losses agrees with a prototype of this law to 10 %.

The prototype is another program with the same equations. benchmarks/servo_world.py holds all of its results and their
conditions. This file tests rows of each table. The prototype's results have two or three digits, so rounding takes up to 5 % of
the 10 %. Measured differences are 0 to 5 %, in r up to 9 % for a reason that is tested below.

Further rows of the same tables are in test_sensors.py (losses with the measured dt), test_actuators.py (PI),
test_saturation.py (stops and rates) and test_gains.py (linear margins).
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from benchmarks import servo_world
from benchmarks.servo_world import (
    FINE_STEP,
    LITERAL,
    METRICS,
    TABLES,
    Row,
    delayed,
    linear_loop,
    measure,
    score,
    servo_scenario,
)
from scipy.signal import lsim
from tests.closed_loop import error
from tests.pure.test_saturation import last_beyond, pulse, state, with_stops

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.vectors import FloatArray
from reference_model.command import Profile, command
from rise_di_controller.linear_loop import is_stable

pytestmark = [pytest.mark.package("flight_analysis"), pytest.mark.slow]

ROWS = {row.name: row for _, rows in TABLES.values() for row in rows()}


@cache
def measured(name: str) -> dict[str, FloatArray]:
    """The metrics of a row, flown in steps of 5 ms where the benchmark has 2.5 ms, for half of the time."""
    row = ROWS[name]
    return measure(row if row.scenario.aircraft.step == FINE_STEP else flown_coarsely(row))


def flown_coarsely(row: Row) -> Row:
    return row._replace(scenario=row.scenario.vary(aircraft={"step": 0.005}))


def assert_agrees(metrics: dict[str, FloatArray], row: Row) -> None:
    for key, published in row.published.items():
        assert metrics[key] == pytest.approx(published, rel=0.1), key


@pytest.mark.parametrize(
    "name",
    [
        "soft, 20 ms, calm",
        "soft, 10 ms, gusts",  # also the settling times of q, V and r after each gust: 1.70, 3.65, 1.52 s
        "soft, high gains, gusts",
        "literal, calm",  # the limit cycle
        "implicit, at rest",  # gains of benchmarks/sampling.py; chatter with servos that the law ignores
        "soft, 0.005 rad/s",  # gyro noise per sample of 10 ms, calm air; none on V
        "soft, 0.01 rad/s",
        "soft, 0.02 rad/s",
        "soft, 0.05 rad/s",
        "PI, 0.005 rad/s",
        "PI, 0.05 rad/s",
        "none lost",  # gusts, gyro noise 1.7 mrad/s, airspeed noise 0.03 m/s
    ],
)
def test_a_flight_agrees_with_the_prototype(name: str) -> None:
    assert_agrees(measured(name), ROWS[name])


def test_sign_term_loses_advantage_with_gyros_as_noisy_as_error() -> None:
    # The prototype's laws are equal at 0.02 rad/s per sample, 7.2 mrad/s each; here they have 7.01 and 6.82.
    q = {
        (sign, gyro): float(measured(f"{sign}, {gyro:g} rad/s")["rms of q"][0])
        for sign in ("soft", "PI")
        for gyro in (0.005, 0.05)
    }
    assert q["soft", 0.005] < 0.6 * q["PI", 0.005]
    assert q["soft", 0.05] > 1.1 * q["PI", 0.05]


def test_lost_ticks_with_nominal_dt_cost_as_much_as_in_prototype() -> None:
    # A single flight scatters with the samples that are lost in a gust. Over twelve seeds the rms has standard deviations of
    # 2.2, 0.004, 0.9, 0.6. The means of twelve, 12.7, 0.114, 17.3, 10.8, agree with the prototype to 5 %. The row of 20 % lost
    # is in benchmarks/servo_world.py alone.
    row = ROWS["50% lost, nominal dt"]
    assert_agrees(measure(flown_coarsely(row)._replace(seeds=range(1, 4))), row)


@pytest.mark.parametrize(
    ("changes", "below", "above"),
    [
        pytest.param({}, 0.045, 0.055, id="soft"),  # the prototype: 50 ms
        pytest.param(LITERAL, 0.040, 0.045, id="literal"),  # 44 ms
    ],
)
def test_score_triples_at_delay_of_prototype(changes: dict[str, Any], below: float, above: float) -> None:
    # By bisection 50.1 and 42.1 ms: benchmarks/servo_world.py, also for PI. Delays here come in whole samples of 5 ms.
    scores = [score(delayed(servo_scenario(**changes), delay, 200.0)) for delay in (0.0, below, above)]
    assert scores[1] < servo_world.TRIPLED * scores[0] < scores[2]


def test_ten_milliseconds_of_topic_delay_cost_three_percent() -> None:
    # In the prototype of V and r; here of V, and 1 % of the others.
    none, late = (measure(Row("", delayed(servo_scenario(), delay, 100.0), {"rms": ()}))["rms"] for delay in (0.0, 0.01))
    ratio = late / none
    assert (ratio > 1.0).all()
    assert (ratio < 1.04).all()
    assert ratio[1] == pytest.approx(1.03, abs=0.01)


def test_loop_has_gain_margin_of_ten() -> None:
    # The prototype has 11. The linear sampled loop without delay.
    plant, law, loop = linear_loop(servo_scenario())
    stable = {gain: is_stable(plant._replace(B=plant.B * gain), law, loop, np.zeros(4)) for gain in (10.0, 12.0)}
    assert stable == {10.0: True, 12.0: False}


def turn_with_model_bank(scenario: Scenario) -> Callable[[FloatArray, Profile], FloatArray]:
    """u_m with the turn coordinated to the bank of the reference model, phi_m_dot = p_m, instead of the command."""
    reference = scenario.reference_model
    profile = reference.profile()
    straight = profile._replace(turn_rate=0.0 * profile.turn_rate)
    p, r = (reference.outputs.index(name) for name in ("p", "r"))
    t = np.arange(0.0, 60.02, 0.005)
    assert reference.second_order is not None
    omega, zeta = reference.second_order.natural_frequency[p], reference.second_order.damping[p]
    _, p_m, _ = lsim(([omega**2], [1.0, 2.0 * zeta * omega, omega**2]), command(t, straight)[:, p], t)
    phi_m = np.cumsum(p_m) * (t[1] - t[0])

    def turned(now: FloatArray, _: Profile) -> FloatArray:
        u_m = np.array(command(now, straight))
        u_m[..., r] += profile.turn_rate[r] * np.sin(np.interp(now, t, phi_m))
        return u_m

    return turned


def test_r_differs_in_calm_air_as_turns_coordinated_to_bank_of_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The prototype uses the bank of the reference model: max of r 14 mrad/s with the softened sign, PI 4.7 rms and max 23.
    # Measured here with the bank of the command 12.5, and 5.47 and 25.6; with the prototype's bank 13.7, and 4.62 and 22.2.
    soft, pi = ROWS["soft, 10 ms, calm"], ROWS["PI, calm"]
    with pytest.raises(AssertionError):
        assert_agrees(measure(pi), pi)
    monkeypatch.setattr("reference_model.reference.command", turn_with_model_bank(pi.scenario))
    assert_agrees(measure(soft), soft)
    assert_agrees(measure(pi), pi)


def test_integrator_windup_and_anti_windup_of_thrust_agree_with_prototype() -> None:
    # Thrust +-15 %, V +4 m/s from 10 s to 30 s as in the manoeuvre of the scenario. The prototype: 677 % commanded, undershoot
    # 1.42 m/s, 12.6 s to within 0.1 m/s, rms 0.96 m/s; with anti-windup (conditional integration) 60 %, 0.00, 4.1, 0.44.
    # Measured 681, 1.41, 12.5, 0.946 and 60.6, 0.001, 4.08, 0.438.
    back, metrics = 30.0, {}
    for guarded in (False, True):
        held = with_stops("thrust", 0.15, guarded=guarded)
        tape = simulate(held.vary(flight={"duration": 60.0}, reference_model={"pulses": {"V": pulse(10.0, back, 4.0)}}))
        e, t = error(tape)["V"], tape.time("truth")
        metrics[guarded] = [
            100.0 * np.abs(tape["internals"]["u_free.thrust"]).max(),
            -state(tape, "V")[t > back].min(),
            last_beyond(t, e, 0.1) - back,
            np.sqrt(np.mean(e**2)),
        ]
    assert metrics[False] == pytest.approx([677, 1.42, 12.6, 0.96], rel=0.1)
    assert metrics[True][0::2] == pytest.approx([60, 4.1], rel=0.1)
    assert metrics[True][1] < 0.005  # the prototype: 0.00
    assert metrics[True][3] == pytest.approx(0.44, rel=0.1)


def test_every_metric_of_every_row_is_known() -> None:
    assert {key for row in ROWS.values() for key in row.published} == set(METRICS)
