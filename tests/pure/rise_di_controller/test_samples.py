# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that samples that no aircraft can give are lost.

The law engages again if its state is not finite, and u is always a number.
"""

from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.conftest import refusing
from tests.other_laws import SECTIONS

import rise_di
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.modes import Mode
from flight_core.vectors import FloatArray, StampedVector
from rise_di_controller.controller import Controller
from rise_di_controller.extensions.observer import initial_estimates
from rise_di_controller.guard import guard
from rise_di_controller.laws import AnyLaw

PERIOD_NS = 10_000_000  # 100 Hz, of all scenarios below
SERVO, OBSERVER = (find_scenario(name).controller for name in ("osprey_servo", "osprey_observer"))
SPIKE = 120  # tick of the one wrong sample, at 1.2 s
NOISE = np.array([0.0017, 0.0017, 0.0017, 0.03])  # rad/s and m/s, of osprey_servo


def noisy(ticks: int, seed: int = 1) -> FloatArray:
    """Return samples of y, (ticks, 4), with a slow motion and noise."""
    t = np.arange(ticks)[:, None] / 100.0
    return 0.1 * np.sin(t + np.arange(4.0)) + NOISE * np.random.default_rng(seed).normal(
        size=(ticks, 4)
    )


def flown(
    controller: Controller, y: Iterable[FloatArray | None], first: int = 0
) -> tuple[FloatArray, list[Mode], list[str]]:
    """Return the u after each tick, (T, m), the modes, and why samples are lost.

    In `y`, None stands for a tick without a sample of y. y_m is always 0.
    """
    u = []
    modes = []
    reasons = []
    for k, value in enumerate(y, first):
        now_ns = k * PERIOD_NS
        if value is not None:
            reasons.append(controller.take_y(StampedVector(now_ns, value), now_ns))
        controller.take_y_m(StampedVector(now_ns, np.zeros(4)), now_ns)
        controller.tick(now_ns)
        u.append(controller.state.u)
        modes.append(controller.mode)
    return np.array(u), modes, [str(reason) for reason in reasons if reason]


@cache
def without_sample(observed: bool) -> FloatArray:
    """Return the u of a flight in which the sample SPIKE never arrives."""
    y: list[FloatArray | None] = list(noisy(SPIKE + 60))
    y[SPIKE] = None
    return flown(Controller(OBSERVER if observed else SERVO), y)[0]


@pytest.mark.parametrize("observed", [False, True], ids=["law alone", "observer"])
@pytest.mark.parametrize("channel", [0, 3])
@pytest.mark.parametrize("size", [3.0, 35.0, -1e3, 1e6, -1e307, np.nan])
def test_wrong_sample_is_as_one_that_did_not_arrive(
    observed: bool, channel: int, size: float
) -> None:
    """A wrong sample leaves the same u, to the bit, as a sample that did not arrive.

    In a period, full inputs can change y by half of 0.7 rad/s and of 4 m/s. The wrong samples are 3
    rad/s and 30 m/s off.
    """
    config = OBSERVER if observed else SERVO
    unit = np.array([1.0, 1.0, 1.0, 10.0])
    y = noisy(SPIKE + 60)
    y[SPIKE, channel] += size * unit[channel]
    u, modes, reasons = flown(Controller(config), y)
    assert u.tobytes() == without_sample(observed).tobytes()
    assert set(modes) == {Mode.ENGAGED}
    assert len(reasons) == 1
    assert config.outputs[channel] in reasons[0]


@pytest.mark.parametrize("channel, bound", [(0, 34.9066), (3, 340.0)])
def test_bounds_hold_from_the_first_sample_on(channel: int, bound: float) -> None:
    """The bounds are 2000 deg/s, the range of a gyro, and the speed of sound.

    They apply to y and to y_m, so that the law never engages with more.
    """
    controller = Controller(SERVO)
    unit = np.eye(4)[channel]
    for take in (controller.take_y, controller.take_y_m):
        sentence = str(take(StampedVector(0, 1.001 * bound * unit), 0))
        name = SERVO.outputs[channel]
        assert sentence.startswith(f"{name} = ")
        assert sentence.endswith(f", the bound of {name} (controller.y_max)")
        assert take(StampedVector(0, np.nan * unit), 0)
        assert take(StampedVector(0, 0.999 * bound * unit), 0) is None


def test_bound_is_a_parameter() -> None:
    config = AnyLaw.validate_mapping(
        SERVO.model_dump() | {"y_max": [1.0, 2.0, 3.0, 4.0]}, "controller"
    )
    controller = Controller(config)
    reason = controller.take_y(StampedVector(0, np.array([0.9, 1.9, 2.9, -4.1])), 0)
    assert str(reason).startswith("V = -4.1 is beyond 4")
    assert controller.take_y(StampedVector(0, np.array([0.9, -1.9, 2.9, 3.9])), 0) is None
    with refusing("y_max"):
        AnyLaw.validate_mapping(SERVO.model_dump() | {"y_max": [1.0]}, "controller")


def test_jump_that_stays_is_taken_at_its_third_sample() -> None:
    """The law engages again from its last u, with the estimates of the new y.

    So a y that really jumped is not refused for ever.
    """
    controller = Controller(OBSERVER)
    before, _, _ = flown(controller, noisy(SPIKE))
    y = noisy(3, 2) + np.array([0.0, 3.0, 0.0, 0.0])
    u, modes, reasons = flown(controller, y, SPIKE)
    assert len(reasons) == 2
    assert (u == before[-1]).all()
    assert set(modes) == {Mode.ENGAGED}
    assert "and stays there" in str(controller.pop_restart_reason())
    assert controller.pop_restart_reason() is None
    params = OBSERVER.tuned_law().params
    assert controller.state.law.z == pytest.approx(initial_estimates(y[-1], params), rel=1e-12)
    assert not controller.state.law.u_o.any()
    _, _, reasons = flown(controller, noisy(100, 3) + np.array([0.0, 3.0, 0.0, 0.0]), SPIKE + 3)
    assert not reasons


def test_samples_that_disagree_are_all_lost() -> None:
    """Samples that disagree with each other start the failsafe, as if there were none.

    The failsafe ends with the third sample in a row that agrees.
    """
    controller = Controller(SERVO)
    flown(controller, noisy(SPIKE))
    garbage = 30.0 * np.where(np.arange(9)[:, None] % 2, 1.0, -1.0) * np.ones(4)
    _, modes, reasons = flown(controller, garbage, SPIKE)
    assert len(reasons) == len(garbage)
    assert modes == [Mode.ENGAGED] * 9  # within the age limit of 0.1 s
    quiet: list[FloatArray | None] = [None] * 10
    _, modes, _ = flown(controller, quiet, SPIKE + 9)
    assert modes[-1] is Mode.HOLD
    _, modes, _ = flown(controller, noisy(100, 3), SPIKE + 19)
    assert modes[-1] is Mode.ENGAGED


def test_samples_that_never_agree_are_taken_again() -> None:
    """A y that alternates by 2 rad/s is accepted again after a few samples.

    The possible change of 0.6 rad/s grows with the periods since the last accepted sample.
    """
    controller = Controller(SERVO)
    flown(controller, noisy(SPIKE))
    loud = noisy(100, 3) + 2.0 * np.where(np.arange(100)[:, None] % 2, 1.0, -1.0) * np.eye(4)[0]
    _, modes, reasons = flown(controller, loud, SPIKE)
    assert 0 < len(reasons) < 10
    assert set(modes) == {Mode.ENGAGED}


def test_abrupt_motion_within_the_power_of_the_inputs_is_taken() -> None:
    """A full elevator changes q by 0.29 rad/s in a period.

    Such a change is accepted, even after calm air.
    """
    controller = Controller(SERVO)
    limit = float(SERVO.guard().limits.upper[0]) / SERVO.input_scale[0] / 100.0
    assert limit == pytest.approx(0.29, abs=0.01)
    calm = np.zeros((SPIKE, 4))
    ramp = np.cumsum(np.full((5, 1), limit), axis=0) * np.eye(4)[0]
    _, _, reasons = flown(controller, [*calm, *ramp])
    assert not reasons


@pytest.mark.slow
@pytest.mark.parametrize("name", ["osprey_turbulence", "osprey_vanes", "x8_elevons"])
def test_flights_lose_no_sample(name: str) -> None:
    """Gusts, turbulence, commands and engagement are possible motion.

    So every sample of y after the first tick becomes a tick.
    """
    scenario = find_scenario(name, 4.0).vary(
        aircraft={"rate": 100.0, "step": 0.005}, reference_model={"rate": 100.0}
    )
    tape = rise_di.simulate(scenario)
    ticks = tape["internals"]
    assert tape.outcome.status == 0
    assert (ticks["mode"] == Mode.ENGAGED).all()
    assert ticks["dt"][1:] == pytest.approx(0.01, rel=1e-9)


@pytest.mark.parametrize("reading", [1e308, -4.0, np.nan])
def test_reading_beyond_half_a_turn_is_that_of_the_tick_before(reading: float) -> None:
    """A vane with an impossible reading does not make the law lose y.

    The reading is treated as unchanged, and a vane that stands still is left out.
    """
    config = find_scenario("osprey_vanes").controller
    readings = 0.02 * np.random.default_rng(2).normal(size=(SPIKE + 1, 2))
    y = np.hstack([noisy(SPIKE + 1), readings])
    y[SPIKE, 4:] = readings[SPIKE - 1]
    u, modes, _ = flown(Controller(config), y)
    y[SPIKE, 4:] = reading
    after, _, reasons = flown(Controller(config), y)
    assert not reasons
    assert set(modes) == {Mode.ENGAGED}
    assert after.tobytes() == u.tobytes()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of NumPy, on the infinite state
def test_state_that_is_not_finite_begins_again() -> None:
    """The law engages from the last u in the same tick, and flies on."""
    controller = Controller(OBSERVER)
    u, _, _ = flown(controller, noisy(50))
    law = controller.state.law
    controller._state = controller.state._replace(law=law._replace(z=np.full_like(law.z, np.inf)))
    after, modes, _ = flown(controller, noisy(51)[50:], 50)
    assert after[0].tobytes() == u[-1].tobytes()
    assert modes == [Mode.ENGAGED]
    assert str(controller.pop_restart_reason()) == "u or the state of the law was not finite"
    assert np.isfinite(controller.state.law.z).all()
    later, modes, _ = flown(controller, noisy(100)[51:], 51)
    assert set(modes) == {Mode.ENGAGED}
    assert np.isfinite(later).all()
    assert controller.pop_restart_reason() is None


def test_loop_warns_of_a_lost_sample_and_of_a_new_engagement() -> None:
    loop = rise_di.Loop(SERVO)
    zero = np.zeros(4)
    for k in range(SPIKE):
        loop.step(k / 100.0, y=zero, y_m=zero)
    with pytest.warns(
        RuntimeWarning, match=r"^sample lost at t = 1.2 s: q = 1e\+308 is beyond 34\.9"
    ):
        loop.step(1.2, y=1e308 * np.eye(4)[0], y_m=zero)
    assert loop.lost
    loop.step(1.21, y=zero, y_m=zero)
    assert not loop.lost
    jumped = np.array([3.0, 0.0, 0.0, 0.0])
    with pytest.warns(
        RuntimeWarning, match="sample lost at t = 1.22 s: a jump of y in 0.01 s: q from 0 to 3"
    ):
        loop.step(1.22, y=jumped, y_m=zero)
    # the second of a row: no further warning, which a test makes an error
    loop.step(1.23, y=jumped, y_m=zero)
    with pytest.warns(RuntimeWarning, match="the law engages again at t = 1.24 s: a jump of y"):
        loop.step(1.24, y=jumped, y_m=zero)


LIMITS = {"lower": (-0.3,) * 4, "upper": (0.2,) * 4}
MODELS = {key: getattr(OBSERVER, key) for key in ("feedforward", "observer")}
LAWS = {
    name: AnyLaw.validate_mapping(section, "controller")
    for name, section in SECTIONS.items()
    if name != "pid"
} | {
    "rise_di": SERVO,
    **{
        f"rise_di, {sign}": SERVO.model_copy(update={"sign": sign})
        for sign in ("literal", "implicit")
    },
}
"""The registered laws. The observer of osprey_observer beside each: not for a good flight, but for
any state."""

ANY = st.one_of(
    st.sampled_from(
        [
            0.0,
            1e-320,
            0.1,
            -0.5,
            3.0,
            30.0,
            1e3,
            1e6,
            1e154,
            -1e200,
            1e308,
            -1.7e308,
            np.inf,
            -np.inf,
            np.nan,
        ]
    ),
    st.floats(),
)
ROWS = st.lists(
    st.tuples(st.tuples(ANY, ANY, ANY, ANY), st.tuples(ANY, ANY, ANY, ANY), st.integers(1, 12)),
    min_size=1,
)


@pytest.mark.parametrize("observed", [False, True], ids=["alone", "observed"])
@pytest.mark.parametrize("name", list(LAWS))
@settings(max_examples=12, deadline=None)
@given(rows=ROWS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of NumPy, on what is not finite
def test_u_is_a_number_within_its_limits_whatever_comes(
    name: str, observed: bool, rows: list[tuple[Any, ...]]
) -> None:
    """Any y and y_m give a u that is a number within its limits.

    Each law is flown behind the controller, and also behind the guard alone, which has no bounds of
    y.
    """
    config = LAWS[name].model_copy(update=LIMITS | (MODELS if observed else {}))
    controller = Controller(config)
    law = config.tuned_law()
    limits = config.guard()
    state = guard.initial_state(4)
    now_ns = 0
    for k, (y, y_m, periods) in enumerate(rows):
        # zeros engage between what comes
        ready = np.zeros((2, 4)) if k % 3 == 0 else np.array([y, y_m])
        now_ns += periods * PERIOD_NS
        samples = [StampedVector(now_ns, value) for value in ready]
        controller.take_y(samples[0], now_ns)
        controller.take_y_m(samples[1], now_ns)
        output = controller.tick(now_ns)
        state, inputs = guard.tick(state, now_ns, samples[0], samples[1:], limits, law)
        for u in (controller.state.u, state.u):
            assert (u >= -0.3).all()
            assert (u <= 0.2).all()
        if output is not None and controller.has_internals:
            assert np.isfinite(output.internals).all()
        if inputs is not None and state.law is not None:
            assert np.isfinite([*inputs.y, *inputs.y_m, *state.u_free]).all()
