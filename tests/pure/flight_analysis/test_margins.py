# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the margins of the sampled loop, and the smallest ones of uncertain aircraft.

They are compared with closed forms and with python-control.
"""

import math

import control
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx
from tests.conftest import refusing

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.uncertainty import nominal_and_sampled
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.delay_margin import delay_margin
from flight_analysis.linear_loop.input_margins import (
    Margins,
    disk_gain,
    disk_phase,
    input_margins,
    loop_transfer,
    phase_margins,
    scaled_norm,
    slow_modes,
)
from flight_analysis.linear_loop.loop_margins import (
    LinearLoop,
    law_order,
    loop_margins,
    loop_of,
    margins,
)
from flight_core.vectors import FloatArray
from rise_di_controller.law import linear_loop
from rise_di_controller.law.linear_loop import LinearLaw, LinearPlant, LoopTiming, linear_law

NO_LAG = LoopTiming(np.zeros(1), 0.0, 0.01)
INTEGRATOR = LinearPlant(np.zeros((1, 1)), np.eye(1), np.eye(1))


def proportional(k: FloatArray) -> LinearLaw:
    """Return the law u = -k y."""
    m = len(k)
    return LinearLaw(np.zeros((0, 0)), np.zeros((0, m)), np.zeros((m, 0)), -k)


def plant_of(scenario: Scenario) -> LinearPlant:
    airframe = load_airframe(scenario.aircraft.airframe)
    controller = scenario.controller
    rows, columns = law_order(airframe, controller)
    A = airframe.matrix_a() + airframe.matrix_gravity()
    return LinearPlant(A, airframe.matrix_b()[:, columns], airframe.matrix_c()[rows])


def margins_of(scenario: Scenario) -> Margins:
    controller = scenario.controller
    loop = loop_of(controller)
    return input_margins(
        plant_of(scenario), linear_law(controller.tuned_law(), len(loop.lag), loop.period), loop
    )


@pytest.mark.parametrize("k", [5.0, 60.0, 150.0])
def test_integrator_has_its_closed_forms(k: float) -> None:
    # L = kT / (z - 1): abs(L) = 1 at 2 sin(wT/2) = kT, angle -(pi/2 + wT/2); L(-1) = -kT/2; S(-1) =
    # 1 / (1 - kT/2); S - 1/2 = (z - 1 - kT) / (2 (z - 1 + kT)), largest at z = -1
    kT = k * NO_LAG.period
    margins = input_margins(INTEGRATOR, proportional(np.array([[k]])), NO_LAG)
    assert margins.stable
    assert margins.phase[0] == approx(math.pi / 2.0 - math.asin(kT / 2.0), rel=1e-8)
    assert margins.crossover[0] == approx(2.0 * math.asin(kT / 2.0) / NO_LAG.period, rel=1e-8)
    assert margins.gain_increase[0] == approx(2.0 / kT)
    assert margins.gain_decrease[0] == 0.0
    assert margins.gain[0] == approx(2.0 / kT)
    assert margins.sensitivity[0] == approx(1.0 / (1.0 - kT / 2.0))
    assert margins.disk[0] == approx(2.0 * (2.0 - kT) / (2.0 + kT))
    assert [margins.sensitivity_all, margins.disk_all] == approx(
        [margins.sensitivity[0], margins.disk[0]]
    )
    assert margins.damping == 1.0  # its pole 1 - kT is real


def test_phase_margin_beside_modes_with_one_vector_for_two() -> None:
    # a double integrator that no input moves and no output shows
    A = np.zeros((3, 3))
    A[0, 1] = 1.0
    plant = LinearPlant(A, np.eye(3)[:, 2:], np.eye(3)[2:])
    phase = phase_margins(plant, proportional(np.array([[60.0]])), NO_LAG)
    assert phase == approx(math.pi / 2.0 - math.asin(0.3), rel=1e-8)


@pytest.mark.parametrize("near", [0.001, 0.05, 0.0625, 0.09])
def test_delay_margin_is_found_from_another_one(near: float) -> None:
    law = proportional(np.array([[20.0]]))
    margin = delay_margin(INTEGRATOR, law, NO_LAG)
    assert margin == approx(math.pi / 40.0 - 0.005, abs=1e-3)  # pi / 2k, half a period in the hold
    assert delay_margin(INTEGRATOR, law, NO_LAG, near=near) == margin


def test_law_is_linearised_at_all_values_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    law = find_scenario("osprey_observer").controller.tuned_law()
    at_once = linear_law(law, 4, 0.01)
    monkeypatch.setattr(linear_loop, "_has_columns", lambda _: False)
    for matrix, column_by_column in zip(at_once, linear_law(law, 4, 0.01), strict=True):
        assert_array_equal(matrix, column_by_column)


def test_unstable_plant_has_a_gain_decrease() -> None:
    # y_dot = y + u under u = -k y is stable for k > 1 and, sampled, up to (e^T + 1) / (e^T - 1)
    plant = LinearPlant(np.eye(1), np.eye(1), np.eye(1))
    k = 4.0
    margins = input_margins(plant, proportional(np.array([[k]])), NO_LAG)
    # at w = 0, seen at the lowest frequency
    assert margins.gain_decrease[0] == approx(1.0 / k, rel=1e-3)
    growth = math.exp(NO_LAG.period)
    assert margins.gain_increase[0] == approx((growth + 1.0) / (growth - 1.0) / k)
    assert margins.gain[0] == approx(k, rel=1e-3)


def test_unstable_loop_has_no_margin() -> None:
    margins = input_margins(INTEGRATOR, proportional(np.array([[-1.0]])), NO_LAG)
    assert not margins.stable
    assert [*margins.phase, *margins.gain, *margins.disk, margins.disk_all] == [0.0, 1.0, 0.0, 0.0]
    assert [*margins.sensitivity, margins.sensitivity_all] == [math.inf, math.inf]


def test_no_feedback_has_infinite_margins() -> None:
    margins = input_margins(INTEGRATOR, proportional(np.zeros((1, 1))), NO_LAG)
    assert [*margins.phase, *margins.crossover, *margins.gain] == [math.inf, 0.0, math.inf]
    assert [*margins.sensitivity, *margins.disk, margins.disk_all] == approx([1.0, 2.0, 2.0])


def test_least_delay_margin_beside_a_nominal_loop_that_tolerates_every_delay() -> None:
    gains = np.array([[[2.0]], [[4.0]]])  # an integrator of gain k has the delay margin pi / 2 k
    plant = LinearPlant(np.zeros((2, 1, 1)), gains, np.eye(1))
    margins = loop_margins(
        LinearLoop(
            model="two",
            states=("y",),
            outputs=("y",),
            inputs=("u",),
            plant=plant,
            law=proportional(np.eye(1)),
            loop=NO_LAG,
        )
    )
    assert margins.delay == math.inf  # beyond MAX_DELAY_MARGIN
    assert margins.worst_delay == approx(math.pi / 8.0, rel=0.02)


def test_second_order_loop_has_its_damping() -> None:
    # y_dot = u through a lag tau under u = -k y: tau s^2 + s + k. 0.1 ms a tick: the hold costs 1 %
    # of the damping
    tau, k = 0.2, 20.0
    loop = LoopTiming(np.array([tau]), 0.0, 1e-4)
    modes = slow_modes(INTEGRATOR, proportional(np.array([[k]])), loop)
    natural = math.sqrt(k / tau)
    assert modes.frequency == approx([natural], rel=1e-2)
    assert modes.damping == approx([1.0 / (2.0 * tau * natural)], rel=1e-2)
    assert input_margins(INTEGRATOR, proportional(np.array([[k]])), loop).damping == approx(
        modes.damping[0]
    )


def test_disk_margin_of_the_spinning_satellite() -> None:
    # P = [[s - a^2, a (s + 1)], [-a (s + 1), s - a^2]] / (s^2 + a^2), u = -y, a = 10: S = [[s, -a],
    # [a, s]] / (s + 1). Seiler, Packard, Gahinet (2020): one loop at a time 2, both 0.0997, since
    # max norm(S - I/2)^2 is the eigenvalue below.
    a = 10.0
    A = np.array([[0.0, a], [-a, 0.0]])
    C = np.array([[1.0, a], [-a, 1.0]])
    margins = input_margins(
        LinearPlant(A, np.eye(2), C), proportional(np.eye(2)), LoopTiming(np.zeros(2), 0.0, 1e-3)
    )
    expected = 1.0 / math.sqrt(np.linalg.eigvalsh([[0.25, a / 2.0], [a / 2.0, a**2 + 0.25]])[-1])
    assert expected == approx(0.0997, abs=1e-4)
    # the hold, and frequencies from 1e-5 pi / T on
    assert margins.disk_all == approx(expected, rel=0.02)
    assert margins.disk == approx([2.0, 2.0], rel=0.02)
    assert math.degrees(disk_phase(margins.disk_all)) == approx(5.7, abs=0.1)  # 2 atan(alpha / 2)
    assert disk_gain(np.array(1.0)) == 3.0


def test_scaled_norm_of_product_is_sum_of_diagonal() -> None:
    # mu of u v' with independent complex scalars is sum abs(u_i v_i), which the scaling reaches
    # (Packard, Doyle 1993)
    random = np.random.default_rng(1)
    u, v = (
        random.normal(size=(20, 4)) * 10.0 ** random.uniform(-3.0, 3.0, (20, 4)) for _ in range(2)
    )
    matrices = (u[:, :, None] * v[:, None]).astype(complex)
    assert_allclose(scaled_norm(matrices), np.abs(u * v).sum(axis=1), rtol=1e-3)


def test_scaled_norm_of_triangle_is_diagonal() -> None:
    triangle = np.array([[[2.0, 1e3, 5.0], [0.0, -3.0, 1e2], [0.0, 0.0, 1.0]]], dtype=complex)
    assert scaled_norm(triangle)[0] == approx(3.0, rel=1e-2)


def pi_of_python_control(scenario: Scenario) -> control.StateSpace:
    """Return K(z) of RISE-DI inside its softened sign, from (20) to (22), with u = -K e.

    The integrals are a trapezoid and backward Euler.
    """
    params = scenario.rise_di().law_params()
    T = 1.0 / scenario.controller.rate
    z = control.tf([1.0, 0.0], [1.0], T)
    slope = params.beta / params.eps
    entries = [
        control.ss(
            control.tf(
                D
                * scale
                * (K * (1 + Lambda * T / 2.0 * (z + 1) / (z - 1)) + rate * T * z / (z - 1))
            )
        )
        for K, Lambda, D, scale, rate in zip(
            params.K, params.Lambda, params.D, params.input_scale, slope, strict=True
        )
    ]
    return control.append(*entries)


def loops_of_python_control(
    scenario: Scenario,
) -> tuple[list[control.StateSpace], control.StateSpace]:
    """Return L_i with the other inputs closed, and the closed loop, from python-control.

    The delay is one period.
    """
    plant = plant_of(scenario)
    controller = scenario.controller
    T = 1.0 / controller.rate
    m = len(controller.inputs)
    lags = control.append(*(control.ss(control.tf([1.0], [lag, 1.0])) for lag in controller.lag))
    P = control.c2d(control.ss(plant.A, plant.B, plant.C, np.zeros((m, m))) * lags, T, "zoh")
    P = P * control.append(*(control.ss(control.tf([1.0], [1.0, 0.0], T)) for _ in range(m)))
    L = pi_of_python_control(scenario) * P
    each = []
    for i in range(m):
        closed = control.feedback(
            L, control.ss([], [], [], np.diag((np.arange(m) != i).astype(float)), T)
        )
        each.append(closed[i, i])
    return each, control.feedback(L, control.ss([], [], [], np.eye(m), T))


def test_margins_are_those_of_python_control() -> None:
    scenario = find_scenario("osprey_servo").vary(controller={"delay": 0.01})
    margins = margins_of(scenario)
    loops, closed = loops_of_python_control(scenario)
    w = np.geomspace(0.1, math.pi * scenario.controller.rate * (1.0 - 1e-9), 4000)
    for i, L in enumerate(loops):
        response = control.frequency_response(L, w)
        gain, phase, sensitivity, _, crossover, _ = control.stability_margins(
            control.frd(L, w, smooth=True)
        )
        # they agree far below 1 deg and 2 %
        assert math.degrees(margins.phase[i]) == approx(phase, abs=0.1)
        assert margins.crossover[i] == approx(crossover, rel=1e-3)
        assert margins.gain_increase[i] == approx(gain, rel=1e-3)
        assert margins.sensitivity[i] == approx(1.0 / sensitivity, rel=5e-3)
        disk, *_ = control.disk_margins(L, w)
        assert margins.disk[i] == approx(float(disk), rel=5e-3)
        assert_allclose(
            loop_transfer(
                plant_of(scenario), law_of(scenario), loop_of(scenario.controller), w[::400]
            )[:, i],
            response.complex[::400],
            rtol=1e-6,
        )
    modes = slow_modes(plant_of(scenario), law_of(scenario), loop_of(scenario.controller))
    natural, damping, _ = control.damp(closed, doprint=False)
    slow = {
        (round(w, 3), round(zeta, 3))
        for w, zeta in zip(natural, damping, strict=True)
        if 1e-3 < w < 157.0 and zeta < 0.9999
    }
    assert slow == {
        (round(w, 3), round(zeta, 3))
        for w, zeta in zip(modes.frequency, modes.damping, strict=True)
        if zeta < 0.9999
    }
    assert margins.damping == approx(min(zeta for _, zeta in slow), abs=1e-3)


def law_of(scenario: Scenario) -> LinearLaw:
    return linear_law(
        scenario.controller.tuned_law(),
        len(scenario.controller.inputs),
        1.0 / scenario.controller.rate,
    )


@pytest.mark.parametrize("name", ["osprey_servo", "osprey_observer"])
def test_phase_margin_over_crossover_is_delay_margin(name: str) -> None:
    # delay_margin bisects the eigenvalues of the delayed loop; a delay costs w tau of phase at the
    # crossover. The two differ by the sampled delay, 0.1 ms of bisection and a further crossover: 3
    # %
    scenario = find_scenario(name)
    margins = margins_of(scenario)
    plant = plant_of(scenario)
    loop = loop_of(scenario.controller)
    for share, tolerated in zip(np.eye(4), margins.phase / margins.crossover, strict=True):
        assert delay_margin(plant, law_of(scenario), loop, share) == approx(tolerated, rel=0.03)


def test_uncertain_aircraft_have_the_margins_of_each() -> None:
    scenario = find_scenario("osprey_servo")
    nominal = plant_of(scenario)
    law = law_of(scenario)
    loop = loop_of(scenario.controller)
    airframe = load_airframe("osprey")
    A, B = nominal_and_sampled(airframe, 0.3, 20, seed=3)
    _, columns = law_order(airframe, scenario.controller)
    plants = LinearPlant(A + airframe.matrix_gravity(), B[:, :, columns], nominal.C)
    together = input_margins(plants, law, loop)
    # a sum over modes beside back substitution: the vectors of the modes have a condition up to 1e6
    assert_allclose(phase_margins(plants, law, loop), together.phase, rtol=1e-8)
    for k in (0, 7, 20):
        single = input_margins(LinearPlant(plants.A[k], plants.B[k], plants.C), law, loop)
        for name, value in single._asdict().items():
            assert_allclose(getattr(together, name)[k], value, rtol=1e-6, err_msg=name)
    worst = together.worst()
    assert worst.stable
    assert_array_equal(worst.phase, together.phase.min(axis=0))
    assert_array_equal(worst.sensitivity, together.sensitivity.max(axis=0))
    assert worst.crossover[0] == together.crossover[np.argmin(together.phase[:, 0]), 0]
    assert worst.disk_all == together.disk_all.min()


def test_no_linear_loop_no_margins() -> None:
    with refusing(r"^sign: found literal, expected soft or implicit"):
        margins(find_scenario("osprey_servo").vary(controller={"sign": "literal"}))
