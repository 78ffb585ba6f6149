# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Vanes: what they read, icing and loss, and the filter with them.

What a still vane leaves, flights and refusals are tested too.
"""

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import solve_discrete_are
from tests.builders import aircraft_parameters, rms, truth_of

from aircraft_sim import vanes
from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.simulator import Simulator
from control_laws.observer_design import (
    Names,
    Weights,
    aircraft_correction,
    aircraft_model,
    vane_correction,
)
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.summary import vane_notes
from flight_analysis.report.tables import events
from flight_core.parameters import ParameterError
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from flight_design.gains.observer_selection import model_for
from rise_di_controller.extensions.observer import VaneObserverState, correct, without_frozen
from rise_di_controller.law.control_law import Measurements

SHIPPED = find_scenario("osprey_vanes")
# y at the rate of the law: a third of the time of the shipped one.
SHORT = SHIPPED.vary(
    flight={"duration": 12.0},
    aircraft={"rate": 100.0, "step": 0.005},
    reference_model={"rate": 100.0},
)


def with_vanes(**values: Any) -> Scenario:
    return SHORT.vary(aircraft={"vanes": SHORT.aircraft.vanes.model_dump() | values})


@cache
def frozen() -> tuple[Scenario, Tape]:
    """A flight in which the vane of alpha freezes at 4 s."""
    scenario = with_vanes(frozen_at=[4.0, np.inf])
    return scenario, simulate(scenario)


# The aircraft


def test_vane_reads_angle_relative_to_air() -> None:
    # AIR_STATE of docs/topics.md: alpha less the wind down over V0, beta less the wind to the
    # right over V0.
    gusts = {
        "vertical": {"start": 0.0, "speed": 5.0, "length": 5.0},
        "lateral": {"start": 0.0, "speed": -3.0, "length": 8.0},
    }
    turbulent = {"altitude": 100.0, "wind": 7.7}
    result = aircraft_parameters(
        vanes={"channels": ["beta", "alpha"]}, gusts=gusts, turbulence=turbulent
    )
    simulator = Simulator(result)
    assert simulator.outputs == ("q", "V", "p", "r", "beta", "alpha")
    speed = load_airframe("osprey").speed
    for number in range(30):
        (sample,) = simulator.sample(number, np.array([0.02, 0.0, 0.01, 0.0]))
        true = truth_of(simulator)
        air = [
            true["x.beta"] - true["gust.lateral"] / speed,
            true["x.alpha"] - true["gust.vertical"] / speed,
        ]
        assert_allclose(sample.value[4:], air, atol=1e-15)


def test_vane_of_jsbsim_reads_its_air_angles() -> None:
    simulator = Simulator(
        SHORT.aircraft.validate_mapping(
            {
                "airframe": "jsbsim:c172p",
                "speed": 50.0,
                "altitude": 1000.0,
                "rate": 50.0,
                "step": 0.01,
            }
            | {"vanes": {"channels": ["alpha"]}},
            "aircraft",
        )
    )
    simulator.sample(0, np.zeros(4))
    for number in range(1, 10):
        (sample,) = simulator.sample(number, np.array([-0.05, 0.0, 0.0, 0.0]))
    assert sample.value[4] == truth_of(simulator)["x.alpha"] != 0.0


def test_frozen_vane_keeps_its_angle_and_lost_reading_repeats_one_before() -> None:
    params = vanes.Vanes([0, 1], np.array([0.5, np.inf]), 0.3, 1)
    state = vanes.initial_state(params)
    readings = []
    for number in range(1000):
        state = vanes.turned(0.001 * number, np.array([1.0, 2.0]) * number, state, params)
        state = vanes.read_vanes(number, state.angle, state, params)
        readings.append(state.reading)
    alpha, beta = np.array(readings).T
    assert alpha[-1] == 499.0  # of the last sample before 0.5 s
    repeated = np.mean(np.diff(beta) == 0.0)
    assert abs(repeated - 0.3) < 0.05  # three standard deviations of 1000 draws


def test_a_vane_freezes_in_flight() -> None:
    result = aircraft_parameters(vanes={"channels": ["alpha"]})
    simulator = Simulator(result)
    u = np.array([0.05, 0.0, 0.0, 0.0])
    contents = [simulator.sample(number, u)[0].value[4] for number in range(20)]
    simulator.retune(
        result.validate_mapping(
            result.model_dump() | {"vanes": {"channels": ["alpha"], "frozen_at": [0.2]}}, ""
        )
    )
    after = [simulator.sample(number, u)[0].value[4] for number in range(20, 30)]
    assert contents[-1] != contents[-2]
    assert set(after) == {contents[-1]}


# The observer


def test_gain_with_vane_is_that_of_the_stationary_filter() -> None:
    controller = SHIPPED.rise_di()
    airframe = load_airframe("osprey")
    model = model_for(airframe, controller, np.array([0.0017, 0.0017, 0.0017, 0.03]))
    names = Names(
        tuple(airframe.states), controller.inputs, controller.outputs, tuple(airframe.gusts)
    )
    T = model.total_lag
    weights = Weights(
        effort=T,
        drift=0.4 * T,
        gust=np.full(3, 0.5),
        wind_time=np.full(3, 4.0),
        loose=np.array([0.01]),
    )
    sampled = aircraft_model(model, names, weights.wind_time)
    row = np.array(
        [1.0 * (name == "x.alpha") - 0.04 * (name == "wind.vertical") for name in sampled.states]
    )
    result = vane_correction(sampled, model, (weights, weights), row, 0.0035)
    L = np.column_stack([aircraft_correction(sampled, model, weights), np.zeros(len(row))]) + result
    # The same filter by scipy.
    H = np.vstack([sampled.H, row])
    noise = np.diag(np.append(model.noise, 0.0035) ** 2)
    size = [
        weights.loose * model.size,
        np.full(4, 1e-6),
        weights.gust,
        weights.drift * (model.C @ model.size),
    ]
    S = solve_discrete_are(
        sampled.Phi.T, H.T, np.diag(np.concatenate(size) ** 2 * model.period), noise
    )
    assert_allclose(L, S @ H.T @ np.linalg.inv(H @ S @ H.T + noise), rtol=1e-6, atol=1e-9)


def test_still_vane_is_left_out_and_moving_vane_corrects() -> None:
    params = SHIPPED.controller.tuned_law().params
    assert params.vanes is not None
    s = len(params.Phi)
    generator = np.random.default_rng(1)
    z = generator.standard_normal(s)
    e = generator.standard_normal(4)
    reading = np.array([0.1, -0.2])
    zero = np.zeros(4)
    measured = Measurements(
        y=e, y_m=zero, y_m_dot=zero, u_trim=zero, u_before=zero, vane=reading, vane_m=np.zeros(2)
    )
    none = np.zeros(2)

    def corrected(square: FloatArray, frozen: list[bool]) -> FloatArray:
        state = VaneObserverState(
            law=None,
            z=z,
            u_o=np.zeros(4),
            sigma=np.zeros(1),
            vane_mean=reading,
            vane_square=square,
            vane_measures=none,
        )
        return np.asarray(
            correct(state, measured, np.float64(0.01), without_frozen(params, frozen)).z
        )

    single = z + params.L @ (e - params.H @ z)
    assert_array_equal(corrected(none, [False, False]), corrected(np.ones(2), [True, True]))
    assert_allclose(corrected(none, [False, False]), single, rtol=1e-12)
    one = np.append(e - params.H @ z, (reading - params.vanes.H @ z)[1])
    assert_allclose(
        corrected(np.ones(2), [True, False]),
        single + params.vanes.L[1] @ one,
        rtol=1e-12,
        atol=1e-12,
    )


# Flights


def test_vanes_lower_errors_in_turbulence_and_flight_replays() -> None:
    tape = simulate(SHORT)
    single = rms(simulate(SHORT.vary(controller=SHORT.controller.without_vanes().model_dump())))
    # Measured 0.79 in q in 12 s of moderate turbulence; 200 aircraft in
    # docs/evidence/tables/laws-vanes.csv.
    assert rms(tape)[0] < 0.9 * single[0]
    replayed = replay(tape)
    assert replayed.is_equal()
    assert replayed.checked.all()


def test_frozen_vane_is_left_out_and_told() -> None:
    _, tape = frozen()
    measures = tape["internals"].group("vane_measures")
    t = tape.time("internals")
    assert measures["alpha"][t > 9.0].max() == 0.0  # five time constants later
    assert measures["beta"][t > 3.0].min() == 1.0
    (event,) = (event for event in events(tape, {}) if event.name.startswith("vane"))
    assert event.name == "vane alpha stands still: left out"
    assert event.start > 4.0
    assert vane_notes(tape)[0].startswith("vane alpha stands still from t = ")
    assert replay(tape).is_equal()


# Refusals


@pytest.mark.parametrize(
    "changes, sentence",
    [
        (
            {"aircraft": {"vanes": {}, "sensors": {}}},
            "controller.observer.vanes.channels: found alpha, beta, expected",
        ),
        (
            {"aircraft": {"vanes": {"channels": ["alpha"], "frozen_at": [1.0, 2.0]}}},
            "aircraft.vanes.frozen_at: found 2 values",
        ),
    ],
)
def test_vanes_that_do_not_fit_are_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError) as error:
        SHIPPED.vary(**changes)
    assert str(error.value).startswith(sentence), str(error.value)
