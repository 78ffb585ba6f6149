# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test noise, bias, drift, quantisation, dropout and transport delay of sensors.

The tests cover statistics, repeatability, and the effect on a flight.
"""

from typing import Any

import numpy as np
import pytest
from pytest import approx
from tests.builders import MS, aircraft_parameters
from tests.closed_loop import PROTOTYPE_SERVO

from aircraft_sim.sensors import (
    DelayLine,
    Sensors,
    has_arrived,
    initial_drift,
    measure,
    noise,
    transmit,
    walk,
)
from aircraft_sim.simulator import Simulator
from aircraft_sim.state_space_model import StateSpaceModel
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.vectors import FloatArray

pytestmark = pytest.mark.slow

NOISE = [0.0017, 0.03, 0.0017, 0.0017]
COUNT = 20_000  # samples


def sensors(std: list[float], delay_ms: int = 0, dropout: float = 0.0, seed: int = 1) -> Sensors:
    return Sensors(np.array(std), delay_ms * MS, dropout, seed)


@pytest.fixture(scope="module")
def samples() -> FloatArray:
    """Return COUNT samples of four channels with a standard deviation of 1."""
    return np.array([noise(k, sensors([1.0] * 4)) for k in range(COUNT)])


def test_noise_has_mean_zero_and_specified_variance(samples: FloatArray) -> None:
    # For N samples the standard deviation of the mean is 1/sqrt(N), that of the variance sqrt(2/N).
    # Four of these hold in 99.95 % of seeds for four channels of mean and variance together. The
    # seed is fixed: the test is deterministic.
    assert np.abs(samples.mean(axis=0)).max() < 4.0 / np.sqrt(COUNT)
    assert np.abs(samples.var(axis=0) - 1.0).max() < 4.0 * np.sqrt(2.0 / COUNT)
    assert (np.array([noise(k, sensors(NOISE)) for k in range(5)]) == samples[:5] * NOISE).all()


def test_noise_of_sample_k_depends_on_seed_and_not_on_earlier_calls() -> None:
    params = sensors(NOISE)
    first = noise(1234, params)
    for k in (7, 3, 99):
        noise(k, params)
        has_arrived(k, params._replace(dropout=0.5))
    assert (noise(1234, params) == first).all()
    assert (noise(1234, params._replace(seed=2)) != first).all()


def test_channel_without_noise_exact_and_does_not_change_others() -> None:
    some = noise(5, sensors([0.0, 0.03, 0.0017, 0.0017]))
    assert some[0] == 0.0
    assert (some[1:] == noise(5, sensors(NOISE))[1:]).all()
    assert (noise(5, sensors([0.0] * 4)) == 0.0).all()


@pytest.mark.parametrize("dropout", [0.05, 0.2, 0.5])
def test_fraction_of_dropped_samples_is_specified_one(dropout: float) -> None:
    lost = np.array([not has_arrived(k, sensors(NOISE, dropout=dropout)) for k in range(COUNT)])
    # Four standard deviations of a fraction.
    tolerance = 4.0 * np.sqrt(dropout * (1.0 - dropout) / COUNT)
    assert lost.mean() == approx(dropout, abs=tolerance)
    # Dropouts are independent: the fraction of two in a row is dropout^2.
    assert (lost[1:] & lost[:-1]).mean() == approx(dropout**2, abs=tolerance)


def test_delay_shifts_arrival_by_whole_samples_and_keeps_stamp() -> None:
    params = sensors(NOISE, delay_ms=4)
    delay_line: DelayLine = ()
    history = []
    for k in range(5):
        delay_line, arrived = transmit(delay_line, 2 * k * MS, np.array([float(k)]), params)
        history.append([(sample.stamp_ns // MS, float(sample.value[0])) for sample in arrived])
    assert history == [[], [], [(0, 0.0)], [(2, 1.0)], [(4, 2.0)]]


def test_dropped_sample_never_arrives_and_delays_no_other() -> None:
    params = sensors(NOISE, delay_ms=2)
    delay_line, _ = transmit((), 0, np.array([0.0]), params)
    delay_line, arrived = transmit(delay_line, 2 * MS, None, params)
    assert [sample.stamp_ns for sample in arrived] == [0]
    delay_line, arrived = transmit(delay_line, 4 * MS, np.array([2.0]), params)
    assert arrived == ()


def test_after_missed_ticks_due_samples_arrive_together_oldest_first() -> None:
    params = sensors(NOISE, delay_ms=2)
    delay_line, _ = transmit((), 0, np.array([0.0]), params)
    delay_line, _ = transmit(delay_line, MS, np.array([1.0]), params)
    delay_line, arrived = transmit(delay_line, 9 * MS, np.array([9.0]), params)
    assert [sample.stamp_ns for sample in arrived] == [0, MS]
    assert [sample.stamp_ns for sample in delay_line] == [9 * MS]


def test_sample_is_output_with_noise_or_dropped() -> None:
    parameters = aircraft_parameters(step=0.01, sensors={"noise": NOISE, "dropout": 0.5})
    simulator = Simulator(parameters)
    model = StateSpaceModel(parameters)
    u = np.array([0.01, 0.1, 0.02, 0.03])
    arrivals = []
    for k in range(20):
        arrived = simulator.sample(k, u)
        if k:
            model.advance((k - 1) * 10 * MS, u, 10 * MS)
        error = noise(k, parameters.sensor_arrays())
        assert (simulator.truth()[-4:] == error).all()
        arrivals.append(len(arrived))
        for sample in arrived:
            assert sample.stamp_ns == k * 10 * MS
            assert (sample.value == model.y() + error).all()
    assert set(arrivals) == {0, 1}


def test_errors_add_up_and_quantisation_comes_last() -> None:
    y = np.array([0.1234, -0.1234, 0.1234, 20.0])
    params = sensors([0.01] * 4)._replace(
        bias=np.array([0.2, -0.3, 0.0, 0.0]),
        drift=np.array([0.1, 0.1, 0.0, 0.1]),
        quantum=np.array([0.0, 0.05, 0.05, 0.5]),
    )
    drift = walk(6, initial_drift(params), params)
    measured = measure(7, y, drift, params)
    analog = y + params.bias + walk(7, drift, params).value + noise(7, params)
    assert measured.y[0] == approx(analog[0], abs=1e-15)
    assert measured.y[1:] == approx(
        [0.05, 0.05, 0.5] * np.round(analog[1:] / [0.05, 0.05, 0.5]), abs=1e-15
    )
    assert np.abs(measured.y - analog).max() <= 0.25  # half a step
    assert measured.error == approx(measured.y - y, abs=1e-15)


def test_quantisation_rounds_to_nearest_step_and_halves_to_even() -> None:
    params = sensors([0.0] * 6)._replace(quantum=np.full(6, 0.25))
    y = np.array([0.1, 0.125, 0.375, -0.1, -0.2, 0.3])  # 0.125 and 0.375 are exact halves
    assert measure(0, y, initial_drift(params), params).y.tolist() == [
        0.0,
        0.0,
        0.5,
        -0.0,
        -0.25,
        0.25,
    ]


def test_variance_of_drift_grows_with_time_at_any_rate() -> None:
    # 0.2 SI per sqrt(s) gives variance 0.04 t. 400 walks at two rates: chi-square of 400 has a
    # standard deviation of 7 %; the limit of four of them holds in 99.99 % of seeds.
    for rate, samples in ((10.0, 20), (40.0, 80)):
        params = aircraft_parameters(
            rate=rate, step=0.005, sensors={"drift": [0.2, 0.0, 0.4, 0.0]}
        ).sensor_arrays()
        ends = np.array(
            [
                walk(samples, initial_drift(params), params._replace(seed=seed)).value
                for seed in range(400)
            ]
        )
        variance = np.mean(ends**2, axis=0)
        assert variance[[0, 2]] == approx([0.04 * 2.0, 0.16 * 2.0], rel=0.28)
        assert (variance[[1, 3]] == 0.0).all()


# Flights of osprey_servo. With aircraft and controller both at 100 Hz a dropped sample is a missed
# tick. The expected figures are those of the prototype of the gains: softened sign, width 3 (lag +
# 1.5 dt).


@pytest.fixture(scope="module")
def servo() -> Scenario:
    slow = {"rate": 100.0}
    controller = {"delay": 0.0, "softening": 3.0}
    return PROTOTYPE_SERVO.vary(
        aircraft=slow | {"step": 0.005}, reference_model=slow, controller=controller
    )


def with_sensors(scenario: Scenario, **sensors: Any) -> Scenario:
    return scenario.vary(aircraft={"sensors": scenario.aircraft.sensors.model_dump() | sensors})


def test_truth_holds_whole_error_of_sensors_with_every_fault(servo: Scenario) -> None:
    faults = {
        "bias": [0.01, 0.5, 0.0, -0.01],
        "drift": [1e-3, 0.0, 1e-3, 1e-3],
        "quantisation": [1e-3, 0.0, 1e-3, 5e-4],
    }
    tape = simulate(with_sensors(servo, dropout=0.3, **faults).vary(flight={"duration": 2.0}))
    y = tape["y"]
    truth = tape["truth"]
    at = np.searchsorted(truth.stamp_ns, y.stamp_ns)
    for name in y.names:
        assert y[name] == approx(truth[f"x.{name}"][at] + truth[f"noise.{name}"][at], abs=1e-15)
    # The bias; the noise is 0.03 over 200 samples.
    assert np.mean(truth["noise.V"]) == approx(0.5, abs=0.01)
    assert y["q"] / 1e-3 == approx(np.round(y["q"] / 1e-3), abs=1e-9)
    again = simulate(with_sensors(servo, dropout=0.3, **faults).vary(flight={"duration": 2.0}))
    assert again["truth"].values.tobytes() == truth.values.tobytes()
