# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the feedforward: its numbers, its effect on the error, and bumpless transfer.

By default there is no feedforward.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from pytest import approx
from tests.closed_loop import PROTOTYPE_SERVO, error
from tests.conftest import REPOSITORY, refusing

from aircraft_sim.airframes.airframe import load_airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.integrators import rk4
from flight_core.modes import Mode
from flight_core.vectors import FloatArray, StampedVector
from flight_design.gains.feedforward_model import with_feedforward, with_states_of
from flight_design.gains.ideal_control import manoeuvre, study_airframe
from rise_di_controller.extensions import feedforward
from rise_di_controller.extensions.feedforward import Nominal, nominal_model
from rise_di_controller.guard import guard
from rise_di_controller.guard.guard import ControllerState
from rise_di_controller.law import law as rise
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig

pytestmark = pytest.mark.slow

MS = 1_000_000
SERVO = PROTOTYPE_SERVO
BY_HAND = nominal_model(
    A=np.array([[-1.0, 2.0], [4.0, -3.0]]),
    B=np.array([[2.0], [0.0]]),
    C=np.array([[1.0, 0.0]]),
    gravity=np.zeros((2, 2)),
    lead=np.zeros(1),
)

# A small aircraft: two channels and two further states, one of them an angle that acts on y through
# gravity. CB = [[2, 0.4], [0.3, -1]], so D = (1, -1). At y = 0 the eigenvalues of the other two
# states are -2 1/s and 0.
A = ((-1.0, 0.2, 1.5, 0.0), (0.3, -2.0, 0.5, 0.0), (1.0, 0.4, -2.0, 0.0), (1.0, 0.0, 0.0, 0.0))
B = ((2.0, 0.4), (0.3, -1.0), (0.0, 0.0), (0.0, 0.0))
GRAVITY = ((0.0, 0.0, 0.0, -3.0), (0.0,) * 4, (0.0,) * 4, (0.0,) * 4)
MODEL: dict[str, Any] = {
    "states": ("a", "b", "c", "d"),
    "A": sum(A, ()),
    "B": sum(B, ()),
    "gravity": sum(GRAVITY, ()),
}
CONTROLLER: dict[str, Any] = SERVO.controller.model_dump() | {
    "outputs": ("a", "b"),
    "inputs": ("u", "v"),
    "k_d": (0.01,),
    "k_g": 0.01,  # with beta of 1e-9 the law has almost no effect
    "beta": (1e-9, 1e-9),
    "Lambda": (0.01, 0.01),
    "D": (1, -1),
    "input_scale": (0.5, 1.0),
    "omega": (1.0, 1.0),
    "lag": (0.0, 0.0),
    "delay": 0.0,
    "lower": None,
    "upper": None,
}


def small_aircraft(rate: float = 100.0, **model: Any) -> ControllerConfig:
    """Return a controller of the small aircraft.

    The lead is half a period unless `model` has one.
    """
    values = CONTROLLER | {"rate": rate, "feedforward": MODEL | {"lead": (0.5 / rate,) * 2} | model}
    return AnyLaw.validate_mapping(values, "controller")


def reference(t: float) -> FloatArray:
    """Return a reference that rests until t = 0 and moves afterwards.

    Its second derivative is continuous.
    """
    t = max(t, 0.0)
    return np.array([np.sin(t) ** 3, (1.0 - np.cos(2.0 * t)) ** 2 / 2.0])


def nominal_of(params: ControllerConfig) -> Nominal:
    nominal = params.nominal()
    assert nominal is not None
    return nominal


def largest_error(params: ControllerConfig) -> float:
    """Return the largest error in 6 s behind the guard, sampled at the controller's rate.

    Ten integration steps make a period.
    """
    limits = params.guard()
    law = params.tuned_law()
    state = guard.initial_state(2)
    x = np.zeros(4)
    samples: list[StampedVector] = []
    errors = []

    def x_dot(t: float, x: FloatArray, u: FloatArray, _: None) -> FloatArray:
        return np.asarray(np.array(A) @ x + np.array(GRAVITY) @ np.sin(x) + np.array(B) @ u)

    for k in range(round(6.0 * params.rate)):
        now_ns = k * limits.period_ns
        t = k / params.rate
        samples = [*samples[-2:], StampedVector(now_ns, reference(t))]
        state, _ = guard.tick(state, now_ns, StampedVector(now_ns, x[:2]), samples, limits, law)
        errors.append(np.abs(x[:2] - reference(t)).max())
        for _ in range(10):
            x = rk4(x_dot, 0.0, x, state.u, None, 0.1 / params.rate)
    return float(max(errors))


def test_one_tick_gives_the_hand_worked_numbers() -> None:
    # From x = (0, 0) to y_m = 0.1 in 0.1 s: y_m_dot = 1. The other state, eta_dot = 4 y_m - 3 eta
    # with y_m = t, is 4 (3 t - 1 + exp(-3 t)) / 9 = 0.0181414 then, and Runge-Kutta is within (3
    # t)^5 / 5! of it. In the middle x = (0.05, 0.0090707), so u = (1 - (-0.05 + 2 0.0090707)) / 2 =
    # 0.5159293.
    state, u_ff = feedforward.step(
        feedforward.initial_state(np.zeros(1), BY_HAND), np.array([0.1]), np.array(0.1), BY_HAND
    )
    assert state.x == approx([0.1, 0.0181414], abs=1e-5)
    assert state.u == approx([0.5159293], abs=1e-5)
    assert u_ff.tolist() == [0.0]


def test_input_extrapolated_linearly_from_last_two() -> None:
    # The middles of ticks of 0.1 and 0.2 s are 0.15 s apart; from the last middle it is 0.1 s to
    # the tick plus 0.05 s of lead.
    nominal = BY_HAND._replace(lead=np.array([0.05]))
    first, _ = feedforward.step(
        feedforward.initial_state(np.zeros(1), nominal), np.array([0.1]), np.array(0.1), nominal
    )
    second, _ = feedforward.step(first, np.array([0.5]), np.array(0.2), nominal)
    assert second.u_0 == approx(second.u + 0.15 * (second.u - first.u) / 0.15)


def test_zero_dynamics_are_zeros_of_model() -> None:
    # With y = x_1 at 0, x_2_dot = -3 x_2; in the small aircraft c_dot = -2 c and d_dot = 0
    assert feedforward.nominal_zeros(BY_HAND) == approx([-3.0])
    assert sorted(feedforward.nominal_zeros(nominal_of(small_aircraft())).real) == approx(
        [-2.0, 0.0]
    )


def test_the_feedforward_does_not_depend_on_y() -> None:
    # For two different y, u_ff is the same to the last bit.
    tracking, oscillating = (
        ticks(small_aircraft(), y)
        for y in (reference, lambda t: np.full(2, 10.0 * np.sin(30.0 * t)))
    )
    assert [state.u_ff.tobytes() for state in tracking] == [
        state.u_ff.tobytes() for state in oscillating
    ]
    assert (tracking[-1].u != oscillating[-1].u).all()


def test_on_nominal_plant_feedforward_alone_leaves_sampling_error() -> None:
    # K = 1.02 and beta = 1e-9 alone leave an error of 1.6. With the feedforward it is 1.0e-3, the
    # error of the linear extrapolation, which is of second order in the period: 3.5 to 4.5 differs
    # from first order (2) and third order (8).
    coarse = largest_error(small_aircraft(100.0))
    fine = largest_error(small_aircraft(200.0))
    assert coarse < 2e-3
    assert 3.5 < coarse / fine < 4.5
    assert largest_error(small_aircraft().model_copy(update={"feedforward": None})) > 0.5


def short(**changes: Any) -> Scenario:
    """Return osprey_servo with its manoeuvre and gusts shortened to 12 s."""
    pulses = {
        "q": {"start": [1.0, 4.0], "stop": [2.0, 5.0], "value": [0.1, -0.1]},
        "V": {"start": [0.5], "stop": [6.0], "value": [1.5]},
        "p": {"start": [1.5, 4.5], "stop": [2.5, 5.5], "value": [0.4, -0.4]},
        "r": {"start": [3.0, 3.5], "stop": [3.5, 4.0], "value": [0.03, -0.03]},
    }
    starts = zip(SERVO.aircraft.gusts.items(), (7.0, 9.5), strict=True)
    gusts = {name: gust.model_dump() | {"start": start} for (name, gust), start in starts}
    # y and y_m at the controller's rate, in steps of 5 ms: a fifth of the computation, scores
    # within 1 %
    slow = {"rate": 100.0, "step": 0.005, "gusts": gusts}
    reference_model = {"rate": 100.0, "pulses": pulses}
    return SERVO.vary(
        flight={"duration": 12.0}, aircraft=slow, reference_model=reference_model
    ).vary(**changes)


def both(scenario: Scenario) -> tuple[Scenario, Scenario]:
    """Return the scenario without feedforward and with the one of its published airframe."""
    config = with_feedforward(scenario.controller, scenario.aircraft.load()[0])
    return scenario.vary(controller={"feedforward": None}), scenario.vary(
        controller=config.model_dump()
    )


def ticks(
    params: ControllerConfig,
    y: Callable[[float], FloatArray],
    missing: tuple[float, float] = (9.0, 9.0),
) -> list[ControllerState]:
    """Return the states at every 10 ms from 0.5 to 1.5 s, while the reference moves.

    No samples arrive in the interval `missing`.
    """
    state = guard.initial_state(2)
    states = []
    y_now = StampedVector(0, np.zeros(2))
    y_m_samples = [StampedVector(0, np.zeros(2))]
    for k in range(50, 150):
        t = k / 100
        now_ns = k * 10 * MS
        if not missing[0] < t < missing[1]:
            y_now = StampedVector(now_ns, y(t))
            y_m_samples = [*y_m_samples[-2:], StampedVector(now_ns, reference(t))]
        state, _ = guard.tick(state, now_ns, y_now, y_m_samples, params.guard(), params.tuned_law())
        states.append(state)
    return states


def test_engagement_and_re_engagement_during_manoeuvre_bumpless() -> None:
    states = ticks(small_aircraft(), reference, missing=(0.8, 1.2))
    modes = [state.mode for state in states]
    ticks_of_engagement = [0, modes.index(Mode.ENGAGED, modes.index(Mode.HOLD))]
    assert ticks_of_engagement[1] == 70
    # With y = y_m the law is at rest, so u changes by the feedforward only, by 0.04 to 0.07 per
    # tick. The whole u_ff would be a jump of 0.8 at the first engagement and of 4.6 at the second.
    nominal = nominal_of(small_aircraft())
    for first in ticks_of_engagement:
        u = np.array([state.u for state in states[first : first + 20]])
        assert (u[:3] == u[0]).all()  # two ticks determine the slope and add nothing
        assert 0.005 < np.abs(np.diff(u[2:], axis=0)).max() < 0.1
        t = 0.5 + first / 100
        rate = (reference(t + 0.01) - reference(t)) / 0.01
        whole = feedforward.ideal_input(
            feedforward.initial_state(reference(t), nominal).x, rate, nominal
        )
        assert np.abs(whole).max() > 0.5


def test_new_gains_change_neither_feedforward_nor_input() -> None:
    old = small_aircraft()
    values = old.model_dump() | {"k_g": 5.0, "Lambda": (2.0, 2.0), "delay": 0.02}
    new = AnyLaw.validate_mapping(values, "controller")
    state = ticks(old, lambda t: reference(t) + 0.1 * t)[-1]
    assert state.law is not None
    law = rise.retune(state.law, old.law_params(), new.law_params())
    retuned = state._replace(law=law)
    assert rise.control(law, law, new.law_params()) == approx(
        rise.control(state.law, state.law, old.law_params())
    )
    now = StampedVector(1500 * MS, reference(1.5))
    before, _ = guard.tick(state, now.stamp_ns, now, [now], old.guard(), old.tuned_law())
    after, _ = guard.tick(retuned, now.stamp_ns, now, [now], new.guard(), new.tuned_law())
    assert before.u_ff.tobytes() == after.u_ff.tobytes()


@pytest.mark.parametrize(
    "change, sentence",
    [
        (
            {"A": (1.0,) * 15},
            r"^controller\.feedforward\.A: found 15 values, expected 16: 4 rows of 4$",
        ),
        (
            {"B": (2.0, 0.4, 0.3, 1.0) + (0.0,) * 4},
            (
                r"^controller\.feedforward\.B: found a C B with D = \[1, 1\], expected D = \[1, "
                r"-1\], the D of the controller$"
            ),
        ),
        (
            {"A": sum((*A[:2], (1.0, 0.4, 0.5, 0.0), A[3]), ())},
            (
                r"^controller\.feedforward\.A: found zero dynamics with an eigenvalue at 0\.5 1/s, "
                r"expected none in the right half"
            ),
        ),
        (
            {"A": sum((*A[:2], (1.0, 0.4, -30.0, 0.0), A[3]), ())},
            (
                r"^controller\.feedforward\.A: found zero dynamics as fast as 30 1/s, expected at "
                r"most 25 1/s, which"
            ),
        ),
    ],
)
def test_an_unusable_nominal_model_is_refused(change: Mapping[str, Any], sentence: str) -> None:
    with refusing(sentence):
        small_aircraft(**change)


def test_feedforward_lowers_needed_beta() -> None:
    """With a feedforward, beta only has to exceed the slew of the remaining ideal input."""
    # N_d is -D U times the slew of the ideal control less the slew of u_ff. For 20 aircraft at +-30
    # % in calm air the mean remainder is 20 %, 17 %, 20 % and 37 % of the slew of elevator, thrust,
    # aileron and rudder; the test allows half.
    airframe = load_airframe("osprey")
    study = study_airframe(airframe, manoeuvre(short(), airframe)._replace(gusts={}), 0.3, 20)
    rates = np.abs(study.u_dot[:, 1:]).max(axis=0)
    remainder = np.abs(study.u_dot[:, 1:] - study.u_dot[:, :1]).max(axis=0)
    assert (remainder.mean(axis=0) < 0.5 * rates.mean(axis=0)).all()


def test_feedforward_reduces_error_of_nominal_osprey_with_servos() -> None:
    # Measured in units of a score: 1.98 -> 0.22 in calm air, where noise remains. The margin is
    # half of the improvement.
    errors = [error(simulate(scenario)).values for scenario in both(short(aircraft={"gusts": {}}))]
    error_without, with_it = (
        float(np.sqrt(np.mean(e**2, axis=0)) @ [100.0, 10.0, 50.0, 100.0]) for e in errors
    )
    assert with_it < 0.55 * error_without


def test_airframe_takes_the_states_of_a_feedforward_that_it_lacks() -> None:
    """The airframe gets the states that a feedforward has and it lacks.

    Here this is the bank angle, which the feedforward of PX4's rates has.
    """
    scenario = find_scenario(str(REPOSITORY / "examples/px4_airplane/rates.yaml"))
    law = scenario.rise_di()
    former = law.feedforward
    assert former is not None
    assert former.states == ("alpha", "q", "beta", "p", "r", "phi")
    airframe = load_airframe(str(REPOSITORY / "examples/px4_airplane/rates_airframe.yaml"))
    heavy = airframe.with_matrices(
        0.5 * airframe.matrix_a(), 0.5 * airframe.matrix_b(), np.ones((5, 2))
    )
    new = with_feedforward(law, with_states_of(heavy, former)).feedforward
    assert new is not None
    assert new.states == former.states
    A, B = np.reshape(new.A, (6, 6)), np.reshape(new.B, (6, 3))
    before = np.reshape(former.A, (6, 6))
    assert A[:5, :5] == approx(0.5 * before[:5, :5])
    assert np.array_equal(A[5], before[5])
    assert np.array_equal(A[:, 5], before[:, 5])
    assert B[:5] == approx(0.5 * np.reshape(former.B, (6, 3))[:5])
    assert not B[5].any()
    # Without them the model is that of the airframe alone.
    bare = with_feedforward(law, heavy).feedforward
    assert bare is not None
    assert bare.states == tuple(heavy.states)
    with_gravity = former.model_copy(update={"gravity": (0.0,) * 36})
    with refusing("gravity beside phi, expected an airframe with these states"):
        with_states_of(heavy, with_gravity)
