# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test what an aircraft in trim loses with an effector.

It loses the thrust of an engine or a rotor, and nothing of a surface.
"""

import math
from typing import Any

import numpy as np
import pytest
from pytest import approx
from tests.conftest import REPOSITORY

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.params import AircraftConfig
from aircraft_sim.plant import plant
from aircraft_sim.plant.actuators import move
from flight_core.parameters import ParameterError
from flight_core.units import GRAVITY
from flight_core.vectors import FloatArray

STEP = 1e-5  # s: over one step in trim the damping changes an acceleration by less than 1e-3 of it
STEP_NS = 10_000
HEXAROTOR = str(REPOSITORY / "examples" / "hexarotor" / "hexarotor.yaml")


def configured(airframe: str, lost: str, *others: str, **actuators: Any) -> AircraftConfig:
    """The aircraft whose effector `lost` fails at t = 0, with other faults of each effector."""
    inputs = load_airframe(airframe).inputs
    beside = [f"{name} {kind} 0" for name in inputs for kind in others]
    values = {
        "airframe": airframe,
        "rate": 100.0,
        "step": STEP,
        "actuators": {"faults": [f"{lost} failed 0", *beside]} | actuators,
    }
    return AircraftConfig.validate_mapping(values, "aircraft")


def accelerations(airframe: str, lost: str) -> dict[str, float]:
    """Return x_dot of the aircraft in trim by state, SI, with an effector lost.

    All commands are at trim.
    """
    params = configured(airframe, lost).plant()
    u = np.zeros(len(load_airframe(airframe).inputs))
    x = plant.advance(0, plant.initial_state(params), u, STEP_NS, params).x
    return dict(zip(load_airframe(airframe).states, (x / STEP).tolist(), strict=True))


@pytest.mark.parametrize("lost, toward", [("left_thrust", -1.0), ("right_thrust", 1.0)])
def test_twin_yaws_toward_its_dead_engine_by_the_arm_times_the_remaining_thrust(
    lost: str, toward: float
) -> None:
    """The yaw follows by hand from the sources of the file.

    The thrust in trim is 3 m/s^2 times 13.5 kg, half of it from each engine, at an arm of 0.2 m.
    J_z is 1.759 kg m^2.
    """
    thrust = 0.5 * 0.06 * 100.0 * 13.5 / 2.0
    result = accelerations("osprey_twin", lost)
    # The file has two figures: 0.046 of 0.04605.
    assert result["r"] == approx(toward * 0.2 * thrust / 1.759, rel=2e-3)
    assert result["V"] == approx(-thrust / 13.5, rel=2e-3)
    assert result["p"] == approx(0.0, abs=1e-3)


@pytest.mark.parametrize("name", ["osprey", "osprey_vtail"])
def test_without_its_only_engine_the_osprey_slows_down_by_its_thrust(name: str) -> None:
    """The thrust is half of 0.6 times the weight, as the airframe file says.

    The 0.06 m/s^2 per % of the file are rounded by 2 %.
    """
    result = accelerations(name, "thrust")
    assert result["V"] == approx(-0.5 * 0.6 * GRAVITY, rel=0.02)
    assert [result["q"], result["r"]] == approx([0.0, 0.0], abs=1e-3)


def test_thrust_of_flying_wing_in_trim_is_its_drag() -> None:
    """At constant alpha, drag grows with V^2 and is m V0 abs(A[V,V]) / 2.

    The thrust is not part of this column of the file.
    """
    result = accelerations("x8_elevons", "thrust")
    assert result["V"] == approx(-0.1142 * 18.0 / 2.0, rel=2e-3)


@pytest.mark.parametrize("number", range(1, 7))
def test_hexarotor_loses_a_sixth_of_its_lift_and_the_moments_of_the_rotor(number: int) -> None:
    """The values follow from Newton and Euler with the geometry of the file.

    The mass is 1.5 kg, the arm 0.275 m, the inertia 0.02, 0.02, 0.035 kg m^2, and a rotor has 0.016
    m of torque per newton. The trim thrust of the file has three digits, 2.45 of 2.4525 N.
    """
    thrust = 1.5 * GRAVITY / 6.0
    angle = math.radians(30.0 + 60.0 * (number - 1))  # from the nose to the right
    north = 0.275 * math.cos(angle)
    east = 0.275 * math.sin(angle)
    roll, pitch = np.array([-east, north]) * thrust / 0.02  # of a thrust up: r x F
    yaw = 0.016 * thrust / 0.035 * (1.0 if number % 2 else -1.0)
    result = accelerations(HEXAROTOR, f"rotor_{number}")
    assert result["w"] == approx(GRAVITY / 6.0, rel=2e-3)  # down
    expected = np.array([-roll, -pitch, -yaw])
    assert [result[rate] for rate in "pqr"] == approx(expected.tolist(), rel=2e-3, abs=1e-3)


def positions(params: AircraftConfig, commands: list[float]) -> FloatArray:
    position = np.zeros(len(commands))
    at = []
    for k in range(5):
        position, mean = move(0.01 * k, position, np.array(commands), 0.01, params.actuator_model())
        at += [position, mean]
    return np.array(at)


@pytest.mark.parametrize(
    "airframe, effector",
    [
        ("osprey_twin", "left_thrust"),
        ("osprey_vtail", "thrust"),
        ("x8_elevons", "thrust"),
        (HEXAROTOR, "rotor_3"),
    ],
)
def test_no_command_and_no_other_fault_gives_a_lost_engine_thrust(
    airframe: str, effector: str
) -> None:
    """In each step, the lost engine is at the position without thrust.

    This is so whatever its lag, rate and stops are, and also with the other faults.
    """
    frame = load_airframe(airframe)
    place = list(frame.inputs).index(effector)
    count = len(frame.inputs)
    nothing = {"osprey_twin": -0.5, "osprey_vtail": -0.5, "x8_elevons": -3.46, HEXAROTOR: -2.45}[
        airframe
    ]
    behind = {
        "lag": [0.1] * count,
        "rate": [0.5] * count,
        "lower": [-0.1] * count,
        "upper": [0.1] * count,
    }
    nothing_else: dict[str, Any] = {}
    for others, properties in (
        ((), nothing_else),
        ((), behind),
        (("stuck",), nothing_else),
        (("slow", "loose"), nothing_else),
        (("weak",), nothing_else),
    ):
        for command in (-5.0, 0.0, 5.0):
            result = positions(
                configured(airframe, effector, *others, **properties), [command] * count
            )
            assert result[:, place].tolist() == [nothing] * len(result)


def refusal(airframe: str, *faults: str, **actuators: Any) -> str:
    """Return the sentence that refuses these faults, or "" if they are possible."""
    values = {"airframe": airframe, "rate": 100.0, "step": 0.01}
    try:
        section = actuators | {"faults": list(faults)}
        AircraftConfig.validate_mapping(values | {"actuators": section}, "aircraft")
    except ParameterError as refused:
        return str(refused).removeprefix("aircraft.actuators.")
    return ""


def test_loss_of_an_unknown_thrust_is_refused_with_the_way_out() -> None:
    """An input that is no angle may be a thrust, and the value without thrust is not guessed."""
    unknown = (
        "faults[0]: found thrust {} at 5 s, expected no_thrust of thrust in the airframe "
        "navion_longitudinal: its value without thrust, from trim; 0 for a surface"
    )
    assert refusal("navion_longitudinal", "thrust failed 5") == unknown.format("failed")
    assert refusal("navion_longitudinal", "elevator lost 5") == ""
    assert refusal("navion_longitudinal") == ""


@pytest.mark.parametrize(
    "fault, sentence",
    [
        ("aileron lots 60", "found 'lots', expected lost perhaps, or another of stuck, lost,"),
        ("ailron lost 60", "found 'ailron', expected aileron perhaps, or another of elevator,"),
        ("aileron lost", "found 'aileron lost', expected INPUT KIND AT, as aileron lost 60"),
        ("aileron lost soon", "found 'soon', expected a time in s, as 60"),
        ("aileron lost -1", "found -1 s, expected a time from 0 on"),
        ("aileron lost 60 0.5", "found 'aileron lost 60 0.5', expected aileron lost 60 alone"),
        ("aileron failed 60", "found aileron failed at 60 s, expected lost, of a surface"),
        ("thrust lost 60", "found thrust lost at 60 s, expected failed, of a thrust"),
        ("rudder hard_over 60", "found no end stop, expected rudder hard_over 60 lower, or upper"),
        (
            "rudder hard_over 60 upper",
            "found rudder hard_over at 60 s, expected an end stop of rudder in actuators.",
        ),
    ],
)
def test_fault_that_cannot_be_is_refused_with_the_mend(fault: str, sentence: str) -> None:
    assert refusal("osprey", fault).startswith(f"faults[0]: {sentence}")


def test_second_fault_of_a_kind_is_refused() -> None:
    assert refusal("osprey", "rudder slow 1", "rudder slow 2").endswith("expected one of each kind")
