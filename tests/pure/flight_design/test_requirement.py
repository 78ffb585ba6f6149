# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test margins as a requirement: gains that meet it, and what a margin costs.

The margins are measured with python-control.
"""

import math
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import control
import numpy as np
import pytest
import yaml
from pytest import approx
from tests.conftest import invoke, refusing
from typer.testing import Result

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.linear_loop.input_margins import input_margins
from flight_analysis.linear_loop.loop_margins import LinearLoop, law_order, linear_loop, margins
from flight_analysis.metrics.errors import best_error, error_metrics
from flight_core.vectors import FloatArray
from flight_design.gains import gain_selection, ideal_control
from flight_design.gains import requirement as requirement_module
from flight_design.gains.constrained_search import Place, Trial, descend
from flight_design.gains.gain_design import select_gains
from flight_design.gains.gain_yaml import selection_yaml
from flight_design.gains.ideal_control import Manoeuvre
from flight_design.gains.linear_error import linear_error
from flight_design.gains.relaxation import reason_against_gains
from flight_design.gains.requirement import (
    MOVES,
    NAMES,
    Requirement,
    above_zeros,
    least_fraction,
    margin_conditions,
    requirement,
)
from flight_design.gains.trade import trade
from reference_model.params import ReferenceModelConfig
from rise_di_controller.law.linear_loop import LinearLaw, LinearPlant, LoopTiming
from rise_di_controller.rise_di_config import RiseDiConfig

pytestmark = pytest.mark.slow

SERVO = find_scenario("osprey_servo")
T = 0.01  # s, of the law
LAG = {"elevator": 0.05, "throttle": 0.3}  # s
RESPONSE = {"elevator": -8.0, "throttle": 3.0}  # abs(Omega_ii)


def integrators() -> Airframe:
    """Return q_dot = -8 elevator, V_dot = 3 throttle.

    python-control can describe this loop channel by channel.
    """
    return Airframe.validate_mapping(
        {
            "name": "integrators",
            "source": "none",
            "speed": 50.0,
            "states": {"q": "rad/s", "V": "m/s"},
            "inputs": {name: {"unit": "1", "positive": "none"} for name in LAG},
            "outputs": ["q", "V"],
            "A": [[0.0, 0.0], [0.0, 0.0]],
            "B": np.diag(list(RESPONSE.values())).tolist(),
        },
        "airframe",
    )


@cache
def selected(phase_margin: float, V_product: float = 0.46) -> RiseDiConfig:
    reference = find_scenario("osprey_servo").reference_model.model_dump(exclude_none=True)
    commands = {
        "rate": 100.0,
        "outputs": ["q", "V"],
        "second_order": {"natural_frequency": [4.0, 1.2], "damping": [0.9, 1.0]},
        "rise": 0.1,
        "pulses": {"q": reference["pulses"]["q"]},
    }
    manoeuvre = Manoeuvre(
        ReferenceModelConfig.validate_mapping(commands, "reference_model"), {}, 4.0
    )
    studied = ideal_control.study_airframe(integrators(), manoeuvre, samples=3)
    setting = gain_selection.loop_setting(SERVO)._replace(
        lag=LAG, delay=0.0, rate_limit={}, requirement=requirement(phase_margin, accept=True)
    )
    setting = setting._replace(
        crossover_lag_products={**gain_selection.CROSSOVER_LAG_PRODUCTS, "V": V_product}
    )
    return gain_selection.gain_sets(studied, setting).chosen


def of_python_control(controller: RiseDiConfig, channel: int) -> tuple[float, float]:
    """Return the phase margin, deg, and the largest sensitivity, from python-control.

    The loop is K (1 + integral dt z / (z - 1)) with the sampled lag and integrator.
    """
    params = controller.law_params()
    name = controller.inputs[channel]
    integral = (
        params.Lambda[channel] + params.beta[channel] / params.eps[channel] / params.K[channel]
    )
    z = control.tf([1.0, 0.0], [1.0], T)
    K = params.K[channel] * params.input_scale[channel] * (1.0 + integral * T * z / (z - 1.0))
    P = control.sample_system(control.tf([abs(RESPONSE[name])], [LAG[name], 1.0, 0.0]), T, "zoh")
    L = K * P
    w = np.geomspace(1e-3, math.pi / T * 0.999, 4000)
    _, phase, modulus, *_ = control.stability_margins(control.frd(L, w, smooth=True))
    return float(phase), 1.0 / float(modulus)


@pytest.mark.parametrize("phase_margin", [30.0, 45.0, 60.0])
def test_selected_gains_have_the_phase_margin(phase_margin: float) -> None:
    # The law integrates by a trapezoid, python-control's K backward: half a tick of the integral,
    # 0.5 degrees here. A step of the search is 5 % of the integral, at most 1.5 degrees, and a
    # sensitivity of 2 asks for more than 30 degrees.
    controller = selected(phase_margin)
    margins = [of_python_control(controller, i) for i in range(2)]
    for phase, sensitivity in margins:
        assert phase > phase_margin - 0.5
        assert sensitivity < 2.0 * 1.02
    if phase_margin > 40.0:
        assert min(phase for phase, _ in margins) < phase_margin + 2.0


@pytest.mark.parametrize("phase_margin, product", [(45.0, 0.03), (60.0, 0.003)])
def test_a_slow_channel_keeps_its_bandwidth_and_gets_a_slower_integral(
    phase_margin: float, product: float
) -> None:
    # A throttle with little authority: the bandwidth times the lag is 0.03, the integral by the
    # rule 12 times the bandwidth, 120 times at 0.003. The phase is lost below the crossover, where
    # a lower bandwidth gains nothing and an integral 4, or 64, times slower is not enough.
    controller = selected(phase_margin, product)
    params = controller.law_params()
    V = controller.outputs.index("V")
    response = RESPONSE["throttle"] * params.input_scale[V]
    assert params.K[V] * response == approx(product / (0.3 + 1.5 * T), rel=1e-6)
    assert phase_margin - 0.5 < of_python_control(controller, V)[0] < phase_margin + 2.0
    assert params.Lambda[V] < params.K[V] * response / 4.0 / 4.0


def test_no_gains_of_a_random_search_meet_the_margins_with_a_lower_error() -> None:
    # The walk by coordinates may end beside the least error: 2 % are what two steps of 5 % leave.
    selection = select_gains("osprey", "osprey_servo", samples=0)
    chosen = selection.chosen
    study = selection.study
    _, columns = law_order(study.airframe, chosen)

    def log_error(controller: RiseDiConfig) -> float:
        loop = linear_loop(controller, study.airframe, study.A, study.B)
        loop_figures = input_margins(loop.nominal, loop.law, loop.loop, together=False)
        is_met = least_fraction(loop_figures, Requirement()) >= 1.0
        error = linear_error(loop, study.u_dot[:, 0][:, columns])
        return float(np.log(error).sum()) if is_met else math.inf

    rng = np.random.default_rng(3)
    others = []
    for _ in range(60):
        integral, bandwidth = np.exp(rng.uniform([[-0.4], [0.0]], 0.4, (2, 4)))
        changes = {
            "Lambda": np.array(chosen.Lambda) / integral,
            "softening": np.array(chosen.softening) * integral,
            "input_scale": np.array(chosen.input_scale) / bandwidth,
            "omega": np.array(chosen.omega) / bandwidth,
            "beta": np.array(chosen.beta) * bandwidth,
        }
        values = {key: tuple(value.tolist()) for key, value in changes.items()}
        others.append(log_error(chosen.model_copy(update=values)))
    assert sum(map(math.isfinite, others)) > 5
    assert log_error(chosen) < min(others) + 0.02


def test_descend_goes_round_a_corner_of_two_goals() -> None:
    # The least a + 2 b with a + 3 b >= 60 and a + b >= 40 is that of a = 30, b = 10
    def assess(places: Sequence[Place]) -> list[Trial[None]]:
        shortages = [max(60 - a - 3 * b, 0) / 60 + max(40 - a - b, 0) / 40 for a, b in places]
        costs = [
            math.inf if shortage else float(a + 2 * b)
            for (a, b), shortage in zip(places, shortages, strict=True)
        ]
        return [Trial(*row, None) for row in zip(places, shortages, costs, strict=True)]

    (start,) = assess([(0, 0)])
    lowest = np.zeros((2, 1), dtype=np.int64)
    assert descend(assess, start, MOVES, lowest, lowest + 80).place == (30, 10)


def test_a_larger_margin_costs_integral_gain() -> None:
    def integral(controller: RiseDiConfig) -> FloatArray:
        params = controller.law_params()
        return np.asarray(
            params.K * params.input_scale * (params.Lambda + params.beta / params.eps / params.K)
        )

    each = [integral(selected(phase_margin)) for phase_margin in (30.0, 45.0, 60.0)]
    assert (np.diff(each, axis=0) < 0.0).all()


def test_gains_of_osprey_meet_the_requirement() -> None:
    gains = select_gains("osprey", "osprey_servo", samples=20).engineering
    assert not gains.unmet
    assert {condition.name for condition in gains.loop} >= set(NAMES)
    # other aircraft than those of the selection
    of = margins(SERVO.vary(controller=gains.controller), aircraft=50, seed=9)
    assert of.worst is not None
    assert math.degrees(of.nominal.phase.min()) >= 45.0 - 0.01
    assert math.degrees(of.worst.phase.min()) >= 30.0
    assert of.nominal.sensitivity.max() <= 2.0
    assert of.nominal.damping >= 0.4


def test_conditions_say_what_is_missing() -> None:
    of = margins(SERVO.vary(controller={"softening": 2.75, "Lambda": [5.0, 5.0, 3.0, 0.5]}))
    failing = [
        condition.name
        for condition in margin_conditions(of, Requirement(phase=math.radians(80.0)))
        if not condition.is_met
    ]
    assert failing[:1] == ["phase margin (deg)"]
    assert least_fraction(of.nominal, Requirement(phase=math.radians(80.0))) == approx(
        math.degrees(of.nominal.phase.min()) / 80.0
    )


def test_margin_below_40_deg_has_to_be_accepted() -> None:
    with refusing(r"^phase_margin: found 30\.0, expected at least 40 deg, or accept beside it$"):
        requirement(30.0)
    assert math.degrees(requirement(30.0, accept=True).phase) == approx(30.0)
    with refusing(r"^phase_margin: found 90\.0, expected 5 to 80 deg$"):
        requirement(90.0)


def test_linear_error_of_a_ramp_is_the_closed_form() -> None:
    # e_dot = -k e - a t: e = -(a / k) (t - (1 - exp(-k t)) / k), from trim on. Sampling at 1 ms: 1
    # %
    k, a, period, duration = 5.0, 2.0, 0.001, 4.0
    law = LinearLaw(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[-k]]))
    plant = LinearPlant(np.zeros((1, 1, 1)), np.ones((1, 1, 1)), np.eye(1))
    of = LinearLoop(
        model="",
        states=("y",),
        outputs=("y",),
        inputs=("u",),
        plant=plant,
        law=law,
        loop=LoopTiming(np.zeros(1), 0.0, period),
    )
    u_dot = np.full((round(duration / ideal_control.STEP) + 1, 1), a)
    t = np.arange(0.0, duration, period)
    expected = a / k * (t - (1.0 - np.exp(-k * t)) / k)
    assert linear_error(of, u_dot)[0] == approx(np.sqrt(np.mean(expected**2)), rel=0.01)


def test_trade_predicts_the_flight() -> None:
    # Linear, without noise, and u* of the nominal airframe: within 5 % of the rms of a flight
    # without noise
    short = SERVO.vary(
        flight={"duration": 20.0},
        aircraft={"sensors": {}, "rate": 100.0, "step": 0.005},
        reference_model={"rate": 100.0},
    )
    selection = select_gains("osprey", short, samples=2)
    (row,) = trade(selection, (45.0,))
    tape = simulate(short.vary(controller=selection.chosen))
    _, error = best_error(tape)
    rms = [error_metrics(error[name]).rms for name in selection.chosen.outputs]
    np.testing.assert_allclose(row.rms, rms, rtol=0.05)
    assert row.reached >= row.phase_margin


def test_a_refusal_names_bound_and_change_and_the_file_is_marked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Without its slow integrals the search ends at 42 deg of V
    for name, factor in (("MAX_SLOWER", 2.0), ("MAX_LOWER", 1.0)):
        monkeypatch.setattr(requirement_module, name, factor)
    selection = select_gains("osprey", "osprey_servo", samples=0)
    assert str(reason_against_gains(selection, options=("lag", "delay", "rate"))) == (
        "phase margin (deg) of V: found 41.99, expected at least 45: the best of the search, bound "
        "by phase margin (deg) of V; met with --phase-margin 41"
    )
    eased = select_gains("osprey", "osprey_servo", samples=0, phase_margin=41.0)
    assert not eased.engineering.unmet
    assert reason_against_gains(eased) is None
    assert selection_yaml(selection).startswith(
        "# Margins below the requirement: phase margin (deg) of V"
    )
    assert "Margins below" not in selection_yaml(eased)


def test_damping_of_a_zero_bounds_what_is_asked_for() -> None:
    # y_dot = eta_1 + u beside an oscillator of 5 rad/s that y does not drive: its damping is that
    # of the zeros
    def asked(damping: float) -> float:
        A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -25.0, -10.0 * damping]])
        return above_zeros(Requirement(), LinearPlant(A, np.eye(3)[:, :1], np.eye(3)[:1])).damping

    assert asked(0.9) == Requirement().damping
    assert 0.19 < asked(0.2) < 0.2


def rise_di(*arguments: str) -> Result:
    return invoke(*arguments, env={"COLUMNS": "150"})


def test_command_shows_trade_and_writes_margins(tmp_path: Path) -> None:
    path = tmp_path / "gains.yaml"
    page = tmp_path / "loop.html"
    result = rise_di(
        "gains",
        "select",
        "osprey",
        "--samples",
        "2",
        "--phase-margin",
        "50",
        "--write",
        str(path),
        "--page",
        str(page),
    )
    assert result.exit_code == 0, result.output
    assert {"Bode plot of the loop", "Nyquist plot of the loop", "all inputs"} <= set(
        re.findall(r">([^<>]+)<", page.read_text())
    )
    assert "Trade" in result.stdout
    text = path.read_text()
    assert "# Phase margins elevator " in text
    section = yaml.safe_load(text)["/**/controller"]["ros__parameters"]
    of = margins(SERVO.vary(controller=RiseDiConfig.validate_mapping(section, "controller")))
    assert 50.0 - 0.01 <= math.degrees(of.nominal.phase.min()) < 53.0
