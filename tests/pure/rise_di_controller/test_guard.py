# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the guard: alignment of y_m, engagement, failsafe, saturation, anti-windup and the log."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx
from tests.closed_loop import law_params

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.modes import Mode
from flight_core.vectors import ChannelError, FloatArray, StampedVector
from rise_di_controller import internals
from rise_di_controller.controller import Controller
from rise_di_controller.guard import guard
from rise_di_controller.guard.guard import ControllerState, align
from rise_di_controller.internals import Saturation
from rise_di_controller.law.law import (
    LawState,
    Sign,
    control,
    engage,
    retune,
    step,
    step_with_anti_windup,
)
from rise_di_controller.law.saturation import Limits, saturate
from rise_di_controller.params import ControllerConfig

MS = 1_000_000
PARAMS = find_scenario("osprey_gust").controller


def sample(ms: float, value: float = 0.0) -> StampedVector:
    return StampedVector(round(ms * MS), np.full(4, value))


def test_reference_taken_at_stamp_of_y() -> None:
    samples = [sample(0, 0.0), sample(10, 1.0), sample(20, 3.0)]

    def at(ms: float) -> FloatArray | None:
        return align(samples, round(ms * MS), 10 * MS)

    assert at(10) == approx([1.0] * 4, rel=0.0, abs=0.0)  # a sample of that stamp
    assert at(15) == approx([2.0] * 4)  # between two
    assert at(25) == approx([4.0] * 4)  # extrapolated from the last two
    assert at(31) is None  # more than one period after the newest
    assert at(-1) is None  # before the oldest


def test_single_sample_held_for_one_period() -> None:
    assert align([sample(0, 7.0)], 10 * MS, 10 * MS) == approx([7.0] * 4, rel=0.0, abs=0.0)
    assert align([sample(0, 7.0)], 11 * MS, 10 * MS) is None


def test_close_reference_samples_amplify_no_noise() -> None:
    # Two samples 1 us apart differ by 1: the line through them is wrong by 8000 after 8 ms. The
    # slope is taken from samples that are at least a twentieth of the extrapolation limit apart,
    # here the first and the last; otherwise the value is held.
    close = [StampedVector(2 * MS, np.array([1.0])), StampedVector(2 * MS + 1000, np.array([2.0]))]
    first = StampedVector(0, np.array([0.0]))
    assert align([first, *close], 10 * MS, 10 * MS) == approx([2.0 * 10.0 / 2.001], rel=1e-12)
    assert align(close, 10 * MS, 10 * MS) == approx([2.0], rel=0.0)


@given(ms=st.floats(0, 20))
def test_straight_line_reproduced_at_any_instant(ms: float) -> None:
    value = align([sample(t, t) for t in (0, 5, 10)], round(ms * MS), 10 * MS)
    assert value == approx([round(ms * MS) / MS] * 4, abs=1e-9)


def tick(
    state: ControllerState,
    ms: float,
    y: StampedVector | None,
    y_m: list[StampedVector],
    params: ControllerConfig = PARAMS,
    active: bool = True,
) -> tuple[ControllerState, guard.TickInputs | None]:
    return guard.tick(state, round(ms * MS), y, y_m, params.guard(), params.tuned_law(), active)


def run(
    *ticks: tuple[float, StampedVector | None, list[StampedVector]],
    params: ControllerConfig = PARAMS,
) -> list[ControllerState]:
    states = [guard.initial_state(4)]
    for ms, y, y_m in ticks:
        states.append(tick(states[-1], ms, y, y_m, params)[0])
    return states[1:]


def test_engages_with_zero_input() -> None:
    """The controller waits for y and y_m, then engages with u = 0."""
    both = (30, sample(30, 1.0), [sample(20), sample(30)])
    modes = run((0, None, []), (10, sample(10, 1.0), []), (20, None, [sample(20)]), both)
    assert [state.mode for state in modes] == [
        Mode.WAITING,
        Mode.WAITING,
        Mode.WAITING,
        Mode.ENGAGED,
    ]
    assert modes[-1].u.tolist() == [0.0] * 4


AGE = round(1000 * PARAMS.max_age)  # ms


@pytest.mark.parametrize("offset", [-10_000, -AGE - 1, -AGE, 0, AGE, AGE + 1, 10_000])  # ms
def test_y_bounded_behind_and_ahead_of_clock(offset: int) -> None:
    now = 20_000
    y_m = [sample(ms) for ms in sorted({now, now + offset})]
    (state,) = run((now, sample(now + offset), y_m))
    assert (state.mode is Mode.ENGAGED) == (abs(offset) <= AGE)


# ms: an old y_m has no value at the stamp of a fresh y.
@pytest.mark.parametrize("offset", [AGE, AGE + 1, 10_000])
def test_y_m_bounded_ahead_of_clock(offset: int) -> None:
    (state,) = run((0, sample(0), [sample(0), sample(offset)]))
    assert (state.mode is Mode.ENGAGED) == (offset <= AGE)


@pytest.mark.parametrize("signal", ["y", "y_m"])
def test_controller_refuses_stamp_ahead_of_clock(signal: str) -> None:
    """A later sample with a right stamp would be out of order after a stamp ahead of the clock."""
    controller = Controller(PARAMS)
    take = controller.take_y if signal == "y" else controller.take_y_m
    with pytest.raises(ChannelError, match="ahead of the clock"):
        take(sample(AGE + 1), 0)
    take(sample(AGE), 0)


def test_y_of_at_most_a_period_after_newest_y_m_is_used() -> None:
    controller = Controller(PARAMS)
    for ms in (0, 10, 20, 30):
        controller.take_y(sample(ms), 30 * MS)
    for ms in (0, 10):  # y_m is late: at 30 ms it has no value, at 20 ms it can be extrapolated
        controller.take_y_m(sample(ms), 30 * MS)
    output = controller.tick(30 * MS)
    assert output is not None
    assert output.stamp_ns == 20 * MS


# by tick: age of the y in ms, whether it comes, and whether the controller is active
BUSY: dict[str, Callable[[int], tuple[int, bool, bool]]] = {
    "a late y after a failsafe": lambda k: (8 if k < 50 else 95, not 50 <= k < 80, True),
    "the delay grows and shrinks": lambda k: (8 + 3 * (k % 30), not 50 <= k < 80, True),
    "a y ahead of the clock, then behind": lambda k: (-90 if k < 50 else 90, k % 40 > 15, True),
    "deactivated meanwhile": lambda k: (8 if k < 50 else 60, True, not 40 <= k < 70),
    "inactive before it engages": lambda k: (8 if k < 30 else 90, True, k > 30),
    "each y is late": lambda k: (99, k % 33 < 16, True),
}


@pytest.mark.parametrize("case", BUSY)
def test_stamp_of_u_is_that_of_its_y_and_never_goes_back(case: str) -> None:
    """The receiver and the report use the stamps of a topic as its clock, also after a failsafe."""
    controller = Controller(PARAMS)
    stamps: list[int] = []
    used: list[int] = []
    sent: set[int] = set()
    for k in range(200):
        now = 1000 + 10 * k
        age, comes, active = BUSY[case](k)
        controller.take_y_m(sample(now), now * MS)
        if comes and now - age > max(sent, default=0):
            sent.add(now - age)
            controller.take_y(sample(now - age, 0.01 * (k % 7)), now * MS)
        if (output := controller.tick(now * MS, active=active)) is not None:
            stamps.append(output.stamp_ns)
            assert abs(now * MS - output.stamp_ns) <= AGE * MS
            if controller.mode is Mode.ENGAGED:
                used.append(output.stamp_ns)
    assert (np.diff(stamps) >= 0).all()
    assert {*used} <= {ms * MS for ms in sent}
    assert len(used) > 60
    assert len({*stamps}) > 0.8 * len(stamps)  # in a failsafe it goes on


def test_new_sample_is_step_of_law() -> None:
    """A new y causes one step of the law, with the measured dt."""
    first, second = run((0, sample(0, 1.0), [sample(0)]), (12, sample(12, 1.1), [sample(12)]))
    law_state = engage(np.full(4, 1.0), np.zeros(4))
    _, u = step(law_state, np.full(4, 1.1), np.zeros(4), np.array(0.012), PARAMS.law_params())
    assert first.u.tolist() == [0.0] * 4
    assert second.u.tolist() == u.tolist()


@pytest.mark.parametrize("gap_ms, dt_ms", [(1, 2), (25, 25), (80, 80), (110, 110), (111, 0)])
def test_dt_is_the_time_that_passed_or_the_law_engages_again(gap_ms: int, dt_ms: int) -> None:
    """The step is between a fifth of the period and the age limit plus a period.

    The period is 10 ms, and the age limit is 100 ms.
    """
    (state,) = run((0, sample(0, 1.0), [sample(0)]))
    _, inputs = tick(state, gap_ms, sample(gap_ms, 1.0), [sample(gap_ms)])
    assert inputs is not None
    assert inputs.dt == approx(dt_ms / 1000)


def test_a_repeated_sample_changes_nothing() -> None:
    y = sample(10, 1.0)
    y_m = [sample(10)]
    states = run((0, sample(0, 1.0), [sample(0)]), (10, y, y_m), (20, y, y_m))
    assert states[2].u is states[1].u
    assert states[2].law is states[1].law


def test_failsafe_holds_ramps_and_re_engages(osprey_gust: Scenario) -> None:
    """The input holds and then ramps to trim.

    Fresh samples engage the law again, and u does not jump.
    """
    params = osprey_gust.vary(controller={"max_age": 0.1, "hold": 0.2, "ramp": 0.4}).controller
    y = sample(10, 1.1)
    y_m = [sample(10)]
    states = run(
        (0, sample(0, 1.0), [sample(0)]),
        (10, y, y_m),
        (120, y, y_m),  # 110 ms old: stale
        (320, y, y_m),  # 200 ms later
        (520, y, y_m),  # 400 ms later: half of the ramp
        (600, sample(600, 1.3), [sample(600)]),
        (610, sample(610, 1.3), [sample(610)]),
        (1800, y, y_m),
        (2500, y, y_m),
        params=params,
    )
    modes = " ".join(state.mode.name for state in states)
    assert modes == "ENGAGED ENGAGED HOLD HOLD RAMP ENGAGED ENGAGED HOLD TRIM"
    u = states[1].u
    assert (u != 0).all()
    assert (states[3].u == u).all()
    assert states[3].law is states[1].law  # nothing is integrated
    assert states[4].u == approx(0.5 * u)
    assert (states[5].u == states[4].u).all()  # bumpless re-engagement
    assert (states[5].u_trim == states[4].u).all()
    law_state = states[5].law
    assert law_state is not None
    assert law_state.e_0.tolist() == [1.3] * 4
    assert (law_state.integral_e == 0).all()
    assert (states[8].u == 0).all()


@pytest.mark.parametrize("policy", ["trim", "hold"])
def test_deactivation_holds_or_ramps_input_as_configured(
    policy: str, osprey_gust: Scenario
) -> None:
    params = osprey_gust.vary(controller={"ramp": 0.4, "on_deactivate": policy}).controller
    states = [guard.initial_state(4)]
    for ms, active in ((0, True), (10, True), (20, False), (220, False), (620, False), (630, True)):
        states.append(
            tick(states[-1], ms, sample(ms, 1.0 + ms / 100), [sample(ms)], params, active)[0]
        )
    states = states[1:]
    assert [state.mode.name for state in states] == [
        "ENGAGED",
        "ENGAGED",
        "INACTIVE",
        "INACTIVE",
        "INACTIVE",
        "ENGAGED",
    ]
    scales = [1.0, 1.0, 1.0] if policy == "hold" else [1.0, 0.5, 0.0]
    for state, expected in zip(states[2:5], scales, strict=True):
        assert state.u == approx(expected * states[1].u)
    assert (states[5].u == states[4].u).all()  # bumpless re-engagement


def test_inactive_controller_commands_trim() -> None:
    """An inactive controller sends the trim.

    A bridge engages only with a fresh u, and activates the controller afterwards.
    """
    state, inputs = tick(guard.initial_state(4), 0, None, [sample(0)], active=False)
    assert (state.mode, inputs) == (Mode.INACTIVE, None)
    state, inputs = tick(state, 0, sample(0, 1.0), [sample(0)], active=False)
    assert state.mode is Mode.INACTIVE
    assert inputs is not None
    assert inputs.y.tolist() == [1.0] * 4
    assert not state.u.any()


def limits_of(bound: float, rate: float = np.inf) -> Limits:
    return Limits(np.full(2, -bound), np.full(2, bound), np.full(2, rate))


TWO = law_params(
    [5.0, 2.0], [2.0, 1.0], [3.0, 1.0], [1.0, -1.0], input_scale=[0.5, 2.0], eps=[0.1, 0.2]
)
VALUES = st.floats(-10, 10)
PAIRS = st.tuples(VALUES, VALUES).map(np.array)
STATES = st.builds(LawState, PAIRS, PAIRS, PAIRS, PAIRS)


@pytest.mark.parametrize("sign", list(Sign))
@given(state=STATES, y=PAIRS)
def test_anti_windup_leaves_unsaturated_law(sign: Sign, state: LawState, y: FloatArray) -> None:
    """Without saturation, the law with anti-windup gives the same bits as the law alone."""
    law = TWO._replace(sign=sign)
    zero = np.zeros(2)
    dt = np.array(0.01)
    after, u = step(state, y, zero, dt, law)
    limited_state, u_free, limited = step_with_anti_windup(
        state, y, zero, dt, zero, u, law, limits_of(np.inf)
    )
    assert limited.tobytes() == u_free.tobytes() == (zero + u).tobytes()
    assert [part.tobytes() for part in limited_state] == [part.tobytes() for part in after]


@given(u=PAIRS, before=PAIRS, bound=st.floats(0.1, 5), rate=st.floats(0.1, 100))
def test_saturation_leaves_input_inside_limits(
    u: FloatArray, before: FloatArray, bound: float, rate: float
) -> None:
    limits = limits_of(bound, rate)
    before = np.clip(before, -bound, bound)
    saturated = saturate(u, before, np.array(0.01), limits)
    assert (np.abs(saturated) <= bound).all()
    assert (np.abs(saturated - before) <= rate * 0.01 + 1e-12).all()
    inside = (np.abs(u) <= bound) & (np.abs(u - before) <= rate * 0.01)
    assert (saturated[inside] == u[inside]).all()


def test_saturation_moves_to_new_limits_at_rate() -> None:
    """A u outside of new limits moves back at the limited rate, or at once without such a limit."""
    u = np.array([5.0, -5.0])
    before = np.array([3.0, -3.0])
    for rate, expected in ((10.0, [2.9, -2.9]), (1000.0, [1.0, -1.0]), (np.inf, [1.0, -1.0])):
        assert saturate(u, before, np.array(0.01), limits_of(1.0, rate)).tolist() == expected


@given(state=STATES, y=PAIRS, trim=PAIRS)
@pytest.mark.parametrize("limited_in", ["magnitude", "rate"])
def test_integrals_stop_only_in_direction_that_worsens_saturation(
    limited_in: str, state: LawState, y: FloatArray, trim: FloatArray
) -> None:
    limits = limits_of(1.0) if limited_in == "magnitude" else limits_of(np.inf, 10.0)
    zero = np.zeros(2)
    dt = np.array(0.01)
    free, u = step(state, y, zero, dt, TWO)
    limited_state, _, _ = step_with_anti_windup(state, y, zero, dt, trim, zero, TWO, limits)
    excess = trim + u - saturate(trim + u, zero, dt, limits)
    outward = -TWO.D * (free.integral_e - state.integral_e) * excess > 0
    assert (limited_state.integral_e == np.where(outward, state.integral_e, free.integral_e)).all()
    outward = -TWO.D * (free.Pi - state.Pi) * excess > 0
    assert (limited_state.Pi[~outward] == free.Pi[~outward]).all()
    assert (np.minimum(state.Pi, free.Pi) - 1e-9 <= limited_state.Pi).all()
    assert (limited_state.Pi <= np.maximum(state.Pi, free.Pi) + 1e-9).all()


@pytest.mark.equation(23)
@given(
    state=STATES,
    k=st.floats(0.5, 50),
    Lambda=st.floats(0.1, 10),
    scale=st.floats(0.1, 10),
    D=st.sampled_from([-1.0, 1.0]),
)
def test_new_gains_transfer_without_a_bump(
    state: LawState, k: float, Lambda: float, scale: float, D: float
) -> None:
    new = TWO._replace(
        D=TWO.D * D,
        K=TWO.K * k,
        Lambda=TWO.Lambda * Lambda,
        input_scale=TWO.input_scale * scale,
        beta=TWO.beta * 2,
    )
    retuned = retune(state, TWO, new)
    before = control(state, state, TWO)
    after = control(retuned, retuned, new)
    # u is a sum of terms of this size, each rounded once or twice
    size = np.abs(new.input_scale) * (
        new.K * (np.abs(state.e - state.e_0) + new.Lambda * np.abs(state.integral_e))
        + np.abs(state.Pi)
    )
    assert (np.abs(after - before) <= 1e-12 * np.maximum(size, 1.0)).all()
    assert (retuned.e, retuned.e_0, retuned.integral_e) == (state.e, state.e_0, state.integral_e)


def logged(
    state: ControllerState, inputs: guard.TickInputs, limits: Limits, *others: Any
) -> dict[str, float]:
    values = internals.values(state, inputs, PARAMS.guard()._replace(limits=limits), *others)
    return dict(zip(internals.names(PARAMS.logged_groups()), values, strict=True))


def test_internals_hold_integrals_and_what_limited_each_input() -> None:
    limits = Limits(np.full(4, -1.0), np.full(4, 1.0), np.full(4, np.inf))
    law_state = LawState(np.zeros(4), np.ones(4), np.full(4, 2.0), np.full(4, 3.0))
    state = guard.initial_state(4)._replace(
        law=law_state,
        u_free=np.array([0.5, 5.0, -5.0, 0.9]),
        u=np.array([0.5, 1.0, -1.0, 0.7]),
        u_trim=np.full(4, 0.1),
    )
    values = logged(
        state,
        guard.TickInputs(stamp_ns=0, y=np.ones(4), y_m=np.zeros(4), y_m_offset=0.0, dt=0.01),
        limits,
        0.0,
        0.0,
        7,
        8,
        np.zeros(0),
    )
    assert (values["e.q"], values["e_0.q"], values["integral_e.q"], values["Pi.q"]) == (
        1.0,
        0.0,
        2.0,
        3.0,
    )
    assert (values["u_free.aileron"], values["u.aileron"], values["u_trim.aileron"]) == (
        5.0,
        1.0,
        0.1,
    )
    limited = [values[f"limited.{name}"] for name in PARAMS.inputs]
    assert limited == [Saturation.NO, Saturation.MAGNITUDE, Saturation.MAGNITUDE, Saturation.RATE]
