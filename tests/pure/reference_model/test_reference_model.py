# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The reference model and its commands against closed forms and exact simulation."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx
from scipy.integrate import quad
from scipy.signal import StateSpace, lsim
from tests.closed_loop import reference_outputs
from tests.conftest import refusing

from flight_core.integrators import rk4
from flight_core.vectors import FloatArray
from reference_model import model
from reference_model.command import command
from reference_model.params import ReferenceModelConfig


def parameters(**changes: object) -> ReferenceModelConfig:
    values = {
        "rate": 500.0,
        "outputs": ["q", "p", "r"],
        "second_order": {"natural_frequency": [4.0, 5.0, 4.0], "damping": [0.9, 0.9, 1.0]},
        "rise": 0.1,
    }
    return ReferenceModelConfig.validate_mapping(values | changes, "reference_model")


PULSES = {
    "q": {"start": [1.0, 3.0], "stop": [2.0, 4.0], "value": [0.1, -0.2]},
    "p": {"start": [1.0], "stop": [2.5], "value": [0.4]},
}


def test_pulse_rises_holds_and_falls_over_edges() -> None:
    profile = parameters(pulses=PULSES).profile()
    at = [float(command(t, profile)[0]) for t in (0.9, 1.0, 1.05, 1.1, 1.9, 2.05, 2.2, 3.5, 9.0)]
    assert at == approx([0.0, 0.0, 0.05, 0.1, 0.1, 0.05, 0.0, -0.2, 0.0], abs=1e-12)


@pytest.mark.equation(2)
@given(t=st.floats(0, 10), dt=st.floats(1e-6, 1e-3))
def test_commands_have_a_bounded_derivative(t: float, dt: float) -> None:
    # Equation (2) requires a bounded u_m_dot: the slope of an edge is value / rise, and edges do
    # not overlap here.
    profile = parameters(pulses=PULSES).profile()
    change = np.abs(command(t + dt, profile) - command(t, profile))
    assert (change <= np.array([0.2, 0.4, 0.0]) / 0.1 * dt + 1e-12).all()


def test_coordinated_turn_follows_integral_of_bank_rate() -> None:
    turn = {"bank_rate": "p", "turn_rate": "r", "speed": 25.0}
    sines = {"p": {"amplitude": 0.3, "frequency": 2.0, "phase": 0.4}}
    profile = parameters(pulses=PULSES, sines=sines, coordinated_turn=turn).profile()
    for t in (0.7, 1.05, 2.0, 5.0):
        edges = [1.0, 1.1, 2.5, 2.6] if t > 2.6 else None
        bank, _ = quad(lambda s: float(command(s, profile)[1]), 0.0, t, points=edges, limit=200)
        # r = g / V0 sin(phi) is the turn rate without sideslip
        assert float(command(t, profile)[2]) == approx(9.81 / 25.0 * math.sin(bank), abs=1e-8)


def simulate(params: ReferenceModelConfig, duration: float, dt: float) -> FloatArray:
    return reference_outputs(params.model(), params.profile(), dt, round(duration / dt))


@pytest.mark.equation(2)
def test_equation_2_agrees_with_exact_linear_simulation() -> None:
    params = parameters(pulses=PULSES)
    matrices = params.model()
    profile = params.profile()
    t = np.arange(0, 3001) * 0.002
    u_m = command(t, profile)  # piecewise linear with knots on the grid: lsim is exact for it
    _, exact, _ = lsim(StateSpace(matrices.A_m, matrices.B_m, matrices.C, np.zeros((3, 3))), u_m, t)  # type: ignore[call-overload]
    assert simulate(params, 6.0, 0.002) == approx(exact, abs=1e-9)


def test_step_is_one_runge_kutta_step_of_equation_2() -> None:
    params = parameters(pulses=PULSES)
    matrices = params.model()
    profile = params.profile()
    dt = 0.05
    x_m = np.linspace(-0.2, 0.3, 6)

    def x_dot(t: float, x: FloatArray, _: None, params: model.ReferenceMatrices) -> FloatArray:
        return np.asarray(model.x_m_dot(t, x, command(t, profile), params))

    # PULSES change u_m within this step; the two differ by rounding only.
    u_m = np.concatenate([command(1.0 + part * dt, profile) for part in (0.0, 0.5, 1.0)])
    one_step = rk4(x_dot, 1.0, x_m, None, matrices, dt)
    assert model.step(x_m, u_m, model.stepper(dt, matrices)) == approx(
        one_step, rel=1e-14, abs=1e-15
    )


def test_general_form_and_second_order_form_are_same_model() -> None:
    same = parameters().model()
    A_m = same.A_m.ravel().tolist()
    B_m = same.B_m.ravel().tolist()
    linear = {"states": ["q", "q_rate", "p", "p_rate", "r", "r_rate"], "A_m": A_m, "B_m": B_m}
    for general_matrix, matrix in zip(
        parameters(second_order=None, linear=linear).model(), same, strict=True
    ):
        assert (general_matrix == matrix).all()


def test_rate_at_which_runge_kutta_steps_diverge_refused() -> None:
    # 1 + z + z^2/2 + z^3/6 + z^4/24 = 1 at z = -2.785, here a pole of 278.5 1/s at 100 Hz.
    def first_order(pole: float) -> ReferenceModelConfig:
        linear = {"states": ["q"], "A_m": [-pole], "B_m": [pole]}
        return parameters(rate=100.0, outputs=["q"], second_order=None, linear=linear)

    assert first_order(278.0).model().A_m.tolist() == [[-278.0]]
    with refusing(r"reference_model.rate: found 100 Hz, expected a higher one: the"):
        first_order(279.0)
