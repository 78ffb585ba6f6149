# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Dryden turbulence against the published spectra: lengths, intensities, filters, and what an ensemble of flights sees."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.signal import get_window
from scipy.stats import chi2

from aircraft_sim import plant, turbulence
from aircraft_sim.disturbance import AXES
from aircraft_sim.params import AircraftParameters
from aircraft_sim.plant import PlantParams
from aircraft_sim.simulator import Simulator
from aircraft_sim.turbulence import Dryden, Turbulence, dryden, filters
from flight_core.parameters import ParameterError
from flight_core.vectors import FloatArray

FEET, KNOTS = 0.3048, 0.514444  # m, m/s
V0 = 25.0
MS = 1_000_000
SMALL = Dryden(np.array([60.0, 60.0, 25.0]), np.array([1.1, 1.1, 0.8]))  # about 60 ft above the ground in 15 kt
ALL = (0, 1, 2)


def spectrum(omega: FloatArray, axis: int, of: Dryden) -> FloatArray:
    """The published spectrum, one-sided in omega, m^2/s^2 per rad/s: MIL-F-8785C, 3.7.1.2, in Omega = omega / V0."""
    L, sigma, space = of.length[axis], of.sigma[axis], omega / V0
    if axis == 0:
        return np.asarray(sigma**2 * 2.0 * L / np.pi / (1.0 + (L * space) ** 2) / V0)
    return np.asarray(sigma**2 * L / np.pi * (1.0 + 3.0 * (L * space) ** 2) / (1.0 + (L * space) ** 2) ** 2 / V0)


def correlation(lag: FloatArray, axis: int, of: Dryden) -> FloatArray:
    """Dryden's correlation at a distance d = V0 lag: sigma^2 exp(-d/L) along the flight, (1 - d/2L) times that across it."""
    d = V0 * np.abs(lag) / of.length[axis]
    return np.asarray(of.sigma[axis] ** 2 * np.exp(-d) * (1.0 if axis == 0 else 1.0 - d / 2.0))


def ensemble(of: Dryden, dt: float, seeds: int, steps: int) -> FloatArray:
    """Winds of many seeds at multiples of dt, shape (3, seeds, steps)."""
    params = [filters(of, V0, dt, ALL, seed) for seed in range(seeds)]
    z = np.array([turbulence.initial_state(one) for one in params]).T
    numbers = np.array([turbulence.normals(0, steps, seed) for seed in range(seeds)])
    winds = np.empty((3, seeds, steps))
    for k in range(steps):
        winds[:, :, k] = turbulence.wind(z, params[0])
        z = turbulence.step(z, numbers[:, k].T, params[0])
    return winds


# The published figures


@pytest.mark.parametrize(
    ("feet", "wind", "sigma", "lengths", "intensities"),
    [
        # c = 0.177 + 0.000823 h. At 1000 ft c = 1, and all lengths are 1000 ft, all intensities W_20 / 10.
        (1000.0, 15.0, 0.0, (1000.0, 1000.0, 1000.0), (1.5, 1.5, 1.5)),
        (100.0, 15.0, 0.0, (100.0 / 0.2593**1.2, 100.0 / 0.2593**1.2, 100.0), (1.5 / 0.2593**0.4, 1.5 / 0.2593**0.4, 1.5)),
        (10.0, 30.0, 0.0, (10.0 / 0.18523**1.2, 10.0 / 0.18523**1.2, 10.0), (3.0 / 0.18523**0.4, 3.0 / 0.18523**0.4, 3.0)),
        (2000.0, 0.0, 5.0, (1750.0,) * 3, (5.0,) * 3),
        (30000.0, 0.0, 5.0, (1750.0,) * 3, (5.0,) * 3),
        (1500.0, 15.0, 5.0, (1375.0,) * 3, (3.25,) * 3),  # half way
    ],
)
def test_lengths_and_intensities_are_those_published(
    feet: float, wind: float, sigma: float, lengths: tuple[float, ...], intensities: tuple[float, ...]
) -> None:
    found = dryden(feet * FEET, wind * KNOTS, sigma * KNOTS)
    assert found.length == pytest.approx(np.array(lengths) * FEET)
    assert found.sigma == pytest.approx(np.array(intensities) * KNOTS)


@pytest.mark.parametrize("feet", [1000.0, 2000.0])
def test_nothing_jumps_where_one_model_ends(feet: float) -> None:
    below, above = (dryden(h * FEET, 7.7, 1.5) for h in (feet - 1e-6, feet + 1e-6))
    assert np.concatenate(above) == pytest.approx(np.concatenate(below), rel=1e-8)


# The filters: in frequency, in time, and over one step


def continuous(of: Dryden) -> tuple[FloatArray, FloatArray]:
    """F and G of the docstring's z_dot = F z + G n."""
    a = V0 / of.length
    F, G = np.zeros((5, 5)), np.zeros((5, 3))
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
        assert np.sum(np.abs(response) ** 2) / np.pi == pytest.approx(float(spectrum(omega, axis, SMALL)), rel=1e-12)


@given(dt=st.floats(1e-6, 10.0), altitude=st.floats(3.048, 600.0))
def test_a_step_is_the_exact_solution_of_the_filters(dt: float, altitude: float) -> None:
    # Van Loan: exp([[-F, G G'], [0, F']] dt) holds exp(F dt) and the covariance. exp(-F dt) grows, so that at h = 5 the
    # covariance has lost four digits of sixteen: no further.
    of = dryden(altitude, 7.7, 1.5)
    params = filters(of, V0, dt, ALL, 1)
    transition, added = params.transition, params.spread @ params.spread.T
    stationary = params.stationary @ params.stationary.T
    assert transition @ stationary @ transition.T + added == pytest.approx(stationary, abs=1e-14)
    if dt * V0 / of.length.min() < 5.0:
        F, G = continuous(of)
        double = expm(np.block([[-F, G @ G.T], [np.zeros((5, 5)), F.T]]) * dt)
        assert transition == pytest.approx(expm(F * dt), rel=1e-9, abs=1e-14)
        assert added == pytest.approx(double[5:, 5:].T @ double[:5, 5:], rel=1e-9, abs=1e-11)


@pytest.mark.parametrize("dt", [0.002, 0.02, 0.5])
@pytest.mark.parametrize("axis", ALL, ids=AXES)
def test_samples_are_correlated_as_published_whatever_the_step(axis: int, dt: float) -> None:
    params = filters(SMALL, V0, dt, ALL, 1)
    stationary = params.stationary @ params.stationary.T
    for lag in (0, 1, 7, 50):
        found = params.output @ np.linalg.matrix_power(params.transition, lag) @ stationary @ params.output.T
        assert found[axis, axis] == pytest.approx(float(correlation(np.array(lag * dt), axis, SMALL)), rel=1e-10, abs=1e-14)
        assert np.count_nonzero(np.round(found - np.diag(np.diag(found)), 15)) == 0  # axes are independent


@pytest.mark.parametrize("axis", ALL, ids=AXES)
def test_the_published_spectra_and_correlations_belong_together(axis: int) -> None:
    # What the ensemble below is held against: sigma^2 and the correlation are integrals of the spectrum over omega.
    for lag in (0.0, 0.3, 2.0):
        weight: dict[str, Any] = {"weight": "cos", "wvar": lag} if lag else {}
        total = quad(lambda omega: float(spectrum(omega, axis, SMALL)), 0.0, np.inf, limit=500, **weight)[0]
        assert total == pytest.approx(float(correlation(np.array(lag), axis, SMALL)), abs=1e-6)


# What is drawn, as an ensemble of seeds


SEEDS, STEPS = 300, 1024
RATES = (10.0, 50.0)  # Hz: at 10 Hz, half the spectrum of w near half the rate is folded back from beyond it


@pytest.fixture(scope="module", params=RATES, ids=lambda rate: f"{rate:g} Hz")
def seen(request: pytest.FixtureRequest) -> tuple[float, FloatArray]:
    """The step and the winds of the ensemble, shape (3, seeds, steps)."""
    dt = 1.0 / float(request.param)
    return dt, ensemble(SMALL, dt, SEEDS, STEPS)


def band(degrees: int, tests: int) -> tuple[float, float]:
    """Where chi-square over its degrees of freedom lies in 99 % of seeds, for all of so many tests together."""
    return float(chi2.ppf(0.005 / tests, degrees)) / degrees, float(chi2.ppf(1.0 - 0.005 / tests, degrees)) / degrees


def test_the_variance_is_that_asked_for_from_the_first_sample_to_the_last(seen: tuple[float, FloatArray]) -> None:
    # Seeds are independent: their sum of squares is chi-square, the band -25 % to +29 %. Both rates pass, so they agree too.
    _, winds = seen
    low, high = band(SEEDS, 9)
    for k in (0, STEPS // 2, STEPS - 1):
        ratio = np.mean(winds[:, :, k] ** 2, axis=1) / SMALL.sigma**2
        assert (ratio > low).all(), ratio
        assert (ratio < high).all(), ratio


def expected_periodogram(omega: FloatArray, dt: float, axis: int, of: Dryden, window: FloatArray) -> FloatArray:
    """What the mean of periodograms of samples tends to: aliases and the window's leakage in it, one-sided in omega.

    E |sum_k h_k w(k dt) exp(-i omega k dt)|^2 = sum_k (h * h)(k) R(k dt) cos(omega k dt)
    """
    lags: FloatArray = np.arange(1 - len(window), len(window), dtype=np.float64)
    weighted = np.correlate(window, window, "full") * correlation(lags * dt, axis, of)
    return np.asarray(np.cos(np.outer(omega, lags * dt)) @ weighted * dt / np.pi / np.sum(window**2))


def periodogram_ratio(seen: tuple[float, FloatArray], axis: int, of: Dryden) -> FloatArray:
    """Mean periodogram of the ensemble over that expected, at twelve frequencies from 1/50 of half the rate to 9/10 of it."""
    dt, winds = seen
    window: FloatArray = np.asarray(get_window("hann", STEPS), dtype=np.float64)
    bins = np.unique(np.round(np.geomspace(STEPS / 100, 0.45 * STEPS, 12)).astype(int))
    found = np.mean(np.abs(np.fft.rfft(winds[axis] * window, axis=1)[:, bins]) ** 2, axis=0) * dt / np.pi / np.sum(window**2)
    return np.asarray(found / expected_periodogram(2.0 * np.pi * bins / (STEPS * dt), dt, axis, of, window))


@pytest.mark.parametrize("axis", ALL, ids=AXES)
def test_the_spectrum_is_the_published_one_with_its_aliases(seen: tuple[float, FloatArray], axis: int) -> None:
    # Each bin of each seed is chi-square of two degrees of freedom: the band is -18 % to +20 %.
    low, high = band(2 * SEEDS, 12)
    ratio = periodogram_ratio(seen, axis, SMALL)
    assert ((ratio > low) & (ratio < high)).all(), ratio
    for factor in (0.7, 1.4):  # and it is no other: with L wrong by 40 % the estimate leaves the band
        other = periodogram_ratio(seen, axis, SMALL._replace(length=factor * SMALL.length))
        assert not ((other > low) & (other < high)).all()


def test_folded_to_infinity_the_published_spectrum_is_what_the_estimate_is_held_against() -> None:
    # sum over m of Phi(omega + 2 pi m / dt), with the tail beyond 2000 aliases as an integral; far from the window's leakage.
    dt, axis = 0.1, 2
    omega = np.array([3.0, 10.0, 25.0])
    m = np.arange(-2000, 2001)
    folded = np.sum(spectrum(np.abs(omega[:, None] + 2.0 * np.pi * m / dt), axis, SMALL), axis=1)
    T = SMALL.length[axis] / V0
    tail = 2.0 * SMALL.sigma[axis] ** 2 * 3.0 / (np.pi * T) * (dt / (2.0 * np.pi)) ** 2 / 2000.5
    expected = expected_periodogram(omega, dt, axis, SMALL, get_window("hann", 4096))
    assert folded + tail == pytest.approx(expected, rel=1e-3)
    assert folded[-1] > 1.5 * float(spectrum(omega[-1], axis, SMALL))  # aliasing matters


def test_no_axis_is_differentiable_and_so_turbulence_lies_outside_the_theorem() -> None:
    # A bounded derivative would give mean squares of increments in proportion to dt^2. They are in proportion to dt: 2 sigma^2
    # dt / T along the flight, 3 sigma^2 dt / T across it, so that the quotient grows without bound.
    for axis, slope in enumerate((2.0, 3.0, 3.0)):
        for dt in (1e-3, 1e-4, 1e-5):
            moved = 2.0 * (correlation(np.array(0.0), axis, SMALL) - correlation(np.array(dt), axis, SMALL))
            expected = slope * SMALL.sigma[axis] ** 2 * dt * V0 / SMALL.length[axis]
            assert float(moved) == pytest.approx(expected, rel=2e-3)
    fine = ensemble(SMALL, 1e-3, 100, 64)
    mean = np.mean(np.diff(fine, axis=2) ** 2, axis=(1, 2)) / SMALL.sigma**2 * SMALL.length / (1e-3 * V0)
    assert mean == pytest.approx([2.0, 3.0, 3.0], rel=0.1)  # 6300 increments, nearly independent: 1.8 % standard deviation


# Repeatability


def test_step_k_has_the_same_numbers_whatever_was_asked_before() -> None:
    whole = turbulence.normals(0, 300, 5)
    for first, count in ((0, 1), (63, 2), (64, 64), (130, 99), (299, 1)):
        assert (turbulence.normals(first, count, 5) == whole[first : first + count]).all()
    assert (turbulence.normals(0, 300, 6) != whole).all()


def turbulent(step_ms: float = 2.0, **values: Any) -> AircraftParameters:
    section = {"airframe": "osprey", "rate": 100.0, "step": step_ms / 1e3, "turbulence": {"altitude": 30.0, "wind": 7.7}}
    return AircraftParameters.validate_mapping(section | values, "aircraft")


def test_a_flight_meets_the_same_air_however_its_time_is_cut() -> None:
    parts, u = turbulent().plant(), np.array([0.01, 0.1, 0.0, 0.0])
    whole = plant.advance(0, plant.initial_state(parts), u, 400 * MS, parts)
    cut = plant.initial_state(parts)
    for k in range(40):
        cut = plant.advance(10 * k * MS, cut, u, 10 * MS, parts)
    assert cut.turbulence is not None
    assert whole.turbulence is not None
    assert cut.turbulence.tobytes() == whole.turbulence.tobytes()
    assert cut.x == pytest.approx(whole.x, abs=1e-14)  # the gust's instants are rounded differently
    first, second = Simulator(turbulent()), Simulator(turbulent())
    for number in range(20):
        for simulator in (first, second):
            simulator.sample(number, u)
        assert first.truth().tobytes() == second.truth().tobytes()


def test_numbers_from_elsewhere_may_take_the_place_of_the_seed() -> None:
    # As a campaign on other arrays does, which NumPy cannot draw for.
    parts, u = turbulent().plant(), np.zeros(4)
    assert parts.turbulence is not None
    state = plant.initial_state(parts)
    own = plant.advance(0, state, u, 20 * MS, parts)
    given_numbers = plant.advance(0, state, u, 20 * MS, parts, normals=turbulence.normals(0, 10, parts.turbulence.seed))
    assert own.x.tobytes() == given_numbers.x.tobytes()
    assert (plant.advance(0, state, u, 20 * MS, parts, normals=np.zeros((10, 5))).x != own.x).any()


def test_truth_shows_the_wind_that_acts_from_then_on_and_f_holds_it() -> None:
    parameters = turbulent(gusts={"vertical": {"start": 0.0, "speed": 2.0, "length": 2.5}})
    simulator, parts = Simulator(parameters), parameters.plant()
    air = parts.turbulence
    assert air is not None
    z = turbulence.initial_state(air)
    for number in range(3):
        simulator.sample(number, np.zeros(4))
        shown = dict(zip(simulator.truth_names, simulator.truth(), strict=True))
        winds = dict(zip(parameters.sampled_airframe().gusts, turbulence.wind(z, air), strict=True))
        gust = 1.0 - math.cos(math.pi * 0.01 * number * 25.0 / 2.5)
        assert shown["gust.lateral"] == winds["lateral"] != 0.0
        assert shown["gust.vertical"] == pytest.approx(winds["vertical"] + gust, rel=1e-12)
        assert shown["f.p"] == pytest.approx(3.13 / 25.0 * shown["gust.lateral"], rel=1e-12)
        for normal in turbulence.normals(5 * number, 5, 1):
            z = turbulence.step(z, normal, air)


def test_an_airframe_meets_the_axes_that_it_knows() -> None:
    # Each axis has its noise, known to the airframe or not.
    of = dryden(30.0, 7.7, 0.0)
    whole, lateral = filters(of, V0, 0.01, ALL, 1), filters(of, V0, 0.01, [AXES.index("lateral")], 1)
    assert (
        turbulence.wind(turbulence.initial_state(whole), whole)[1]
        == turbulence.wind(turbulence.initial_state(lateral), lateral)[0]
    )


def parts_of(section: dict[str, Any], airframe: str = "osprey") -> PlantParams:
    values = {"airframe": airframe, "rate": 100.0, "step": 0.002, "turbulence": section}
    return AircraftParameters.validate_mapping(values, "aircraft").plant()


def test_no_intensity_is_no_turbulence() -> None:
    assert parts_of({"altitude": 100.0, "wind": 0.0}).turbulence is None
    assert parts_of({"altitude": 400.0, "wind": 0.0, "sigma": 0.0}).turbulence is None
    assert isinstance(parts_of({"altitude": 400.0, "wind": 0.0, "sigma": 0.1}).turbulence, Turbulence)


@pytest.mark.parametrize(
    ("section", "sentence"),
    [
        ({"altitude": 3.0, "wind": 7.7}, r"turbulence\.altitude: found 3\.0, expected greater than or equal to 3\.048"),
        ({"altitude": 100.0}, r"turbulence\.wind: found none, expected a value at 100 m: it acts below 609\.6 m"),
        ({"altitude": 400.0, "wind": 7.7}, r"turbulence\.sigma: found none, expected a value at 400 m: it acts above 304\.8 m"),
        (
            {"altitude": 100.0, "wind": 7.7, "sigma": 1.0},
            r"turbulence\.sigma: found 1 m/s, expected none at 100 m: it acts above 304\.8 m",
        ),
        ({"altitude": 700.0, "wind": 7.7, "sigma": 1.0}, r"turbulence\.wind: found 7\.7 m/s, expected none at 700 m"),
        ({"altitude": 100.0, "wind": -1.0}, r"turbulence\.wind: found -1\.0, expected greater than or equal to 0"),
        ({"altitude": 100.0, "winds": 1.0}, r"turbulence\.winds: unknown key, expected wind perhaps"),
    ],
)
def test_turbulence_that_does_not_fit_is_refused_by_name(section: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError, match=f"^aircraft.{sentence}"):
        parts_of(section)


def test_an_airframe_without_gusts_takes_no_turbulence() -> None:
    with pytest.raises(
        ParameterError, match=r"^aircraft\.turbulence: found a section, expected none: the airframe f16_lateral has"
    ):
        parts_of({"altitude": 100.0, "wind": 7.7}, "f16_lateral")
