# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test what law and observer do when samples of y are lost.

They predict over each period without a sample, no more and no less.
"""

import numpy as np
import pytest

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.vectors import FloatArray, StampedVector
from rise_di_controller.controller import Controller
from rise_di_controller.extensions import feedforward
from rise_di_controller.guard.guard import ControllerState, law_within_limits
from rise_di_controller.law.control_law import Measurements

OBSERVER = find_scenario("osprey_observer").controller
PERIOD_NS = 10_000_000
LAST = 80  # the last tick before the loss


def samples(ticks: int) -> FloatArray:
    """Return samples of y, (ticks, 4), with a slow motion and noise."""
    t = np.arange(ticks)[:, None] / 100.0
    noise = np.random.default_rng(6).normal(size=(ticks, 4))
    return 0.1 * np.sin(3.0 * t + np.arange(4.0)) + 0.002 * noise


def y_m_at(k: int) -> FloatArray:
    return 0.05 * np.sin(0.02 * k + np.arange(4.0))


def flown(lost: int) -> tuple[ControllerState, ControllerState, FloatArray]:
    """Return the states before and after the tick that follows `lost` samples, and its y."""
    controller = Controller(OBSERVER)
    y = samples(LAST + lost + 2)
    before = controller.state
    for k in range(1, LAST + lost + 2):
        now_ns = k * PERIOD_NS
        before = controller.state
        controller.take_y_m(StampedVector(now_ns, y_m_at(k)), now_ns)
        if not LAST < k <= LAST + lost:
            assert controller.take_y(StampedVector(now_ns, y[k]), now_ns) is None
        controller.tick(now_ns)
    return before, controller.state, y[-1]


def by_hand(state: ControllerState, y: FloatArray, lost: int, predicted: int) -> ControllerState:
    """Make a step of law, observer and feedforward after `predicted` predictions."""
    guard, law = OBSERVER.guard(), OBSERVER.tuned_law()
    assert state.y is not None
    assert state.y_m is not None
    assert state.feedforward is not None
    assert guard.nominal is not None
    y_m = y_m_at(LAST + lost + 1)
    dt = np.float64((lost + 1) * 0.01)
    zero = np.zeros(4)
    at_last_y = Measurements(
        y=state.y.value,
        y_m=state.y_m,
        y_m_dot=zero,
        u_trim=state.u_trim + state.u_ff,
        u_before=state.u,
    )
    law_state = state.law
    for _ in range(predicted):
        law_state = law.control_law.missed(law_state, at_last_y, law.params)
    _, u_ff = feedforward.step(state.feedforward, y_m, dt, guard.nominal)
    u_trim = state.u_trim + u_ff
    measurements = Measurements(
        y=y, y_m=y_m, y_m_dot=(y_m - state.y_m) / dt, u_trim=u_trim, u_before=state.u
    )
    after, _, u, _ = law_within_limits(law_state, measurements, dt, law, guard, None)
    return state._replace(law=after, u=u)


@pytest.mark.parametrize("lost", [0, 1, 2, 5])
def test_law_predicts_over_every_lost_period(lost: int) -> None:
    """For each lost sample the observer predicts once.

    One prediction more or less gives other estimates and another u.
    """
    before, after, y = flown(lost)
    expected = by_hand(before, y, lost, lost)
    assert after.law.z == pytest.approx(expected.law.z, rel=1e-12)
    assert after.u == pytest.approx(expected.u, rel=1e-12)
    for wrong in {max(lost - 1, 0), lost + 1} - {lost}:
        state = by_hand(before, y, lost, wrong)
        assert np.abs(state.law.z - after.law.z).max() > 1e-6


def test_prediction_keeps_the_estimates_of_a_motion_that_is_lost() -> None:
    """Without y the estimates follow the model.

    After ten lost samples they are closer to those of a flight without a loss than estimates that
    were kept constant.
    """
    count = 9
    before, after, y = flown(count)
    controller = Controller(OBSERVER)
    for k in range(1, LAST + count + 2):
        now_ns = k * PERIOD_NS
        controller.take_y_m(StampedVector(now_ns, y_m_at(k)), now_ns)
        controller.take_y(StampedVector(now_ns, samples(LAST + count + 2)[k]), now_ns)
        controller.tick(now_ns)
    complete = controller.state.law.z
    still = by_hand(before, y, count, 0).law.z
    hidden = slice(4, None)  # states that y does not correct at once
    assert (
        np.abs(after.law.z[hidden] - complete[hidden]).sum()
        < np.abs(still[hidden] - complete[hidden]).sum()
    )
