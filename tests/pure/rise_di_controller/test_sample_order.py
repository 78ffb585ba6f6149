# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test repeated samples, a first second of garbage, gaps, and a y that stands still."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pytest import approx

from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.modes import Mode
from flight_core.outcome import Refusal
from flight_core.vectors import ChannelError, FloatArray, StampedVector
from rise_di_controller.controller import Controller
from rise_di_controller.extensions.feedforward import step_count
from rise_di_controller.guard.samples import MOVING, STILL
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig

MS = 1_000_000  # ns
PERIOD_NS = 10 * MS
SERVO = find_scenario("osprey_servo").controller
NOISE = np.array([0.0017, 0.0017, 0.0017, 0.03])  # rad/s and m/s, of osprey_servo
ZERO = np.zeros(4)


def noise(seed: int = 5) -> Iterator[FloatArray]:
    rng = np.random.default_rng(seed)
    while True:
        yield NOISE * rng.normal(size=4)


def take(controller: Controller, value: FloatArray, stamp_ns: int, now_ns: int) -> str:
    """Return why a sample is not taken, as the node counts it, or "" if it is taken."""
    try:
        refusal = controller.take_y(StampedVector(stamp_ns, value), now_ns)
    except ChannelError as error:
        return error.reason
    return "" if refusal is None else str(refusal)


def step(controller: Controller, value: FloatArray | None, k: int) -> str:
    """Run a tick with a y, or without one, and with y_m = 0. Return why y is not taken, or ""."""
    now_ns = k * PERIOD_NS
    reason = "" if value is None else take(controller, value, now_ns, now_ns)
    controller.take_y_m(StampedVector(now_ns, ZERO), now_ns)
    controller.tick(now_ns)
    return reason


# A sample that comes again


@pytest.mark.parametrize("behind_ns", [0, 1, 5 * MS], ids=["again", "1 ns older", "older"])
def test_one_wrong_sample_sent_again_is_never_three_that_agree(behind_ns: int) -> None:
    """The stamp of a lost sample is remembered.

    So neither this sample nor an older one is accepted afterwards.
    """
    controller = Controller(SERVO)
    calm = noise()
    for k in range(1, 200):
        assert step(controller, next(calm), k) == ""
    now_ns = 200 * PERIOD_NS
    wrong = np.array([3.0, 0.0, 0.0, 0.0])
    assert "a jump of y" in take(controller, wrong, now_ns, now_ns)
    assert [take(controller, wrong, now_ns - behind_ns, now_ns) for _ in range(5)] == ["order"] * 5
    controller.take_y_m(StampedVector(now_ns, ZERO), now_ns)
    controller.tick(now_ns)
    assert controller.pop_restart_reason() is None
    for k in range(201, 220):
        assert step(controller, next(calm), k) == ""


def test_frozen_sample_does_not_come_again_either() -> None:
    controller = Controller(SERVO)
    last = moving(controller, 150)
    assert any(still(controller, 10, 151, last))
    stamp_ns = 160 * PERIOD_NS
    assert [take(controller, ZERO, stamp_ns - 1, stamp_ns)] == ["order"]
    assert take(controller, ZERO, stamp_ns + 1, stamp_ns) == ""


def test_sample_beyond_its_bound_does_not_take_the_place_of_another() -> None:
    """A value that no aircraft can give is refused together with its stamp.

    A right sample may still have this stamp.
    """
    controller = Controller(SERVO)
    assert "is beyond" in take(controller, np.full(4, np.nan), PERIOD_NS, PERIOD_NS)
    assert take(controller, ZERO, PERIOD_NS, PERIOD_NS) == ""
    sample = StampedVector(PERIOD_NS, np.full(4, 1e9))
    assert "is beyond" in str(controller.take_y_m(sample, PERIOD_NS))
    assert controller.take_y_m(StampedVector(PERIOD_NS, ZERO), PERIOD_NS) is None


def test_sample_from_the_future_does_not_keep_later_ones_out() -> None:
    controller = Controller(SERVO)
    assert take(controller, ZERO, 10**12, PERIOD_NS) == "future"
    assert take(controller, ZERO, PERIOD_NS, PERIOD_NS) == ""


# The first second


def garbage(kind: str, k: int, rng: np.random.Generator) -> FloatArray:
    """Return what a gyro adds to q at the sample k while it starts."""
    size = {"one": 20.0 * (k == 60), "all": rng.uniform(-20.0, 20.0), "ramp": 0.3 * k}[kind]
    noise: FloatArray = size * np.eye(4)[0] * (k < 100)
    return noise


@pytest.mark.parametrize("kind, at", [("one", 5.0), ("all", 2.0), ("all", 60.0), ("ramp", 2.0)])
def test_garbage_in_the_first_second_does_not_open_the_test(kind: str, at: float) -> None:
    """A glitch of 3 rad/s, five times what full inputs can change, is lost.

    It is lost after a first second of garbage as well as without it.
    """
    controller = Controller(SERVO)
    calm = noise()
    rng = np.random.default_rng(1)
    for k in range(1, round(100 * at)):
        step(controller, next(calm) + garbage(kind, k, rng), k)
    before = controller.state.u
    glitch = next(calm) + 3.0 * np.eye(4)[0]
    assert "a jump of y" in step(controller, glitch, round(100 * at))
    assert (controller.state.u == before).all()


@pytest.mark.parametrize("first", [0.0, 20.0])
def test_one_wrong_sample_in_the_first_second_leaves_no_trace(first: float) -> None:
    """A glitch of 1 rad/s, twice what full inputs can change, is lost one second later."""
    controller = Controller(SERVO)
    calm = noise()
    for k in range(1, 200):
        step(controller, next(calm) + first * (k == 60) * np.eye(4)[0], k)
    assert "a jump of y" in step(controller, next(calm) + 1.0 * np.eye(4)[0], 200)


def test_noise_of_the_first_second_is_learned() -> None:
    """No sample is lost to a vibration of five times the noise.

    This is true in the first second and after it.
    """
    controller = Controller(SERVO)
    loud = noise()
    assert [*filter(None, (step(controller, 5.0 * next(loud), k) for k in range(1, 1000)))] == []


# The memory of a knock


@pytest.mark.parametrize("after, taken", [(1.0, True), (50.0, False)])
def test_knock_opens_the_test_of_jumps_for_less_than_a_minute(after: float, taken: bool) -> None:
    """A change of 0.5 rad/s at 5 s is within the power of the inputs.

    After it, five times as much is accepted, and less from second to second. After a minute, 2
    rad/s are as impossible as they were before.
    """
    controller = Controller(SERVO)
    calm = noise()
    q = np.eye(4)[0]
    for k in range(1, 500):
        step(controller, next(calm), k)
    assert step(controller, next(calm) + 0.5 * q, 500) == ""
    last = 500 + round(100 * after)
    for k in range(501, last):
        assert step(controller, next(calm), k) == ""
    reason = step(controller, next(calm) + 2.0 * q, last)
    assert (reason == "") is taken


# Gaps


def at_rate(rate: float) -> ControllerConfig:
    """Return the controller of osprey_turbulence with its feedforward and without an observer."""
    section = find_scenario("osprey_turbulence").controller.model_dump()
    left_out = ("observer", "schedule", "learn")
    values = {name: value for name, value in section.items() if name not in left_out}
    return AnyLaw.validate_mapping(values | {"rate": rate, "max_age": 0.1}, "controller")


GAP = 0.09  # s


def after_gap(parameters: ControllerConfig, *, has_gap: bool) -> tuple[FloatArray, float]:
    """Return the u and the dt of the tick after a gap, while the pitch swings and y equals y_m."""
    controller = Controller(parameters)
    rate = parameters.rate
    end = round((1.5 + GAP) * rate)
    begin = round(1.5 * rate) if has_gap else end
    for k in range(1, end + 1):
        now_ns = 10**9 + k * controller.period_ns
        y_m = 0.3 * np.sin(2.0 * np.pi * 0.5 * k / rate) * np.eye(4)[parameters.outputs.index("q")]
        controller.take_y_m(StampedVector(now_ns, y_m), now_ns)
        if not begin <= k < end:
            controller.take_y(StampedVector(now_ns, y_m), now_ns)
        output = controller.tick(now_ns)
    assert output is not None
    return controller.state.u, output.inputs.dt


@pytest.mark.parametrize("rate", [200.0, 1000.0])
def test_gap_within_the_age_limit_counts_in_full_at_any_rate(rate: float) -> None:
    """After a gap of 90 ms, the feedforward has the same input as without a gap, at any rate.

    The error is the same as at 100 Hz. It is 1 % of u, because y_m is taken as linear over the gap.
    """
    ratios = []
    for parameters in (at_rate(100.0), at_rate(rate)):
        elevator = parameters.inputs.index("elevator")
        u, dt = after_gap(parameters, has_gap=True)
        assert dt == approx(GAP + 1.0 / parameters.rate)
        whole, _ = after_gap(parameters, has_gap=False)
        ratios.append(u[elevator] / whole[elevator])
    assert ratios == approx([1.0, 1.0], abs=0.02)
    assert ratios[0] == approx(ratios[1], abs=0.005)


def test_steps_of_the_model_are_at_most_ten_periods_long() -> None:
    """The model is as stable over a gap of 100 of its periods as over one of ten."""
    period_ns = MS
    assert [step_count(span * period_ns, period_ns) for span in (1, 10, 11, 20, 21, 101)] == [
        1, 1, 2, 2, 3, 11,
    ]  # fmt: skip
    assert step_count(10 * period_ns + 1, period_ns) == 2
    assert step_count(1, period_ns) == 1


def test_gap_beyond_the_age_limit_engages_again_and_says_so() -> None:
    """A gap between stamps restarts the law, although every tick had a fresh y.

    The stamps before the gap were ahead of the clock. The gap is 0.12 s.
    """
    controller = Controller(SERVO)
    calm = noise()
    for k in range(1, 150):
        step(controller, next(calm), k)
    assert controller.mode is Mode.ENGAGED
    u = controller.state.u
    now_ns = 151 * PERIOD_NS
    ahead_ns = (149 + 12) * PERIOD_NS
    assert take(controller, next(calm), ahead_ns, now_ns) == ""
    for stamp_ns in (now_ns, ahead_ns):
        controller.take_y_m(StampedVector(stamp_ns, ZERO), now_ns)
    output = controller.tick(now_ns)
    assert output is not None
    assert output.inputs.dt == 0.0
    assert (controller.state.u == u).all()
    assert controller.mode is Mode.ENGAGED
    assert str(controller.pop_restart_reason()) == "a gap of y of 0.12 s, longer than max_age"


# A y that stands still


def still(controller: Controller, count: int, first: int, value: FloatArray) -> list[str]:
    return [step(controller, value, k) for k in range(first, first + count)]


def moving(controller: Controller, count: int) -> FloatArray:
    """Run ticks with noise, and return the last y."""
    calm = noise()
    value = ZERO
    for k in range(1, count + 1):
        value = next(calm)
        assert step(controller, value, k) == ""
    return value


def test_y_that_stands_still_is_lost_and_the_failsafe_begins() -> None:
    """A y that does not change is lost after five periods, like a frozen pose.

    From then on no sample is accepted until a value changes.
    """
    controller = Controller(SERVO)
    last = moving(controller, 150)
    reason = still(controller, 40, 151, last)
    assert reason[: STILL - 1] == [""] * (STILL - 1)
    assert all(reason[STILL - 1 :])
    assert reason[STILL - 1] == (
        "y: found every value as before for 0.05 s, expected an aircraft that moves"
    )
    modes = [controller.mode]
    y = last + np.array([1e-12, 0.0, 0.0, 0.0])
    assert step(controller, y, 191) == ""
    modes.append(controller.mode)
    assert modes in ([Mode.HOLD, Mode.ENGAGED], [Mode.RAMP, Mode.ENGAGED])
    # again at once: what has been seen is not forgotten
    assert any(still(controller, 10, 192, y))


@pytest.mark.parametrize("count", [1, MOVING])
def test_y_that_has_not_moved_before_is_not_frozen(count: int) -> None:
    """A simulation in trim without noise sends zeros, and a bridge may repeat its samples."""
    controller = Controller(SERVO)
    last = moving(controller, count)
    assert not any(still(controller, 500, count + 1, last))
    assert controller.mode is Mode.ENGAGED


def test_one_value_that_changes_is_enough() -> None:
    controller = Controller(SERVO)
    last = moving(controller, 150)
    for k in range(151, 300):
        assert step(controller, last + 1e-9 * k * np.eye(4)[3], k) == ""


def test_sensor_that_repeats_now_and_then_is_not_frozen() -> None:
    """An airspeed in coarse steps and gyros without noise repeat equal samples for a while."""
    controller = Controller(SERVO)
    rng = np.random.default_rng(3)
    for k in range(1, 3000):
        V = 0.5 * np.round(rng.normal() * 0.3)
        assert step(controller, V * np.eye(4)[SERVO.outputs.index("V")], k) == ""


def test_repeats_faster_than_the_ticks_are_not_frozen() -> None:
    """If a y of 100 Hz is sent at 1 kHz, ten equal samples are one period."""
    controller = Controller(SERVO)
    moving(controller, 150)
    value = ZERO
    for k, value in zip(range(1511, 3000), noise(7), strict=False):
        assert take(controller, value, k * MS, k * MS) == ""
        if k > 2000:
            break
    repeated = [take(controller, value, (2002 + k) * MS, (2002 + k) * MS) for k in range(60)]
    assert not any(repeated[:49])  # 5 periods of the ticks
    assert repeated[-1]


@pytest.mark.slow
def test_frozen_y_in_flight_is_told_and_replayed_to_the_bit() -> None:
    """Every value stands still from 5 s on, while the stamps go on.

    The failsafe begins 0.15 s later.
    """
    scenario = find_scenario("osprey_servo", 8.0).vary(
        aircraft={"rate": 100.0, "step": 0.005}, reference_model={"rate": 100.0}
    )
    sentences: list[str] = []

    class Frozen(Controller):
        kept: FloatArray | None = None

        def take_y(self, sample: StampedVector, now_ns: int) -> Refusal | None:
            if now_ns >= 5_000 * MS:
                self.kept = sample.value if self.kept is None else self.kept
                sample = sample._replace(value=self.kept)
            reason = super().take_y(sample, now_ns)
            if reason:
                sentences.append(str(reason))
            return reason

    tape = simulate(scenario, control=Frozen)
    ticks = tape["internals"]
    instants = tape.time("internals")[ticks["mode"] != Mode.ENGAGED]
    assert instants[0] == approx(5.15, abs=0.011)
    assert "every value as before" in sentences[0]
    # the topic has what the controller received
    y = tape["y"]
    values = y.values.copy()
    values[y.stamp_ns >= 5_000 * MS] = values[y.stamp_ns == 5_000 * MS]
    received = replace(tape, signals={**tape.signals, "y": replace(y, values=values)})
    assert replay(received).is_equal()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["osprey_gust", "jsbsim_c172p"])
def test_healthy_flights_have_no_frozen_y(name: str) -> None:
    """No sample is lost without noise, in trim before the first command and long after the last."""
    quiet: dict[str, Any] = {"sensors": {}}
    reasons: list[Refusal | None] = []

    class Listening(Controller):
        def take_y(self, sample: StampedVector, now_ns: int) -> Refusal | None:
            reasons.append(super().take_y(sample, now_ns))
            return reasons[-1]

    simulate(find_scenario(name, 20.0).vary(aircraft=quiet), control=Listening)
    assert not any(reasons)
