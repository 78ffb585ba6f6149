# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test live commands u_m: their bounds, age limit, and what ends them without a publisher.

The ending levels the wings. A stand-in for guidance rolls each aircraft into a coordinated turn
with p_m = k (phi_c - phi). It falls silent at several instants of the roll-in.
"""

import math
from typing import Any

import numpy as np
import pytest
from tests.conftest import refusing

from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.channels import POSE
from flight_core.units import GRAVITY
from flight_core.vectors import ChannelError, FloatArray, StampedVector, select
from reference_model.params import ReferenceModelConfig
from reference_model.reference import Reference, Source
from rise_di_controller.controller import Controller

pytestmark = pytest.mark.slow

OUTPUTS = ("q", "V", "p", "r")
RATE = 200.0  # Hz
SECTION: dict[str, Any] = {
    "rate": RATE,
    "outputs": list(OUTPUTS),
    "second_order": {"natural_frequency": [4.0, 0.5, 5.0, 4.0], "damping": [0.9, 1.0, 0.9, 0.9]},
    "rise": 0.1,
}
MS = 1_000_000  # ns


def reference(**live: Any) -> Reference:
    return Reference(
        ReferenceModelConfig.validate_mapping(SECTION | {"live": live}, "reference_model")
    )


def test_command_beyond_bound_refused_and_changes_nothing() -> None:
    model = reference(bounds={"p": 0.5})
    with pytest.raises(ChannelError, match="beyond the bounds") as refused:
        model.take(0, np.array([0.0, 0.0, 0.6, 0.0]))
    assert refused.value.reason == "bounds"
    assert model.source() is Source.PROFILE


def test_command_that_is_not_newer_refused() -> None:
    model = reference()
    model.take(0, np.zeros(4))
    with pytest.raises(ChannelError, match="u_m"):
        model.take(0, np.zeros(4))


def test_command_acts_from_step_after_it_and_no_earlier() -> None:
    model = reference()
    before = model.sample(10)
    model.take(10 * 5 * MS, np.array([0.1, 0.0, 0.0, 0.0]))
    # y_m of the same instant has no knowledge of it
    assert np.array_equal(model.sample(10), before)
    assert model.sample(11)[0] > 0.0


def test_bank_is_dead_reckoned_by_y_m_that_was_published_where_samples_skipped() -> None:
    model = reference(speed=25.0)
    bank = math.radians(20.0)
    last = 0
    model.take(0, np.array([0.0, 0.0, 0.35, 0.0]), np.array([bank, 0.0]))
    p = model.sample(0)[2]
    # Of the 0.3 s after sample 90 the reference rolls back without a y_m: the law tracks the roll
    # rate of before.
    for number in [*range(1, 91), *range(150, 2000)]:
        bank += (number - last) / RATE * p
        p = model.sample(number)[2]
        last = number
    # of an aircraft that tracks; 6 deg by the rates of the skipped samples
    assert abs(math.degrees(bank)) < 1.0


def test_without_attitude_command_that_times_out_becomes_zero() -> None:
    model = reference(speed=25.0)
    model.take(0, np.array([0.1, 1.0, 0.2, 0.0]))
    model.sample(40)  # 0.2 s: the age limit
    assert model.source() is Source.LIVE
    y_m = model.sample(41)[2]
    assert model.source() is Source.ENDING
    assert y_m > 0.05  # rad/s: 0.2 s of a reference of 5 rad/s and a command of 0.2 rad/s
    # 40 s: the slowest channel has a time constant of 2 s
    assert np.abs(model.sample(8000)).max() < 1e-6


@pytest.mark.parametrize("outputs", [["q", "p", "r"], ["pitch", "V", "p", "r"]])
def test_levelling_needs_the_rates_and_the_speed(outputs: list[str]) -> None:
    n = len(outputs)
    section = SECTION | {
        "outputs": outputs,
        "second_order": {"natural_frequency": [4.0] * n, "damping": [0.9] * n},
    }
    with refusing(r"live\.speed: found 25"):
        ReferenceModelConfig.validate_mapping(
            section | {"live": {"speed": 25.0}}, "reference_model"
        )


def test_wings_are_levelled_without_rudder() -> None:
    section = SECTION | {
        "outputs": ["q", "V", "p"],
        "second_order": {"natural_frequency": [4.0, 0.5, 5.0], "damping": [0.9, 1.0, 0.9]},
        "live": {"speed": 25.0},
    }
    model = Reference(ReferenceModelConfig.validate_mapping(section, "reference_model"))
    model.take(0, np.zeros(3), np.array([0.4, 0.0]))
    rolled = sum(model.sample(k)[2] for k in range(2000)) / RATE  # 10 s
    # phi_dot = p + tan(theta) (q sin(phi) + r cos(phi)), and theta stays small
    assert rolled == pytest.approx(-0.4, abs=0.02)


def test_in_lockstep_u_m_comes_at_instants_of_reference() -> None:
    with refusing("u_m_rate"):
        ReferenceModelConfig.validate_mapping(SECTION | {"u_m_rate": 60.0}, "reference_model")


AIRCRAFT: dict[str, tuple[Any, float]] = {
    "osprey": (
        lambda: find_scenario("osprey_servo").vary(
            aircraft={"kinematics": "euler", "gusts": {}, "rate": 100.0, "step": 0.005},
            reference_model={"rate": 100.0},
        ),
        35.0,
    ),
    "c172p": (lambda: find_scenario("jsbsim_c172p").vary(aircraft={"gusts": {}}), 30.0),
}


def flight(scenario: Scenario, bank_deg: float, lost: float, duration: float) -> FloatArray:
    """Return the samples [t, phi] of a flight, (N, 2).

    Its guidance rolls to a bank from t = 1 s on, and falls silent at `lost`.
    """
    speed = scenario.aircraft.channels().speed
    varied = scenario.vary(
        reference_model={"live": {"speed": speed}, "pulses": {}, "coordinated_turn": None}
    )
    aircraft = Simulator(varied.aircraft)
    model = Reference(varied.reference_model)
    controller = Controller(varied.controller)
    names = varied.reference_model.outputs
    u = np.zeros(4)
    attitude = np.zeros(len(POSE))
    level = 0.0
    history = []
    for t_ns in range(0, int(duration * 1e9) + 1, min(aircraft.period_ns, model.period_ns)):
        t = t_ns / 1e9
        if t_ns % aircraft.period_ns == 0:
            for sample in aircraft.sample(t_ns // aircraft.period_ns, u):
                y = select(varied.controller.outputs, aircraft.outputs, sample.value)
                controller.take_y(StampedVector(sample.stamp_ns, y), t_ns)
            attitude = aircraft.pose()
            history.append((t, attitude[0]))
        phi, theta = attitude[:2]
        level = theta if t_ns == 0 else level
        y_m = select(varied.controller.outputs, names, model.sample(t_ns // model.period_ns))
        controller.take_y_m(StampedVector(t_ns, y_m), t_ns)
        if t_ns % (20 * MS) == 0 and t < lost:
            phi_c = math.radians(bank_deg) if t >= 1.0 else 0.0
            turn = GRAVITY * math.tan(phi) / speed
            p = min(max(1.25 * (phi_c - phi), -0.6), 0.6)  # rad/s
            commands = {"q": turn * math.sin(phi), "V": 0.0, "p": p, "r": turn * math.cos(phi)}
            u_m = np.array([commands[name] for name in names])
            model.take(t_ns, u_m, np.array([phi, theta - level]))
        if t_ns % controller.period_ns == 0 and (output := controller.tick(t_ns)) is not None:
            u = select(aircraft.inputs, varied.controller.inputs, output.u)
    return np.array(history)


@pytest.mark.parametrize("lost", [1.5, 3.0])
@pytest.mark.parametrize("name", AIRCRAFT)
def test_wings_are_level_ten_seconds_after_guidance_fell_silent_in_roll_in(
    name: str, lost: float
) -> None:
    make, bank_deg = AIRCRAFT[name]
    t, phi = flight(make(), bank_deg, lost, lost + 11.0).T
    after = t > lost
    assert np.degrees(np.abs(phi[after]).max()) < 45.0
    assert np.degrees(np.abs(phi[t > lost + 10.0]).max()) < 5.0
    if lost == 3.0:
        assert np.degrees(np.abs(phi).max()) > 0.7 * bank_deg  # it had rolled
