# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the identification of aircraft with second-order servos, where the file has a lag."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.pure.flight_design.test_model_identification import (
    ACTUATORS,
    DURATION,
    MOST_OFF,
    OSPREY,
    servo,
    true_errors,
)

from aircraft_sim.plant import actuators
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.vectors import FloatArray
from flight_design.identification import innovation_filters
from flight_design.identification.likelihood import Unknown
from flight_design.identification.likelihood_search import Search
from flight_design.identification.model_identification import identify_model
from flight_design.identification.servo_model import behind_servo, behind_servos
from flight_design.learning import scenario_learner
from flight_design.learning.change_test import ANGLE
from flight_design.learning.part_checks import (
    DELAY_DEVIATION,
    LAG_DEVIATION,
    SERVO_DEVIATION,
)

FREQUENCY = np.array([40.0, 15.0, 40.0, 40.0])  # rad/s, in the airframe's order
DAMPING = np.array([0.6, 0.75, 0.6, 0.6])


class Servos:
    """Second-order servos, which move in steps of 0.1 ms."""

    def __init__(self, frequency: FloatArray, damping: FloatArray) -> None:
        self._frequency = frequency
        self._damping = damping
        self._rate = np.zeros(len(frequency))

    def move(
        self, _: Any, position: FloatArray, command: FloatArray, dt: float, __: Any = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the positions at the end of a step and their mean over it.

        It replaces `actuators.move`.
        """
        steps = round(dt / 1e-4)
        square = self._frequency**2
        total = np.zeros(len(position))
        for _ in range(steps):
            pull = (
                square * (command - position) - 2.0 * self._damping * self._frequency * self._rate
            )
            self._rate = self._rate + dt / steps * pull
            moved = position + dt / steps * self._rate
            total += (position + moved) / 2.0
            position = moved
        return position, total / steps


def first_order(u: FloatArray, lag: float, period: float) -> FloatArray:
    """Return the positions, (T + 1,), of an actuator with a lag that starts at rest at u[0]."""
    position = [u[0]]
    for value in u:
        position.append(value + (position[-1] - value) * np.exp(-period / lag))
    return np.array(position)


@pytest.mark.parametrize(("frequency", "damping"), [(40.0, 0.6), (25.0, 0.5), (35.0, 1.2)])
def test_first_order_actuator_moves_as_the_servo_at_each_tick(
    frequency: float, damping: float
) -> None:
    lag, period = 0.02, 0.01
    u = np.random.default_rng(1).standard_normal(60)
    u[0] = 0.0
    servos = Servos(np.array([frequency]), np.array([damping]))
    expected = [np.zeros(1)]
    for value in u:
        expected.append(servos.move(0.0, expected[-1], np.array([value]), period)[0])
    inertia = 1.0 / (frequency * lag) ** 2
    acting = behind_servo(u, period, lag, 2.0 * damping / frequency, inertia)
    moved = first_order(acting, lag, period)
    assert_allclose(moved, np.concatenate(expected), atol=0.01)


def test_servo_of_the_known_lag_gets_u_as_it_is_and_another_lag_is_that_of_first_order() -> None:
    u = np.random.default_rng(2).standard_normal(50)
    assert_array_equal(behind_servo(u, 0.01, 0.02, 0.02, 0.0), u)
    slower = first_order(behind_servo(u, 0.01, 0.02, 0.035, 0.0), 0.02, 0.01)
    assert_allclose(slower, first_order(u, 0.035, 0.01), atol=1e-3)


def test_each_model_and_input_has_a_delay_and_a_servo_of_its_own() -> None:
    u = np.random.default_rng(3).standard_normal((40, 2))
    late = np.array([[0.0, 1.0], [2.0, 0.0]])
    servo_lag = np.array([[0.02, 0.02], [0.02, 0.03]])
    acting = behind_servos(u, late, 0.01, np.full(2, 0.02), servo_lag, np.array([[0, 0], [0, 1.0]]))
    assert_array_equal(acting[0, :, 0], u[:, 0])
    assert_array_equal(acting[0, 1:, 1], u[:-1, 1])
    assert_array_equal(acting[1, 2:, 0], u[:-2, 0])
    assert_array_equal(acting[1, :, 1], behind_servo(u[:, 1], 0.01, 0.02, 0.03, 1.0))


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 3])
def test_entries_are_within_their_deviations_behind_servos_of_second_order(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the servos in the model, damping and effect of a fast roll would come out wrong."""
    flown = servo("turbulence", 0.3).vary(aircraft={"uncertainty": {"number": number}})
    aircraft = flown.aircraft.sampled_airframe()
    monkeypatch.setattr(actuators, "move", Servos(FREQUENCY, DAMPING).move)
    whole = innovation_filters.recording(simulate(flown), OSPREY)

    def largest(seconds: float, deviation: float) -> float:
        count = int(seconds / whole.period)
        recorded = whole._replace(t=whole.t[:count], y=whole.y[:count], u=whole.u[:count])
        unknown = Unknown(delay=DELAY_DEVIATION, angle=ANGLE, lag=LAG_DEVIATION, servo=deviation)
        found = identify_model(recorded, OSPREY, ACTUATORS, unknown=unknown, is_doubted=True)
        true = true_errors(aircraft, found.entries)
        off = [(entry.error - true[entry.name]) / entry.deviation for entry in found.entries]
        return float(np.abs(off).max())

    for seconds in (15.0, DURATION):
        assert largest(seconds, SERVO_DEVIATION) < MOST_OFF
    assert largest(DURATION, 0.0) > MOST_OFF


def test_actuator_without_a_lag_passes_u_on() -> None:
    u = np.array([0.0, 1.0, -1.0])
    assert_array_equal(behind_servo(u, 0.01, 0.0, 0.0, 1.0), u)
    assert np.isfinite(behind_servo(u, 0.01, 1e-4, 1e-4, 1.0)).all()


@pytest.mark.parametrize(("frequency", "damping"), [(40.0, 0.6), (25.0, 0.5)])
def test_first_order_actuator_moves_as_a_servo_at_its_rate_limit(
    frequency: float, damping: float
) -> None:
    """The reference is the servo in steps of 0.1 ms, which may not exceed its rate."""
    lag, period, limit = 0.02, 0.01, 2.0
    u = np.repeat([0.0, 0.3, -0.3, 0.02], 20)
    expected = [0.0]
    rate = 0.0
    for commanded in u:
        position = expected[-1]
        for _ in range(100):
            pull = frequency**2 * (commanded - position) - 2.0 * damping * frequency * rate
            rate = min(max(rate + 1e-4 * pull, -limit), limit)
            position += 1e-4 * rate
        expected.append(position)
    servo = 2.0 * damping / frequency, 1.0 / (frequency * lag) ** 2
    moved = first_order(behind_servo(u, period, lag, *servo, limit), lag, period)
    # where the servo reaches or leaves its limit within a tick, it is off by a part of its motion
    # of 0.02 in a tick
    assert_allclose(moved, expected, atol=0.01)
    free = first_order(behind_servo(u, period, lag, *servo), lag, period)
    assert np.abs(free - expected).max() > 0.1


def test_servo_of_the_known_lag_gets_u_as_it_is_unless_it_reaches_its_limit() -> None:
    u = np.repeat([0.0, 0.1, 0.0], 20)
    assert_array_equal(behind_servo(u, 0.01, 0.02, 0.02, 0.0, 5.1), u)
    moved = first_order(behind_servo(u, 0.01, 0.02, 0.02, 0.0, 1.0), 0.02, 0.01)
    assert np.abs(np.diff(moved)).max() == pytest.approx(0.01)


def test_learner_knows_the_actuators_of_its_scenario(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenario_learner, "Learner", lambda *given, **_: given)
    scenario = find_scenario("osprey_learn")
    make = scenario_learner.learner(scenario)
    assert make is not None
    given: Any = make(scenario.rise_di())
    actuation = next(each for each in given if isinstance(each, innovation_filters.Actuation))
    assert list(OSPREY.inputs) == ["elevator", "thrust", "aileron", "rudder"]
    assert_array_equal(actuation.lag, [0.02, 0.1, 0.02, 0.02])
    assert_array_equal(actuation.rate_limit, [5.23599, 2.0, 5.23599, 5.23599])
    assert actuation.delay == 0.0


def test_search_of_the_whole_aircraft_begins_with_the_file_and_the_delays_of_the_parts() -> None:
    """The separate model of a part that couples is wrong, and so are its servos.

    So the search of the whole aircraft does not begin with them.
    """
    count = 1000
    y, u = np.random.default_rng(6).standard_normal((2, count, 4))
    recorded = innovation_filters.FlightData(0.01, np.linspace(0.0, 9.99, count), y, u)
    model = innovation_filters.filter_model(OSPREY, ACTUATORS, recorded)
    unknown = Unknown(delay=DELAY_DEVIATION, lag=LAG_DEVIATION, servo=SERVO_DEVIATION)

    def search(block: innovation_filters.Block) -> Search:
        return Search(recorded, model, block, OSPREY, 0.0, unknown)

    parts = [search(block) for block in innovation_filters.blocks(model)]
    fits: list[Any] = [SimpleNamespace(theta=np.full(len(part.prior), 0.5)) for part in parts]
    whole = search(innovation_filters.whole_aircraft(model))
    begin = whole.joined(zip(parts, fits, strict=True))
    found = {name for name, value in zip(whole.named(), begin.tolist(), strict=True) if value}
    delays = {f"delay of {name}" for name in OSPREY.inputs}
    assert found == {*OSPREY.gusts, *delays, "lag of y", "shear of alpha", "shear of q"}
    assert set(begin[begin != 0.0]) == {0.5}
