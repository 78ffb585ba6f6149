# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test each control law against an independent result.

The result is a closed form, another recursion, or an exact integration of a known plant.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pytest import approx
from scipy.linalg import solve_discrete_are

from control_laws import l1, lqi, observed, observer_design, riccati
from control_laws.catalogue import LAWS, initial_gains
from control_laws.nominal_model import NominalModel, conditional_integration
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_campaign.comparison import tuning
from flight_core.vectors import FloatArray
from rise_di_controller.law.control_law import ControlLaw, Measurements

pytestmark = pytest.mark.slow

DT = 0.01
COLUMN = (1, 1)


def integrator(Omega: float = 2.0, period: float = DT, limit: float = np.inf) -> NominalModel:
    """Return a model with one output that integrates its input: y_dot = Omega u."""
    one = np.ones(1)
    wide = np.full(1, limit)
    return NominalModel(
        A=np.zeros(COLUMN),
        B=np.full(COLUMN, Omega),
        C=np.ones(COLUMN),
        gravity=np.zeros(COLUMN),
        wind=np.ones(COLUMN),
        noise=0.001 * one,
        kinematic=0.0 * one,
        size=one,
        input_scale=one / Omega,
        D=one,
        lag=0.0 * one,
        total_lag=1.5 * period * one,
        period=period,
        lower=-wide,
        upper=wide,
    )


@pytest.fixture(scope="module")
def osprey() -> NominalModel:
    """Return the osprey without actuators or limits."""
    return tuning.build_benchmark(find_scenario("osprey_gust", 0.1)).model


def at(y: Any, y_m: Any = 0.0, **others: Any) -> Measurements:
    """Return measurements of one aircraft in which x is y and all other fields are 0."""
    y = np.atleast_1d(np.asarray(y, dtype=float))[:, None]
    zero = np.zeros_like(y)
    measurements = Measurements(
        y=y,
        y_m=zero + y_m,
        y_m_dot=zero,
        u_trim=zero,
        u_before=zero,
        position=zero,
        x=y,
        x_air=y,
        y_dot=zero,
    )
    return measurements._replace(**{key: np.asarray(value) for key, value in others.items()})


class Flight(NamedTuple):
    """A flight of one integrating output, with one value for each tick."""

    y: FloatArray
    u: FloatArray
    state: Any


def fly(
    law: ControlLaw,
    params: Any,
    ticks: int,
    y: float,
    d: Any,
    model: NominalModel,
    Omega: float | None = None,
) -> Flight:
    """Return the exact flight of y_dot = Omega u + d with y_m = 0 and ideal actuators.

    u is held over a tick, and d is the mean over the tick.
    """
    response = model.Omega[0, 0] if Omega is None else Omega
    measurements = at(y)
    ys = []
    us = []
    state = law.engage(measurements, params)
    u = np.zeros(COLUMN)
    for k in range(ticks):
        state, _, u = law.limited(
            state, at(y, u_before=u, position=u), np.array(model.period), params, model.limits
        )
        ys.append(y)
        us.append(u.item())
        y += model.period * (response * u.item() + (d(k) if callable(d) else d))
    return Flight(np.array(ys), np.array(us), state)


def gains(**values: Any) -> dict[str, FloatArray]:
    return {name: np.atleast_2d(np.asarray(value, dtype=float)) for name, value in values.items()}


def law_of(name: str, model: NominalModel, **values: Any) -> tuple[ControlLaw, Any]:
    """Return a law of the catalogue and its parameters.

    Without gains, these are the initial ones of a search.
    """
    law = LAWS[name]
    return law.control_law(model), law.params(gains(**values) or initial_gains(law, model), model)


def test_doubling_solves_the_riccati_equation(osprey: NominalModel) -> None:
    estimator = observer_design.aircraft_model(osprey, observed.unnamed(osprey), np.full(3, 2.0))
    generator = np.random.default_rng(1)
    Q = np.tile(estimator.H.T @ estimator.H, (5, 1, 1))
    R = riccati.diagonal(np.exp(generator.normal(-3.0, 1.0, (4, 5))).T)
    solution = riccati.riccati(estimator.Phi, estimator.Gamma, Q, R)
    for k in range(
        5
        # scipy's own residuals are of that size: modes that decay with 0.01 1/s lie 1e-4 from the
        # unit circle
    ):
        expected = solve_discrete_are(estimator.Phi, estimator.Gamma, Q[k], R[k])
        assert_allclose(solution[k], expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())


def recursion(F: FloatArray, G: FloatArray, Q: FloatArray, R: FloatArray, steps: int) -> FloatArray:
    """Return the gain of a long finite horizon, by the Riccati recursion backwards in time."""
    P = Q
    for _ in range(steps):
        gain = np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F)
        P = Q + F.T @ P @ (F - G @ gain)
        P = (P + P.T) / 2.0
    return np.asarray(np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F))


def test_lqi_is_limit_of_long_finite_horizon(osprey: NominalModel) -> None:
    size = osprey.C @ osprey.size
    weights = gains(integral=np.full((4, 1), 2.0), effort=np.full((4, 1), 0.1), fade=4.0)
    F, G, E = lqi.design(osprey, 4.0)
    gain = lqi.lqi_params(weights, osprey).gain[..., 0]
    Q = E.T @ np.diag(np.concatenate([1.0 / size**2, (2.0 / size) ** 2])) @ E
    R = np.diag((0.1 / osprey.input_scale / size) ** 2)
    # what decays with LEAK alone, 0.01 1/s, is not in the gain; the loop's own modes have 50 s to
    # end
    assert_allclose(gain, recursion(F, G, Q, R, 5000), rtol=1e-6, atol=1e-6)
    slow = np.sort(np.abs(np.linalg.eigvals(F - G @ gain)))
    # two angles and four references decay with LEAK for any gain; all other modes of the loop are
    # faster than 0.3 1/s
    assert np.all(slow[-6:] == approx(np.exp(-lqi.LEAK * osprey.period), abs=1e-6))
    assert slow[-7] < np.exp(-0.3 * osprey.period)


def test_the_acceleration_based_law_by_hand() -> None:
    model = integrator(Omega=2.0, period=0.1)
    # eps = 5 / 3 0.24 = 0.4
    control_law, params = law_of(
        "mackunis_ideal", model, K=3.0, Lambda=2.0, beta=5.0, softening=0.24
    )
    state = control_law.engage(at(0.0), params)
    state, u = control_law.step(state, at(0.2, y_dot=np.full(COLUMN, -0.3)), np.array(0.1), params)
    # r = -0.3 + 2 0.2 = 0.1, Pi = 0.1 5 0.1 / 0.4 = 0.125, integral = 0.1 0.2 / 2 = 0.01: -(3 (0.2
    # + 0.02) + 0.125) / 2
    assert u.item() == approx(-(0.66 + 0.125) / 2.0, rel=1e-12)
    state, u = control_law.step(state, at(0.2, y_dot=np.full(COLUMN, 9.0)), np.array(0.1), params)
    # r far beyond eps: Pi = 0.125 + 0.5, integral = 0.03
    assert u.item() == approx(-(3.0 * (0.2 + 0.06) + 0.625) / 2.0, rel=1e-12)


def test_filtered_difference_of_ramp_converges_to_slope() -> None:
    model = integrator()
    control_law, params = law_of(
        "mackunis", model, K=1.0, Lambda=1.0, beta=1.0, softening=1.0, filter=12.6
    )
    state = control_law.engage(at(0.0), params)
    for k in range(1, 301):
        state, _ = control_law.step(state, at(0.3 * k * DT), np.array(DT), params)
    # a filter of first order: 1 - exp(-12.6 3 s) of the slope
    assert state.e_dot.item() == approx(0.3 * (1.0 - np.exp(-12.6 * 3.0)), rel=1e-9)


def test_l1_estimates_disturbance_in_one_tick() -> None:
    """The predictor of L1 estimates a constant disturbance in one tick."""
    model = integrator()
    flight = fly(*law_of("l1", model, K=3.0, bandwidth=20.0), 3, 0.1, 0.7, model)
    x = l1.ADAPTATION_POLE * DT
    assert flight.state.sigma_hat.item() == approx(0.7 * x / (np.exp(x) - 1.0), rel=1e-9)


def test_l1_rejects_constant_disturbance_with_wrong_input_gain() -> None:
    model = integrator()
    flight = fly(
        *law_of("l1", model, K=3.0, bandwidth=20.0),
        1500,
        0.0,
        0.7,
        model,
        Omega=1.4 * model.Omega[0, 0],
    )
    # at rest y_hat - y is constant: K e = d (1 - k) where k = 0.995 is what the pole leaves of the
    # estimate
    assert abs(flight.y[-1]) < 0.7 * 0.006 / 3.0
    assert flight.u[-1] == approx(-0.7 / (1.4 * model.Omega[0, 0]), rel=1e-6)


def test_l1_with_feedforward_does_not_cancel_disturbance_twice() -> None:
    model = integrator()
    control_law, params = law_of("l1_ff", model, K=3.0, bandwidth=20.0)
    y = 0.0
    state = None
    u = np.zeros(COLUMN)
    d, y_m_dot = 0.7, 0.5
    u_ff = np.full(COLUMN, (y_m_dot - d) / model.Omega[0, 0])  # a model with d
    for k in range(500):
        measurements = at(
            y, y_m_dot * k * DT, y_m_dot=np.full(COLUMN, y_m_dot), u_trim=u_ff, u_before=u
        )
        state = control_law.engage(measurements, params) if state is None else state
        state, u = control_law.step(state, measurements, np.array(DT), params)
        y += DT * (model.Omega[0, 0] * u.item() + d)
    assert u.item() == approx(u_ff.item(), rel=1e-2)
    assert abs(y - y_m_dot * 500 * DT) < 0.01 * 0.7 / 3.0


def test_indi_needs_no_model_except_input_gain() -> None:
    model = integrator()
    for Omega in (2.0, 1.4, 2.6):
        flight = fly(
            *law_of("indi", model, K=2.0, bandwidth=60.0, share=1.0),
            1500,
            0.2,
            0.7,
            model,
            Omega=Omega,
        )
        # exp(-2 15) of the start and the disturbance, were it first order
        assert abs(flight.y[-1]) < 1e-6, Omega
        assert flight.u[-1] == approx(-0.7 / Omega, rel=1e-5)


def test_pi_is_the_law_without_its_sign(osprey: NominalModel) -> None:
    K = np.array([[9.0], [8.0], [4.0], [2.0]])
    Lambda = np.array([[3.0], [2.0], [1.0], [0.5]])
    control_law, params = law_of("pi", osprey, K=K, Lambda=Lambda)
    e = np.array([[0.1], [0.2], [0.0], [-0.3]])
    measurements = at(np.zeros(4))
    state = control_law.engage(measurements, params)
    for k in range(1, 6):
        state, u = control_law.step(state, measurements._replace(y=k * e), np.array(DT), params)
    # e rises by one step a tick from 0: its trapezoid up to tick 5 is 12.5 steps of dt
    assert_allclose(
        u, -osprey.input_scale[:, None] * K * (5.0 + Lambda * 12.5 * DT) * e, rtol=1e-12
    )


def test_observer_converges(osprey: NominalModel) -> None:
    """The estimates converge to the states, the wind and the disturbance of the model."""
    # s: faster than the 30 s below
    values = initial_gains(LAWS["lqg"], osprey) | {"wind_time": np.full((3, 1), 0.6)}
    _, params = law_of("lqg", osprey, **values)
    Phi = params.Phi[..., 0]
    Gamma = params.Gamma
    H = params.H
    correction = params.L[..., 0]
    Gamma = Gamma[..., 0] if Gamma.ndim > 2 else Gamma
    generator = np.random.default_rng(1)
    z = 0.01 * generator.standard_normal(len(Phi))
    z_hat = np.zeros(len(Phi))
    for _ in range(3000):
        u = 0.01 * generator.standard_normal(4)
        z_hat = z_hat + correction @ (H @ (z - z_hat))
        z = Phi @ z + Gamma @ u
        z_hat = Phi @ z_hat + Gamma @ u
    # angles and disturbances that only together move V end within 1 / LEAK = 100 s, so exp(-0.3) of
    # them is left after 30 s; the combination that acts on the outputs is observable: compare the
    # prediction of e one second ahead
    assert np.abs(H @ np.linalg.matrix_power(Phi, 100) @ (z - z_hat)).max() < 1e-4
    assert np.abs(np.linalg.eigvals(Phi - Phi @ correction @ H)).max() < 1.0


def test_anti_windup_stops_and_releases_integral() -> None:
    """The integral stops in saturation, and changes when this leads back into the limits."""
    integral = conditional_integration(
        np.zeros(3), np.ones(3), np.ones(3), np.array([0.5, -0.5, 0.0])
    )
    assert integral.tolist() == [0.0, 1.0, 1.0]


@pytest.mark.parametrize("name", list(LAWS))
def test_rival_law_is_same_under_jax(name: str, osprey: NominalModel) -> None:
    """A law gives the same u with NumPy and with JAX, also for a fleet."""
    generator, (control_law, params) = np.random.default_rng(1), law_of(name, osprey)
    # all but the vanes
    shapes = ((4, 3), (4, 1), (4, 1), (4, 1), (4, 3), (4, 3), (8, 3), (8, 3), (4, 3))
    looks = [
        Measurements(*(0.1 * generator.standard_normal(shape) for shape in shapes))
        for _ in range(4)
    ]
    state = control_law.engage(looks[0], params)
    single = [np.asarray(signal)[..., :1] for signal in looks[0][:9]]
    compiled = jax.tree.map(jax.numpy.asarray, state)
    single_state = control_law.engage(Measurements(*single), params)
    step = jax.jit(control_law.step)
    for measurements in looks:
        state, u = control_law.step(state, measurements, np.array(DT), params)
        compiled, by_jax = step(compiled, measurements, DT, params)
        single_state, first = control_law.step(
            single_state,
            Measurements(*(np.asarray(signal)[..., :1] for signal in measurements[:9])),
            np.array(DT),
            params,
        )
        # nothing but the order of additions differs
        assert_allclose(by_jax, u, rtol=1e-9, atol=1e-12)
        assert_allclose(first, u[:, :1], rtol=1e-9, atol=1e-12)
