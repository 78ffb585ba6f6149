# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the observer that any law can have: a Kalman filter that starts, restarts and changes."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.pure.control_laws.each_law import (
    DT,
    MS,
    OBSERVED,
    bits,
    controller,
    first_change,
    sample,
    sections,
    tick,
)

from control_laws import lqg
from flight_core.modes import Mode
from flight_core.vectors import FloatArray
from rise_di_controller.extensions.observer import ObserverParams
from rise_di_controller.guard import guard, retuning
from rise_di_controller.law.control_law import Measurements
from rise_di_controller.law.saturation import Limits
from rise_di_controller.params import ControllerConfig

pytestmark = pytest.mark.usefixtures("example_law")


class Matrices(NamedTuple):
    """The matrices of an observer."""

    Phi: FloatArray
    Gamma: FloatArray
    H: FloatArray
    L: FloatArray
    F: FloatArray


def matrices(parameters: ControllerConfig) -> Matrices:
    nominal = parameters.nominal()
    assert parameters.observer is not None
    assert nominal is not None
    return Matrices(*parameters.observer.matrices(nominal))


def test_observer_is_kalman_filter_with_linear_feedback() -> None:
    generator = np.random.default_rng(1)
    s = 6
    m = 2
    wide = np.full(2, np.inf)
    Phi, Gamma, L, F = (
        0.3 * generator.standard_normal(shape) for shape in ((s, s), (s, m), (s, m), (m, s))
    )
    H = np.eye(m, s)
    params = ObserverParams(
        law=lqg.LqgParams(),
        Phi=Phi,
        Gamma=Gamma,
        H=H,
        L=L,
        F=F,
        limits=Limits(-wide, wide, wide),
        fade_rate=np.float64(2.0),
    )
    law = controller("lqg, observer").tuned_law().control_law
    zero = np.zeros(m)
    e = generator.standard_normal((60, m))
    state = law.engage(
        Measurements(y=e[0], y_m=zero, y_m_dot=zero, u_trim=zero, u_before=zero), params
    )
    x = np.concatenate([e[0], np.zeros(s - m)])  # the outputs are the first states
    u = zero
    for k, error in enumerate(e):
        state, commanded = law.step(
            state,
            Measurements(y=error, y_m=zero, y_m_dot=zero, u_trim=zero, u_before=u),
            np.float64(DT),
            params,
        )
        x = x + L @ (error - H @ x)  # measurement update
        u = -min(1.0, (k + 1) * DT * 2.0) * (F @ x)
        assert_allclose(commanded, u, rtol=1e-9, atol=1e-12)
        x = Phi @ x + Gamma @ u  # time update
        assert_allclose(state.z, x, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", OBSERVED)
def test_a_re_engagement_restarts_the_observer(name: str) -> None:
    parameters = controller(name)
    state = guard.initial_state(4)
    for k in range(100):
        state = tick(parameters, state, 10 * k, 1e-3 * np.sin(k / 5.0))
    law = parameters.tuned_law()
    old = sample(990, 0.0)
    after, _ = guard.tick(state, 1300 * MS, old, [old], parameters.guard(), law)
    assert after.mode is Mode.HOLD
    assert bits(after.law) == bits(state.law)  # nothing is estimated from what is not measured
    again = tick(parameters, after, 1310, [0.01, 0.02, -0.01, 0.1])
    assert again.u.tolist() == state.u.tolist() == again.u_trim.tolist()
    H = matrices(parameters).H
    assert again.law.z.tolist() == (H.T @ [0.01, 0.02, -0.01, 0.1]).tolist()
    assert not again.law.u_o.any()
    assert again.law.sigma.tolist() == [0.0]


@pytest.mark.parametrize("name", OBSERVED)
def test_observer_with_other_matrices_restarts_without_jump(name: str) -> None:
    parameters = controller(name)
    state = guard.initial_state(4)
    e = 1e-3 * np.array([1.0, -1.0, 2.0, -2.0])
    for k in range(50):
        state = tick(parameters, state, 10 * k, e)
    weaker = [0.9 * gain for gain in sections()[name]["observer"]["F"]]
    new = controller(name, observer=sections()[name]["observer"] | {"F": weaker})
    after = retuning.retune_state(state, parameters.tuned_law(), new.tuned_law())
    assert state.law.u_o.any()
    assert_allclose(after.u_trim, state.u_trim + state.law.u_o, rtol=1e-12)
    assert after.law.z.tolist() == (matrices(new).H.T @ e).tolist()
    assert not after.law.u_o.any()
    assert after.law.sigma.tolist() == [0.0]
    # the next tick changes u by what the law integrates in a tick and by one hundredth of the new
    # u_o
    next_tick = tick(new, after, 500, e)
    assert (
        np.abs(next_tick.u - state.u)
        <= first_change(name, parameters, e, state.u) + np.abs(next_tick.law.u_o) + 1e-12
    ).all()
    assert np.abs(next_tick.law.u_o).max() < 0.02 * np.abs(matrices(new).F @ after.law.z).max()
