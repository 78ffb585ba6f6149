# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the simulated aircraft by exact solutions, independent integrators and its definition."""

import math
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from tests.builders import MS, aircraft_parameters
from tests.conftest import refusing

from aircraft_sim import truth
from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.atmosphere import turbulence
from aircraft_sim.atmosphere.disturbance import Gusts, one_minus_cosine
from aircraft_sim.plant import actuators, dynamics
from aircraft_sim.plant.dynamics import Aircraft
from aircraft_sim.plant.plant import AircraftState, advance, initial_state
from flight_core.integrators import rk4
from flight_core.rates import NANOSECONDS
from flight_core.vectors import FloatArray


def osprey(**gusts: dict[str, float]) -> Aircraft:
    return aircraft_parameters(gusts=gusts).plant().aircraft


def final_state(
    x: FloatArray, u: FloatArray, duration_ns: int, step_ns: int, aircraft: Aircraft
) -> FloatArray:
    """Return the state x after `duration_ns` with a held u and ideal actuators."""
    params = aircraft_parameters().plant()._replace(aircraft=aircraft, step_ns=step_ns)
    return np.asarray(advance(0, AircraftState(x, np.zeros_like(u)), u, duration_ns, params).x)


@pytest.mark.equation(1)
def test_without_f_plant_follows_matrix_exponential() -> None:
    # x(t) = exp([[A, B], [0, 0]] t) [x0; u] exactly for a held u. Runge-Kutta with 2 ms and poles
    # up to 13 rad/s leaves
    # (0.026)^5 / 120 a step, about 1e-9 over a second.
    aircraft = osprey()
    aircraft = aircraft._replace(gravity=np.zeros_like(aircraft.gravity))
    x_0 = np.linspace(-0.1, 0.1, 8)
    u = np.array([0.02, 0.1, -0.01, 0.03])
    block = np.block([[aircraft.A, aircraft.B], [np.zeros((4, 12))]])
    exact = (expm(block * 1.0) @ np.concatenate([x_0, u]))[:8]
    assert final_state(x_0, u, NANOSECONDS, 2 * MS, aircraft) == approx(exact, abs=1e-8)


def test_halving_step_divides_integration_error_by_sixteen() -> None:
    aircraft = osprey()
    x_0 = np.linspace(-0.2, 0.2, 8)
    u = np.zeros(4)
    finest = final_state(x_0, u, NANOSECONDS, MS // 4, aircraft)
    errors = [
        np.abs(final_state(x_0, u, NANOSECONDS, step, aircraft) - finest).max()
        for step in (20 * MS, 10 * MS)
    ]
    assert errors[0] / errors[1] == approx(16.0, rel=0.15)  # fourth order


def test_plant_agrees_with_adaptive_integrator_through_gust() -> None:
    aircraft = osprey(vertical={"start": 0.2, "speed": 10.12, "length": 15.24})
    u = np.array([0.01, 0.0, 0.02, 0.0])
    reference = solve_ivp(
        lambda t, x: dynamics.x_dot(t, x, u, aircraft),
        (0.0, 2.0),
        np.zeros(8),
        "DOP853",
        rtol=1e-11,
        atol=1e-12,
        max_step=0.01,
    )
    end = final_state(np.zeros(8), u, 2 * NANOSECONDS, 2 * MS, aircraft)
    # The gust's second derivative jumps at its ends: Runge-Kutta loses an order there.
    assert end == approx(reference.y[:, -1], abs=1e-6)


@pytest.mark.equation("Assumption 2")
@given(speed=st.floats(-20, 20), length=st.floats(1, 100), t=st.floats(0, 100))
def test_gust_stays_between_zero_and_speed_with_bounded_derivative(
    speed: float, length: float, t: float
) -> None:
    gusts = Gusts(np.array([10.0]), np.array([speed]), np.array([length]))
    w = [float(one_minus_cosine(t + dt, gusts, np.array(25.0))[0]) for dt in (0.0, 1e-4)]
    assert min(0.0, speed) - 1e-12 <= w[0] <= max(0.0, speed) + 1e-12
    # abs(w_dot) <= U/2 pi V0 / H.
    assert abs(w[1] - w[0]) <= 1e-4 * abs(speed) / 2 * math.pi * 25.0 / length + 1e-12


def test_gust_of_speed_zero_is_exactly_no_gust() -> None:
    undisturbed = osprey()
    zero = osprey(vertical={"start": 0.0, "speed": 0.0, "length": 15.24})
    x = np.linspace(-0.1, 0.1, 8)
    assert (dynamics.f(0.5, x, zero) == dynamics.f(0.5, x, undisturbed)).all()


@pytest.mark.equation(1)
def test_gravity_and_lateral_coupling_enter_as_published() -> None:
    x = np.zeros(8)
    x[3], x[7] = 0.1, -0.2  # theta, phi
    f = dynamics.f(0.0, x, osprey())
    # V_dot gets -9.81 sin(theta), beta_dot +0.39 sin(phi): MacKunis et al. 2010
    assert f == approx([-9.81 * math.sin(0.1), 0, 0, 0, 0.39 * math.sin(-0.2), 0, 0, 0], abs=1e-15)


def test_inputs_of_airframe_converted_to_si_once() -> None:
    airframe = load_airframe("osprey")
    B = airframe.matrix_b()
    # 0.98 rad/s^2 per degree of elevator; 0.06 m/s^2 per percent of thrust
    assert B[2, 0] == approx(0.98 * 180 / math.pi)
    assert B[0, 1] == approx(6.0)


def test_truth_holds_state_disturbance_and_actuators() -> None:
    parameters = aircraft_parameters(
        gusts={"vertical": {"start": 0.0, "speed": 2.0, "length": 10.0}}
    )
    names = truth.names(parameters.load()[0])
    state = AircraftState(np.arange(8.0) / 100, np.array([0.1, 0.2, 0.3, 0.4]))
    now = dynamics.at_times(np.array([0.4]), parameters.plant().aircraft)
    true = dict(
        zip(names, truth.values(state, now.wind[0], now.rate[0], parameters.plant()), strict=True)
    )
    assert true["x.phi"] == 0.07
    assert true["gust.vertical"] == approx(2.0)  # s = 25 0.4 = H
    # Every axis of the airframe's gusts.
    assert true["gust.lateral"] == true["gust.longitudinal"] == 0.0
    assert true["actuator.thrust"] == 0.2
    assert true["f.V"] == approx(-9.81 * math.sin(0.03) - 11.1 * 2.0 / 25)


EVERYTHING = {
    "gusts": {
        "vertical": {"start": 0.0, "speed": 10.0, "length": 15.0},
        "lateral": {"start": 0.01, "speed": -4.0, "length": 5.0},
        "longitudinal": {"start": 0.0, "speed": 3.0, "length": 9.0},
    },
    "turbulence": {"altitude": 50.0, "wind": 15.4},
    "bias": {
        "q": {"start": 0.01, "value": 0.5, "rise": 0.02},
        "V": {"start": 0.0, "value": -1.0, "rise": 0.0},
    },
    "sines": {"r": {"amplitude": 0.3, "frequency": 20.0, "phase": 1.0}},
    "inertial_coupling": 1.0,
    "actuators": {
        "lag": [0.02, 0.1, 0.02, 0.02],
        "dead_zone": [0.001] * 4,
        "faults": ["aileron stuck 0.3"],
    },
}


def test_steps_with_precomputed_forcing_are_runge_kutta_steps_of_equation_1() -> None:
    # x_dot is the definition; advance computes f_time at all instants together. Measured difference
    # 1e-16 over 20 steps.
    params = aircraft_parameters(rate=25.0, **EVERYTHING).plant()
    filters = params.turbulence
    assert filters is not None
    u = np.array([0.05, 0.1, -0.04, 0.03])
    T = 20
    state = initial_state(params)._replace(x=np.linspace(-0.5, 0.5, 8))
    end = advance(7 * 40 * MS, state, u, 40 * MS, params)

    x, position, z = state
    for k, normal in enumerate(turbulence.normals(7 * T, T, filters)):
        t = 0.28 + 0.002 * k
        position, mean = actuators.move(t, position, u, 0.002, params.actuators)
        x_dot = partial(dynamics.x_dot, turbulence=turbulence.wind(z, filters))
        x = rk4(x_dot, t, x, mean, params.aircraft, 0.002)
        z = turbulence.step(z, normal, filters)
    assert end.x == approx(x, rel=1e-13, abs=1e-15)
    assert (end.position == position).all()
    assert np.asarray(end.turbulence).tobytes() == np.asarray(z).tobytes()


def test_equation_1_is_sum_of_parts() -> None:
    aircraft = aircraft_parameters(rate=25.0, **EVERYTHING).load()[1]
    x = np.linspace(-0.3, 0.3, 8)
    u = np.array([0.01, 0.1, 0.02, 0.03])
    turbulent = np.array([0.5, -1.0, 2.0])
    x_dot = dynamics.x_dot(0.3, x, u, aircraft, turbulent)
    assert x_dot == approx(
        aircraft.A @ x + dynamics.f(0.3, x, aircraft, turbulent) + aircraft.B @ u, abs=1e-14
    )
    difference = dynamics.f(0.3, x, aircraft, turbulent) - dynamics.f(0.3, x, aircraft)
    assert difference == approx(aircraft.gust_direction @ turbulent, abs=1e-14)


def test_f_of_states_in_columns_is_f_of_each_state() -> None:
    gusts = {"vertical": {"start": 0.0, "speed": 10.0, "length": 15.0}}
    single = aircraft_parameters(gusts=gusts, inertial_coupling=1.0).load()[1]
    batched = single._replace(gusts=Gusts(*(values[:, None] for values in single.gusts[:3])))
    columns = np.random.default_rng(1).uniform(-1.0, 1.0, (8, 5))
    f = dynamics.f(0.3, columns, batched)
    for k in range(5):
        assert f[:, k] == approx(dynamics.f(0.3, columns[:, k], single), abs=1e-14)


def test_step_that_does_not_divide_time_refused() -> None:
    with refusing(r"step: found 0\.003 s, expected a whole fraction of the duration \(0\.01 s\)"):
        final_state(np.zeros(8), np.zeros(4), 10 * MS, 3 * MS, osprey())
