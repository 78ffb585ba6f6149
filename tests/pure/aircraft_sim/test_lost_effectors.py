# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a lost effector takes from an aircraft in trim: the thrust of an engine or a rotor, and
nothing of a surface.
"""

import math
from typing import Any

import numpy as np
import pytest
from tests.conftest import REPOSITORY

from aircraft_sim import plant
from aircraft_sim.actuators import move
from aircraft_sim.airframe import load_airframe
from aircraft_sim.params import AircraftConfig
from flight_core.parameters import ParameterError
from flight_core.units import GRAVITY
from flight_core.vectors import FloatArray

STEP = 1e-5  # s: over one step in trim the damping changes an acceleration by less than 1e-3 of it
STEP_NS = 10_000
HEXAROTOR = str(REPOSITORY / "examples" / "hexarotor" / "hexarotor.yaml")


def configured(airframe: str, lost: str, **actuators: Any) -> AircraftConfig:
    """The aircraft whose effector `lost` is lost at t = 0."""
    times = [0.0 if name == lost else math.inf for name in load_airframe(airframe).inputs]
    values = {
        "airframe": airframe,
        "rate": 100.0,
        "step": STEP,
        "actuators": {"lost_at": times} | actuators,
    }
    return AircraftConfig.validate_mapping(values, "aircraft")


def accelerations(airframe: str, lost: str) -> dict[str, float]:
    """x_dot of the aircraft in trim by state, SI, with all commands at trim and an effector
    lost.
    """
    params = configured(airframe, lost).plant()
    u = np.zeros(len(load_airframe(airframe).inputs))
    x = plant.advance(0, plant.initial_state(params), u, STEP_NS, params).x
    return dict(zip(load_airframe(airframe).states, (x / STEP).tolist(), strict=True))


@pytest.mark.parametrize(("lost", "toward"), [("left_thrust", -1.0), ("right_thrust", 1.0)])
def test_twin_yaws_toward_its_dead_engine_by_the_arm_times_the_remaining_thrust(
    lost: str, toward: float
) -> None:
    """By hand, of the sources of the file: 3 m/s^2 by 13.5 kg in trim, half of it an engine, at 0.2
    m, J_z 1.759 kg m^2.
    """
    thrust = 0.5 * 0.06 * 100.0 * 13.5 / 2.0
    found = accelerations("osprey_twin", lost)
    assert found["r"] == pytest.approx(
        toward * 0.2 * thrust / 1.759, rel=2e-3
    )  # the file has two figures: 0.046 of 0.04605
    assert found["V"] == pytest.approx(-thrust / 13.5, rel=2e-3)
    assert found["p"] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("name", ["osprey", "osprey_vtail"])
def test_without_its_only_engine_the_osprey_slows_down_by_its_thrust(name: str) -> None:
    """Half of 0.6 times the weight, as the airframe file says; 0.06 m/s^2 per % rounds it by 2
    %.
    """
    found = accelerations(name, "thrust")
    assert found["V"] == pytest.approx(-0.5 * 0.6 * GRAVITY, rel=0.02)
    assert [found["q"], found["r"]] == pytest.approx([0.0, 0.0], abs=1e-3)


def test_thrust_of_flying_wing_in_trim_is_its_drag() -> None:
    """Drag of V^2 at constant alpha: m V0 abs(A[V,V]) / 2, of a column of the file that no thrust
    has a part in.
    """
    found = accelerations("x8_elevons", "thrust")
    assert found["V"] == pytest.approx(-0.1142 * 18.0 / 2.0, rel=2e-3)


@pytest.mark.parametrize("number", range(1, 7))
def test_hexarotor_loses_a_sixth_of_its_lift_and_the_moments_of_the_rotor(number: int) -> None:
    """Newton and Euler with the geometry in the file: 1.5 kg, 0.275 m, 0.02, 0.02, 0.035 kg m^2,
    0.016 m of torque a newton.

    The trim thrust of the file has three figures, 2.45 of 2.4525 N.
    """
    thrust = 1.5 * GRAVITY / 6.0
    angle = math.radians(30.0 + 60.0 * (number - 1))  # from the nose to the right
    north, east = 0.275 * math.cos(angle), 0.275 * math.sin(angle)
    roll, pitch = np.array([-east, north]) * thrust / 0.02  # of a thrust up: r x F
    yaw = 0.016 * thrust / 0.035 * (1.0 if number % 2 else -1.0)
    found = accelerations(HEXAROTOR, f"rotor_{number}")
    assert found["w"] == pytest.approx(GRAVITY / 6.0, rel=2e-3)  # down
    expected = np.array([-roll, -pitch, -yaw])
    assert [found[rate] for rate in "pqr"] == pytest.approx(expected.tolist(), rel=2e-3, abs=1e-3)


def positions(params: AircraftConfig, commands: list[float]) -> FloatArray:
    position, at = np.zeros(len(commands)), []
    for k in range(5):
        position, mean = move(0.01 * k, position, np.array(commands), 0.01, params.actuator_model())
        at += [position, mean]
    return np.array(at)


@pytest.mark.parametrize(
    ("airframe", "effector"),
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
    """Its position is that of no thrust in each step, behind lag, rate and stops, and beside the
    other faults.
    """
    frame = load_airframe(airframe)
    place, count = list(frame.inputs).index(effector), len(frame.inputs)
    nothing = {"osprey_twin": -0.5, "osprey_vtail": -0.5, "x8_elevons": -3.46, HEXAROTOR: -2.45}[
        airframe
    ]
    always = [0.0] * count  # s
    beside: tuple[dict[str, list[float]], ...] = (
        {},
        {
            "lag": [0.1] * count,
            "rate": [0.5] * count,
            "lower": [-0.1] * count,
            "upper": [0.1] * count,
        },
        {"stuck_at": always},
        {"slow_at": always, "loose_at": always},
        {"weak_at": always},
    )
    for properties in beside:
        for command in (-5.0, 0.0, 5.0):
            found = positions(configured(airframe, effector, **properties), [command] * count)
            assert found[:, place].tolist() == [nothing] * len(found)


@pytest.mark.parametrize("key", ["lost_at", "weak_at"])
def test_loss_of_an_unknown_thrust_is_refused_with_the_way_out(key: str) -> None:
    """An input that is no angle may be a thrust: where it gives none is not guessed."""
    never = math.inf
    values = {"airframe": "navion_longitudinal", "rate": 100.0, "step": 0.01}
    with pytest.raises(ParameterError) as refused:
        AircraftConfig.validate_mapping(values | {"actuators": {key: [never, 5.0]}}, "aircraft")
    assert str(refused.value) == (
        f"aircraft.actuators.{key}: found 5 s for thrust, expected .inf, or no_thrust of thrust "
        "in the airframe"
        " navion_longitudinal: its value without thrust, from trim, in 1; 0 for a surface"
    )
    for accepted in ([5.0, never], [never, never], []):
        AircraftConfig.validate_mapping(values | {"actuators": {key: accepted}}, "aircraft")
