# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test Dryden turbulence against the published spectra.

The tests cover lengths, intensities, filters, ensemble statistics and repeatability.
"""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from pytest import approx
from scipy.integrate import quad
from scipy.linalg import expm
from tests.builders import MS, aircraft_parameters, truth_of
from tests.conftest import refusing

from aircraft_sim.atmosphere import turbulence
from aircraft_sim.atmosphere.disturbance import AXES
from aircraft_sim.atmosphere.turbulence import Dryden, Turbulence, dryden, filters
from aircraft_sim.plant import plant
from aircraft_sim.simulator import Simulator
from flight_core.vectors import FloatArray

pytestmark = pytest.mark.slow

FEET, KNOTS = 0.3048, 0.514444  # m, m/s
V0 = 25.0
SPAN = 3.0  # m
# About 60 ft above the ground in 15 kt.
SMALL = Dryden(np.array([60.0, 60.0, 25.0]), np.array([1.1, 1.1, 0.8]))
ALL = (0, 1, 2)
TURBULENCE = {"altitude": 30.0, "wind": 7.7}


def spectrum(omega: FloatArray, axis: int, model: Dryden) -> FloatArray:
    """Return the published spectrum, one-sided in omega, m^2/s^2 per rad/s.

    Source: MIL-F-8785C, 3.7.1.2, in Omega = omega / V0.
    """
    L = model.length[axis]
    sigma = model.sigma[axis]
    space = omega / V0
    if axis == 0:
        return np.asarray(sigma**2 * 2.0 * L / np.pi / (1.0 + (L * space) ** 2) / V0)
    return np.asarray(
        sigma**2 * L / np.pi * (1.0 + 3.0 * (L * space) ** 2) / (1.0 + (L * space) ** 2) ** 2 / V0
    )


def correlation(lag: FloatArray, axis: int, model: Dryden) -> FloatArray:
    """Return Dryden's correlation at a distance d = V0 lag.

    It is sigma^2 exp(-d/L) along the flight, and (1 - d/2L) times this across it.
    """
    d = V0 * np.abs(lag) / model.length[axis]
    return np.asarray(model.sigma[axis] ** 2 * np.exp(-d) * (1.0 if axis == 0 else 1.0 - d / 2.0))


def ensemble(model: Dryden, dt: float, seeds: int, steps: int) -> FloatArray:
    """Return the winds of many seeds at multiples of dt, (3, seeds, steps)."""
    params = [filters(model, V0, dt, ALL, seed) for seed in range(seeds)]
    z = np.array([turbulence.initial_state(filter_params) for filter_params in params]).T
    numbers = np.array([turbulence.normals(0, steps, each) for each in params])
    winds = np.empty((3, seeds, steps))
    for k in range(steps):
        winds[:, :, k] = turbulence.wind(z, params[0])
        z = turbulence.step(z, numbers[:, k].T, params[0])
    return winds


@pytest.mark.parametrize(
    "feet, wind, sigma, lengths, intensities",
    [
        # c = 0.177 + 0.000823 h. At 1000 ft c = 1, and all lengths are 1000 ft, all intensities
        # W_20 / 10.
        (1000.0, 15.0, 0.0, (1000.0, 1000.0, 1000.0), (1.5, 1.5, 1.5)),
        (
            100.0,
            15.0,
            0.0,
            (100.0 / 0.2593**1.2, 100.0 / 0.2593**1.2, 100.0),
            (1.5 / 0.2593**0.4, 1.5 / 0.2593**0.4, 1.5),
        ),
        (2000.0, 0.0, 5.0, (1750.0,) * 3, (5.0,) * 3),
        (1500.0, 15.0, 5.0, (1375.0,) * 3, (3.25,) * 3),  # in the middle
    ],
)
def test_lengths_and_intensities_are_those_published(
    feet: float,
    wind: float,
    sigma: float,
    lengths: tuple[float, ...],
    intensities: tuple[float, ...],
) -> None:
    result = dryden(feet * FEET, wind * KNOTS, sigma * KNOTS)
    assert result.length == approx(np.array(lengths) * FEET)
    assert result.sigma == approx(np.array(intensities) * KNOTS)


def continuous(model: Dryden) -> tuple[FloatArray, FloatArray]:
    """Return F and G of the docstring's z_dot = F z + G n."""
    a = V0 / model.length
    F = np.zeros((5, 5))
    G = np.zeros((5, 3))
    for axis, first in enumerate((0, 1, 3)):
        F[first, first], G[first, axis] = -a[axis], math.sqrt(2.0 * a[axis])
    for first, rate in ((1, a[1]), (3, a[2])):
        F[first + 1, first : first + 2] = rate, -rate
    return F, G


@pytest.mark.parametrize("axis", ALL, ids=AXES)
def test_the_filters_have_the_published_spectra(axis: int) -> None:
    F, G = continuous(SMALL)
    output = filters(SMALL, V0, 0.01, ALL, 1).output
    for omega in np.logspace(-2, 2, 9):
        response = output[axis] @ np.linalg.solve(1j * omega * np.eye(5) - F, G)
        # White noise of unit intensity has the one-sided spectrum 1/pi.
        assert np.sum(np.abs(response) ** 2) / np.pi == approx(
            float(spectrum(omega, axis, SMALL)), rel=1e-12
        )


@given(dt=st.floats(1e-6, 10.0), altitude=st.floats(3.048, 600.0))
def test_step_is_exact_solution_of_filters(dt: float, altitude: float) -> None:
    # Van Loan: exp([[-F, G G'], [0, F']] dt) holds exp(F dt) and the covariance. exp(-F dt) grows:
    # at h = 5 the covariance has lost four digits of sixteen, so the comparison ends there.
    model = dryden(altitude, 7.7, 1.5)
    params = filters(model, V0, dt, ALL, 1)
    transition = params.transition
    added = params.spread @ params.spread.T
    stationary = params.stationary @ params.stationary.T
    assert transition @ stationary @ transition.T + added == approx(stationary, abs=1e-14)
    if dt * V0 / model.length.min() < 5.0:
        F, G = continuous(model)
        double = expm(np.block([[-F, G @ G.T], [np.zeros((5, 5)), F.T]]) * dt)
        assert transition == approx(expm(F * dt), rel=1e-9, abs=1e-14)
        assert added == approx(double[5:, 5:].T @ double[:5, 5:], rel=1e-9, abs=1e-11)


@pytest.mark.parametrize("axis", ALL, ids=AXES)
def test_published_correlations_are_integrals_of_published_spectra(axis: int) -> None:
    # The ensemble tests below use both: sigma^2 and the correlation are integrals of the spectrum
    # over omega.
    for lag in (0.0, 0.3, 2.0):
        weight: dict[str, Any] = {"weight": "cos", "wvar": lag} if lag else {}
        total = quad(
            lambda omega: float(spectrum(omega, axis, SMALL)), 0.0, np.inf, limit=500, **weight
        )[0]
        assert total == approx(float(correlation(np.array(lag), axis, SMALL)), abs=1e-6)


SEEDS, STEPS = 300, 1024


@pytest.mark.equation("Assumption 2")
def test_no_axis_is_differentiable_and_so_turbulence_lies_outside_theorem() -> None:
    # With a bounded derivative the mean squares of increments are proportional to dt^2. Here they
    # are proportional to dt: 2 sigma^2 dt / T along the flight, 3 sigma^2 dt / T across it. The
    # difference quotient grows without limit.
    for axis, slope in enumerate((2.0, 3.0, 3.0)):
        for dt in (1e-3, 1e-4, 1e-5):
            increment = 2.0 * (
                correlation(np.array(0.0), axis, SMALL) - correlation(np.array(dt), axis, SMALL)
            )
            expected = slope * SMALL.sigma[axis] ** 2 * dt * V0 / SMALL.length[axis]
            assert float(increment) == approx(expected, rel=2e-3)
    fine = ensemble(SMALL, 1e-3, 100, 64)
    mean = (
        np.mean(np.diff(fine, axis=2) ** 2, axis=(1, 2))
        / SMALL.sigma**2
        * SMALL.length
        / (1e-3 * V0)
    )
    # 6300 nearly independent increments: 1.8 % standard deviation
    assert mean == approx([2.0, 3.0, 3.0], rel=0.1)


def test_numbers_of_step_k_do_not_depend_on_range() -> None:
    plain, other = (filters(SMALL, V0, 0.01, ALL, seed) for seed in (5, 6))
    turning = filters(SMALL, V0, 0.01, ALL, 5, SPAN)
    for params in (plain, turning):
        whole = turbulence.normals(0, 300, params)
        for first, count in ((0, 1), (63, 2), (64, 64), (130, 99), (299, 1)):
            assert (turbulence.normals(first, count, params) == whole[first : first + count]).all()
    assert (turbulence.normals(0, 300, other) != turbulence.normals(0, 300, plain)).all()


@pytest.mark.parametrize("dt", [1e-4, 0.002, 0.01])
def test_rotary_gusts_have_the_published_intensities(dt: float) -> None:
    # The integrals of the spectra of MIL-F-8785C, 3.7.4, written here again. A step holds the wind
    # behind the lags of q_g and r_g, an error of dt / T of the variance: T_r is 0.11 s.
    params = filters(SMALL, V0, dt, range(6), 1, SPAN)
    (p, q, r), spread = params.output[3:], params.stationary
    result = [float(np.sqrt(row @ spread @ spread.T @ row)) for row in (p, q, r)]

    def phi_p(omega: float) -> float:
        L = SMALL.length[2]
        sigma = SMALL.sigma[2]
        share = 0.8 * (np.pi * L / (4.0 * SPAN)) ** (1.0 / 3.0)
        lag = 4.0 * SPAN / np.pi * omega / V0
        return float(sigma**2 / L / V0 * share / (1.0 + lag**2))

    def phi(omega: float, axis: int, arms: float) -> float:
        lag = arms * SPAN / np.pi * omega / V0
        wind = float(spectrum(np.array(omega), axis, SMALL))
        return float((omega / V0) ** 2 / (1.0 + lag**2) * wind)

    published = [
        quad(phi_p, 0.0, np.inf)[0],
        quad(phi, 0.0, np.inf, args=(2, 4.0))[0],
        quad(phi, 0.0, np.inf, args=(1, 3.0))[0],
    ]
    assert_allclose(result, np.sqrt(published), rtol=dt / 0.1 + 1e-6)


def test_the_air_turns_nose_up_where_the_wind_down_falls_along_the_flight() -> None:
    # A slow linear change: q_g = -w_dot / V0, r_g = v_dot / V0, of the field w(x) with x = V0 t.
    params = filters(SMALL, V0, 0.01, range(6), 1, SPAN)
    z = np.zeros(8)
    slope = 0.4  # of each state of the winds, 1/s
    for k in range(400):
        z[:5] = slope * 0.01 * k
        z = np.append(z[:5], (params.transition @ z)[5:])
    z[:5] = slope * 0.01 * 400
    rate = params.output[:3, :5] @ np.full(5, slope)  # m/s^2
    turning = turbulence.wind(z, params)[3:]
    assert_allclose(turning[1:], [-rate[2] / V0, rate[1] / V0], rtol=0.05)


def test_winds_are_the_same_with_rotary_gusts() -> None:
    plain = filters(SMALL, V0, 0.01, ALL, 5)
    turning = filters(SMALL, V0, 0.01, range(6), 5, SPAN)
    states = [turbulence.initial_state(params) for params in (plain, turning)]
    for k in range(200):
        assert_allclose(states[1][:5], states[0], rtol=1e-9, atol=1e-12)
        states = [
            turbulence.step(z, turbulence.normals(k, 1, params)[0], params)
            for z, params in zip(states, (plain, turning), strict=True)
        ]


def test_air_that_turns_moves_the_aircraft_as_its_own_rates_the_other_way() -> None:
    chosen = aircraft_parameters(turbulence=TURBULENCE | {"rotary": True})
    airframe, aircraft = chosen.load()
    place = list(airframe.gusts).index("roll")
    rows = [airframe.index(name) for name in ("p", "q", "r")]
    column = airframe.matrix_a()[:, airframe.index("p")]
    assert_allclose(aircraft.gust_direction[rows, place], -column[rows], rtol=1e-12)
    simulator = Simulator(chosen)
    simulator.sample(0, np.zeros(4))
    true = truth_of(simulator)
    assert {"gust.roll", "gust.pitch", "gust.yaw"} <= set(true)
    assert true["gust.roll"] != 0.0


def test_rotary_gusts_need_a_span_and_matrices() -> None:
    rotary: dict[str, Any] = {"turbulence": TURBULENCE | {"rotary": True}}
    with refusing(r"turbulence.rotary: found true.*no span"):
        aircraft_parameters(airframe="x8_elevons", **rotary)
    jsbsim: dict[str, Any] = {"airframe": "jsbsim:c172p", "speed": 50.0, "altitude": 1000.0}
    with refusing(r"turbulence.rotary: found true.*JSBSim takes winds"):
        aircraft_parameters(**jsbsim, **rotary)


def test_turbulence_does_not_depend_on_how_flight_divided() -> None:
    params = aircraft_parameters(turbulence=TURBULENCE).plant()
    u = np.array([0.01, 0.1, 0.0, 0.0])
    whole = plant.advance(0, plant.initial_state(params), u, 400 * MS, params)
    cut = plant.initial_state(params)
    for k in range(40):
        cut = plant.advance(10 * k * MS, cut, u, 10 * MS, params)
    assert cut.turbulence is not None
    assert whole.turbulence is not None
    assert cut.turbulence.tobytes() == whole.turbulence.tobytes()
    assert cut.x == approx(whole.x, abs=1e-14)  # the instants are rounded differently
    first, second = (Simulator(aircraft_parameters(turbulence=TURBULENCE)) for _ in range(2))
    for number in range(20):
        for simulator in (first, second):
            simulator.sample(number, u)
        assert first.truth().tobytes() == second.truth().tobytes()


def test_truth_holds_wind_that_acts_from_now_on_and_f_includes_it() -> None:
    gusts = {"vertical": {"start": 0.0, "speed": 2.0, "length": 2.5}}
    parameters = aircraft_parameters(turbulence=TURBULENCE, gusts=gusts)
    simulator = Simulator(parameters)
    params = parameters.plant()
    air = params.turbulence
    assert air is not None
    z = turbulence.initial_state(air)
    for number in range(3):
        simulator.sample(number, np.zeros(4))
        true = truth_of(simulator)
        winds = dict(zip(parameters.sampled_airframe().gusts, turbulence.wind(z, air), strict=True))
        gust = 1.0 - math.cos(math.pi * 0.01 * number * 25.0 / 2.5)
        assert true["gust.lateral"] == winds["lateral"] != 0.0
        assert true["gust.vertical"] == approx(winds["vertical"] + gust, rel=1e-12)
        assert true["f.p"] == approx(3.13 / 25.0 * true["gust.lateral"], rel=1e-12)
        for normal in turbulence.normals(5 * number, 5, air):
            z = turbulence.step(z, normal, air)


def test_without_intensity_there_is_no_turbulence() -> None:
    for calm in ({"altitude": 100.0, "wind": 0.0}, {"altitude": 400.0, "wind": 0.0, "sigma": 0.0}):
        assert aircraft_parameters(turbulence=calm).plant().turbulence is None
    light = {"altitude": 400.0, "wind": 0.0, "sigma": 0.1}
    assert isinstance(aircraft_parameters(turbulence=light).plant().turbulence, Turbulence)
