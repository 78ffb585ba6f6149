# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Guidance over topics: lockstep as in one process, targets and routes in flight, services, faults."""

import json
import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest
from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import Path as PathMessage
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from std_srvs.srv import SetBool, Trigger
from tests.ros.conftest import Start
from tests.ros.peer import OUTPUTS, Peer, stamp_ns
from tests.ros.test_lockstep import FIRST_CHUNKS, ROUGH, fly, scenario_file

from flight_analysis.closed_loop.scenario import load_scenario, scenario_yaml
from flight_analysis.closed_loop.simulate import simulate
from flight_bringup.scenarios import find_scenario
from flight_core.channels import POSE
from flight_core.modes import Mode as ControllerMode
from flight_core.outcome import STATUS_INCOMPLETE
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal
from flight_guidance.modes import Lateral, Vertical
from flight_guidance.reach import AUTHORITY
from flight_log.tape_reader import read_run
from flight_ros.messages import to_message
from flight_ros.topics import PUBLISH
from flight_view.control_client import ControlClient

pytestmark = pytest.mark.package("flight_guidance")

PEER_TOPICS = ("u_m", "guidance", "pose", "/diagnostics")
ORIGIN = [47.38, 8.54, 400.0]  # deg, m above WGS84
PATIENT = ("-p", "max_age:=1000.0")  # a delay of the host makes no sample stale
ENU_OF_NED, FLU_OF_FRD = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])
LEVEL = {"altitude": 50.0, "v_north": 25.0}


def test_lockstep_flight_repeats_bytes_of_one_process(start: Start, tmp_path: Path) -> None:
    lost_link = {"home": {"link_timeout": 1.0}, "origin": ORIGIN}
    scenario = scenario_file(tmp_path, 2.0, "osprey_route", aircraft=ROUGH, guidance=lost_link)
    run = fly(start, scenario, "runs", status=STATUS_INCOMPLETE)  # the route takes longer
    recorded = read_run(run).tape
    for name, signal in simulate(load_scenario(scenario)).signals.items():
        assert signal.names == recorded[name].names
        assert signal.stamp_ns.tobytes() == recorded[name].stamp_ns.tobytes(), name
        assert signal.values.tobytes() == recorded[name].values.tobytes(), name
    assert recorded["guidance"]["mode.lateral"][-1] == Lateral.ORBIT  # home
    assert len(recorded["u_m"].stamp_ns) == 100  # one at each instant but the first: y takes 10 ms
    tools_read(run, recorded["guidance"])


def tools_read(run: Path, logged: Signal) -> None:
    """Rosbags reads what tools get as guidance had it: frames of REP 103 by SciPy, the place on WGS84 by pymap3d."""
    with AnyReader([run]) as reader:
        messages: dict[str, list[Any]] = {
            topic: [] for topic in ("/odometry", "/guidance/imu", "/guidance/fix", "/guidance/wind")
        }
        for connection, _, data in reader.messages([each for each in reader.connections if each.topic in messages]):
            messages[connection.topic].append(reader.deserialize(data, connection.msgtype))
    assert {topic: len(received) for topic, received in messages.items()} == dict.fromkeys(messages, 20)  # 2 s at 10 Hz
    for odometry, imu, fix, wind in zip(*messages.values(), strict=True):
        stamp = odometry.header.stamp
        k = logged.stamp_ns.tolist().index(stamp.sec * NANOSECONDS + stamp.nanosec)
        assert all(each.header.stamp == stamp for each in (imu, fix, wind))
        assert (odometry.child_frame_id, imu.header.frame_id, wind.header.frame_id) == ("base_link", "base_link", "map")
        angles = [logged[f"pose.{name}"][k] for name in ("psi", "theta", "phi")]
        flu_in_enu = ENU_OF_NED @ Rotation.from_euler("ZYX", angles).as_matrix() @ FLU_OF_FRD
        orientation = [getattr(imu.orientation, key) for key in "xyzw"]
        assert Rotation.from_quat(orientation).as_matrix() == pytest.approx(flu_in_enu, abs=1e-12)
        body = imu.angular_velocity
        assert (body.x, -body.y, -body.z) == tuple(logged[f"y.{name}"][k] for name in "pqr")
        assert imu.linear_acceleration_covariance[0] == -1.0  # none: sensor_msgs/Imu
        assert (wind.vector.y, wind.vector.x) == tuple(logged[f"wind.{name}"][k] for name in ("north", "east"))
        place = [logged[f"pose.{name}"][k] for name in ("east", "north", "altitude")]
        velocity = [logged[f"pose.{name}"][k] for name in ("v_east", "v_north", "climb")]
        linear = odometry.twist.twist.linear
        assert flu_in_enu @ [linear.x, linear.y, linear.z] == pytest.approx(velocity, abs=1e-9)
        east, north, _ = pymap3d.geodetic2enu(fix.latitude, fix.longitude, 0.0, *ORIGIN[:2], 0.0)  # on the ellipsoid
        assert (east, north, fix.altitude - ORIGIN[2]) == pytest.approx(place, abs=1e-6)


def test_lockstep_flight_takes_target_and_ends_with_name_of_lost_guidance(start: Start, tmp_path: Path) -> None:
    command = start("flight_cli.cli", "fly", str(scenario_file(tmp_path, 1e5, "osprey_route")), "--lockstep", "--runs", "runs")
    command.wait_for_log(tmp_path / "runs", FIRST_CHUNKS)
    assert "in force: altitude=60" in start("flight_cli.cli", "target", "altitude=60").succeed().output
    command.child("flight_guidance.main").kill()
    assert command.end() == 3
    summary = json.loads((tmp_path / "runs" / "latest" / "summary.json").read_text(encoding="utf-8"))
    assert summary["outcome"] == "guidance was killed by SIGKILL"


def test_guidance_alone_starts_from_parameters_of_run(start: Start, tmp_path: Path) -> None:
    refused = start("flight_guidance.main", "--ros-args", "--params-file", str(find_scenario("osprey_route").path))
    assert refused.end() == 2
    assert "`parameters.yaml` of a run has them" in refused.output
    flight = start("flight_cli.cli", "fly", "osprey_route", "--in-process", "--duration", "1", "--runs", "runs")
    assert flight.end() == STATUS_INCOMPLETE  # the route takes longer
    parameters = tmp_path / "runs" / "latest" / "parameters.yaml"
    start("flight_guidance.main", "--ros-args", "--params-file", str(parameters)).wait_for("ready")


@pytest.fixture
def calm(tmp_path: Path) -> Path:
    """The osprey in calm air, without a route."""
    varied = find_scenario("osprey_route").vary(
        aircraft={"wind": [0.0, 0.0], "turbulence": None},
        guidance={"route": None},
    )
    path = tmp_path / "calm.yaml"
    path.write_text(scenario_yaml(varied), encoding="utf-8")
    return path


class Flight:
    """A guidance node alone; the peer is aircraft and controller."""

    def __init__(self, start: Start, peer_node: Peer, scenario: Path, age_limit: tuple[str, ...] = PATIENT) -> None:
        self.peer = peer_node
        self.process = start("flight_guidance.main", "--ros-args", "--params-file", str(scenario), *age_limit)
        self.mode: float = ControllerMode.ENGAGED
        self.rng = np.random.default_rng(1)

    def send(self, sender: str = "/aircraft#1") -> None:
        """One y, one pose and one sample of internals, stamped now."""
        now_ns, pose = time.time_ns(), np.array([LEVEL.get(name, 0.0) for name in POSE])
        pose[POSE.index("v_east")] = self.rng.normal(0.0, 0.01)  # a pose that stands still is refused
        self.peer.publish("y", to_message(now_ns, OUTPUTS, np.zeros(4), sender))
        self.peer.publish("pose", to_message(now_ns, POSE, pose, sender))
        self.peer.publish("internals", to_message(now_ns, ["mode"], np.array([float(self.mode)]), "/controller#1"))

    def until(self, condition: Callable[[], object], each: Callable[[], object] = lambda: None) -> None:
        """Send, and call `each`, until the condition holds."""

        def both() -> None:
            self.send()
            each()

        self.peer.until(condition, each=both)

    def last(self, name: str) -> float:
        """The last value of a channel of `guidance`; NaN before the first."""
        messages = self.peer.received["guidance"]
        return float(messages[-1].position[messages[-1].name.index(name)]) if messages else math.nan

    def target(self, **values: float) -> None:
        """Publish commands by channel."""
        self.peer.publish("target", to_message(time.time_ns(), [*values], np.array([*values.values()]), "/operator#1"))


@pytest.fixture
def flight(start: Start, peer_node: Peer, calm: Path) -> Flight:
    """Guidance that has engaged."""
    made = Flight(start, peer_node, calm)
    made.until(lambda: peer_node.received["u_m"])
    return made


def test_there_is_no_command_before_controller_engaged(start: Start, peer_node: Peer, calm: Path) -> None:
    made = Flight(start, peer_node, calm)
    made.mode = ControllerMode.WAITING

    def has_both() -> bool:
        keys = {pair.key for array in peer_node.received["/diagnostics"] for status in array.status for pair in status.values}
        return {"age of y (s)", "age of pose (s)"} <= keys

    made.until(has_both)
    made.mode = 17  # no mode of the controller
    made.until(partial(peer_node.counted, "refused internals: mode"))
    assert not peer_node.received["u_m"]
    made.mode = ControllerMode.ENGAGED
    made.until(lambda: peer_node.received["u_m"])


def test_targets_select_modes_and_bad_ones_refused(flight: Flight) -> None:
    flight.until(lambda: flight.last("target.altitude") == 60.0, lambda: flight.target(heading=1.0, altitude=60.0))
    assert flight.last("mode.lateral") == Lateral.HEADING
    assert flight.last("mode.vertical") == Vertical.ALTITUDE
    for reason, values in {"bounds": {"phi": 2.0}, "name": {"bank": 0.1}, "finite": {"heading": math.nan}}.items():
        flight.until(partial(flight.peer.counted, f"refused target: {reason}"), partial(flight.target, **values))
    assert flight.last("target.heading") == 1.0
    late = to_message(1, ["heading"], np.array([0.5]), "/operator#1")
    flight.until(partial(flight.peer.counted, "refused target: old"), partial(flight.peer.publish, "target", late))
    assert flight.last("target.heading") == 1.0


def test_target_without_channels_keeps_link(start: Start, peer_node: Peer, calm: Path) -> None:
    with_limit = load_scenario(calm).vary(guidance={"home": {"link_timeout": 1.0}})
    calm.write_text(scenario_yaml(with_limit), encoding="utf-8")
    made = Flight(start, peer_node, calm)
    made.until(lambda: made.last("age.link") > 0.3)
    made.until(lambda: made.last("age.link") < 0.1, made.target)
    made.until(lambda: made.last("mode.lateral") == Lateral.ORBIT)
    made.until(lambda: made.process.has_logged("no message of an operator for 1 s: home"))


def test_learned_authority_limits_commands_and_a_bad_one_is_refused(flight: Flight) -> None:
    def able(value: float) -> None:
        channels = np.full(len(AUTHORITY), value)
        flight.peer.publish("authority", to_message(time.time_ns(), AUTHORITY, channels, "/controller#1"))

    warned = "by the learned model no roll rate: p has no input with an effect"
    flight.until(lambda: flight.last("authority.p") == 0.0 and flight.process.has_logged(warned), lambda: able(0.0))
    flight.until(partial(flight.peer.counted, "refused authority: bounds"), lambda: able(-1.0))
    assert flight.last("authority.p") == 0.0


def test_modes_of_second_controller_refused(flight: Flight) -> None:
    def second() -> None:
        inactive = np.array([float(ControllerMode.INACTIVE)])
        flight.peer.publish("internals", to_message(time.time_ns(), ["mode"], inactive, "/standby#2"))

    flight.until(lambda: flight.last("target.heading") == 1.0, lambda: flight.target(heading=1.0))
    flight.until(partial(flight.peer.counted, "refused internals: sender"), second)
    assert flight.last("target.heading") == 1.0  # that of an INACTIVE controller is forgotten


def test_route_to_stopped_guidance_ends_when_cancelled(flight: Flight) -> None:
    with ControlClient("") as client, ThreadPoolExecutor(max_workers=1) as worker, flight.process.stopped():
        sent = worker.submit(client.send_route, [[0.0, 0.0, 50.0], [900.0, 0.0, 55.0]])
        flight.until(lambda: flight.peer.node.count_publishers("route") == 1)
        client.cancel()
        with pytest.raises(ParameterError, match="cancelled by a later request"):
            sent.result()


def test_command_target_says_what_is_in_force_and_what_refused(flight: Flight, start: Start) -> None:
    good = start("flight_cli.cli", "target", "heading=90", "altitude=60")
    flight.until(lambda: good.popen.poll() is not None)
    assert "in force: heading=90, altitude=60" in good.succeed().output
    flight.until(lambda: (flight.last("target.heading"), flight.last("target.altitude")) == (math.pi / 2.0, 60.0))
    refused = start("flight_cli.cli", "target", "phi=80")  # degrees
    flight.until(lambda: refused.popen.poll() is not None)
    assert refused.end() == 1
    assert "error: not in force: target.phi: found 80, expected -30 to 30 deg" in refused.output


def test_a_storm_of_targets_delays_no_command(flight: Flight) -> None:
    def storm() -> None:
        flight.send()
        for k in range(20):
            flight.target(heading=0.01 * k)

    flight.peer.until(lambda: not math.isnan(flight.last("target.heading")), each=storm)
    flight.peer.received["u_m"].clear()
    flight.peer.until(lambda: len(flight.peer.received["u_m"]) > 100, each=storm)
    stamps = [stamp_ns(message) for message in flight.peer.received["u_m"]]
    assert np.median(np.diff(stamps)) == 20_000_000  # ns, every tick, except where the host is late


def test_services_hold_skip_and_disengage(flight: Flight) -> None:
    def call(kind: type, name: str, request: object) -> tuple[bool, str]:
        response = flight.peer.call(kind, f"guidance/{name}", request, each=flight.send)
        return response.success, response.message

    flight.until(lambda: flight.last("mode.lateral") == Lateral.PHI, lambda: flight.target(phi=0.2))
    flight.until(lambda: flight.last("mode.lateral") == Lateral.HEADING, lambda: call(Trigger, "hold", Trigger.Request()))
    assert call(Trigger, "skip", Trigger.Request()) == (False, "no route with a further leg is flown")
    assert call(SetBool, "engage", SetBool.Request(data=False)) == (True, "")
    flight.until(lambda: flight.process.has_logged("ENGAGED -> OFF"))
    flight.peer.received["u_m"].clear()
    flight.mode = ControllerMode.INACTIVE
    flight.until(lambda: call(SetBool, "engage", SetBool.Request(data=True)) == (False, REFUSAL))
    flight.mode = ControllerMode.ENGAGED
    flight.until(lambda: call(SetBool, "engage", SetBool.Request(data=True)) == (True, ""))
    flight.until(lambda: flight.peer.received["u_m"])


def test_the_client_of_a_page_commands_guidance(flight: Flight) -> None:
    with ControlClient("") as client, ThreadPoolExecutor(max_workers=1) as worker:

        def answer(method: Callable[..., str], *arguments: object) -> str:
            pending = worker.submit(method, *arguments)
            flight.until(pending.done)
            return pending.result()

        assert answer(client.send_target, {"phi": 0.2}) == ""
        flight.until(lambda: flight.last("target.phi") == 0.2)
        # The log has these values already; guidance refuses two lateral commands at once.
        refused = answer(client.send_target, {"theta": 0.0, "leg": 0.0, "phi": 0.2})
        assert refused == "target: found theta, leg, phi, expected one lateral and one vertical command at most"
        assert answer(client.guide, "skip") == "no route with a further leg is flown"
        assert answer(client.send_route, [[0.0, 0.0, 50.0], [900.0, 0.0, 55.0], [900.0, 900.0, 55.0]]) == ""
        flight.until(lambda: flight.last("mode.lateral") == Lateral.ROUTE)
        flight.until(lambda: flight.peer.node.count_publishers("route") == 0)  # a later guidance receives no route of before
        leg = flight.last("leg")
        assert answer(client.guide, "skip") == ""
        flight.until(lambda: flight.last("leg") > leg)
        assert answer(client.guide, "hold") == ""
        flight.until(lambda: flight.last("mode.lateral") == Lateral.HEADING)


REFUSAL = "the controller is INACTIVE, expected ENGAGED"


def test_route_flown_when_it_arrives_and_refused_when_it_cannot_be_flown(flight: Flight) -> None:
    publisher = flight.peer.node.create_publisher(PathMessage, "route", PUBLISH)

    def route(*points: tuple[float, float, float]) -> PathMessage:
        message = PathMessage()
        message.poses = [pose_at(*point) for point in points]
        return message

    good, alone = route((0.0, 0.0, 50.0), (0.0, 900.0, 55.0)), route((0.0, 0.0, 50.0))  # east, north, up
    good.header.frame_id = "odom"

    for message, sentence in ((good, "route: found the frame 'odom', expected 'map'"), (alone, "route: found 1 waypoints")):
        flight.until(partial(flight.process.has_logged, sentence), partial(publisher.publish, message))
    good.header.frame_id = "map"
    flight.until(lambda: flight.last("mode.lateral") == Lateral.ROUTE, lambda: publisher.publish(good))
    # the last line is a tangent to the last orbit, of the least radius at 25 m/s, 3 m/s of wind and 0.8 of a bank of 30 deg
    radius = math.ceil((25.0 + 3.0) ** 2 / (9.80665 * math.tan(0.8 * math.radians(30.0))))
    assert flight.last("to_go") == pytest.approx(math.sqrt(900.0**2 - radius**2))
    assert flight.last("target.altitude") == pytest.approx(50.0, abs=0.1)  # at the begin of the slope


def pose_at(east: float, north: float, up: float) -> PoseStamped:
    """A stamped pose at a position."""
    message = PoseStamped()
    message.pose.position = Point(x=east, y=north, z=up)
    return message


def test_second_publisher_of_pose_refused(flight: Flight) -> None:
    flight.until(lambda: flight.peer.counted("refused pose: sender", 5), lambda: flight.send("/other#2"))


def test_stale_pose_levels_wings(start: Start, peer_node: Peer, calm: Path) -> None:
    flight = Flight(start, peer_node, calm, age_limit=())
    flight.until(lambda: peer_node.received["u_m"])

    def without_pose() -> None:
        now_ns = time.time_ns()
        flight.peer.publish("y", to_message(now_ns, OUTPUTS, np.zeros(4), "/aircraft#1"))

    peer_node.until(lambda: flight.process.has_logged("pose is stale: wings are levelled"), each=without_pose)
    stale = len(flight.process.lines)
    flight.until(lambda: "-> ENGAGED" in "".join(flight.process.lines[stale:]))  # from OFF after a delay of the host
