# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Around the law: samples of one instant, engagement, stale and repeated samples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flight_analysis.scenario import Scenario
from rise_di_controller import guard, internals
from rise_di_controller.guard import ControllerState, Mode, Sample, align
from rise_di_controller.law import engage, step
from rise_di_controller.params import ControllerParameters

MS = 1_000_000


@pytest.fixture
def params(osprey_gust: Scenario) -> ControllerParameters:
    return osprey_gust.controller


def sample(ms: float, value: float = 0.0) -> Sample:
    return Sample(round(ms * MS), np.full(4, value))


def test_reference_is_taken_at_the_stamp_of_y() -> None:
    samples = [sample(0, 0.0), sample(10, 1.0), sample(20, 3.0)]

    def at(ms: float) -> float | None:
        value = align(samples, round(ms * MS), 10 * MS)
        return None if value is None else float(value[0])

    assert at(10) == 1.0  # its own sample
    assert at(15) == pytest.approx(2.0)  # between two
    assert at(25) == pytest.approx(4.0)  # beyond the newest, along the last two
    assert at(31) is None  # beyond the reach of one period
    assert at(-1) is None  # before the oldest


def test_a_single_sample_is_held_for_one_period() -> None:
    held = align([sample(0, 7.0)], 10 * MS, 10 * MS)
    assert held is not None
    assert held.tolist() == [7.0] * 4
    assert align([sample(0, 7.0)], 11 * MS, 10 * MS) is None


@given(ms=st.floats(0, 20))
def test_a_straight_line_is_reproduced_at_any_instant(ms: float) -> None:
    value = align([sample(t, t) for t in (0, 5, 10)], round(ms * MS), 10 * MS)
    assert value is not None
    assert value[0] == pytest.approx(round(ms * MS) / MS, abs=1e-9)


def fly(params: ControllerParameters, *ticks: tuple[float, Sample | None, list[Sample]]) -> list[ControllerState]:
    state, states = guard.start(4), []
    for now_ms, y, y_m in ticks:
        state, _ = guard.tick(state, round(now_ms * MS), y, y_m, params.guard(), params.law())
        states.append(state)
    return states


def test_waits_until_both_signals_are_there_then_engages_with_zero_input(params: ControllerParameters) -> None:
    modes = fly(
        params,
        (0, None, []),
        (10, sample(10, 1.0), []),
        (20, None, [sample(20)]),
        (30, sample(30, 1.0), [sample(20), sample(30)]),
    )
    assert [state.mode for state in modes] == [Mode.WAITING, Mode.WAITING, Mode.WAITING, Mode.ENGAGED]
    assert modes[-1].u.tolist() == [0.0] * 4


def test_each_new_sample_is_one_step_of_the_law_with_its_measured_dt(params: ControllerParameters) -> None:
    first, second = fly(params, (0, sample(0, 1.0), [sample(0)]), (12, sample(12, 1.1), [sample(12)]))[0:2]
    law_state = engage(np.full(4, 1.0), np.zeros(4))
    _, u = step(law_state, np.full(4, 1.1), np.zeros(4), np.array(0.012), params.law())
    assert first.u.tolist() == [0.0] * 4
    assert second.u.tolist() == u.tolist()


@pytest.mark.parametrize(("gap_ms", "dt_ms"), [(1, 2), (25, 25), (80, 30)])
def test_the_measured_dt_is_held_between_a_fifth_and_three_periods(
    params: ControllerParameters, gap_ms: int, dt_ms: int
) -> None:
    state, _ = guard.tick(guard.start(4), 0, sample(0, 1.0), [sample(0)], params.guard(), params.law())
    _, used = guard.tick(state, gap_ms * MS, sample(gap_ms, 1.0), [sample(gap_ms)], params.guard(), params.law())
    assert used is not None
    assert used.dt == pytest.approx(dt_ms / 1000)


def test_a_sample_seen_before_changes_nothing(params: ControllerParameters) -> None:
    y, y_m = sample(10, 1.0), [sample(10)]
    states = fly(params, (0, sample(0, 1.0), [sample(0)]), (10, y, y_m), (20, y, y_m))
    assert states[2].u is states[1].u
    assert states[2].law is states[1].law


def test_stale_samples_hold_the_input_and_freeze_the_integrals(params: ControllerParameters) -> None:
    y, y_m = sample(10, 1.0), [sample(10)]
    states = fly(params, (0, sample(0, 1.0), [sample(0)]), (10, y, y_m), (111, y, y_m), (120, sample(120, 1.0), [sample(120)]))
    assert [state.mode for state in states] == [Mode.ENGAGED, Mode.ENGAGED, Mode.HOLD, Mode.ENGAGED]
    assert states[2].u is states[1].u
    assert states[2].law is states[1].law


def test_internals_are_named_after_the_outputs(params: ControllerParameters) -> None:
    state, used = guard.tick(guard.start(4), 0, sample(0, 1.5), [sample(0, 0.5)], params.guard(), params.law())
    assert used is not None
    shown = dict(zip(internals.names(params.outputs), internals.values(state, used, late=1e-4, age=2e-3), strict=True))
    assert shown["mode"] == Mode.ENGAGED
    assert (shown["late"], shown["age"], shown["dt"]) == (1e-4, 2e-3, 0.0)
    assert (shown["y.V"], shown["y_m.V"], shown["e.V"], shown["Pi.V"]) == (1.5, 0.5, 1.0, 0.0)
