# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test actuators and their faults against closed forms.

The actuators have dead zones, lags, and saturation of rate and position.
"""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax import enable_x64
from jax import numpy as jnp
from pytest import approx
from scipy.integrate import solve_ivp
from tests.builders import MS, aircraft_parameters, rms
from tests.closed_loop import PROTOTYPE_SERVO, error

from aircraft_sim.plant import plant
from aircraft_sim.plant.actuators import Actuators, move, step
from aircraft_sim.plant.dynamics import x_dot
from aircraft_sim.plant.plant import AircraftState, PlantParams, advance
from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.integrators import rk4
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_core.vectors import FloatArray

pytestmark = pytest.mark.slow

SIX = Actuators(  # ideal, lag, rate limit, lag and rate limit, end stops, all
    lag=np.array([0.0, 0.1, 0.0, 0.1, 0.0, 0.1]),
    lower=np.array([-np.inf, -np.inf, -np.inf, -np.inf, -0.5, -0.05]),
    upper=np.array([np.inf, np.inf, np.inf, np.inf, 0.5, 0.05]),
    rate=np.array([np.inf, np.inf, 2.0, 2.0, np.inf, 2.0]),
)


def actuator(
    lag: float = 0.0, lower: float = -math.inf, upper: float = math.inf, rate: float = math.inf
) -> Actuators:
    return Actuators(*(np.array([value]) for value in (lag, lower, upper, rate)))


def positions(
    commands: list[float], dt: float, params: Actuators, start: float = 0.0
) -> list[float]:
    position = np.array([start])
    history = []
    for command in commands:
        position = step(position, np.array([command]), np.array(dt), params)
        history.append(float(position[0]))
    return history


def osprey(step_ms: float = 2.0, **actuators: Any) -> PlantParams:
    return aircraft_parameters(step=step_ms / 1e3, actuators=actuators).plant()


@given(position=st.floats(-1e3, 1e3), command=st.floats(-1e3, 1e3), dt=st.floats(1e-4, 0.1))
def test_ideal_actuator_passes_command_on_to_last_bit(
    position: float, command: float, dt: float
) -> None:
    assert positions([command], dt, actuator(), start=position) == [command]


@pytest.mark.parametrize("dt", [0.001, 0.01, 0.05])
def test_step_response_is_exact_first_order_response_for_any_dt(dt: float) -> None:
    # p(t) = c (1 - exp(-t / lag)): no error of integration, only rounding.
    history = positions([0.3] * 20, dt, actuator(lag=0.02))
    assert history == approx(
        [0.3 * (1.0 - math.exp(-dt * (k + 1) / 0.02)) for k in range(20)], rel=1e-13
    )


def test_rate_limit_gives_straight_ramp_that_ends_on_command() -> None:
    # 2 /s over 0.1 s: 0.2 a step, the last one only as far as the command
    assert positions([0.7] * 5, 0.1, actuator(rate=2.0)) == approx(
        [0.2, 0.4, 0.6, 0.7, 0.7], abs=1e-15
    )
    assert positions([-0.7] * 5, 0.1, actuator(rate=2.0)) == approx(
        [-0.2, -0.4, -0.6, -0.7, -0.7], abs=1e-15
    )


def test_position_saturation_does_not_wind_up() -> None:
    # The position leaves the stop at once: the position, not the command, is the state.
    assert positions([9.0, 9.0, -0.1, -9.0], 0.1, actuator(lower=-0.3, upper=0.5)) == [
        0.5,
        0.5,
        -0.1,
        -0.3,
    ]


def test_lag_comes_before_rate_limit_and_end_stop_last() -> None:
    # Command 1 from 0 over 0.1 s: the lag alone would reach 1 - 1/e = 0.632, the rate allows 0.2,
    # the stop 0.05.
    after = step(np.zeros(6), np.ones(6), np.array(0.1), SIX)
    assert after == approx([1.0, 1.0 - math.exp(-1.0), 0.2, 0.2, 0.5, 0.05], abs=1e-15)
    # Close to the command the lag is slower than the rate limit: 0.1 (1 - 1/e) = 0.063 < 0.2.
    assert step(np.zeros(6), np.full(6, 0.1), np.array(0.1), SIX)[3] == approx(
        0.1 * (1.0 - math.exp(-1.0)), abs=1e-15
    )


def test_dead_zone_gives_zero_inside_and_excess_outside() -> None:
    # Input = c - clip(c, -w, w), w = 0.1.
    params = Actuators(dead_zone=np.array([0.1]))
    commands = [0.0, 0.05, 0.1, 0.3, -0.1, -0.25]
    assert positions(commands, 0.01, params) == approx([0.0, 0.0, 0.0, 0.2, 0.0, -0.15], abs=1e-16)


@given(command=st.floats(-1.0, 1.0), further=st.floats(0.0, 1e-3), width=st.floats(0.0, 0.5))
def test_dead_zone_has_no_jump_and_never_reverses_command(
    command: float, further: float, width: float
) -> None:
    first, second = positions(
        [command, command + further], 0.01, Actuators(dead_zone=np.array([width]))
    )
    assert -1e-15 <= second - first <= further + 1e-15
    assert first * command >= 0.0
    assert abs(first) <= abs(command)


def position_history(times_ms: range, command: float, **actuators: Any) -> FloatArray:
    """Return the positions of the four actuators 10 ms after each of the given instants.

    All four have the same command.
    """
    params = osprey(10.0, **actuators)
    state = plant.initial_state(params)
    history = []
    for t in times_ms:
        state = advance(t * MS, state, np.full(4, command), 10 * MS, params)
        history.append(state.position)
    return np.array(history)


def test_stuck_surface_stays_where_it_is_from_instant_on() -> None:
    # Lag 20 ms, elevator stuck at 50 ms: it moves normally until then and keeps its position.
    lag = [0.02] * 4
    healthy = position_history(range(0, 100, 10), 0.2, lag=lag)
    stuck = position_history(range(0, 100, 10), 0.2, lag=lag, faults=["elevator stuck 0.05"])
    assert (stuck[:, 1:] == healthy[:, 1:]).all()
    assert (stuck[:5, 0] == healthy[:5, 0]).all()
    assert (stuck[5:, 0] == healthy[4, 0]).all()
    assert stuck[-1, 0] == approx(0.2 * (1.0 - math.exp(-2.5)))


def test_lost_surface_is_in_trim_from_instant_on_even_if_it_was_stuck() -> None:
    lost = position_history(
        range(0, 80, 10),
        0.2,
        faults=[
            "elevator lost 0.05",
            "rudder lost 0.06",
            "aileron stuck 0.03",
            "rudder stuck 0.03",
        ],
    )
    assert lost[:, 0].tolist() == [0.2] * 5 + [0.0] * 3
    assert lost[:, 3].tolist() == [0.2] * 6 + [0.0] * 2
    # One healthy, one stuck where it was commanded.
    assert lost[:, 1:3].tolist() == [[0.2, 0.2]] * 8


def test_fault_within_step_acts_from_next_step_on() -> None:
    lost = position_history(
        range(0, 40, 10), 0.2, faults=["elevator lost 0.015", "thrust failed 0.015"]
    )
    assert lost[:, 0].tolist() == [0.2, 0.2, 0.0, 0.0]
    assert lost[:, 1].tolist() == [0.2, 0.2, -0.5, -0.5]


def test_lost_aileron_acts_like_zero_column_of_b() -> None:
    params = osprey(faults=["aileron lost 0"])
    u = np.array([0.01, 0.1, -0.02, 0.03])
    without = osprey()
    without = without._replace(
        aircraft=without.aircraft._replace(B=without.aircraft.B * [1.0, 1.0, 0.0, 1.0])
    )
    actual, expected = (
        advance(0, plant.initial_state(each), u, 500 * MS, each).x for each in (params, without)
    )
    assert (actual == expected).all()


@pytest.mark.parametrize("part, thrust", [(0.5, 0.35), (0.0, 0.0), (1.0, 0.7), (-1.0, -0.7)])
def test_weak_engine_gives_a_part_of_its_whole_thrust(part: float, thrust: float) -> None:
    """Thrust is 0.5 in trim, and the command adds 0.2. Without any effect, the engine is lost."""
    params = osprey(faults=[f"thrust weak 0 {part}"]).actuators
    _, mean = move(0.0, np.zeros(4), np.array([0.0, 0.2, 0.0, 0.0]), 0.01, params)
    assert 0.5 + mean[1] == approx(thrust, abs=1e-15)
    assert mean[[0, 2, 3]].tolist() == [0.0] * 3


def test_slow_surface_has_lag_of_fault_from_instant_on() -> None:
    # From 50 ms on at 0.2 (1 - exp(-2.5)) with a lag of 0.2 s; the thrust, which has 1 s, stays as
    # it is.
    lag = [0.02, 1.0, 0.02, 0.02]
    faults = ["elevator slow 0.05", "thrust slow 0.05"]
    slow = position_history(range(0, 100, 10), 0.2, lag=lag, faults=faults)
    healthy = position_history(range(0, 100, 10), 0.2, lag=lag)
    assert (slow[:5] == healthy[:5]).all()
    assert (slow[:, 1:] == healthy[:, 1:]).all()
    assert slow[-1, 0] == approx(0.2 * (1.0 - math.exp(-2.5) * math.exp(-0.05 / 0.2)))


def test_runaway_takes_travel_over_rate_to_its_stop_whatever_is_commanded() -> None:
    """The elevator moves at 2 rad/s from 0.1 rad at 0.02 s to the lower stop of -0.3 rad.

    This takes 0.4 / 2 = 0.2 s behind any lag. The mean over a step of this motion is the mean of
    its ends.
    """
    params = osprey(
        lag=[0.05] * 4,
        rate=[2.0] * 4,
        lower=[-0.3] * 4,
        upper=[0.3] * 4,
        faults=["elevator hard_over 0.02 lower", "aileron hard_over 0 upper"],
    ).actuators
    position = np.array([0.1, 0.0, 0.0, 0.0])
    command = np.array([0.1, 0.0, -0.2, 0.0])
    history = []
    means = []
    for k in range(30):
        position, mean = move(0.01 * k, position, command, 0.01, params)
        history.append(position)
        means.append(mean)
    t = 0.01 * np.arange(1, 31)
    expected = np.maximum(0.1 - 2.0 * np.maximum(t - 0.02, 0.0), -0.3)
    assert np.array(history)[:, 0] == approx(expected, abs=1e-12)
    assert np.array(means)[2:20, 0] == approx(expected[2:20] + 0.01, abs=1e-12)
    assert np.array(history)[:, 2] == approx(np.minimum(2.0 * t, 0.3), abs=1e-12)
    assert np.array(history)[:, 3].tolist() == [0.0] * 30


def test_runaway_without_a_rate_limit_is_at_its_stop_at_once() -> None:
    result = position_history(
        range(0, 30, 10), 0.0, upper=[0.3] * 4, faults=["rudder hard_over 0.01 upper"]
    )
    assert result[:, 3].tolist() == [0.0, 0.3, 0.3]


def test_loose_surface_follows_play_operator() -> None:
    # Half-width 0.1: the position stays while the command is within 0.1 of it, and trails it by 0.1
    # otherwise.
    params = Actuators(loose_at=np.array([1.0]), loose_play=np.array([0.1]))
    position = np.zeros(1)
    history = []
    for t, command in ((0.0, 0.05), (1.0, 0.1), (1.0, 0.3), (1.0, 0.15), (1.0, 0.05), (1.0, -0.2)):
        position, _ = move(t, position, np.array([command]), 0.01, params)
        history.append(float(position[0]))
    assert history == approx([0.05, 0.05, 0.2, 0.2, 0.15, -0.1])


def test_drift_ends_as_the_drifted_aircraft() -> None:
    ice = aircraft_parameters(drift={"start": 1.0, "duration": 2.0, "A": 0.3, "B": 0.2})
    after = plant.aircraft_at(3000 * MS, ice.plant())
    before = ice.plant().aircraft
    airframe = ice.drifted_airframe()
    expected = (airframe.matrix_a(), airframe.matrix_b(), airframe.matrix_gusts())
    for matrix, first, last in zip(
        ("A", "B", "gust_direction"),
        (before.A, before.B, before.gust_direction),
        expected,
        strict=True,
    ):
        assert getattr(after, matrix) == approx(last)
        assert getattr(plant.aircraft_at(2000 * MS, ice.plant()), matrix) == approx(
            (first + last) / 2.0
        )
        assert (getattr(plant.aircraft_at(1000 * MS, ice.plant()), matrix) == first).all()
    # Wind acts by the aircraft's own A.
    assert not np.allclose(after.gust_direction, before.gust_direction)


@given(
    st.lists(st.floats(-10, 10), min_size=1, max_size=30),
    st.floats(0, 1),
    st.floats(0.01, 100),
    st.floats(0.01, 1),
)
def test_rate_and_stops_hold_for_any_command(
    commands: list[float], lag: float, rate: float, stop: float
) -> None:
    history = np.array([0.0, *positions(commands, 0.01, actuator(lag, -stop, stop, rate))])
    assert np.abs(history).max() <= stop
    assert np.abs(np.diff(history)).max() <= rate * 0.01 * (1.0 + 1e-9) + 1e-15


def test_scenario_without_actuators_integrates_command_to_last_bit() -> None:
    params = osprey()
    u = np.array([0.01, 0.1, -0.02, 0.03])
    x: FloatArray = np.linspace(-0.1, 0.1, 8)
    state = advance(0, AircraftState(x, np.zeros(4)), u, 10 * MS, params)
    for k in range(5):
        x = rk4(x_dot, k * 2 * MS / NANOSECONDS, x, u, params.aircraft, 0.002)
    assert (state.x == x).all()
    assert (state.position == u).all()


@pytest.mark.parametrize("every", [1, 2])
def test_late_command_acts_as_that_command_given_later(every: int) -> None:
    """A late command is equal to the last bit to the same command given later.

    Every second sample may be left out. u is then held over two periods.
    """
    scenario = find_scenario("osprey_servo")
    periods = 3
    late = {"actuators": scenario.aircraft.actuators.model_dump() | {"delay": 0.006}}
    delayed = Simulator(scenario.vary(aircraft=late).aircraft)
    at_once = Simulator(scenario.aircraft)
    # Over the periods 0 and 1, 2 and 3, ...
    held = np.repeat(0.1 * np.random.default_rng(1).normal(size=(20, 4)), 2, axis=0)
    shifted = np.vstack([np.zeros((periods, 4)), held])
    y = {k: at_once.sample(k, shifted[k - 1])[0].value for k in range(1, 41)}
    for k in range(every, 41, every):
        np.testing.assert_array_equal(delayed.sample(k, held[k - 1])[0].value, y[k])


# Mean positions, against the continuous actuator p_dot = clip((input - p) / lag, -rate, rate)
# between its end stops.


def continuous(
    commands: list[float], tick: float, lag: float, rate: float, stop: float
) -> FloatArray:
    """Return the integral of the continuous actuator's position at the ends of the ticks.

    It is from SciPy's integrator.
    """

    def rates(_: float, state: FloatArray, command: float) -> list[float]:
        p_dot = min(max((command - state[0]) / lag, -rate), rate)
        return [
            0.0 if p_dot * state[0] > 0.0 and abs(state[0]) >= stop else p_dot,
            min(max(state[0], -stop), stop),
        ]

    state = np.zeros(2)
    history = []
    for command in commands:
        # The largest step bounds the overshoot of a stop: rate or command / lag times 1e-4 s.
        result = solve_ivp(
            rates, (0.0, tick), state, args=(command,), max_step=1e-4, rtol=1e-8, atol=1e-11
        )
        state = np.array([min(max(result.y[0, -1], -stop), stop), result.y[1, -1]])
        history.append(state[1])
    return np.array(history)


def travelled(commands: list[float], tick: float, dt: float, params: Actuators) -> FloatArray:
    """Return the same integral from mean positions over steps of dt."""
    position = np.zeros(1)
    total = 0.0
    history = []
    for command in commands:
        for _ in range(round(tick / dt)):
            position, mean = move(0.0, position, np.array([command]), dt, params)
            total += dt * float(mean[0])
        history.append(total)
    return np.array(history)


COMMANDS = (0.2 * np.random.default_rng(1).normal(size=30)).tolist()


@pytest.mark.parametrize(
    "rate, stop",
    [(2.0, math.inf), (math.inf, 0.1), (2.0, 0.1)],
    ids=["rate limit", "end stops", "both"],
)
def test_mean_position_at_limit_is_right_to_second_order(rate: float, stop: float) -> None:
    exact = continuous(COMMANDS, 0.05, 0.02, rate, stop)
    params = actuator(0.02, -stop, stop, rate)
    errors = [np.abs(travelled(COMMANDS, 0.05, dt, params) - exact).max() for dt in (0.01, 0.00125)]
    # An eighth of dt: a 64th of the error at second order, an eighth at first. The instants at
    # which limits begin and cease to act fall anywhere in their steps, so that each halving alone
    # scatters.
    assert errors[1] < errors[0] / 16.0
    # Measured 2e-6 to 3e-6; the positions at the ends of the steps give 7e-5 to 1.4e-4.
    assert errors[1] < 5e-6


def test_mean_positions_of_fleet_are_those_of_each_aircraft() -> None:
    position = np.linspace(-0.04, 0.04, 12).reshape(6, 2)
    command = np.linspace(0.3, -0.3, 12).reshape(6, 2)
    columns = Actuators(*(None if value is None else value[:, None] for value in SIX))
    with enable_x64():
        together = move(0.0, jnp.asarray(position), jnp.asarray(command), 0.01, columns)
    for k in range(2):
        apart = move(0.0, position[:, k], command[:, k], 0.01, SIX)
        for whole, part in zip(together, apart, strict=True):
            assert np.asarray(whole)[:, k] == approx(part, abs=1e-15)


def test_plant_behind_lag_follows_continuous_model_to_second_order() -> None:
    # Against SciPy's integrator of lags and plant together, with u held.
    u = np.array([0.02, 0.0, 0.03, 0.01])
    lag = np.array([0.02, 0.1, 0.02, 0.02])
    params = osprey()

    def rates(t: float, state: FloatArray) -> FloatArray:
        x = state[:8]
        position = state[8:]
        return np.concatenate([x_dot(t, x, position, params.aircraft), (u - position) / lag])

    exact = solve_ivp(rates, (0.0, 0.1), np.zeros(12), method="DOP853", rtol=1e-12, atol=1e-14).y[
        :8, -1
    ]
    runs = [
        advance(0, plant.initial_state(osprey()), u, 100 * MS, osprey(ms, lag=lag.tolist())).x
        for ms in (5.0, 2.5)
    ]
    errors = [np.abs(x - exact).max() for x in runs]
    assert errors[0] / errors[1] == approx(4.0, rel=0.1)  # half the step, a quarter of the error


# Flights through servos: scenario osprey_servo without its noise, with the gains of the prototype.
# 200 Hz and steps of 5 ms, a quarter of the shortest lag.

STEP = 0.005  # s


@pytest.fixture(scope="module")
def servo() -> Scenario:
    return PROTOTYPE_SERVO.vary(
        aircraft={"sensors": {}, "rate": 200.0, "step": STEP}, reference_model={"rate": 200.0}
    )


@pytest.fixture(scope="module")
def gusty(servo: Scenario) -> Tape:
    """Return the whole flight, with gusts."""
    return simulate(servo)


def test_error_through_servos_with_margins(servo: Scenario) -> None:
    # The shipped gains have 45 deg or more. Noise apart, the error of V is that of a loop twice as
    # fast; r pays 10 %.
    coarser = servo.vary(aircraft={"rate": 100.0, "step": 0.005}, reference_model={"rate": 100.0})
    shipped = rms(simulate(coarser.vary(controller=find_scenario("osprey_servo").controller)))
    assert (shipped <= np.array([1.01, 0.75, 1.01, 1.1]) * [7.6, 0.088, 9.9, 6.4]).all()


def test_softened_sign_leaves_no_limit_cycle_behind_servos(servo: Scenario, gusty: Tape) -> None:
    rest = gusty.time("u") > 55.0  # gusts and commands end before 50 s
    # The literal sign would keep moving every input by beta: 15 deg/s, 60 %/s. Here the slow spiral
    # mode is left.
    slew = np.abs(np.diff(gusty["u"].values[rest], axis=0)).mean(axis=0) / 0.01
    beta = np.array(servo.rise_di().beta) * np.array(servo.controller.input_scale)
    assert (slew < 0.01 * beta).all()
    e = error(gusty)
    assert np.abs(e.values[(e.stamp_ns - gusty.start_ns) > 55 * 10**9]).max() < 5e-4


def test_actuators_stay_inside_limits_in_flight(servo: Scenario, gusty: Tape) -> None:
    positions = gusty["truth"].group("actuator").values
    limits = servo.aircraft.actuators
    assert (positions >= limits.lower).all()
    assert (positions <= limits.upper).all()
    assert (np.abs(np.diff(positions, axis=0)) <= np.array(limits.rate) * STEP * (1 + 1e-9)).all()
    assert np.abs(positions).max() > 0.1  # thrust for 1.5 m/s: the flight uses the actuators
