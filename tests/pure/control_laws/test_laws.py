# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the control laws through their protocol: engagement, limits, retuning, replay, JAX."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.conftest import refusing
from tests.pure.control_laws.each_law import (
    DT,
    EVERY_LAW,
    NAMES,
    OBSERVED,
    SERVO,
    at,
    bits,
    controller,
    first_change,
    random_flight,
    tick,
)
from tests.pure.flight_analysis.test_replay import equal

from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.simulate import simulate
from flight_core.modes import Mode
from flight_core.vectors import FloatArray
from rise_di_controller.controller import Controller
from rise_di_controller.extensions.observer import ObserverState
from rise_di_controller.guard import guard
from rise_di_controller.law.control_law import Measurements, field_names, fields, restored
from rise_di_controller.law.law import gain
from rise_di_controller.law.linear_loop import linear_law
from rise_di_controller.law.saturation import Limits

pytestmark = pytest.mark.usefixtures("example_law")

# Engagement, limits, retuning


@EVERY_LAW
@pytest.mark.parametrize("size", [1e-6, 1e6])
def test_law_engages_without_jump_at_any_error(name: str, size: float) -> None:
    parameters = controller(name, lower=None, upper=None)
    u = np.array([0.1, -0.2, 0.3, -0.4])
    e = size * np.array([1.0, -2.0, 3.0, -4.0])
    begin = tick(parameters, guard.initial_state(4)._replace(u=u), 0, e)
    assert begin.u.tolist() == begin.u_trim.tolist() == u.tolist()
    after = tick(parameters, begin, 10, e)
    observed = np.zeros(4) if parameters.observer is None else np.abs(after.law.u_o)
    # 1e-12 of u and of K e, which the law subtracts again, is rounding
    rounding = 1e-12 * (np.abs(u) + 1e3 * np.abs(e) * np.array(parameters.input_scale))
    assert (np.abs(after.u - u) <= first_change(name, parameters, e, u) + observed + rounding).all()


@EVERY_LAW
def test_limits_that_are_not_reached_change_no_bit(name: str) -> None:
    law = controller(name).tuned_law()
    state, measurements = random_flight(law, 0.05)
    wide = Limits(np.full(4, -1e3), np.full(4, 1e3), np.full(4, 1e3 / DT))
    after, u = law.control_law.step(state, measurements, np.float64(DT), law.params)
    limited_state, u_free, u_limited = law.control_law.limited(
        state, measurements, np.float64(DT), law.params, wide
    )
    assert u.tobytes() == u_free.tobytes() == u_limited.tobytes()
    assert bits(after) == bits(limited_state)


@EVERY_LAW
def test_limits_hold_for_any_error(name: str) -> None:
    """The limits of magnitude and rate hold for any error."""
    parameters = controller(name, lower=[-0.02] * 4, upper=[0.01] * 4, slew=[0.05] * 4)
    # u_o of lqg is 0.6 of the limits within 0.1 s: 0.09 /s
    generator = np.random.default_rng(1)
    state = guard.initial_state(4)
    us = [np.zeros(4)]
    for k in range(300):
        state = tick(
            parameters,
            state,
            10 * k,
            generator.standard_normal(4) * 10.0 ** generator.integers(-3, 2),
        )
        us.append(state.u)
    u = np.array(us)
    assert u.min() >= -0.02
    assert u.max() <= 0.01
    # reached, and kept
    assert np.abs(np.diff(u, axis=0)).max() == pytest.approx(0.05 * DT, rel=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_no_integral_winds_up_in_saturation(name: str) -> None:
    parameters = controller(name, lower=[-0.02] * 4, upper=[0.02] * 4, slew=[0.1] * 4)
    state = guard.initial_state(4)
    for k in range(500):
        state = tick(parameters, state, 10 * k, 0.5)
    earlier = fields(state.law)
    for k in range(500, 1000):
        state = tick(parameters, state, 10 * k, 0.5)
    assert state.u == pytest.approx([-0.02] * 4, rel=1e-12)
    # the slowest filter is l1's, 4 rad/s: 5 s leave exp(-20) of a change
    for group, value in fields(state.law).items():
        assert_allclose(value, earlier[group], rtol=1e-7, err_msg=group)
    # so u leaves its limit with the first sample of the other sign, as fast as it may
    assert tick(parameters, state, 10_000, -0.5).u == pytest.approx(
        [-0.02 + 0.1 * DT] * 4, rel=1e-9
    )


RETUNED: dict[str, dict[str, Any]] = {
    "rise_di": {"k_g": 2.0, "Lambda": [1.0, 2.0, 3.0, 4.0], "beta": [1.0] * 4, "softening": 4.0},
    "pi": {"K": [1.0, 2.0, 3.0, 4.0], "Lambda": [1.0, 0.0, 3.0, 4.0]},
    "l1": {
        "K": [1.0, 2.0, 3.0, 4.0],
        "bandwidth": [5.0] * 4,
        "Omega": np.diag([40.0, 60.0, 9.0, 5.0]).ravel().tolist(),
    },
    "pid": {
        "K": [1.0, 2.0, 3.0, 4.0],
        "Lambda": [1.0, 0.0, 3.0, 4.0],
        "lead": [0.1] * 4,
        "filter_time": [0.1] * 4,
    },
    "lqg": {},
    "own": {"input_scale": [0.01, 0.02, 0.05, 0.1]},  # a parameter of every law
}


@EVERY_LAW
def test_new_parameters_leave_u_as_it_is(name: str) -> None:
    law = controller(name).tuned_law()
    # l1 with another Omega has another u_r: its measurements have y_m_dot = 0
    changes = RETUNED[name.partition(",")[0]]
    if name in OBSERVED:
        changes = {
            key: (0.1 * np.array(value)).tolist()
            for key, value in changes.items()
            if key in {"K", "Lambda", "beta"}
        }
    new = controller(name, **changes).tuned_law()
    state, measurements = random_flight(law, 1e-3)
    measurements = measurements._replace(y_m_dot=np.zeros(4))
    if name in OBSERVED:  # no innovation, so that the observer has nothing to add
        state = state._replace(
            z=law.params.H.T @ (measurements.y - measurements.y_m), sigma=np.ones(1)
        )
        state = state._replace(u_o=-law.params.F @ state.z)
    after = law.control_law.retune(state, law.params, new.params)
    # a tick of no time shows u: its filters and integrals do not move; 1e-12 s moves them by 1e-12
    # of their rates
    _, u = law.control_law.step(state, measurements, np.float64(1e-12), law.params)
    _, u_new = new.control_law.step(after, measurements, np.float64(1e-12), new.params)
    assert_allclose(u_new, u, rtol=1e-8, atol=1e-10)


# Flight and replay


@EVERY_LAW
def test_every_law_flies_and_replays(name: str) -> None:
    """A replay of each law equals the flight to the last bit."""
    scenario = replace(SERVO, controller=controller(name))
    tape = simulate(scenario)
    result = replay(tape, scenario.controller)
    assert equal(result), result.first()
    assert (len(result.number), result.notes) == (201, ())
    log = tape["internals"]
    assert set(log["mode"]) == {Mode.ENGAGED}
    # the commands are 0.1 rad/s to 0.4 rad/s and 1.5 m/s, the gust is 10 m/s; a lost aircraft has
    # errors of several rad/s
    assert (np.abs(log.group("e").values).max(axis=0) < [0.2, 0.2, 0.2, 1.0]).all()
    of_law = [
        group for group in field_names(scenario.controller.tuned_law().control_law) if group != "e"
    ]
    assert all(log.group(group).values.any() for group in of_law)  # the log holds its state


def test_only_gains_change_in_flight() -> None:
    """Neither the law nor its channels can change in flight.

    Only a learner can change the models, and only those of RISE-DI.
    """
    assert {"K", "Lambda", "lead", "filter_time", "upper", "hold"} <= controller("pid").tunable()
    for name in (*NAMES, *OBSERVED):
        assert not controller(name).tunable() & {"law", "outputs", "D", "rate", "learn"}
        models = {"feedforward", "observer"} if controller(name).law == "rise_di" else set()
        assert not controller(name).tunable() & {"feedforward", "observer"}
        assert controller(name).changed_by_node() == models


def test_another_law_or_observer_refused_in_flight() -> None:
    controller_of_pi = Controller(controller("pi"))
    for name in ("rise_di", "pid", "pi, observer"):
        expected = (
            r"controller\.law: found \w+, expected the law and the observer in use: "
            r"these change at a restart"
        )
        with refusing(expected):
            controller_of_pi.retune(controller(name))


# The linear model of a law


@EVERY_LAW
def test_linear_model_predicts_step_of_law(name: str) -> None:
    law = controller(name).tuned_law()
    linear = linear_law(law, 4, DT)
    generator = np.random.default_rng(1)
    state = law.control_law.engage(at(0.0), law.params)
    if isinstance(state, ObserverState):
        state = state._replace(sigma=np.ones(1))
    z = np.concatenate([*fields(state).values()]) * 0.0
    for _ in range(50):
        y = 1e-9 * generator.standard_normal(4)  # inside every softened or implicit sign
        state, u = law.control_law.step(state, at(y), np.float64(DT), law.params)
        predicted = linear.C @ z + linear.D @ y
        z = linear.A @ z + linear.B @ y
        assert_allclose(u, predicted, rtol=1e-6, atol=1e-6 * np.abs(predicted).max())


def responses(name: str, parameters: Any, z: complex) -> FloatArray:
    """Return the transfer matrix from y to u at z, derived by hand."""
    T = DT
    K = np.array(
        parameters.K if hasattr(parameters, "K") else gain(np.array(1.0), np.array(parameters.k_d))
    )
    if name == "l1":
        Omega = np.reshape(parameters.Omega, (4, 4))
        decay = 1.0 - np.exp(-np.array(parameters.bandwidth) * T)
        # and a pole of 1 1/s in the adaptation
        low_pass = np.diag(decay / (1.0 - (1.0 - decay) / z) / (np.exp(T) - 1.0))
        # u = -Omega^-1 (K y + F ((1 - 1/z) y - T / z Omega u))
        return np.asarray(
            -np.linalg.solve(
                (np.eye(4) - low_pass * T / z) @ Omega, np.diag(K) + low_pass * (1.0 - 1.0 / z)
            )
        )
    series = 1.0 + np.array(parameters.Lambda) * T / 2.0 * (z + 1.0) / (z - 1.0)
    if name == "pid":
        share = 1.0 - np.exp(-T / np.array(parameters.filter_time))
        series = series + np.array(parameters.lead) * share / T * (z - 1.0) / (z - 1.0 + share)
    if name == "rise_di":
        lag = np.array(parameters.lag) + 1.5 * T + parameters.delay
        # beta / (eps K) is 1 / (softening lag)
        series = series + T / (parameters.softening * lag) * z / (z - 1.0)
    return np.diag(-np.array(parameters.input_scale) * np.array(parameters.D) * K * series)


@pytest.mark.parametrize("name", ["rise_di", "pi", "l1", "pid"])
def test_linear_model_has_frequency_response_of_law(name: str) -> None:
    parameters = controller(name)
    A, B, C, D = linear_law(parameters.tuned_law(), 4, DT)
    for omega in (0.1, 1.0, 10.0, 100.0):  # rad/s
        z = np.exp(1j * omega * DT)
        transfer = C @ np.linalg.solve(z * np.eye(len(A)) - A, B) + D
        assert_allclose(transfer, responses(name, parameters, z), rtol=1e-6, atol=1e-9)


@EVERY_LAW
def test_a_state_is_restored_from_its_fields(name: str) -> None:
    law = controller(name).tuned_law()
    state, _ = random_flight(law, 0.05)
    values = fields(state)
    assert tuple(values) == field_names(law.control_law)
    again = restored(law.control_law, {**values, "u_free": np.zeros(4)})  # a log has more groups
    assert type(again) is type(state)
    assert bits(again) == bits(state)


# Arrays of NumPy and of JAX


@EVERY_LAW
def test_law_is_same_under_jax(name: str) -> None:
    """A law gives the same u with NumPy and with JAX, also for many aircraft at once."""
    law = controller(name).tuned_law()

    def column(value: Any) -> Any:
        return value[:, None] if np.ndim(value) == 1 else value

    params = jax.tree.map(column, law.params)
    generator = np.random.default_rng(1)
    looks = [
        Measurements(*(0.05 * generator.standard_normal((4, 3)) for _ in range(5)))
        for _ in range(5)
    ]
    limits = Limits(*(np.full((4, 1), value) for value in (-0.1, 0.1, 1.0)))
    many = law.control_law.engage(looks[0], params)
    compiled = jax.tree.map(jax.numpy.asarray, many)
    singles = [
        law.control_law.engage(Measurements(*(signal[:, k] for signal in looks[0][:5])), law.params)
        for k in range(3)
    ]
    limited_step = jax.jit(
        lambda state, measurements: law.control_law.limited(state, measurements, DT, params, limits)
    )
    row = Limits(*(limit[:, 0] for limit in limits))
    for measurements in looks:
        many, _, u = law.control_law.limited(many, measurements, np.float64(DT), params, limits)
        compiled, _, by_jax = limited_step(compiled, measurements)
        assert_allclose(by_jax, u, rtol=1e-9, atol=1e-12)  # the order of additions differs
        for k in range(3):
            one = Measurements(*(value[:, k] for value in measurements[:5]))
            singles[k], _, of_one = law.control_law.limited(
                singles[k], one, np.float64(DT), law.params, row
            )
            assert_allclose(u[:, k], of_one, rtol=1e-9, atol=1e-12)
