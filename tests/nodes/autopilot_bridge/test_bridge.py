# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the bridge's node: the unchanged controller flies a simulated autopilot through a map.

The map is examples/maps/ardupilot_2024.yaml. tests/ros/autopilot.py is no autopilot. These tests
show that frames, signs, rates and engagement agree with the map, and not that the map agrees with
ArduPilot.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import TwistStamped, Vector3, Vector3Stamped
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from pytest import approx
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import FluidPressure, Imu, Joy
from std_msgs.msg import UInt8
from std_srvs.srv import SetBool, Trigger
from tests.conftest import REPOSITORY, invoke
from tests.maps import MAP_FILES
from tests.nodes.world import INPUTS, OUTPUTS, World, parameters, world_of
from tests.ros.autopilot import Autopilot

from autopilot_bridge.channel_map import (
    no_publisher,
    read_raw,
)
from autopilot_bridge.node import (
    ACTIVATION_TIMEOUT_NS,
    RELEASES_AT_SHUTDOWN,
    BridgeNode,
)
from autopilot_bridge.params import LIBRARY
from flight_core.channels import UNKNOWN
from flight_core.environment import PROFILE_VARIABLE
from flight_core.modes import Mode
from flight_core.outcome import FlightEnded
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS, nanoseconds, seconds
from reference_model.node import ReferenceModelNode
from rise_di_controller.node import ControllerNode

SCENARIO = REPOSITORY / "tests" / "ros" / "slow_autopilot.yaml"
RELEASE_AFTER = 3.0  # s, RC_OVERRIDE_TIME of ArduPilot
FULL = math.radians(30.0)  # full deflection of a surface in the map
MAX_AGE, RELEASE = 0.2, 0.5  # s, of u in the map, and of its release
# s, between two ticks of the bridge, and between two messages to the autopilot.
TICK, JOY = (0.005, 0.02)
QOS = {"reliability": "reliable", "durability": "volatile", "depth": 1}
RATES = Vector3(x=0.3, y=-0.2, z=-0.1)
AIRSPEED = Vector3Stamped(vector=Vector3(x=-18.0, y=18.0, z=-9.0))  # of length 27


class Sent(NamedTuple):
    """A message to the autopilot. t is in s since the beginning of the test."""

    t: float
    axes: list[float]

    @property
    def released(self) -> bool:
        """Return whether the message returns all channels."""
        return all(map(math.isnan, self.axes))


class Setup:
    """A bridge, the simulated autopilot, and a publisher of u."""

    def __init__(self, world: World, channel_map: Path) -> None:
        self.world = world
        self.map = channel_map
        self.begin_ns = world.clock.now_ns
        self.autopilot = Autopilot(SCENARIO, RELEASE_AFTER, world, world.clock.monotonic)
        self.autopilot_runs = True
        # Published each 5 ms; None: not published.
        self.u: tuple[float, ...] | None = (0.0, 0.0, 0.0, 0.0)
        self.further: dict[str, Any] = {}  # messages that are published each 5 ms, by topic
        self.joys: list[Sent] = []
        world.create_subscription(
            Joy, "/ap/joy", lambda joy: self.joys.append(Sent(self.t, list(joy.axes))), 1
        )
        self._number = 0

    @property
    def t(self) -> float:
        """Return the time of the test, s."""
        return seconds(self.world.clock.now_ns - self.begin_ns)

    def start(self, **changes: Any) -> Any:
        """Start the bridge with a changed map.

        A change is of a key, or of the keys of a row.
        """
        content = yaml.safe_load(self.map.read_text())
        for key, value in changes.items():
            content[key] = (
                content[key] | value if isinstance(value, Mapping) and key in content else value
            )
        self.map.write_text(yaml.safe_dump(content, sort_keys=False))
        self.bridge = self.world.start(BridgeNode)
        return self.bridge

    def step(self) -> None:
        """Do what surrounds the bridge: send y at 50 Hz, u and further messages."""
        due = self.t >= self._number * self.autopilot.period
        if due and self.autopilot_runs:
            self.autopilot.step(self._number)
        self._number += due
        if self.u is not None:
            self.world.send("/u", dict(zip(INPUTS, self.u, strict=True)))
        for topic, message in self.further.items():
            self.world.publish(topic, message)

    def run(self, duration: float) -> None:
        """Run for a duration, s."""
        self.world.run(duration, self.step)

    def until_logged(self, *parts: str) -> float:
        """Run until the bridge logs a line with the given parts, and return the time, s."""
        before = len(self.bridge.log.lines)

        def logged() -> list[str]:
            return [
                line
                for line in self.bridge.log.lines[before:]
                if all(part in line for part in parts)
            ]

        self.world.until(logged, f"the line {parts}", self.step)
        return self.t

    def engage(self, *, on: bool = True, blind: bool = False) -> str:
        """Call the service, and return the reason of a refusal, or ""."""
        name, request = (
            ("engage_blind", Trigger.Request()) if blind else ("engage", SetBool.Request(data=on))
        )
        return str(self.world.call(f"/bridge/{name}", request).message)

    def engaged(self) -> None:
        """Engage, and run for a while with u."""
        self.run(0.3)
        assert self.engage() == ""
        self.run(0.2)
        assert self.joys
        assert not self.joys[-1].released

    def sent_since(self, t: float) -> tuple[list[float], list[float]]:
        """Return when u and when release values were sent after a time, in s from this time."""
        since = [sent for sent in self.joys if sent.t > t]
        return [sent.t - t for sent in since if not sent.released], [
            sent.t - t for sent in since if sent.released
        ]


@contextmanager
def bridged(folder: Path, **values: object) -> Iterator[Setup]:
    """Return a setup with parameters of the bridge."""
    channel_map = folder / "ardupilot.yaml"
    channel_map.write_bytes(MAP_FILES["ardupilot_2024"].read_bytes())
    given = parameters(
        {
            f"bridge.{name}": value
            for name, value in {"map": channel_map, "dry_run": "false", **values}.items()
        }
    )
    with world_of("--params-file", str(SCENARIO), *given) as world:
        yield Setup(world, channel_map)


@pytest.fixture
def setup(tmp_path: Path) -> Iterator[Setup]:
    with bridged(tmp_path) as made:
        yield made


def flown(setup: Setup, duration: float) -> dict[str, float]:
    """Return the rms of y without noise minus y_m, over the rms of y_m, by output."""
    ratios: list[tuple[list[float], list[float]]] = []

    def step() -> None:
        number = setup._number
        setup.step()
        if setup._number > number and setup.world.sent["/y_m"]:
            y_m = setup.world.last("/y_m")
            truth = setup.autopilot.truth()
            ratios.append((truth, [y_m[name] for name in OUTPUTS]))

    setup.world.run(duration, step)
    y, y_m = np.array(ratios).transpose(1, 0, 2)
    return dict(zip(OUTPUTS, np.std(y - y_m, axis=0) / np.std(y_m, axis=0), strict=True))


def test_unchanged_controller_tracks_through_map_and_when_killed_releases_channels(
    setup: Setup,
) -> None:
    world = setup.world
    setup.u = None
    setup.start()
    controller = world.start(ControllerNode)
    world.start(ReferenceModelNode)
    setup.run(2.0)
    assert not setup.joys  # nothing is sent before it is engaged
    assert not any(world.last("/u").values())
    assert setup.engage() == ""
    setup.run(6.0)
    error = flown(setup, 7.0)
    # The loop is little faster than the commands. 1 of an aircraft that stays at trim.
    assert max(error.values()) < 0.7, error

    killed = setup.t
    world.kill(controller)
    released_at = setup.until_logged("ENGAGED -> RELEASE: u is")
    assert killed + MAX_AGE - 2 * JOY < released_at <= killed + MAX_AGE + TICK
    restarted = world.start(ControllerNode)
    setup.until_logged("RELEASE -> DISENGAGED: u is")
    setup.run(2.0)
    finite, released = setup.sent_since(killed)
    assert max(finite) <= released_at - killed
    assert released[-1] - released[0] == approx(RELEASE, abs=JOY + TICK)
    assert np.diff(released).max() <= JOY + TICK
    # The controller is inactive, so that its integrals do not wind up.
    assert any("-> INACTIVE" in line for line in restarted.log.lines)


def test_pilot_override_releases_at_once_and_blocks_an_engagement_while_it_is_active(
    setup: Setup,
) -> None:
    setup.start()
    setup.engaged()
    pressed = setup.t
    setup.world.publish("/joy", Joy(buttons=[1]))
    assert setup.until_logged("ENGAGED -> RELEASE: pilot override by gamepad") <= pressed + 2 * TICK
    setup.run(RELEASE + 0.1)
    finite, released = setup.sent_since(pressed)
    assert max(finite, default=0.0) <= TICK
    assert released[0] <= JOY + TICK
    setup.world.publish("/joy", Joy(buttons=[1]))
    setup.run(TICK)
    assert setup.engage() == "pilot override active: gamepad"
    setup.world.publish("/joy", Joy(buttons=[0]))
    setup.run(TICK)
    assert setup.engage() == ""


def test_surface_without_effect_by_the_probe_of_the_controller_releases(setup: Setup) -> None:
    setup.start()
    setup.engaged()
    effects = dict(zip(INPUTS, (0.9, 0.1, 0.9, UNKNOWN), strict=True))
    setup.world.send("/effects", effects, "/rogue#1")
    setup.run(0.5)
    assert setup.bridge.refusals.counts["effects: sender"] == 1
    assert not [line for line in setup.bridge.log.lines if "-> RELEASE" in line]
    setup.world.send("/effects", effects)
    setup.until_logged(f"ENGAGED -> RELEASE: {INPUTS[1]} does not answer the probe")


def test_silent_autopilot_releases_and_bridge_does_not_engage_again_by_itself(setup: Setup) -> None:
    setup.start()
    setup.engaged()
    silent = setup.t
    setup.autopilot_runs = False
    setup.until_logged("RELEASE -> DISENGAGED: ", " s old (/ap/")
    setup.until_logged("waiting for /ap/twist/filtered: no sample of its publisher arrives")
    setup.autopilot_runs = True
    setup.run(1.0)
    finite, released = setup.sent_since(silent)
    assert max(finite) <= 0.2 + JOY + TICK  # max_age of y in the map
    assert released[-1] - released[0] == approx(RELEASE, abs=JOY + TICK)
    assert setup.engage() == ""


def test_request_and_end_of_bridge_release(setup: Setup) -> None:
    bridge = setup.start()
    setup.engaged()
    assert setup.engage(on=False) == ""
    assert any("ENGAGED -> RELEASE: disengaged by request" in line for line in bridge.log.lines)
    setup.run(RELEASE + 0.1)
    setup.engaged()
    setup.joys.clear()
    setup.world.end(bridge)
    assert [sent.released for sent in setup.joys] == [True] * RELEASES_AT_SHUTDOWN


@pytest.mark.parametrize("step", [20.0, -20.0])  # s, beyond the limits either way
def test_step_of_system_clock_leaves_engagement_and_release_as_they_are(
    step: float, setup: Setup
) -> None:
    setup.start()
    setup.engaged()
    setup.world.clock.step_ns = nanoseconds(step)
    # The controller's time is not that of its system clock.
    setup.world.send("/u", dict.fromkeys(INPUTS, 0.0), age=step)
    before = len(setup.world.sent["/y"])
    u = setup.u
    setup.u = None

    def step_with_old_time() -> None:
        setup.step()
        setup.world.send("/u", dict(zip(INPUTS, u or (), strict=True)), age=step)

    setup.world.run(1.0, step_with_old_time)
    assert not any("ENGAGED -> RELEASE" in line for line in setup.bridge.log.lines)
    assert len(setup.world.sent["/y"]) > before + 40
    setup.joys.clear()
    setup.world.end(setup.bridge)
    assert setup.joys[-1].released


@pytest.mark.parametrize("suspended", [False, True])
def test_bridge_that_did_not_run_releases_and_can_be_engaged_again(
    suspended: bool, setup: Setup
) -> None:
    """After a stop by SIGSTOP, or a suspended host, the bridge can be engaged again.

    The monotonic clock of a suspended host stands still.
    """
    setup.start()
    setup.engaged()
    if suspended:
        setup.world.clock.suspended_ns = 10 * NANOSECONDS
    else:
        with setup.world.stopped(setup.bridge):
            setup.run(2.0)
    stopped = setup.t
    setup.until_logged("ENGAGED -> RELEASE: the bridge did not run for ")
    assert not setup.sent_since(stopped)[0]
    setup.run(RELEASE + 0.1)
    setup.engaged()


@pytest.mark.parametrize(
    "topic, kind, count, sentence",
    [
        (
            "/ap/airspeed",
            Vector3Stamped,
            2,
            "/ap/airspeed has 2 publishers, expected the autopilot alone",
        ),
        ("/ap/joy", Joy, 1, "/ap/joy has 1 publishers beside this bridge, expected none"),
    ],
)
def test_second_publisher_of_autopilot_releases_and_blocks(
    topic: str, kind: type, count: int, sentence: str, setup: Setup
) -> None:
    setup.start()
    setup.engaged()
    second = setup.world.publisher(kind, topic, 5)
    begin = setup.t
    # The graph is checked once a second.
    assert setup.until_logged(f"ENGAGED -> RELEASE: {sentence}") - begin <= 1.1
    setup.run(1.0)
    assert setup.engage() == sentence
    second.leave()
    setup.run(1.1)
    assert setup.engage() == ""


CONDITION = {"type": "std_msgs/msg/UInt8", "field": "data", "source": "a test"}


def test_engagement_waits_for_awaited_condition_and_can_be_withdrawn(setup: Setup) -> None:
    guided = CONDITION | {
        "topic": "/ap/mode",
        "one_of": [15],
        "sentence": "the mode is not guided",
        "max_age": 1e3,
    }
    request = {"topic": "/ap/request", "type": "std_msgs/msg/UInt8", "rate": 5.0, "stamped": False}
    # The requests are those of the map of PX4.
    requests = {"enter": request | {"when": "engaging"}, "leave": request | {"when": "release"}}
    setup.start(
        conditions={"guided": guided | {"awaited": True}},
        engage_timeout=1e3,
        messages=requests,
        topics={"/ap/mode": QOS, "/ap/request": QOS},
    )
    setup.further["/ap/mode"] = UInt8(data=10)
    setup.run(0.3)
    assert setup.engage() == ""
    setup.run(1.0)
    assert setup.world.messages("/bridge/engagement")[-1].key == "ENGAGING"
    assert (
        "the mode is not guided (data is 10)"
        in setup.world.messages("/bridge/engagement")[-1].value
    )
    assert setup.engage(on=False) == ""
    assert any(
        "ENGAGING -> RELEASE: disengaged by request" in line for line in setup.bridge.log.lines
    )
    setup.run(1.0)
    assert setup.engage() == ""
    setup.further["/ap/mode"] = UInt8(data=15)
    setup.until_logged("ENGAGING -> ENGAGED")


@pytest.mark.parametrize(
    "lost, reason, within",
    [
        (0, "the transmitter is lost (data is 0)", 2 * TICK),
        (None, "transmitter: data is 0.8", 0.8 + 2 * TICK),
    ],
    ids=("says so", "falls silent"),
)
def test_lost_transmitter_releases_within_a_second(
    lost: int | None, reason: str, within: float, setup: Setup
) -> None:
    transmitter = CONDITION | {
        "topic": "/ap/transmitter",
        "one_of": [1],
        "sentence": "the transmitter is lost",
        "max_age": 0.8,
    }
    setup.start(
        conditions={"transmitter": transmitter | {"transmitter": True}},
        max_engaged=None,
        topics={"/ap/transmitter": QOS},
    )
    setup.further["/ap/transmitter"] = UInt8(data=1)
    setup.engaged()
    begin = setup.t
    if lost is None:
        setup.further.clear()
    else:
        setup.further["/ap/transmitter"] = UInt8(data=lost)
    assert setup.until_logged("ENGAGED -> RELEASE: ", reason) - begin <= within
    setup.run(JOY)
    assert setup.joys[-1].released


def test_map_without_a_bound_engages_blind_alone_and_says_what_still_releases(setup: Setup) -> None:
    setup.start(max_engaged=None)
    setup.run(0.3)
    assert setup.engage().startswith(
        "the loss of the transmitter cannot be seen over this link: set max_engaged"
    )
    assert setup.engage(blind=True) == ""
    lacks = setup.world.messages("/bridge/engagement")[-1].value
    assert "a pilot override has no effect" in lacks
    assert (
        "the loss of the transmitter cannot be seen over this link; released by the override by "
        "gamepad" in lacks
    )


def test_max_engaged_is_announced_and_then_releases(setup: Setup) -> None:
    setup.start(max_engaged=11.0)
    setup.engaged()
    assert "max_engaged after 11 s" in setup.world.messages("/bridge/engagement")[-1].value
    (begin, _), *_ = setup.joys
    setup.until_logged("ENGAGED: max_engaged releases in 10 s")
    setup.until_logged("ENGAGED -> RELEASE: engaged for 11 s, max_engaged of the map")
    assert setup.t - begin == approx(11.0, abs=JOY + TICK)


def test_stale_u_sends_neutral_then_release_values_then_nothing_each_for_its_time(
    setup: Setup,
) -> None:
    """The publisher of u stays alive, and u returns.

    Only the age of u is judged, and not whether there is a publisher.
    """
    neutral = 0.4  # s
    setup.start(silence={"neutral": neutral})
    commanded = 0.02  # rad of elevator, within a tenth of its limit, as engagement requires
    setup.u = (commanded, 0.0, 0.0, 0.0)
    setup.engaged()
    setup.u = None
    stale = setup.t - TICK  # the last u
    setup.until_logged("RELEASE -> DISENGAGED: u is")
    setup.run(1.0)
    since = [sent for sent in setup.joys if sent.t > stale]
    u = [sent.t for sent in since if sent.axes[1] == approx(commanded / FULL, abs=1e-6)]
    neutral_values = [sent.t for sent in since if sent.axes == [0.0] * 4]
    released = [sent.t for sent in since if sent.released]
    assert len(u) + len(neutral_values) + len(released) == len(since)  # nothing else is sent
    late = JOY + 2 * TICK
    assert max(u) - stale == approx(MAX_AGE, abs=late)
    assert max(neutral_values) - stale == approx(MAX_AGE + neutral, abs=late)
    assert max(released) - stale == approx(MAX_AGE + neutral + RELEASE, abs=late)
    setup.joys.clear()
    setup.u = (commanded, 0.0, 0.0, 0.0)
    setup.run(0.5)
    assert not setup.joys  # u is fresh again; the bridge does not re-engage by itself


def test_messages_of_autopilot_become_y_to_the_last_bit_and_dry_run_publishes_what_it_would_send(
    tmp_path: Path,
) -> None:
    with bridged(tmp_path, dry_run="true") as setup:
        setup.start()
        setup.u = (0.1, 0.1, 9.0, -0.1)
        setup.run(1.0)
        would = setup.world.vectors("/bridge/would_send")[-1].channels
        assert list(would) == ["joy.axes[1]", "joy.axes[2]", "joy.axes[0]", "joy.axes[3]"]
        # Aileron at its limit.
        assert [*would.values()] == approx([0.1 / FULL, 0.2, 0.5, -0.1 / FULL], rel=1e-5)
        twists = setup.world.messages("/ap/twist/filtered")
        rates = {
            (-twist.twist.angular.y, twist.twist.angular.x, -twist.twist.angular.z)
            for twist in twists
        }
        messages = [y.channels for y in setup.world.vectors("/y")]
        assert len(messages) > 40
        assert all(tuple(y) == OUTPUTS for y in messages)
        assert {(y["q"], y["p"], y["r"]) for y in messages} <= rates
        assert max(abs(y["V"]) for y in messages) < 0.2  # m/s from trim: noise of 0.03 m/s
        assert setup.engage().startswith(
            "dry_run is true: nothing is sent; u.elevator is 0.1 from trim"
        )
        setup.run(0.3)
        assert not setup.joys


def test_topic_whose_publisher_has_left_named_as_that_of_a_client(setup: Setup) -> None:
    setup.start()
    setup.run(0.3)
    setup.autopilot_runs = False
    for publisher in (setup.autopilot._twist, setup.autopilot._airspeed):
        publisher.leave()
    # A client that left its agent has no publisher.
    setup.until_logged("waiting for /ap/twist/filtered: no publisher any more")


@pytest.mark.parametrize(
    "answer, reason",
    [
        (
            lambda _: ChangeState.Response(success=False),
            "the controller refused to activate, or was active already",
        ),
        (lambda _: None, "timed out waiting for the controller to activate"),
    ],
    ids=("refuses", "silent"),
)
def test_controller_that_does_not_activate_ends_engagement(
    answer: Callable[[Any], Any], reason: str, setup: Setup
) -> None:
    state = GetState.Response(current_state=State(id=State.PRIMARY_STATE_INACTIVE))
    setup.world.answers = {
        "/controller/get_state": lambda _: state,
        "/controller/change_state": answer,
    }
    setup.start()
    setup.run(0.3)
    begin = setup.t
    assert setup.engage() == ""
    assert (
        setup.until_logged("ENGAGED -> RELEASE: ", reason) - begin
        <= seconds(ACTIVATION_TIMEOUT_NS) + 2 * TICK
    )


def test_controller_is_active_only_while_engaged(setup: Setup) -> None:
    setup.u = None
    setup.start()
    controller = setup.world.start(ControllerNode)
    setup.world.start(ReferenceModelNode)
    setup.run(1.5)
    modes = [sample.channels["mode"] for sample in setup.world.vectors("/internals")]
    assert Mode.ENGAGED not in modes[-1:]
    assert setup.engage() == ""
    setup.run(0.5)
    assert setup.world.last("/internals")["mode"] == Mode.ENGAGED
    setup.engage(on=False)
    setup.run(1.5)
    assert any("-> INACTIVE" in line for line in controller.log.lines)
    assert not any(setup.world.last("/u").values())


def test_bridge_without_topics_of_autopilot_ends_with_the_cause_of_each(tmp_path: Path) -> None:
    with bridged(tmp_path, first_y=3.0) as setup:
        setup.autopilot_runs = False
        for publisher in (setup.autopilot._twist, setup.autopilot._airspeed):
            publisher.leave()
        setup.start()
        with pytest.raises(FlightEnded) as error:
            setup.run(4.0)
        sentence = str(error.value)
        assert sentence.startswith("no y after 3 s: ")
        assert "/ap/twist/filtered, /ap/airspeed: no publisher" in sentence


def test_domain_or_profile_named_where_a_topic_has_no_publisher() -> None:
    """The user has a domain of their own in the shell, and the agent is in domain 0."""
    assert no_publisher({"ROS_DOMAIN_ID": "37"}).startswith("no publisher in domain 37. The ")
    sentence = no_publisher({PROFILE_VARIABLE: "mine.xml"})
    assert "needs the same DDS profile, FASTRTPS_DEFAULT_PROFILES_FILE=mine.xml" in sentence


def test_topic_of_another_version_is_error_that_names_both_types(setup: Setup) -> None:
    # An AP_DDS whose type has changed publishes this.
    setup.world.publisher(TwistStamped, "/ap/airspeed", 10)
    setup.start()
    setup.world.subscribe(Imu, "/ap/joy", 10, "/peer", raw=True)
    setup.run(2.0)
    expected = "geometry_msgs/msg/TwistStamped, expected geometry_msgs/msg/Vector3Stamped"
    assert f"[ERROR] /ap/airspeed: /peer publishes {expected}" in setup.bridge.log.lines
    assert (
        "[ERROR] /ap/joy: /peer subscribes to sensor_msgs/msg/Imu, expected sensor_msgs/msg/Joy"
        in setup.bridge.log.lines
    )


def test_message_that_is_none_of_its_type_refused_and_counted(setup: Setup) -> None:
    bridge = setup.start()
    setup.run(0.3)
    setup.world.publisher(TwistStamped, "/ap/twist/filtered").publish(b"\x00\x01\x00\x00x")
    setup.run(TICK)
    assert bridge.refusals.counts == {"/ap/twist/filtered: malformed": 1}


def test_imu_and_odometry_of_simulator_become_y_and_pose_in_namespace() -> None:
    """The publisher uses the frames of REP 103.

    SciPy computes orientation and velocity in the body axes.
    """
    phi = 0.3
    theta = -0.2
    psi = 2.0
    enu_of_ned = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
    flu_of_frd = np.diag([1, -1, -1])
    turn = Rotation.from_matrix(
        enu_of_ned @ Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix() @ flu_of_frd
    )
    imu = Imu(angular_velocity=RATES)
    odometry = Odometry(child_frame_id="plane/base_link")
    for message, values in (
        (odometry.pose.pose.position, (30.0, 40.0, 20.0)),
        (odometry.pose.pose.orientation, turn.as_quat().tolist()),
        (odometry.twist.twist.linear, turn.inv().apply([3.0, 4.0, 2.0]).tolist()),
    ):
        for key, value in zip("xyzw", values, strict=False):
            setattr(message, key, value)

    with world_of("-r", "__ns:=/uav1", "-p", f"map:={MAP_FILES['odometry']}") as world:
        world.start(BridgeNode)

        def publish() -> None:
            world.publish("/uav1/sim/imu", imu)
            world.publish("/uav1/sim/odom", odometry)

        world.run(0.5, publish)
        y = world.last("/uav1/y")
        pose = world.last("/uav1/pose")
    assert y == approx({"q": 0.2, "V": 0.0, "p": 0.3, "r": 0.1})  # V is captured at an engagement
    expected = {
        "phi": phi,
        "theta": theta,
        "psi": psi,
        "north": 40.0,
        "east": 30.0,
        "altitude": 20.0,
    }
    assert pose == approx(expected | {"v_north": 4.0, "v_east": 3.0, "climb": 2.0}, abs=1e-6)


def test_missing_message_package_named_with_command_that_builds_it(tmp_path: Path) -> None:
    absent = tmp_path / "absent.yaml"
    absent.write_text((LIBRARY / "px4.yaml").read_text().replace("px4_msgs/", "absent_msgs/"))
    with world_of("-p", f"map:={absent}") as world, pytest.raises(ParameterError) as error:
        world.make(BridgeNode)
    assert "absent_msgs/msg/VehicleOdometry: the Python package absent_msgs" in str(error.value)
    assert "make messages PACKAGE=absent_msgs SOURCE=FOLDER" in str(error.value)


@pytest.mark.parametrize("sign", [1, -1])
def test_signs_of_map_compared_with_those_of_controller(sign: int, tmp_path: Path) -> None:
    content = yaml.safe_load(MAP_FILES["ardupilot_2024"].read_text())
    content["inputs"]["elevator"] = content["inputs"]["elevator"] | {
        "sign": sign * content["inputs"]["elevator"].get("sign", 1)
    }
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    check = invoke("check", tmp_path / "map.yaml", "--scenario", SCENARIO)
    assert (check.exit_code == 0) is (sign > 0), check.output
    words = (
        "fly",
        str(SCENARIO),
        "--bridge",
        str(tmp_path / "map.yaml"),
        "--send",
        "--runs",
        str(tmp_path / "runs"),
    )
    if sign < 0:
        refused = invoke(*words)
        assert "D of q and elevator is -1, the controller has +1" in str(refused.exception)


# Rows with real messages, after serialisation and deserialisation.


def serialised(message: Any) -> Any:
    return deserialize_message(serialize_message(message), type(message))


def test_a_real_pressure_gives_the_speed() -> None:
    message = serialised(FluidPressure(fluid_pressure=0.5 * 1.225 * 30.0**2))
    assert read_raw(message, "fluid_pressure", "airspeed_of_pressure") == approx(30.0)
