# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test guidance of multicopters: the direction of the thrust, and flights in one process."""

import math
from typing import Any

import numpy as np
import pytest
from pytest import approx
from scipy.spatial.transform import Rotation
from tests.conftest import REPOSITORY, refusing

from flight_analysis.closed_loop.guidance_replay import replay_guidance
from flight_analysis.closed_loop.scenario import Scenario, load_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.guided import LegResult, flown_legs, guidance_notices, guidance_summary
from flight_core.channels import POSE
from flight_core.kinematics import thrust_axis
from flight_core.tape import Tape
from flight_core.units import GRAVITY
from flight_core.vectors import ChannelError, StampedVector
from flight_guidance import guidance_state
from flight_guidance.guidance import Guidance
from flight_guidance.guidance_state import GuidanceMode
from flight_guidance.multicopter import multicopter
from flight_guidance.params import GuidanceConfig
from reference_model.reference import Reference

SQUARE = load_scenario(REPOSITORY / "examples/px4_quadrotor/square.yaml")
ROUTE = {"north": [0, 20, 20, 0, 0], "east": [0, 0, 20, 20, 0], "altitude": [2.0] * 5}
assert SQUARE.guidance is not None
SECTION = SQUARE.guidance
PARAMS = SECTION.params()
DRAG = 0.9794  # 1/s, of the climb by the airframe file


def flight(duration: float, aircraft: Any = None, **section: Any) -> tuple[Scenario, Tape]:
    """Fly the quadrotor in one process. It has no route unless the section has one."""
    changes: dict[str, Any] = {"flight": {"duration": duration}, "aircraft": aircraft or {}}
    scenario = SQUARE.vary(**changes, guidance={"route": None} | section)
    tape = simulate(scenario)
    assert tape.outcome.status == 0
    return scenario, tape


@pytest.fixture(scope="module")
def square() -> tuple[Scenario, Tape]:
    return flight(34.0, route=ROUTE)


def commanded(**values: float) -> dict[str, Any]:
    """Return a program that commands channels from 1 s on."""
    return {name: {"start": [1.0], "value": [value]} for name, value in values.items()}


@pytest.mark.parametrize("attitude", [(0.3, -0.5, 2.0), (-1.2, 0.4, -0.7), (2.5, 0.2, 0.1)])
def test_body_rates_turn_thrust_to_its_direction_by_the_shortest_way(
    attitude: tuple[float, float, float],
) -> None:
    # The rotations of scipy know nothing of the angles here: body to north, east, down.
    phi, theta, psi = attitude
    turned = Rotation.from_euler("ZYX", [psi, theta, phi])
    north, east, down = turned.apply([0.0, 0.0, -1.0])
    assert thrust_axis(phi, theta, psi) == approx((north, east, -down))
    own = PARAMS.multicopter
    assert own is not None
    state = multicopter._begin(None, inputs_of(attitude), pose_of(attitude), PARAMS)
    rates = multicopter._rates(state, 0.1, -0.2, own._replace(tilt_rate=math.inf))
    expected = Rotation.from_euler("ZYX", [psi, -0.2, 0.1]).apply([0.0, 0.0, -1.0])
    way = np.array([rates["p"], rates["q"], 0.0]) / own.k_tilt
    assert (turned * Rotation.from_rotvec(way)).apply([0.0, 0.0, -1.0]) == approx(expected)
    assert np.linalg.norm(way) == approx(math.acos(expected @ [north, east, down]))


def pose_of(attitude: tuple[float, float, float], **values: float) -> dict[str, float]:
    return dict.fromkeys(POSE, 0.0) | dict(zip(POSE, attitude, strict=False)) | values


def inputs_of(attitude: tuple[float, float, float]) -> guidance_state.Inputs:
    pose = tuple(pose_of(attitude).values())
    return guidance_state.Inputs(
        t_ns=0, begin=guidance_state.Begin.HOLD, pose=pose, pose_age_ns=0, y=(0.0,) * 4, commands={}
    )


def test_square_at_3_m_per_s_stays_on_its_lines_and_replays_to_the_bit(
    square: tuple[Scenario, Tape],
) -> None:
    scenario, tape = square
    log = tape["guidance"]
    legs = flown_legs(tape)
    assert [leg.result for leg in legs] == [LegResult.FLOWN] * 7 + [LegResult.NOT_ENDED]
    on_lines = (log["leg"] < 7) & (log["joining"] == 0.0)
    # 0.07 m flown, with noise; a tilt that is late by its lag of 0.4 s would be beside by 0.3 m
    assert np.max(np.abs(log["xtrack"][on_lines])) < 0.15
    assert log["xtrack"][-1] < 1.0  # hovers at the last waypoint
    assert np.max(np.abs(log["pose.psi"])) < math.radians(3.0)  # the nose stays
    first = (log["leg"] == 0) & (tape.time("guidance") > 5.0)
    assert np.mean(np.hypot(log["pose.v_north"], log["pose.v_east"])[first]) == approx(3.0, abs=0.1)
    # The drag of a steady flight holds against the tilt: g tan(tilt) = d v.
    steady = math.atan(DRAG * 3.0 / GRAVITY)
    assert np.mean(log["pose.theta"][first]) == approx(-steady, abs=0.03)
    replayed = replay_guidance(tape, scenario.guidance)
    assert replayed.is_equal()
    assert replayed.checked == len(log.stamp_ns)
    summary = guidance_summary(tape, scenario.guidance)
    assert summary is not None
    assert summary["segments"][0]["V"]["quantity"] == "V"
    assert guidance_notices(tape, scenario.guidance) == []


def test_wait_hovers_at_its_waypoint_for_its_time_and_the_flight_goes_on() -> None:
    scenario, tape = flight(19.0, route=ROUTE | {"wait": [0, 4, 0, 0, 0]})
    log = tape["guidance"]
    beside = np.hypot(log["pose.north"] - 20.0, log["pose.east"])
    hovers = (log["leg"] == 1) & (log["loitered"] > 0.0)
    assert np.ptp(tape.time("guidance")[hovers]) == approx(4.0, abs=0.05)
    assert np.max(beside[hovers]) < 1.5  # within 0.5 s of flight at 3 m/s, where the time begins
    assert [leg.result for leg in flown_legs(tape)[:2]] == [LegResult.FLOWN] * 2
    assert log["leg"][-1] > 1
    assert replay_guidance(tape, scenario.guidance).is_equal()


def test_attitude_heading_and_climb_are_held_apart() -> None:
    program = commanded(phi=0.15, theta=-0.1, heading=1.2, climb=0.5)
    _, tape = flight(9.0, program=program)
    log = tape["guidance"]
    late = tape.time("guidance") > 7.0
    for name, value in (("phi", 0.15), ("theta", -0.1), ("psi", 1.2), ("climb", 0.5)):
        assert np.mean(log[f"pose.{name}"][late]) == approx(value, abs=0.05)


def test_fence_is_kept_and_home_reached() -> None:
    zone = {"north": [-10, 30, 30, -10], "east": [-10, -10, 30, 30]}
    program = commanded(course=0.4, V=4.0)
    _, tape = flight(22.0, program=program, fence={"field": zone})
    log = tape["guidance"]
    assert np.min(log["fence.clearance"]) > 0.5  # MARGIN of flight at 1 m/s
    assert np.hypot(log["pose.north"], log["pose.east"])[-1] < 2.0


def test_wind_is_found_by_the_tilt_of_a_hover() -> None:
    _, tape = flight(15.0, {"wind": [2.0, -1.0]})
    log = tape["guidance"]
    assert (log["wind.north"][-1], log["wind.east"][-1]) == approx((2.0, -1.0), abs=0.3)
    assert log["xtrack"][-1] < 0.5


def test_lost_rotor_is_said_within_a_second() -> None:
    hexarotor = load_scenario(REPOSITORY / "examples/hexarotor/hexarotor_square.yaml")
    actuators = hexarotor.aircraft.actuators.model_dump() | {"faults": ["rotor_1 failed 1"]}
    failing = hexarotor.vary(aircraft={"actuators": actuators}, flight={"duration": 2.0})
    (notice,) = guidance_notices(simulate(failing), failing.guidance)
    assert "its limit 30 deg: a rotor may be lost" in notice


def test_stale_pose_levels_and_its_return_hovers() -> None:
    guide = Guidance(GuidanceConfig(**SECTION.model_dump() | {"route": None, "hold": 1.0}))
    tilted = pose_of((0.3, 0.0, 0.0), v_east=1.0, altitude=10.0)
    modes = []
    for k in range(120):
        now_ns = k * guide.period_ns
        guide.take_y(StampedVector(now_ns, np.zeros(4)), now_ns)
        if k < 2 or k > 100:
            values = np.array([*tilted.values()]) + 1e-6 * k
            guide.take_pose(StampedVector(now_ns, values), now_ns)
        output = guide.step(now_ns, now_ns)
        assert output is not None
        assert guide.state is not None
        modes.append((guide.mode, dict(zip(SECTION.outputs, output.u_m.tolist(), strict=False))))
    assert modes[40][0] is GuidanceMode.DEAD_RECKONING
    assert modes[40][1]["p"] < -0.1  # from a bank of 0.3 rad to a vertical thrust
    assert modes[95][0] is GuidanceMode.POSE_LOST
    assert modes[95][1] == approx(dict.fromkeys(SECTION.outputs, 0.0), abs=0.05)
    assert modes[-1][0] is GuidanceMode.ENGAGED
    assert guide.state is not None
    assert guide.state.target.altitude == approx(10.0, abs=0.01)
    with pytest.raises(ChannelError, match="expected north and east together"):
        guide.take_target({"north": 1.0})
    with pytest.raises(ChannelError, match="found radius, expected some of phi, heading, course"):
        guide.take_target({"radius": 10.0})


def test_reference_model_levels_a_multicopter_whose_guidance_is_lost() -> None:
    reference = Reference(SQUARE.reference_model)
    reference.take(0, np.zeros(4), np.array([0.3, -0.2]))
    rates = np.array([reference.sample(k) for k in range(500)])
    turned = dict(zip(SQUARE.reference_model.outputs, 0.01 * rates.sum(axis=0), strict=True))
    assert (turned["p"], turned["q"]) == approx((-0.3, 0.2), abs=0.01)


def test_what_no_multicopter_flies_is_refused() -> None:
    with refusing("drag: found None, expected g tan"):
        SQUARE.vary(guidance={"drag": None})
    with refusing(r"route\[1\]: found turns or a leave, .*`wait` hovers"):
        SQUARE.vary(guidance={"route": ROUTE | {"turns": [0, 1, 0, 0, 0]}})
    with refusing(r"radius: found 2 m, expected at least 5\.3 m at 3 m/s"):
        SQUARE.vary(guidance={"radius": 2.0})
    with refusing("kinematics: found 'linear' beside guidance, expected thrust"):
        simulate(SQUARE.vary(aircraft={"kinematics": "linear"}))
