# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: N802 - D and U are the paper's names
"""Test gains: Theorem 1 by hand, and the engineering procedure on the osprey.

Further tests are about refusals, and about the predicted delay margin.
"""

import json
import math
import re
from collections import deque
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from pytest import approx
from tests.closed_loop import law_params
from tests.conftest import invoke, refusing
from typer.testing import Result

from aircraft_sim.airframes.airframe import LIBRARY, load_airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.linear_loop.delay_margin import delay_margin
from flight_core.parameters import ParameterError
from flight_core.vectors import FloatArray
from flight_design.gains import gain_conditions, ideal_control
from flight_design.gains import gain_selection as selection
from flight_design.gains.channel_signs import signs_of_pairing
from flight_design.gains.gain_conditions import Bounds, GainCondition, GainSet
from flight_design.gains.gain_design import select_gains
from flight_design.gains.gain_selection import GainAssessment, LoopSetting
from flight_design.gains.gain_yaml import selection_yaml
from flight_design.gains.ideal_control import ChannelPairing, Study
from rise_di_controller.law.decomposition import decompose
from rise_di_controller.law.law import LawParams, Sign, engage, step, tuned
from rise_di_controller.law.linear_loop import LinearLaw, LinearPlant, LoopTiming, linear_law
from rise_di_controller.laws import AnyLaw

pytestmark = pytest.mark.slow

AIRFRAME = load_airframe("osprey")
SERVOS: LoopSetting = selection.loop_setting(find_scenario("osprey_servo"))._replace(
    delay=0.0, rate_limit={}
)
HAND = Bounds(
    U=np.array([[0.0, 2.0, 1.0], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]),
    N_d=np.array([1.0, 2.0, 3.0]),
    rho=2.0,
    gamma_2=np.array([1.0, 2.0, 0.0]),
)


@pytest.fixture(scope="module")
def osprey() -> Study:
    """Return the osprey and twenty airframes around it along the manoeuvre of the default scenario.

    The manoeuvre includes the gusts.
    """
    scenario = find_scenario("osprey_gust")
    return ideal_control.study_airframe(
        AIRFRAME, ideal_control.manoeuvre(scenario, AIRFRAME), samples=20
    )


@pytest.fixture(scope="module")
def selected(osprey: Study) -> selection.Selection:
    """Return both gain sets for the osprey behind servos."""
    return selection.gain_sets(osprey, SERVOS)


def names(conditions: tuple[GainCondition, ...], channels: tuple[str, ...]) -> list[str]:
    return [
        condition.name
        if condition.channel is None
        else f"{condition.name} of {channels[condition.channel]}"
        for condition in conditions
    ]


def failing_in_loop(assessment: GainAssessment[Any]) -> list[str]:
    return names(gain_conditions.failing(assessment.loop), assessment.controller.outputs)


@pytest.mark.equation(29, 30)
def test_beta_follows_29_and_30_from_last_channel_up() -> None:
    # beta_3 = 3 (1 + 0/4) = 3; beta_2 = (2 + 0.5 3) (1 + 2/2) = 7; beta_1 = (1 + 2 7 + 1 3) (1 +
    # 1/1) = 36
    assert gain_conditions.least_beta(np.array([1.0, 2.0, 4.0]), HAND).tolist() == [36.0, 7.0, 3.0]


@pytest.mark.equation(27, "Step 2", "Step 3")
def test_k_g_and_k_d_follow_steps_2_and_3_from_last_channel_up() -> None:
    gains = gain_conditions.theorem_gains(HAND, np.ones(3))
    # k_g = 1.5 2^2 / 4; k_3 = 1 + k_g = 2.5; a row of step 3 may take 0.3 / 2
    # zeta_Phi,2 = 0.5 2.5 = 1.25, k_d,2 = 1.25^2 / (4 0.15); k_2 = 2.5 + k_d,2
    # zeta_Phi,1^2 = (2 k_2)^2 + (1 2.5)^2
    k_2 = 2.5 + 1.5625 / 0.6
    assert gains.k_g == approx(1.5)
    assert gains.k_d.tolist() == approx([((2.0 * k_2) ** 2 + 6.25) / 0.6, 1.5625 / 0.6])
    assert gains.K.tolist() == approx([2.5 + gains.k_d[0], k_2, 2.5])


@pytest.mark.equation("Step 3")
def test_gains_of_theorem_1_meet_conditions() -> None:
    conditions = gain_conditions.check_theorem(
        gain_conditions.theorem_gains(HAND, np.ones(3)), HAND
    )
    assert not gain_conditions.failing(conditions)
    # the least beta
    assert [condition.margin for condition in conditions[:3]] == approx([1.0, 1.0, 1.0])
    assert conditions[3].margin == approx(1.5)
    # 2 rows of 0.15; 1 - 2/3
    assert (conditions[4].value, conditions[4].bound) == approx((0.3, 1.0 / 3.0))


@pytest.mark.equation(29, 30, "Step 2")
@pytest.mark.parametrize(
    "change, failing",
    [
        ({"beta": np.array([72.0, 7.0, 2.9])}, ["beta (29) of c"]),
        ({"k_d": np.array([20.0, 2.7])}, ["k_d, step 3 of a"]),
    ],
)
def test_a_condition_that_fails_is_named(
    change: dict[str, FloatArray | float], failing: list[str]
) -> None:
    bounds = HAND._replace(gamma_2=np.array([1.0, 1.0, 0.0]))
    good = gain_conditions.theorem_gains(bounds, np.ones(3))
    # with Lambda = 1 the gamma_2 of the second channel is 1
    assert good.beta.tolist() == [36.0, 7.0, 3.0]
    gains = good._replace(**change)  # type: ignore[arg-type]
    conditions = gain_conditions.failing(gain_conditions.check_theorem(gains, bounds))
    assert names(conditions, ("a", "b", "c")) == failing


@pytest.mark.equation(22)
def test_gain_that_22_does_not_allow_refused() -> None:
    with refusing(r"^k_d: found \[0\.\], expected values above 0$"):
        gain_conditions.check_theorem(GainSet(1.0, np.zeros(1), np.ones(2), np.ones(2)), HAND)
    with refusing("the smallest in the last channel"):
        gain_conditions.split_gain(np.array([2.0, 3.0]))
    with refusing(r"^K\[1\]: found 0\.9, expected above 1"):
        gain_conditions.split_gain(np.array([2.0, 0.9]))


@pytest.mark.equation(27)
def test_bounds_of_U_are_those_of_worst_sample() -> None:
    lower = np.array([[0.9, 0.0], [0.0, 0.9]])
    upper = np.array([[1.1, 0.3], [0.2, 1.1]])
    places = np.array(list(product((0.0, 0.5, 1.0), repeat=4))).reshape(-1, 2, 2)
    # the corners of the interval, and points between them
    samples = lower + places * (upper - lower)
    # U_12 = W_12 - L_21 with D = I: largest with W_12 = 0.3 / 0.9, L_21 = 0, which is a corner
    assert gain_conditions.bound_U(samples)[0, 1] == approx(0.3 / 0.9)


@pytest.mark.equation(16, 17, 18)
def test_n_d_is_minus_D_U_v_dot() -> None:
    # M Omega v_dot with M = S^-1, for any Omega: the disturbance that the ideal control cancels
    Omega = np.array([[1.0, 2.0], [2.0, 1.0]])
    v_dot = np.array([[0.3, -0.7], [1.0, 2.0]])
    expected = [-np.linalg.solve(decompose(Omega).S, Omega @ row) for row in v_dot]
    assert_allclose(gain_conditions.N_d(Omega, v_dot), expected, atol=1e-12)


def test_airframe_with_unstable_zero_refused(osprey_gust: Scenario) -> None:
    rows = [list(row) for row in AIRFRAME.A]
    # the zero at -0.69 1/s is that entry
    rows[AIRFRAME.index("beta")][AIRFRAME.index("beta")] = 0.69
    with refusing(r"^airframe osprey: found a zero at 0\.69 1/s, expected none in the right"):
        ideal_control.study_airframe(
            AIRFRAME.model_copy(update={"A": rows}), ideal_control.manoeuvre(osprey_gust, AIRFRAME)
        )


def test_engineering_gains_of_osprey_are_close_to_those_tuned_by_hand(
    selected: selection.Selection,
) -> None:
    controller = selected.chosen
    params = controller.law_params()
    assert controller.outputs == ("q", "p", "r", "V")  # the slowest last, as (22) wants it
    # Products of 0.63, 0.63, 0.46, 0.46 rad over total lags of 0.035 and 0.115 s. By hand in
    # flight, K of q and p were 18.
    assert_allclose(params.K, [18.0, 18.0, 0.46 / 0.035, 0.46 / 0.115])
    # a quarter of K: both have more than 45 deg of phase
    assert_allclose(params.Lambda[:2], [4.5, 4.5])
    # T_eps in total lags
    widths = params.eps * params.K / params.beta / np.array([0.035, 0.035, 0.035, 0.115])
    assert_allclose(widths[:2], [2.75, 2.75])
    # both integrals slower alike
    assert_allclose(widths[2:], 2.75 * params.K[2:] / 4.0 / params.Lambda[2:])
    slew = selected.study.slew[[0, 2, 3, 1]] / params.input_scale
    assert_allclose(params.beta, 1.25 * slew)
    assert not gain_conditions.failing((*selected.engineering.loop, *selected.engineering.rules))
    # q alone limits the delay: 45 ms with a softening of 3 in all channels, where r and V had 32
    # and 26 deg of phase
    assert selected.engineering.delay_margin is not None
    assert selected.engineering.delay_margin > 0.045


def test_gains_of_theorem_1_are_unstable_on_osprey_with_servos(
    selected: selection.Selection,
) -> None:
    literal = selected.theorem
    assert not gain_conditions.failing(literal.theorem)
    assert literal.delay_margin == 0.0
    outputs = literal.controller.outputs
    assert {"linear stability", "delay margin"} <= set(failing_in_loop(literal))
    broken = names(gain_conditions.failing(literal.rules), outputs)
    assert {"lag product of q", "lag product of p"} <= set(broken)
    assert not literal.is_stable
    assert "k_g, step 2" in names(gain_conditions.failing(selected.engineering.theorem), outputs)


def test_beta_stays_below_rate_of_actuators(osprey: Study) -> None:
    slow = selection.gain_sets(osprey, SERVOS._replace(rate_limit={"thrust": 1.2})).engineering
    params = slow.controller.law_params()
    # the slew of the ideal thrust is 1.14 1/s
    assert params.beta[3] * params.input_scale[3] == approx(0.7 * 1.2)
    broken = gain_conditions.failing(slow.rules)
    assert names(broken, slow.controller.outputs) == ["beta above slew of V"]


def osprey_channels(
    inputs: tuple[str, ...] = ("elevator", "thrust", "aileron", "rudder"),
    flipped: tuple[str, ...] = (),
) -> tuple[FloatArray, ChannelPairing]:
    """Return Omega of the osprey with its inputs in some order, some of them reversed."""
    columns = [list(AIRFRAME.inputs).index(name) for name in inputs]
    signs = np.array([-1.0 if name in flipped else 1.0 for name in inputs])
    return (AIRFRAME.matrix_c() @ AIRFRAME.matrix_b())[:, columns] * signs, ChannelPairing(
        AIRFRAME.outputs, inputs
    )


@pytest.mark.equation("Remark 1")
def test_wrong_D_refused_with_one_that_fits() -> None:
    Omega, channels = osprey_channels(flipped=("elevator",))
    sentence = (
        r"^controller\.D: found \[1, 1, 1, 1\], expected \[-1, 1, 1, 1\], .* or flip "
        r"elevator and keep D$"
    )
    with refusing(sentence):
        signs_of_pairing(Omega, channels, [1, 1, 1, 1])
    assert signs_of_pairing(Omega, channels, [-1, 1, 1, 1]).tolist() == [-1, 1, 1, 1]


@pytest.mark.parametrize(
    "inputs, sentence",
    [
        (
            ("elevator", "thrust", "rudder", "aileron"),
            (
                r"^controller\.inputs: found .*p-rudder, r-aileron with max abs\(U - I\) = 25.* "
                r"p-aileron, r-rudder$"
            ),
        ),
        (
            ("thrust", "elevator", "aileron", "rudder"),
            r"no D, for leading minor 1 is zero, expected another pairing: q-elevator",
        ),
    ],
)
def test_pairing_without_decomposition_or_with_strong_coupling_refused(
    inputs: tuple[str, ...], sentence: str
) -> None:
    with refusing(sentence):
        signs_of_pairing(*osprey_channels(inputs))


OSPREY_LOOP = LoopTiming(np.array([0.02, 0.1, 0.02, 0.02]), 0.0, 0.01)


def linear(params: LawParams) -> LinearLaw:
    return linear_law(tuned(params), len(params.K), 0.01)


def osprey_loop(
    factor: float = 3.0,
    K: tuple[float, ...] = (18.0, 2.0, 18.0, 9.0),
    Lambda: tuple[float, ...] = (5.0, 0.5, 5.0, 3.0),
) -> tuple[LinearPlant, LinearLaw]:
    """Return the osprey with gains in the order q, V, p, r.

    `factor` is the width of the softened sign in total lags.
    """
    A = AIRFRAME.matrix_a() + AIRFRAME.matrix_gravity()
    B = AIRFRAME.matrix_b()
    C = AIRFRAME.matrix_c()
    scale = 1.0 / np.abs(np.diag(C @ B))
    eps = factor * OSPREY_LOOP.total / np.array(K)
    params = law_params(K, Lambda, 1.0, sign=Sign.SOFT, input_scale=scale, eps=eps)
    return LinearPlant(A, B, C), linear(params)


@pytest.mark.parametrize(
    "factor, K, Lambda, margin",
    [
        (3.0, (18.0, 2.0, 18.0, 9.0), (5.0, 0.5, 5.0, 3.0), 0.045),
        (5.0, (18.0, 2.0, 18.0, 9.0), (5.0, 0.5, 5.0, 3.0), 0.064),
        (3.0, (12.0, 1.5, 12.0, 6.0), (3.0, 0.5, 3.0, 2.0), 0.061),
        (3.0, (22.0, 2.5, 26.0, 11.0), (10.0, 0.5, 10.0, 6.0), 0.030),
    ],
)
def test_delay_margins_of_osprey_are_those_of_independent_prototype(
    factor: float, K: tuple[float, ...], Lambda: tuple[float, ...], margin: float
) -> None:
    # given as 45, 64, 61 and 30 to 31 ms
    found = delay_margin(*osprey_loop(factor, K, Lambda), OSPREY_LOOP)
    assert found == approx(margin, abs=0.001)


def scalar(omega: float, T_eps: float) -> LawParams:
    return law_params(
        18.0,
        5.0,
        100.0,
        sign=Sign.SOFT,
        input_scale=1.0 / omega,
        eps=np.float64(100.0) / 18.0 * T_eps,
    )


def grows(params: LawParams, omega: float, lag: float, delay: float) -> bool:
    """Return whether y_dot = omega u_a behind a servo and a delay diverges under `law.step`.

    u is delayed by whole quarter milliseconds, and between these instants plant and servo are
    solved exactly. e stays within 1e-3 eps, inside the width of the sign.
    """
    dt, ticks, period = 0.00025, 40, 0.01
    fading = math.exp(-dt / lag)
    y = np.array([1e-6])
    state = engage(np.zeros(1), np.zeros(1))
    position = 0.0
    u = 0.0
    line = deque([0.0] * round(delay / dt))
    peaks = [0.0, 0.0]
    seconds = 12.0
    for k in range(round(seconds / dt)):
        if k % ticks == 0:
            state, command = step(state, y, np.zeros(1), np.array(period), params)
            u = float(command[0])
            half = int(k * dt >= seconds / 2.0)
            if k * dt >= seconds / 4.0:
                peaks[half] = max(peaks[half], abs(float(y[0])))
        line.append(u)
        arrived = line.popleft()
        y = y + omega * (arrived * dt + (position - arrived) * lag * (1.0 - fading))
        position = arrived + (position - arrived) * fading
    assert max(peaks) < 1e-3 * float(params.eps[0]) or peaks[1] > peaks[0]
    return peaks[1] > peaks[0]


@pytest.mark.parametrize("lag, factor", [(0.02, 3.0), (0.02, 5.0), (0.05, 3.0)])
def test_predicted_delay_margin_is_where_simulated_loop_begins_to_grow(
    lag: float, factor: float
) -> None:
    omega, period = 0.98, 0.01
    params = scalar(omega, factor * (lag + 1.5 * period))
    plant = LinearPlant(np.zeros((1, 1)), np.array([[omega]]), np.eye(1))
    margin = delay_margin(plant, linear(params), LoopTiming(np.array([lag]), 0.0, period))
    # 0.75 ms: the simulated delay comes in steps of 0.25 ms, the predicted one in 0.1 ms, and
    # growth has to show in 9 s
    assert 0.003 < margin < 0.1
    assert not grows(params, omega, lag, margin - 0.00075)
    assert grows(params, omega, lag, margin + 0.00075)


def test_softened_sign_narrower_than_lag_of_loop_is_unstable() -> None:
    loop = LoopTiming(np.array([0.02]), 0.0, 0.01)
    plant = LinearPlant(np.zeros((1, 1)), np.eye(1), np.eye(1))
    wide, narrow = (scalar(1.0, factor * 0.035) for factor in (1.7, 0.5))
    assert delay_margin(plant, linear(wide), loop) > 0.0
    assert delay_margin(plant, linear(narrow), loop) == 0.0
    conditions = gain_conditions.check_rules(narrow, loop, np.ones(1), np.ones(1))
    assert names(gain_conditions.failing(conditions), ("y",)) == ["softening of y"]


def test_delay_margin_lasts_up_to_speed_at_which_loop_with_responses_turns_unstable(
    osprey: Study, selected: selection.Selection
) -> None:
    margin = selected.engineering.delay_margin
    assert margin is not None
    controller = selected.chosen.model_copy(update={"delay": margin / 2.0})
    ratio = selection.stable_speed_ratio(osprey, controller)
    assert 1.0 < ratio < selection.MAX_SPEED_RATIO
    surfaces = np.array([name != "V" for name in controller.outputs])
    # the same response by a larger input_scale
    for factor, stable in ((ratio, True), (ratio + selection.SPEED_STEP, False)):
        scale = np.where(surfaces, factor**2, 1.0) * controller.input_scale
        rescaled = controller.model_copy(update={"input_scale": tuple(scale.tolist())})
        assert (selection.assess_gains(osprey, rescaled, SERVOS).delay_margin != 0.0) == stable
    assert selection.stable_speed_ratio(osprey, selected.literal) == 0.0


def test_the_literal_sign_has_no_linear_loop(osprey: Study) -> None:
    literal = find_scenario("osprey_servo").vary(controller={"sign": "literal"})
    answer: GainAssessment[Any] = selection.assess_scenario(literal, osprey)
    assert answer.delay_margin is None
    with refusing(r"^sign: found literal, expected soft or implicit"):
        linear_law(literal.controller.tuned_law(), 4, 0.01)


def rise_di(*arguments: str) -> Result:
    return invoke(*arguments, env={"COLUMNS": "80"})


def test_the_command_writes_gains_that_load(tmp_path: Path) -> None:
    path = tmp_path / "gain_conditions.yaml"
    loop = ("--lag", "0.02,0.1,0.02,0.02", "--delay", "0")
    result = rise_di(
        "gains", "select", "osprey", "--samples", "2", "--json", *loop, "--write", str(path)
    )
    assert result.exit_code == 0, result.output
    output = json.loads(result.stdout)
    section = yaml.safe_load(path.read_text())["/**/controller"]["ros__parameters"]
    assert AnyLaw.validate_mapping(section, "controller").outputs == ("q", "p", "r", "V")
    assert output["engineering"]["controller"]["k_g"] == approx(section["k_g"], rel=1e-5)
    assert output["theorem"]["delay_margin"] == 0.0


def test_check_of_the_default_flight_succeeds_by_its_loop_and_tells_the_theorem_apart() -> None:
    """No gains behind servos meet (29) and step 2, and still the loop has its margins."""
    words = ("gains", "check", "osprey", "--samples", "4")
    told = rise_di(*words)
    assert told.exit_code == 0, told.output
    loop, theorem = told.output.index("the loop is stable"), told.output.index("Theorem 1:")
    assert loop < theorem
    assert "osprey_servo: the loop is stable, with the margins asked of it" in told.output
    assert "They are sufficient only, and decide nothing" in told.output
    verdicts = json.loads(rise_di(*words, "--json").stdout)["scenario"]["verdicts"]
    assert verdicts["loop"]["holds"]
    assert not verdicts["theorem"]["holds"]


def test_check_fails_by_a_loop_without_its_margins_although_the_theorem_holds(
    tmp_path: Path,
) -> None:
    """Behind the servos of the osprey, the gains of Theorem 1 make the loop unstable."""
    gains, flight = tmp_path / "gains.yaml", tmp_path / "theorem_gains.yaml"
    ideal = ("--lag", "0", "--delay", "0", "--theorem", "--accept")
    written = rise_di("gains", "select", "osprey", "--samples", "2", *ideal, "--write", str(gains))
    assert written.exit_code == 0, written.output
    section = yaml.safe_load(gains.read_text())["/**/controller"]["ros__parameters"]
    lags = {"sign": "soft", "lag": [0.02, 0.02, 0.02, 0.1]}
    flight.write_text(yaml.safe_dump({"/**/controller": {"ros__parameters": section | lags}}))
    answer = rise_di("gains", "check", "osprey", "--samples", "2", "--scenario", str(flight))
    assert answer.exit_code == 1, answer.output
    assert "theorem_gains: the loop is unstable" in answer.output


def test_y_that_is_slower_than_law_counts_as_delay_and_may_be_three_messages_old() -> None:
    """A slow y adds 1.5 periods to the delay, and its age limit is three periods.

    1.5 periods of 1 / 9.9 Hz, the airspeed of PX4, minus 1.5 of 1 / 50 Hz are 121.515 ms. A faster
    y changes nothing. An age limit of 0.1 s would pass before the next message of such a y.
    """
    servo = find_scenario("osprey_servo").vary(flight={"duration": 1.0})
    slow, fast = (
        select_gains(
            "navion_longitudinal",
            servo,
            rate=50.0,
            delay=0.04,
            y_rate=y_rate,
            samples=0,
            phase_margin=5.0,
            accept=True,
        ).chosen
        for y_rate in (9.9, 139.0)
    )
    assert (slow.delay, fast.delay) == approx((0.161515, 0.04), abs=1e-6)
    assert (slow.max_age, fast.max_age) == approx((3.0 / 9.9, servo.controller.max_age), abs=1e-5)


@pytest.mark.parametrize(
    "option, value, expected",
    [
        ("--rate", "nan", "--rate: found nan, expected 1 to 1000 Hz"),
        ("--lag", "fast", "--lag: found 'fast', expected seconds separated by commas"),
    ],
)
def test_an_invalid_loop_is_refused(option: str, value: str, expected: str) -> None:
    result = rise_di("gains", "select", "osprey", option, value)
    assert isinstance(result.exception, ParameterError)
    assert str(result.exception) == expected


def test_command_shows_the_airframe_of_a_file(tmp_path: Path) -> None:
    """The poles are those that Nelson prints for the Navion on p. 158.

    They are -2.51 +-2.59j and -0.017 +-0.213j.
    """
    path = tmp_path / "own.yaml"
    path.write_text(
        (LIBRARY / "navion_longitudinal.yaml").read_text().replace("navion_longitudinal", "mine")
    )
    (facts,) = json.loads(rise_di("airframes", str(path), "--json").stdout)
    assert facts["name"] == "mine"
    poles = sorted((real, abs(imaginary)) for real, imaginary in facts["poles"])
    # A is printed to 3 digits
    assert_allclose(poles[::2], [(-2.51, 2.59), (-0.017, 0.213)], atol=0.021)


def test_gains_for_actuators_without_lag_say_from_which_delay_on_they_chatter() -> None:
    lags = [0.0] * len(AIRFRAME.inputs)
    chosen = select_gains("osprey", lag=lags, samples=1)
    latest, told = map(float, re.findall(r"([\d.]+) ms(?: late|: if)", selection_yaml(chosen)))
    assert told == 1e3 * chosen.chosen.delay
    fastest = {"rate": 1000.0, "step": 0.0005, "gusts": {}, "sensors": {}}

    def reversals(delay: float) -> float:
        """Return the fraction of the steps of thrust that reverse the step before."""
        actuators = {"lag": lags, "delay": delay}
        flight = simulate(
            find_scenario("osprey_servo", duration=2.5).vary(
                controller=chosen.chosen,
                reference_model={"rate": 1000.0},
                aircraft={**fastest, "actuators": actuators},
            )
        )
        steps = np.diff(flight["u"]["thrust"][100:])
        return float(np.mean(steps[1:] * steps[:-1] < 0.0))

    # A delay of the simulation is whole milliseconds. The linear loop is on the safe side, by less
    # than one more.
    assert reversals(1e-3 * math.floor(latest)) < 0.02
    assert reversals(1e-3 * (math.ceil(latest) + 1)) > 0.1
