# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test guided flights in one process.

The tests cover holds, routes, protection, the failsafe, refusals, and the log, from which each step
can be computed.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import path_laws
from pytest import approx
from rosbags.rosbag2 import StoragePlugin, Writer
from tests.closed_loop import calm_osprey as calm
from tests.conftest import invoke, refusing
from tests.joint_states import path

from flight_analysis.closed_loop.guidance_replay import replay_guidance
from flight_analysis.closed_loop.scenario import load_scenario
from flight_analysis.closed_loop.scenario_library import find_scenario, save_scenario, with_route
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.guided_figures import flown_routes
from flight_bringup.graph import GUIDANCE, second_stage
from flight_core.parameters import ParameterError
from flight_core.tape import Signal, Tape
from flight_core.vectors import ChannelError, FloatArray, StampedVector
from flight_guidance import guidance, guidance_log
from flight_guidance.guidance import Guidance
from flight_guidance.guidance_state import GuidanceMode, Lateral, Vertical
from flight_guidance.modes import modes
from flight_guidance.params import GuidanceConfig
from flight_guidance.routes.route_file import Waypoint, read_route
from flight_guidance.steering.path import Route
from flight_guidance.steering.protection import climb_range
from flight_log.named_vectors import PATH, typestore
from flight_log.tape_reader import read_run

pytestmark = pytest.mark.slow

# 100 Hz and steps of 5 ms: what guidance does at 50 Hz does not depend on them
ROUTE = find_scenario("osprey_route").vary(
    aircraft={"rate": 100.0, "step": 0.005}, reference_model={"rate": 100.0}
)
SECTION: dict[str, Any] = {
    "natural_frequency": [4.0, 1.2, 5.0, 4.0],
    "speed": 25.0,
    "throttle_authority": [3.0, 3.0],
}
MS = 1_000_000  # ns
# A bank of 0.1 rad.
BANKED = (0.1, 0.05, 0.3, 0.0, 0.0, 100.0, 25.0 * math.cos(0.3), 25.0 * math.sin(0.3), 0.0, 0.0)


def program(**channels: float) -> dict[str, Any]:
    """Return commands that begin at 1 s."""
    return {name: {"start": [1.0], "value": [value]} for name, value in channels.items()}


def channels(signal: Signal, *names: str) -> tuple[FloatArray, ...]:
    return tuple(signal[name] for name in names)


def after(tape: Tape, seconds: float) -> FloatArray:
    return np.asarray(tape.time("guidance") > seconds)


def test_heading_altitude_and_airspeed_reached_and_held() -> None:
    tape = simulate(calm(32.0, program=program(heading=math.pi / 2.0, altitude=20.0, V=27.0)))
    psi, altitude, V, phi = channels(
        tape["guidance"], "pose.psi", "pose.altitude", "y.V", "pose.phi"
    )
    end = after(tape, 28.0)
    assert np.degrees(np.abs(psi[end] - math.pi / 2.0).max()) < 1.0
    assert np.abs(altitude[end] - 20.0).max() < 0.5
    assert np.abs(V[end] - 2.0).max() < 0.1
    # The acceptance of a turn by 90 deg and of a climb: at most 2 and 3 % beyond.
    assert np.degrees(psi.max()) < 91.8
    assert altitude.max() < 20.6
    assert np.degrees(np.abs(phi).max()) < 32.0  # the limit of 30 deg, and 2


def test_route_flown_and_ends_in_orbit() -> None:
    """A short route is flown leg by leg, and ends in an orbit."""
    points = {"north": [0.0, 300.0, 300.0], "east": [0.0, 0.0, 300.0], "altitude": [0.0, 0.0, 6.0]}
    tape = simulate(calm(30.0, route=points))
    leg, xtrack, altitude = channels(tape["guidance"], "leg", "xtrack", "pose.altitude")
    assert np.unique(leg).tolist() == [0.0, 1.0, 2.0, 3.0]
    assert (np.diff(leg) >= 0.0).all()
    # 0.35 s of flight, the acceptance of a route in calm air
    assert np.abs(xtrack[leg < 3.0]).max() < 0.35 * 25.0
    assert altitude[-1] == approx(6.0, abs=1.0)


def test_line_captured_without_overshoot() -> None:
    # ArduPilot's L1 in the same loop takes 12.9 s and flies 11 m beyond (docs/evidence).
    time, beyond = path_laws.capture("guidance", 0.6)
    assert time < 12.9
    assert beyond < 0.5


def test_flying_wing_without_rudder_flies_route() -> None:
    """The X8 has elevons and a throttle, so r follows from the bank."""
    wing = find_scenario("x8_elevons").vary(
        flight={"duration": 32.0},
        aircraft={"kinematics": "euler", "gusts": {}, "rate": 100.0, "step": 0.005},
        reference_model={"rate": 100.0, "pulses": {}, "live": {"speed": 18.0}},
        guidance={},
    )
    places = ((0.0, 0.0), (225.0, 0.0), (225.0, 225.0), (0.0, 225.0))
    tape = simulate(with_route(wing, [Waypoint(north, east, 0.0) for north, east in places]))
    leg, xtrack, beta = channels(tape["guidance"], "leg", "xtrack", "pose.beta")
    assert np.unique(leg).tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert np.abs(xtrack).max() < 0.5 * 18.0  # half a second of flight, the claim in wind
    assert np.degrees(np.abs(beta).max()) < 5.0  # the sideslip that no rudder takes away
    with refusing("found r, expected some of phi"):
        wing.vary(guidance={"program": program(phi=0.1, r=0.05)})


def test_lost_aileron_is_found_without_a_learner() -> None:
    orbit = calm(30.0, program=program(north=0.0, east=400.0, radius=400.0))
    actuators = orbit.aircraft.actuators.model_dump() | {"faults": ["aileron lost 4"]}
    # An osprey off by up to 30 %, which else banks by 21 deg from then on.
    weaker = {"A": 0.3, "B": 0.3, "seed": 7, "number": 2}
    tape = simulate(orbit.vary(aircraft={"actuators": actuators, "uncertainty": weaker}))
    phi, ignored = channels(tape["guidance"], "pose.phi", "authority.roll")
    begin = tape.time("guidance")[ignored == 0.0][0]
    assert 4.0 < begin < 12.0  # after 2 s of the largest roll rate, and the turn before
    # 1.6 times the largest bank of 10 deg, and 1 deg
    assert np.degrees(np.abs(phi[after(tape, 22.0)]).max()) < 17.0


def test_small_corner_flown_with_small_bank() -> None:
    """A corner of half a degree needs a bank of about one degree."""
    # Its arc takes 0.07 s, the bank lags by 1.1 s. With the curvature of the arc all that time the
    # osprey banked by 17 deg.
    points = {
        "north": [0.0, 400.0, 900.0, 3000.0],
        "east": [0.0, 0.0, 5.0, 26.0],
        "altitude": [0.0] * 4,
    }
    phi, xtrack = channels(simulate(calm(22.0, route=points))["guidance"], "pose.phi", "xtrack")
    # 0.8 deg; half a degree in the 1.1 s asks for 1.2 deg at most
    assert np.degrees(np.abs(phi).max()) < 2.0
    assert np.abs(xtrack).max() < 1.0  # 0.4 m, in place of 6.9 m


def test_each_step_follows_from_log_to_last_bit() -> None:
    scenario = calm(8.0, program=program(course=1.0, climb=1.0))
    signal = simulate(scenario)["guidance"]
    section = scenario.guidance
    assert section is not None
    params = section.params()
    state = None
    for stamp_ns, values in zip(signal.stamp_ns.tolist(), signal.values, strict=True):
        inputs, logged = guidance_log.restored(
            stamp_ns, dict(zip(signal.names, values.tolist(), strict=True)), params.outputs
        )
        state, commands = modes.step(state, inputs, None, params)
        sample = guidance_log.GuidanceSample(
            inputs=inputs,
            state=state,
            commands=commands,
            route=guidance.digest(None),
            link_age=0.0,
            failed=0,
        )
        assert guidance_log.row(sample, params.outputs).tobytes() == values.tobytes()
        assert state == logged
        state = logged


def pose(stamp_ns: int) -> StampedVector:
    """Return a pose in a bank of 0.1 rad, on the way to the north."""
    return StampedVector(stamp_ns, np.array([*BANKED[:3], 25e-9 * stamp_ns, *BANKED[4:]]))


def flying(**section: Any) -> Guidance:
    """Return guidance after its first step, in a bank of 0.1 rad to the right."""
    made = Guidance(GuidanceConfig.validate_mapping(SECTION | section, "guidance"))
    made.take_pose(pose(0), 0)
    made.take_y(StampedVector(0, np.zeros(4)), 0)
    assert made.step(0, 0) is not None
    return made


def run(made: Guidance, first: int, last: int, rates: FloatArray | None = None) -> Signal:
    """Return the log of steps with y and no pose.

    If `rates` is None, p and q of y follow u_m at once.
    """
    stamps = []
    rows = []
    y = np.zeros(4)
    for k in range(first, last):
        made.take_y(StampedVector(20 * MS * k, y if rates is None else rates), 20 * MS * k)
        output = made.step(20 * MS * k, 20 * MS * k)
        assert output is not None
        stamps.append(20 * MS * k)
        rows.append(output.log)
        y = output.u_m[:4]
    return Signal(np.array(stamps), made.names, np.array(rows))


@pytest.mark.parametrize("y_too", [False, True], ids=["pose alone", "then y too"])
def test_stale_pose_levels_wings(y_too: bool) -> None:
    """Dead reckoning levels the wings first, and later all rates are 0."""
    made = flying(hold=4.0)
    signal = run(made, 1, 300)
    mode = signal["mode"]
    phi = signal["state.phi"]
    assert mode[8] == GuidanceMode.ENGAGED  # 0.18 s
    assert mode[10] == GuidanceMode.DEAD_RECKONING
    assert abs(math.degrees(phi[200])) < 1.0  # 4 s
    assert mode[-1] == GuidanceMode.POSE_LOST
    assert signal["u_m.p"][-1] == signal["u_m.q"][-1] == signal["u_m.r"][-1] == 0.0
    if y_too:
        assert made.step(6400 * MS, 6400 * MS) is None
    made.take_pose(pose(6500 * MS), 6500 * MS)
    made.take_y(StampedVector(6500 * MS, np.zeros(4)), 6500 * MS)
    assert made.step(6500 * MS, 6500 * MS) is not None
    state = made.state
    assert state is not None
    assert (state.lateral, state.target.phi) == (Lateral.PHI, 0.0)
    assert (state.vertical, state.target.altitude) == (Vertical.ALTITUDE, 100.0)


def northwards(altitude: float = 100.0) -> Route:
    """Return a line to the north that ends at an altitude, m, with its orbit."""
    section = GuidanceConfig.validate_mapping(SECTION, "guidance")
    return section.plan([Waypoint(0.0, 0.0, 100.0), Waypoint(900.0, 0.0, altitude)])


@pytest.mark.parametrize("leg", [2.0, 0.5])
def test_leg_that_route_does_not_have_refused(leg: float) -> None:
    made = flying()
    made.take_route(northwards())
    with pytest.raises(
        ChannelError, match=f"target.leg: found {leg:g}, expected a whole number from 0 to 1"
    ):
        made.take_target({"leg": leg})
    assert run(made, 1, 2)["leg"][0] == 0.0


def test_new_route_voids_legs_of_program() -> None:
    route = {"north": [0.0, 900.0, 1800.0], "east": [0.0] * 3, "altitude": [100.0] * 3}
    steps = {"leg": {"start": [0.05], "value": [2.0]}, "V": {"start": [0.07], "value": [26.0]}}
    made = flying(route=route, program=steps)
    made.take_route(northwards())
    signal = run(made, 1, 5)
    assert signal["leg"].tolist() == [0.0] * 4
    assert signal["target.V"][-1] == 26.0


SWITCHES = pytest.mark.parametrize("by", ["controller INACTIVE", "guidance/engage"])


def switch(made: Guidance, by: str, *, on: bool) -> None:
    if by == "guidance/engage":
        made.engage(engaged=on)
    else:
        made.pause(paused=not on, forget=not on)


@SWITCHES
def test_route_waits_for_engagement(by: str) -> None:
    """A route that is sent while guidance is off is flown when guidance engages."""
    made = flying()
    made.take_route(northwards())
    assert run(made, 1, 2)["mode.lateral"][0] == Lateral.ROUTE
    switch(made, by, on=False)
    switch(made, by, on=True)  # the route that was flown before is not flown on
    assert run(made, 2, 3)["mode.lateral"][0] != Lateral.ROUTE
    switch(made, by, on=False)
    made.take_route(northwards(130.0))
    made.take_target({"V": 27.0})
    switch(made, by, on=True)
    signal = run(made, 3, 4)
    assert (signal["mode.lateral"][0], signal["leg"][0]) == (Lateral.ROUTE, 0.0)
    # At the begin of the leg.
    assert (signal["target.altitude"][0], signal["target.V"][0]) == (100.0, 25.0)


@SWITCHES
def test_commands_while_disengaged_are_void(by: str) -> None:
    """Commands that are given while guidance is off are not flown afterwards."""
    made = flying(program={"heading": {"start": [0.05], "value": [2.0]}})
    made.take_target({"altitude": 300.0})
    switch(made, by, on=False)
    for k in range(1, 5):
        made.take_y(StampedVector(20 * MS * k, np.zeros(4)), 20 * MS * k)
        assert made.step(20 * MS * k, 20 * MS * k) is None
    made.take_target({"V": 27.0})
    switch(made, by, on=True)
    made.take_target({"climb": 1.0})  # from now on
    made.take_pose(pose(100 * MS), 100 * MS)
    signal = run(made, 5, 6, np.zeros(4))
    assert signal["target.heading"][0] == approx(0.3)  # that of the pose
    assert signal["target.V"][0] == 25.0
    assert (signal["mode.vertical"][0], signal["target.climb"][0]) == (Vertical.CLIMB, 1.0)


def test_stale_y_gives_no_command() -> None:
    """Without a fresh y there is no u_m, and a frozen pose is refused."""
    made = flying()
    assert made.step(400 * MS, 400 * MS) is None
    with pytest.raises(ChannelError, match="sample: stamp 0 s before the last one"):
        made.take_pose(pose(0), 400 * MS)
    still = pose(0)._replace(stamp_ns=400 * MS)
    with pytest.raises(ChannelError, match="pose: found every value as before"):
        made.take_pose(still, 400 * MS)


@pytest.mark.parametrize("gap, continues", [(5, True), (50, False)])
def test_commands_continue_after_short_pause(gap: int, continues: bool) -> None:
    """u_m continues from its last value after a short pause, and starts again after a long one."""
    made = flying()
    made.take_target({"phi": 0.5})
    before = run(made, 1, 9, np.zeros(4))
    made.pause(paused=True, forget=False)
    made.take_y(StampedVector(20 * MS * 9, np.zeros(4)), 20 * MS * 9)
    assert made.step(20 * MS * 9, 20 * MS * 9) is None
    made.pause(paused=False, forget=False)
    number = 9 + gap
    made.take_pose(pose(20 * MS * number), 20 * MS * number)
    after_pause = run(made, number, number + 1, np.zeros(4))
    assert after_pause["target.phi"][0] == 0.5
    jump = abs(after_pause["u_m.p"][0] - before["u_m.p"][-1])
    # A step of the slew limit; otherwise it starts from zero.
    assert bool(jump <= 0.02 * 5.0 * 0.35 * (1.0 + 1e-9)) is continues


def test_new_command_bounds_slew() -> None:
    """The commanded climb rate is continuous, and the slew of u_m is bounded."""
    made = flying()
    made.take_target({"phi": 0.5, "climb": 2.0})
    signal = run(made, 1, 100, np.zeros(4))
    section = GuidanceConfig.validate_mapping(SECTION, "guidance")
    for name, rate in zip(section.outputs, section.params().slew, strict=True):
        assert np.abs(np.diff(signal[f"u_m.{name}"])).max() <= 0.02 * rate * (1.0 + 1e-9)
    assert np.diff(signal["climb_c"]).max() <= 0.02 * section.acceleration * (1.0 + 1e-9)
    made.take_target({"theta": 0.0})
    made.take_target({"altitude": 150.0})  # of one instant: the last vertical command acts
    assert run(made, 100, 101)["mode.vertical"][0] == Vertical.ALTITUDE


@pytest.mark.parametrize(
    "values, sentence",
    [
        ({"pitch": 0.1}, "target: found pitch, expected some of phi, heading"),
        ({"phi": 0.1, "heading": 0.1}, "expected one lateral and one vertical command at most"),
        ({"phi": 1.0}, r"target.phi: found 57.2958, expected -30 to 30 deg"),
        ({"altitude": 400.0}, "target.altitude: found 400, expected 20 to 300 m"),
    ],
)
def test_refused_command_changes_nothing(values: dict[str, float], sentence: str) -> None:
    """A command that cannot be flown is refused."""
    made = flying(altitude_floor=20.0, ceiling=300.0)
    with pytest.raises(ChannelError, match=sentence):
        made.take_target(values)
    assert run(made, 1, 2)["given"][0] == 0.0


@pytest.mark.parametrize(
    "section, sentence",
    [
        ({"period": 13.0}, r"guidance.period: found 13.0 s, expected at least 14 s: max\(14 s"),
        (
            {"program": program(bank=0.1)},
            r"guidance.program.bank: found a channel, expected one of phi",
        ),
        (
            {"program": program(phi=0.9)},
            r"guidance.program at 1 s.phi: found 0.9, expected -0.523599 to 0.523599 rad",
        ),
        (
            {"program": {"phi": {"start": [1.0, 1.0], "value": [0.1, 0.2]}}},
            "expected times in rising order",
        ),
        (
            {
                "route": {
                    "north": [0.0, 9e3],
                    "east": [0.0, 0.0],
                    "altitude": [0.0, 0.0],
                    "V": [25.0, 36.0],
                }
            },
            r"guidance.route\[1\].V: found 36 m/s, expected at most 35 m/s",
        ),
        (
            {"altitude_floor": 50.0, "ceiling": 40.0},
            "guidance.ceiling: found 40 m, expected more than altitude_floor, 50 m",
        ),
        ({"lockstep": True}, "guidance.y_rate: found 0 Hz, expected the rate of y in lockstep"),
    ],
)
def test_parameters_that_cannot_be_flown_are_refused(
    section: dict[str, Any], sentence: str
) -> None:
    with refusing(sentence):
        GuidanceConfig.validate_mapping(SECTION | section, "guidance")


def test_omitted_numbers_follow_from_sections() -> None:
    """Numbers that are left out follow from the other sections."""
    section = ROUTE.guidance
    assert section is not None
    assert (section.speed, section.natural_frequency) == (25.0, (4.0, 1.2, 5.0, 4.0))
    # 6 m/s^2 a unit of thrust, +-0.5
    assert section.throttle_authority == approx((3.0, 3.0), rel=1e-3)
    params = section.params()
    assert (params.attitude.k_phi, params.attitude.k_theta, params.limits.floor) == (
        1.25,
        1.0,
        20.0,
    )
    assert (params.vertical.climb, params.path.period) == (2.5, section.least_period())
    assert params.attitude.k_beta == approx(5.0 / 14.0 * 25.0 * math.radians(1.0) / 1.5)
    assert params.attitude.roll_rate == 0.35  # 45 rad/s^2 of aileron would permit more
    weak = GuidanceConfig.validate_mapping(SECTION | {"roll_authority": 1.036}, "guidance")
    assert weak.largest_roll_rate() == approx(1.036 / 6.0)  # the 737 of JSBSim


@pytest.mark.parametrize(
    "changes, sentence",
    [
        (
            {"guidance": {"speed": 30.0, "route": None}},
            "guidance.speed: found 30.0, expected 25.0, as the other sections have it",
        ),
        (
            {"guidance": {"rate": 40.0}},
            r"guidance.rate: found 40 Hz, expected a whole fraction of the rate of pose \(50 Hz\)",
        ),
    ],
)
def test_sections_that_do_not_fit_guidance_refused(changes: dict[str, Any], sentence: str) -> None:
    with refusing(sentence):
        ROUTE.vary(**changes)


def test_replay_names_first_different_step() -> None:
    """A replay computes every step of guidance again."""
    scenario = calm(4.0, program=program(heading=0.5))
    tape = simulate(scenario)
    result = replay_guidance(tape, scenario.guidance)
    assert (result.steps, result.checked, result.differing, result.notes) == (201, 201, 0, ())
    tape["u_m"].values[100, 2] = np.nextafter(tape["u_m"].values[100, 2], 1.0)
    changed = replay_guidance(tape, scenario.guidance)
    assert changed.differing == 1
    assert changed.first is not None
    assert (changed.first.number, changed.first.channel, changed.first.ulps) == (
        101,
        "published.p",
        1,
    )


class RoutedInFlight(Guidance):
    """Guidance that receives a route at 1 s."""

    def __init__(self, parameters: GuidanceConfig) -> None:
        super().__init__(parameters)
        self._new = parameters.plan([Waypoint(*point) for point in WAYPOINTS])

    def step(self, now_ns: int, t_ns: int) -> guidance.GuidanceOutput | None:
        """Make a step. See Guidance."""
        if t_ns == 1000 * MS:
            self.take_route(self._new)
        return super().step(now_ns, t_ns)


WAYPOINTS = [(0.0, 0.0, 0.0), (800.0, 0.0, 10.0)]


def test_route_received_in_flight_is_logged(tmp_path: Path) -> None:
    """A route that was received in flight is read from the log, replayed and drawn."""
    scenario = calm(3.0)
    section = scenario.guidance
    assert section is not None
    flight = simulate(scenario, guide=RoutedInFlight)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/route", PATH, typestore=typestore())
        # The first one is refused.
        for points in ([(0.0, 0.0, 0.0)], WAYPOINTS):
            bag.write(topic, 1, path(*points))
    contents = read_run(tmp_path / "bag").tape["route"]
    assert contents.values.tolist() == [
        [0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0],
        [1.0, 800.0, 0.0, 10.0],
    ]
    tape = Tape({**flight.signals, "route": contents})
    result = replay_guidance(tape, section)
    assert (result.steps, result.checked, result.differing) == (151, 151, 0)
    assert flown_routes(scenario, tape) == [section.plan([Waypoint(*point) for point in WAYPOINTS])]
    assert replay_guidance(flight, section).checked == 50  # without the route: those before it


def test_loiters_are_flown_on_their_side() -> None:
    """The route has half a turn to the left, and its last orbit turns to the right."""
    centres = [(350.0, 0.0), (150.0, -320.0)]
    waypoints = [Waypoint(0.0, 0.0, 0.0), *(Waypoint(*centre, 0.0) for centre in centres)]
    waypoints[1] = waypoints[1]._replace(turns=0.5, left=True)
    tape = simulate(with_route(ROUTE, waypoints).vary(flight={"duration": 60.0}))
    log = tape["guidance"]
    legs = np.interp(tape["pose"].stamp_ns, log.stamp_ns, log["leg"])
    turns = []
    for number, (north, east) in zip((1, 3), centres, strict=True):
        bearing = np.arctan2(tape["pose"]["east"] - east, tape["pose"]["north"] - north)
        flown = np.unwrap(bearing[legs == number])
        turns.append(float(flown[-1] - flown[0]) / (2.0 * math.pi))
    # The aircraft flies on at the first tangent after the half turn.
    assert -1.5 < turns[0] < -0.4
    assert turns[1] > 0.25
    # On circles the path is held within half a second of flight, but for the roll into them.
    assert np.percentile(np.abs(log["xtrack"][log["leg"] % 2 == 1]), 95.0) < 12.5


def test_route_file_flown_and_stays_with_flight(tmp_path: Path) -> None:
    file = tmp_path / "line.yaml"
    file.write_text("route: [[0, 0, 0], [800, 0, 10, 26.5], [800, 900, 10]]")
    scenario = save_scenario(with_route(ROUTE, read_route(file)), tmp_path / "osprey_route.yaml")
    section = load_scenario(scenario.path).guidance
    assert section is not None
    assert section.waypoints() == (
        Waypoint(0, 0, 0, 25.0),
        Waypoint(800, 0, 10, 26.5),
        Waypoint(800, 900, 10, 26.5),
    )
    with refusing(r"guidance\.route: found 1 waypoints, expected two or more"):
        with_route(ROUTE, [Waypoint(0.0, 0.0, 0.0)])
    with refusing("kinematics: found 'linear' beside guidance"):
        simulate(ROUTE.vary(aircraft={"kinematics": "linear"}))
    with refusing("kinematics: found 'linear' beside guidance"):
        second_stage(ROUTE.vary(aircraft={"kinematics": "linear"}))
    # The autopilot flies.
    assert GUIDANCE in second_stage(ROUTE.vary(aircraft={"kinematics": "linear"}), bridge=True)


@pytest.mark.parametrize(
    "words, sentence",
    [
        (
            ["guide", "bank=3"],
            "guide: found 'bank=3', expected NAME=VALUE with one of phi, heading",
        ),
        (["guide", "V=30", "V=31"], "guide: found a command twice, or two, expected each once"),
        (
            ["fly", "--in-process", "--origin", "47.4,8.5"],
            "--origin: found no --route, expected the file of a route",
        ),
    ],
)
def test_bad_words_of_command_line_are_one_sentence(words: list[str], sentence: str) -> None:
    result = invoke(*words)
    assert isinstance(result.exception, ParameterError)
    assert sentence in str(result.exception)


def test_steep_climb_slows_and_keeps_airspeed() -> None:
    """A climb beyond the power of the throttle becomes slower, and the airspeed is kept."""
    # An engine that has lost most of its power gives 0.3 m/s^2 in place of 3.
    weak = calm(30.0, program=program(climb=2.5)).vary(
        aircraft={"actuators": {"upper": [0.5, 0.05, 0.5, 0.5]}}
    )
    tape = simulate(weak)
    V, limited, climb = (
        channel[after(tape, 24.0)]
        for channel in channels(tape["guidance"], "y.V", "limited.climb", "pose.climb")
    )
    assert limited.all()
    assert V.min() > -3.5  # without the limit V falls by 5.1 m/s, below the floor of 20 m/s
    assert np.ptp(V) < 0.1  # no limit cycle
    assert climb.min() > 1.5


@pytest.mark.parametrize(
    "shortfall, expected",
    [(0.0, (-3, 2)), (1.96, (-3, 2)), (2.94, (-3, 1)), (9, (-3, 0)), (-9.0, (0, 2))],
)
def test_airspeed_error_limits_climb_and_sink(
    shortfall: float, expected: tuple[float, float]
) -> None:
    """The limits of climb and sink become smaller with the error of the airspeed."""
    # d = 9.81 x 2 / (0.4 x 25) = 1.96.
    assert climb_range(2.0, 3.0, shortfall, 25.0) == approx(expected, abs=5e-3)
