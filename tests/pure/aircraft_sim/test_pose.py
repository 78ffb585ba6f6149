# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the pose of the simulated aircraft, Euler's kinematics, and the steady wind."""

import math
from typing import Any, cast

import numpy as np
import pytest
from pytest import approx
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from tests.builders import aircraft_parameters
from tests.conftest import refusing

from aircraft_sim import pose
from aircraft_sim.jsbsim.jsbsim_model import JsbsimModel
from aircraft_sim.plant import dynamics
from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.channels import POSE
from flight_core.kinematics import heading_rate
from flight_core.tape import Signal
from flight_core.units import GRAVITY

OSPREY = find_scenario("osprey_servo")
C172P = find_scenario("jsbsim_c172p")
RATE = 100.0  # Hz
QUIET: dict[str, Any] = {"gusts": {}, "sensors": {}}


@pytest.mark.parametrize("angle", [-math.pi, 0.0, math.pi, 3.2])
def test_heading_wrapped_to_half_turn_either_way(angle: float) -> None:
    wrapped = pose.wrapped(angle)
    assert -math.pi < wrapped <= math.pi
    assert (math.sin(wrapped), math.cos(wrapped)) == approx(
        (math.sin(angle), math.cos(angle)), abs=1e-12
    )


def test_velocity_over_ground_is_airspeed_turned_from_body_axes_to_north_east_down() -> None:
    speed = 40.0
    alpha = 0.1
    beta = -0.05
    phi = 0.6
    theta = 0.2
    psi = 2.5
    body = speed * np.array(
        [math.cos(alpha) * math.cos(beta), math.sin(beta), math.sin(alpha) * math.cos(beta)]
    )
    # SciPy's intrinsic rotations.
    north, east, down = Rotation.from_euler("ZYX", [psi, theta, phi]).apply(body)
    assert pose.velocity(speed, alpha, beta, phi, theta, psi) == approx(
        (north, east, -down), rel=1e-14
    )


def test_a_start_elsewhere_turns_and_moves_the_flight() -> None:
    pose_in_air = dict.fromkeys(POSE, 0.0) | {
        "psi": 3.0,
        "north": 10.0,
        "east": 2.0,
        "v_north": 5.0,
        "v_east": -1.0,
    }
    after = pose.over_ground(
        np.array([*pose_in_air.values()]), 0.0, (0.0, 0.0), pose.Start(100.0, -50.0, math.pi / 2.0)
    )
    result = dict(zip(POSE, after.tolist(), strict=True))
    # A quarter turn to the right: what was ahead is east, what was to the right is south.
    assert (result["north"], result["east"]) == approx((100.0 - 2.0, -50.0 + 10.0))
    assert (result["v_north"], result["v_east"]) == approx((1.0, 5.0))
    assert result["psi"] == approx(3.0 + math.pi / 2.0 - 2.0 * math.pi)


def euler_rates(x: dict[str, float]) -> dict[str, float]:
    """Return the derivatives of equation (1) for the osprey with kinematics euler and no input."""
    airframe, aircraft = aircraft_parameters(kinematics="euler").load()
    state = np.array([x.get(name, 0.0) for name in airframe.states])
    return dict(
        zip(
            airframe.states, dynamics.x_dot(0.0, state, np.zeros(4), aircraft).tolist(), strict=True
        )
    )


def test_euler_kinematics_turn_body_rates_as_attitude_turns() -> None:
    # The derivative of the rotation matrix of (phi, theta, psi) is R times the skew matrix of (p,
    # q, r).
    phi, theta, (p, q, r) = 0.7, 0.3, (0.2, -0.1, 0.25)
    rates = euler_rates({"phi": phi, "theta": theta, "p": p, "q": q, "r": r})
    dt = 1e-6
    after = Rotation.from_euler("ZYX", [0.0, theta, phi]) * Rotation.from_rotvec(
        np.array([p, q, r]) * dt
    )
    psi_after, theta_after, phi_after = after.as_euler("ZYX")
    assert rates["phi"] == approx((phi_after - phi) / dt, abs=1e-6)
    assert rates["theta"] == approx((theta_after - theta) / dt, abs=1e-6)
    assert heading_rate(phi, theta, q, r) == approx(psi_after / dt, abs=1e-6)


def test_level_turn_keeps_attitude_and_costs_lift() -> None:
    # q = psi_dot sin(phi), r = psi_dot cos(phi), psi_dot = (g/V) tan(phi): the rates of a level
    # turn hold phi and theta.
    phi = 0.5
    turn = GRAVITY / 25.0 * math.tan(0.5)
    rates = euler_rates({"phi": phi, "q": turn * math.sin(phi), "r": turn * math.cos(phi)})
    assert abs(rates["phi"]) < 1e-15
    assert abs(rates["theta"]) < 1e-15
    lift = euler_rates({"phi": phi})["alpha"] - euler_rates({})["alpha"]
    assert lift == approx(GRAVITY / 25.0 * (math.cos(phi) - 1.0), rel=1e-12)


@pytest.mark.parametrize(
    "airframe, values, sentence",
    [
        ("b747_lateral", {"kinematics": "euler"}, "no state alpha, theta"),
        ("osprey", {"wind": [3.0]}, "wind"),
    ],
)
def test_kinematics_and_wind_that_aircraft_cannot_have_refused(
    airframe: str, values: dict[str, Any], sentence: str
) -> None:
    with refusing(sentence):
        aircraft_parameters(airframe=airframe, **values)


def test_pose_of_airframe_agrees_with_another_integrator() -> None:
    """Heading and position after an aileron step agree with SciPy's integrator.

    The rotations are SciPy's, too.
    """
    simulator = Simulator(aircraft_parameters(kinematics="euler"))
    airframe, aircraft = aircraft_parameters(kinematics="euler").load()
    states = list(airframe.states)
    u = np.array([0.0, 0.0, 0.01, 0.0])

    def derivative(t: float, z: Any) -> Any:
        x = z[:8]
        psi = z[8]
        V, alpha, q, theta, beta, _, r, phi = (x[states.index(name)] for name in states)
        air = (25.0 + V) * np.array(
            [math.cos(alpha) * math.cos(beta), math.sin(beta), math.sin(alpha) * math.cos(beta)]
        )
        north, east, down = Rotation.from_euler("ZYX", [psi, theta, phi]).apply(air)
        turn = (q * math.sin(phi) + r * math.cos(phi)) / math.cos(theta)
        return np.concatenate([dynamics.x_dot(t, x, u, aircraft), [turn, north, east, -down]])

    exact = solve_ivp(derivative, (0.0, 5.0), np.zeros(12), rtol=1e-10, atol=1e-12).y[:, -1]
    for number in range(int(5.0 * RATE) + 1):
        simulator.sample(number, u if number else np.zeros(4))
    result = dict(zip(POSE, simulator.pose().tolist(), strict=True))
    expected = {
        "phi": exact[states.index("phi")],
        "psi": exact[8],
        "north": exact[9],
        "east": exact[10],
        "altitude": exact[11],
    }
    assert abs(exact[states.index("phi")]) > 0.05  # it has rolled
    for name, value in expected.items():
        # m and rad: the trapezoidal rule at 100 Hz.
        assert result[name] == approx(value, abs=2e-3), name


def guided(signal: Signal) -> dict[str, Any]:
    return {name: signal[name] for name in signal.names}


@pytest.mark.parametrize("scenario", [OSPREY, C172P], ids=lambda scenario: scenario.name)
def test_steady_wind_moves_position_and_nothing_else(scenario: Any) -> None:
    short = scenario.vary(flight={"duration": 3.0}, aircraft=QUIET)
    still = simulate(short)
    windy = simulate(short.vary(aircraft={"wind": [-4.0, 3.0]}))
    for topic in ("y", "u"):
        assert still[topic].values.tobytes() == windy[topic].values.tobytes()
    for name in still["truth"].names:
        if not name.startswith("pose."):
            assert (still["truth"][name] == windy["truth"][name]).all()
    before = guided(still["pose"])
    after = guided(windy["pose"])
    t = still.time("pose")
    for name, moved in (
        ("north", -4.0 * t),
        ("east", 3.0 * t),
        ("v_north", -4.0),
        ("v_east", 3.0),
        ("altitude", 0.0),
    ):
        assert after[name] - before[name] == approx(np.broadcast_to(moved, t.shape), abs=1e-10), (
            name
        )


def test_pose_of_jsbsim_is_absolute_and_consistent() -> None:
    tape = simulate(C172P.vary(flight={"duration": 20.0}, aircraft=QUIET))
    result = tape["pose"]
    t = tape.time("pose")
    truth = tape["truth"].group("x")
    speed = C172P.aircraft.speed
    altitude = C172P.aircraft.altitude
    assert (result["v_north"][0], result["altitude"][0]) == (
        approx(speed, rel=1e-3),
        approx(altitude, rel=1e-6),
    )
    at = np.isin(tape["truth"].stamp_ns, result.stamp_ns)
    # Truth holds deviations from trim.
    for name in ("theta", "altitude", "phi"):
        assert result[name] - result[name][0] == approx(
            truth[name][at] - truth[name][0], abs=1e-9
        ), name
    # JSBSim integrates the altitude, the model the place from JSBSim's velocities: the derivatives
    # of both are the velocities.
    for position, velocity in (("altitude", "climb"), ("north", "v_north"), ("east", "v_east")):
        slope = np.gradient(result[position], t)
        assert slope[1:-1] == approx(result[velocity][1:-1], abs=0.05), position
    assert np.abs(result["phi"]).max() > 0.1  # the scenario banks


def test_place_of_jsbsim_is_that_of_own_latitude_and_longitude() -> None:
    """The flight lasts 60 s in still air, with a turn after an aileron pulse."""
    aircraft = C172P.vary(aircraft=QUIET).aircraft
    simulator = Simulator(aircraft)
    model = cast(JsbsimModel, simulator._model)  # its properties are not in the pose
    angles = ("position/lat-gc-rad", "position/long-gc-rad")
    start = [model._fdm[path] for path in angles]
    for number in range(int(60.0 * aircraft.rate) + 1):
        pulse = 2.0 < number / aircraft.rate < 3.0
        simulator.sample(number, np.array([0.0, 0.0, 0.05 if pulse else 0.0, 0.0]))
    result = dict(zip(POSE, simulator.pose().tolist(), strict=True))
    radius = 0.3048 * model._fdm["position/radius-to-vehicle-ft"]
    north, east = (
        radius * (model._fdm[path] - before) for path, before in zip(angles, start, strict=True)
    )
    assert abs(start[0]) < 1e-12  # it flies from the equator: no cosine of the latitude
    assert (result["north"], result["east"]) == (approx(north, rel=0.01), approx(east, rel=0.01))
    assert east > 300.0  # m: it has turned


POOR = {
    "rate": 5.0,
    "delay": 0.1,
    "bias": {"psi": 0.1},
    "noise": {"north": 2.0, "psi": 0.02},
    "drift": {"altitude": 0.3},
}


def test_poor_pose_is_late_rare_and_off_as_specified() -> None:
    """In 100 s there are 500 samples.

    The standard deviation of their noise must be within 4 / sqrt(2 N) of the specified one.
    """
    simulator = Simulator(aircraft_parameters(pose=POOR, rate=100.0))
    truth = {}
    arrived = []
    for number in range(100 * 100 + 1):
        simulator.sample(number, np.zeros(4))
        truth[number * 10_000_000] = simulator.pose()
        arrived += [(number * 10_000_000, sample) for sample in simulator.poses()]
        if number % 20 == 0:
            errors = dict(zip(simulator.truth_names, simulator.truth(), strict=True))
            told = [errors[f"pose.{name}"] for name in POSE]
            assert told == simulator.pose().tolist()
    assert {now - sample.stamp_ns for now, sample in arrived} == {100_000_000}
    assert [sample.stamp_ns for _, sample in arrived[:3]] == [0, 200_000_000, 400_000_000]
    off = np.array([sample.value - truth[sample.stamp_ns] for _, sample in arrived])
    assert off[:, POSE.index("north")].std() == approx(2.0, rel=4.0 / math.sqrt(2.0 * len(off)))
    assert off[:, POSE.index("psi")].mean() == approx(0.1, abs=4.0 * 0.02 / math.sqrt(len(off)))
    steps = np.diff(off[:, POSE.index("altitude")])
    assert steps.std() == approx(0.3 * math.sqrt(0.2), rel=4.0 / math.sqrt(2.0 * len(steps)))
    assert not off[:, POSE.index("phi")].any()
    assert errors["noise.pose.psi"] == approx(0.1, abs=0.1)


@pytest.mark.parametrize(
    "section, sentence",
    [
        ({"noise": {"pitch": 1.0}}, "pose.noise: found pitch, expected some of phi, theta"),
        (
            {"rate": 40.0},
            r"rate: found 0.01 s, expected a whole fraction of 1 / pose.rate \(0.025 s\)",
        ),
    ],
)
def test_pose_that_aircraft_cannot_measure_refused(section: dict[str, Any], sentence: str) -> None:
    with refusing(sentence):
        aircraft_parameters(pose=section, rate=100.0)
