# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test guidance's node.

The tests cover targets, routes, services, learned authority, and what it does without its inputs.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import Path as PathMessage
from std_srvs.srv import SetBool, Trigger
from tests.closed_loop import in_calm_air as calm
from tests.conftest import REPOSITORY, refusing
from tests.nodes.world import OUTPUTS, World, diagnostics, world_of

from flight_analysis.closed_loop.scenario import scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.channels import POSE, UNKNOWN
from flight_core.modes import Mode as ControllerMode
from flight_guidance import guidance as guidance_steps
from flight_guidance.guidance_state import Lateral, Vertical
from flight_guidance.node import GuidanceNode
from flight_guidance.reach import AUTHORITY

TICK_NS = 20_000_000
MAX_AGE = 0.2  # s, of y and pose: the default
SQUARE = REPOSITORY / "examples/px4_quadrotor/square.yaml"
LEVEL = {"altitude": 50.0, "v_north": 25.0}


class Flight:
    """A guidance node. The test plays the aircraft, the controller and the operator."""

    def __init__(self, world: World, outputs: tuple[str, ...] = OUTPUTS) -> None:
        self.world = world
        self.outputs = outputs
        self.node: Any = world.start(GuidanceNode)
        self.mode: float = ControllerMode.ENGAGED
        self.has_pose = True
        self._rng = np.random.default_rng(1)

    def send(self) -> None:
        """Send a y, a pose and a sample of internals with the present stamp."""
        self.world.send("/y", dict.fromkeys(self.outputs, 0.0), "/aircraft#1")
        self.world.send("/internals", {"mode": self.mode}, "/controller#1")
        if self.has_pose:
            pose = dict.fromkeys(POSE, 0.0) | LEVEL
            # A pose that stands still is refused.
            self.world.send(
                "/pose", pose | {"v_east": float(self._rng.normal(0.0, 0.01))}, "/aircraft#1"
            )

    def run(self, duration: float = 0.1, each: Callable[[], object] = lambda: None) -> None:
        """Run for a duration, s, while the test sends its messages."""

        def both() -> None:
            self.send()
            each()

        self.world.run(duration, both)

    def target(self, **values: float) -> None:
        """Command some channels, and fly on."""
        self.world.send("/target", values, "/operator#1")
        self.run()

    def last(self, name: str) -> float:
        """Return the last value of a channel of `guidance`, or NaN before the first."""
        return self.world.last("/guidance").get(name, math.nan)

    def refused(self, reason: str) -> int:
        """Return how many samples were refused for a reason."""
        return int(self.node.refusals.counts[reason])

    def call(self, kind: Any, name: str, **fields: object) -> tuple[bool, str]:
        """Return the answer of a service of guidance."""
        response = self.world.call(f"/guidance/{name}", kind.Request(**fields))
        return response.success, response.message

    def logged(self, *parts: str) -> bool:
        """Return whether a line of the log has all parts."""
        return any(all(part in line for part in parts) for line in self.node.log.lines)


@pytest.fixture
def flight(tmp_path: Path) -> Iterator[Flight]:
    """Return guidance that has engaged."""
    with world_of("--params-file", str(calm(tmp_path / "calm.yaml"))) as world:
        made = Flight(world)
        made.run()
        assert world.sent["/u_m"]
        yield made


def test_there_is_no_command_before_controller_engaged(tmp_path: Path) -> None:
    with world_of("--params-file", str(calm(tmp_path / "calm.yaml"))) as world:
        flight = Flight(world)
        flight.mode = ControllerMode.WAITING
        flight.run(1.5)
        _, figures = diagnostics(world, "/guidance")
        assert float(figures["age of y (s)"]) < 0.1
        assert float(figures["age of pose (s)"]) < 0.1
        flight.mode = 17  # no mode of the controller
        flight.run()
        assert flight.refused("internals: mode") > 0
        assert not world.sent["/u_m"]
        flight.mode = ControllerMode.ENGAGED
        flight.run()
        assert world.sent["/u_m"]


def test_multicopter_has_commands_and_a_place_on_a_map(tmp_path: Path) -> None:
    path = tmp_path / "square.yaml"
    path.write_text(scenario_yaml(find_scenario(str(SQUARE))))
    with world_of("--params-file", str(path)) as world:
        Flight(world, ("q", "vertical_speed", "p", "r")).run(0.2)
        assert world.sent["/u_m"]
        assert world.sent["/odometry"]


def test_targets_select_modes_and_bad_ones_refused(flight: Flight) -> None:
    flight.target(heading=1.0, altitude=60.0)
    selected = [flight.last(name) for name in ("target.altitude", "mode.lateral", "mode.vertical")]
    assert selected == [60.0, Lateral.HEADING, Vertical.ALTITUDE]
    for reason, values in {
        "bounds": {"phi": 2.0},
        "name": {"bank": 0.1},
        "finite": {"heading": math.nan},
    }.items():
        flight.target(**values)
        assert flight.refused(f"target: {reason}") == 1
    # Of before a stop of guidance.
    flight.world.send("/target", {"heading": 0.5}, "/operator#1", age=MAX_AGE + 0.05)
    flight.run()
    assert flight.refused("target: old") == 1
    assert flight.last("target.heading") == 1.0


def test_target_without_channels_keeps_link_and_silence_leads_home(tmp_path: Path) -> None:
    with world_of(
        "--params-file", str(calm(tmp_path / "calm.yaml", home={"link_timeout": 1.0}))
    ) as world:
        flight = Flight(world)
        flight.run(0.5)
        assert flight.last("age.link") > 0.3
        flight.target()
        assert flight.last("age.link") <= 0.1
        flight.run(1.2)
        assert flight.last("mode.lateral") == Lateral.ORBIT
        assert flight.logged("no message of an operator for 1 s: home")


@pytest.fixture
def learning(tmp_path: Path) -> Iterator[Flight]:
    """Return guidance of a flight that learns, which has engaged."""
    file = calm(tmp_path / "calm.yaml", authority_rate=10.0)
    with world_of("--params-file", str(file)) as world:
        made = Flight(world)
        made.run()
        yield made


def test_learned_authority_limits_commands_and_a_bad_one_is_refused(learning: Flight) -> None:
    learning.world.send("/authority", dict.fromkeys(AUTHORITY, 0.0), "/controller#1")
    learning.run()
    assert learning.last("authority.p") == 0.0
    assert learning.logged("from now on no roll rate: p has no input with an effect")
    learning.world.send("/authority", dict.fromkeys(AUTHORITY, -1.0), "/controller#1")
    learning.run()
    assert learning.refused("authority: bounds") == 1
    assert learning.last("authority.p") == 0.0


def test_authority_is_the_controllers_alone(learning: Flight) -> None:
    """No other publisher is accepted, even before the controller has sent an authority.

    Another process with the controller's name is refused, too.
    """

    def send(p: float, publisher: str) -> None:
        learning.world.send("/authority", dict.fromkeys(AUTHORITY, p), publisher)
        learning.run()

    for sender in ("/rogue#1", "/controller#2", "/controller", ""):
        send(0.0, sender)
        assert learning.last("authority.p") == UNKNOWN, sender
    assert learning.refused("authority: sender") == 4
    send(0.0, "/controller#1")
    assert learning.last("authority.p") == 0.0


def test_authority_that_stops_is_void(learning: Flight) -> None:
    """An authority is valid for three periods plus the age limit, from its stamp.

    The period is 0.1 s, and the age limit 0.2 s.
    """
    learning.world.send("/authority", dict.fromkeys(AUTHORITY, 0.0), "/controller#1")
    learning.run(0.45)
    assert learning.last("authority.p") == 0.0
    learning.run(0.15)
    assert learning.last("authority.p") == UNKNOWN
    assert learning.logged("authority: none for 0.5 s: its limits are void")


def test_flight_that_does_not_learn_takes_no_authority(flight: Flight) -> None:
    assert "/authority" not in {each.topic_name for each in flight.world.subscriptions}
    flight.world.send("/authority", dict.fromkeys(AUTHORITY, 0.0), "/controller#1")
    flight.run(1.0)
    assert flight.last("authority.p") == UNKNOWN


def test_modes_of_second_controller_refused(flight: Flight) -> None:
    flight.target(heading=1.0)
    inactive = {"mode": float(ControllerMode.INACTIVE)}
    flight.run(each=lambda: flight.world.send("/internals", inactive, "/standby#2"))
    assert flight.refused("internals: sender") > 5
    assert flight.last("target.heading") == 1.0  # that of an INACTIVE controller is forgotten


def test_controller_that_was_inactive_holds_what_is_measured_and_one_in_failsafe_goes_on(
    flight: Flight,
) -> None:
    for mode, kept in ((ControllerMode.HOLD, True), (ControllerMode.INACTIVE, False)):
        flight.target(heading=1.0)
        flight.mode = mode
        flight.run(0.1)
        silent = len(flight.world.sent["/u_m"])
        flight.run(0.5)
        # No command to a controller that does not fly.
        assert len(flight.world.sent["/u_m"]) == silent
        flight.mode = ControllerMode.ENGAGED
        flight.run()
        assert (flight.last("target.heading") == 1.0) is kept


def test_a_storm_of_targets_delays_no_command(flight: Flight) -> None:
    def storm() -> None:
        for k in range(20):
            flight.world.send("/target", {"heading": 0.01 * k}, "/operator#1")

    before = len(flight.world.sent["/u_m"])
    flight.run(2.0, storm)
    stamps = [sample.stamp_ns for sample in flight.world.vectors("/u_m")[before:]]
    assert set(np.diff(stamps)) == {TICK_NS}
    assert len(stamps) == 100


def test_services_hold_skip_and_disengage(flight: Flight) -> None:
    flight.target(phi=0.2)
    assert flight.last("mode.lateral") == Lateral.PHI
    assert flight.call(Trigger, "hold") == (True, "")
    flight.run()
    assert flight.last("mode.lateral") == Lateral.HEADING
    assert flight.call(Trigger, "skip") == (False, "no route with a further leg is flown")
    assert flight.call(Trigger, "resume") == (
        False,
        "found no route to resume, or the route is flown",
    )
    assert flight.call(SetBool, "engage", data=False) == (True, "")
    flight.run()
    assert flight.logged("ENGAGED -> OFF")
    silent = len(flight.world.sent["/u_m"])
    flight.mode = ControllerMode.INACTIVE
    flight.run()
    assert len(flight.world.sent["/u_m"]) == silent
    assert flight.call(SetBool, "engage", data=True) == (
        False,
        "the controller is INACTIVE, expected ENGAGED",
    )
    flight.mode = ControllerMode.ENGAGED
    flight.run()
    assert flight.call(SetBool, "engage", data=True) == (True, "")
    flight.run()
    assert len(flight.world.sent["/u_m"]) > silent


def route(frame: str, *points: tuple[float, float, float]) -> PathMessage:
    """Return waypoints with east, north and up."""
    message = PathMessage()
    message.header.frame_id = frame
    for east, north, up in points:
        stamped = PoseStamped()
        stamped.pose.position = Point(x=east, y=north, z=up)
        message.poses.append(stamped)
    return message


TWO = ((0.0, 0.0, 50.0), (0.0, 900.0, 55.0))


@pytest.mark.parametrize(
    "message, sentence",
    [
        (route("odom", *TWO), "route: found the frame 'odom', expected 'map'"),
        (route("map", TWO[0]), "route: found 1 waypoints"),
        (route("map", *(1000 * TWO)), "a message of "),
    ],
    ids=("frame", "one waypoint", "too long"),
)
def test_route_that_cannot_be_flown_refused(
    message: PathMessage, sentence: str, flight: Flight
) -> None:
    flight.world.publish("/route", message)
    flight.run()
    assert flight.logged("/route: sample refused: ", sentence)
    assert flight.last("mode.lateral") == Lateral.HEADING


def test_route_flown_when_it_arrives(flight: Flight) -> None:
    flight.world.publish("/route", route("map", *TWO))
    flight.run()
    assert flight.last("mode.lateral") == Lateral.ROUTE
    # The last line is a tangent to the last orbit, of the least radius at 25 m/s, 3 m/s of wind and
    # 0.8 of a bank of 30 deg.
    radius = math.ceil((25.0 + 3.0) ** 2 / (9.80665 * math.tan(0.8 * math.radians(30.0))))
    assert flight.last("to_go") == pytest.approx(math.sqrt(900.0**2 - radius**2))
    # At the begin of the slope.
    assert flight.last("target.altitude") == pytest.approx(50.0, abs=0.1)
    assert flight.call(Trigger, "hold") == (True, "")
    flight.run()
    assert flight.call(Trigger, "resume") == (True, "")


def test_second_publisher_of_pose_refused(flight: Flight) -> None:
    flight.run(each=partial(flight.world.send, "/pose", dict.fromkeys(POSE, 0.0), "/other#2"))
    assert flight.refused("pose: sender") > 5
    assert flight.last("pose.altitude") == LEVEL["altitude"]


def test_stale_pose_levels_wings_and_guidance_engages_again(flight: Flight) -> None:
    flight.has_pose = False
    flight.run(MAX_AGE + 0.05)
    assert flight.logged("[WARNING] ENGAGED -> DEAD_RECKONING: pose is stale: wings are levelled")
    assert diagnostics(flight.world, "/guidance")[0] != ""
    flight.has_pose = True
    flight.run()
    assert flight.logged("DEAD_RECKONING -> ENGAGED")


def test_guidance_alone_needs_parameters_of_run(tmp_path: Path) -> None:
    """Only the parameters of a run have the values that follow from other sections."""
    file = find_scenario("osprey_route").path
    refusal = "guidance: missing natural_frequency, speed, expected a value for each"
    with (
        world_of("--params-file", str(file)) as world,
        refusing(refusal),
    ):
        world.make(GuidanceNode)
    with_all_sections = tmp_path / "parameters.yaml"
    with_all_sections.write_text(scenario_yaml(find_scenario("osprey_route")))
    with world_of("--params-file", str(with_all_sections)) as world:
        assert world.make(GuidanceNode).get_name() == "guidance"


def test_step_that_fails_leaves_the_last_u_m_and_the_node_goes_on(
    flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three steps of a climb fail.

    u_m is kept, one line says why, and the diagnostics count the steps.
    """
    flight.target(climb=1.0)
    flight.run(0.3)
    step = guidance_steps.step
    failing = iter(range(3))

    def raises(*arguments: Any) -> Any:
        if next(failing, None) is not None:
            raise IndexError("index 7 is out of bounds")
        return step(*arguments)

    before = len(flight.world.sent["/u_m"])
    last = flight.world.last("/u_m")
    with monkeypatch.context() as patch:
        patch.setattr(guidance_steps, "step", raises)
        flight.run(1.5)
    messages = [sample.channels for sample in flight.world.vectors("/u_m")[before:]]
    assert messages[:3] == [last] * 3
    assert messages[3] != last
    assert len(messages) > 70  # of 75: none is left out
    lines = [line for line in flight.node.log.lines if "a step of guidance failed" in line]
    repeated = "a step of guidance failed, the last u_m is repeated"
    assert lines == [f"[WARNING] {repeated}: IndexError index 7 is out of bounds"]
    assert diagnostics(flight.world, "/guidance")[1]["failed steps"] == "3"
    assert flight.last("failed") == 3.0


def test_steps_that_fail_to_the_end_leave_no_u_m_and_say_why(
    flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reference model then levels the wings, and u_m is back with the first good step."""

    def raises(*arguments: Any) -> Any:
        raise IndexError("index 7 is out of bounds")

    with monkeypatch.context() as patch:
        patch.setattr(guidance_steps, "step", raises)
        flight.run(MAX_AGE + 0.1)
        before = len(flight.world.sent["/u_m"])
        flight.run(3.0)
        assert len(flight.world.sent["/u_m"]) == before
        assert flight.logged("no u_m: a step of guidance failed: IndexError index 7")
        sentence, _ = diagnostics(flight.world, "/guidance")
        assert sentence == "no u_m: a step of guidance failed: IndexError index 7 is out of bounds"
    flight.run(0.3)
    assert len(flight.world.sent["/u_m"]) > before
