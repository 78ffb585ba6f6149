# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test guidance over topics: lockstep, and the commands and the page that control it."""

import json
import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from tests.closed_loop import in_calm_air
from tests.conftest import refusing
from tests.recordings import require_equal_bits
from tests.ros.conftest import Start
from tests.ros.flight_bringup.test_lockstep import FIRST_CHUNKS, ROUGH, fly, scenario_file
from tests.ros.peer import OUTPUTS, Peer

from flight_analysis.closed_loop.scenario import load_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.channels import POSE
from flight_core.modes import Mode as ControllerMode
from flight_core.outcome import STATUS_SHORTFALL, Refusal
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal
from flight_guidance.guidance_state import Lateral
from flight_log.tape_reader import read_run
from flight_ros.messages import to_message
from flight_view.control_client import ControlClient

PEER_TOPICS = ("u_m", "guidance", "target")
ORIGIN = [47.38, 8.54, 400.0]  # deg, m above WGS84
PATIENT = ("-p", "max_age:=1000.0")  # a delay of the host makes no sample stale
ENU_OF_NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FLU_OF_FRD = np.diag([1, -1, -1])
LEVEL = {"altitude": 50.0, "v_north": 25.0}


def test_lockstep_flight_repeats_bytes_of_one_process(start: Start, tmp_path: Path) -> None:
    lost_link = {"home": {"link_timeout": 1.0}, "origin": ORIGIN}
    scenario = scenario_file(tmp_path, 2.0, "osprey_route", aircraft=ROUGH, guidance=lost_link)
    run = fly(start, scenario, "runs", status=STATUS_SHORTFALL)  # the route takes longer
    recorded = read_run(run).tape
    require_equal_bits(recorded, simulate(load_scenario(scenario)))
    assert recorded["guidance"]["mode.lateral"][-1] == Lateral.ORBIT  # home
    assert len(recorded["u_m"].stamp_ns) == 100  # one at each instant but the first: y takes 10 ms
    tools_read(run, recorded["guidance"])


def tools_read(run: Path, logged: Signal) -> None:
    """Check with Rosbags that tools get what guidance had.

    SciPy converts the frames of REP 103, and pymap3d the place on WGS84.
    """
    with AnyReader([run]) as reader:
        messages: dict[str, list[Any]] = {
            topic: [] for topic in ("/odometry", "/guidance/imu", "/guidance/fix", "/guidance/wind")
        }
        for connection, _, data in reader.messages(
            [each for each in reader.connections if each.topic in messages]
        ):
            messages[connection.topic].append(reader.deserialize(data, connection.msgtype))
    # 2 s at 10 Hz
    assert {topic: len(received) for topic, received in messages.items()} == dict.fromkeys(
        messages, 20
    )
    for odometry, imu, fix, wind in zip(*messages.values(), strict=True):
        stamp = odometry.header.stamp
        k = logged.stamp_ns.tolist().index(stamp.sec * NANOSECONDS + stamp.nanosec)
        assert all(each.header.stamp == stamp for each in (imu, fix, wind))
        assert (odometry.child_frame_id, imu.header.frame_id, wind.header.frame_id) == (
            "base_link",
            "base_link",
            "map",
        )
        angles = [logged[f"pose.{name}"][k] for name in ("psi", "theta", "phi")]
        flu_in_enu = ENU_OF_NED @ Rotation.from_euler("ZYX", angles).as_matrix() @ FLU_OF_FRD
        orientation = [getattr(imu.orientation, key) for key in "xyzw"]
        assert Rotation.from_quat(orientation).as_matrix() == pytest.approx(flu_in_enu, abs=1e-12)
        body = imu.angular_velocity
        assert (body.x, -body.y, -body.z) == tuple(logged[f"y.{name}"][k] for name in "pqr")
        assert imu.linear_acceleration_covariance[0] == -1.0  # none: sensor_msgs/Imu
        assert (wind.vector.y, wind.vector.x) == tuple(
            logged[f"wind.{name}"][k] for name in ("north", "east")
        )
        place = [logged[f"pose.{name}"][k] for name in ("east", "north", "altitude")]
        velocity = [logged[f"pose.{name}"][k] for name in ("v_east", "v_north", "climb")]
        linear = odometry.twist.twist.linear
        assert flu_in_enu @ [linear.x, linear.y, linear.z] == pytest.approx(velocity, abs=1e-9)
        # on the ellipsoid
        east, north, _ = pymap3d.geodetic2enu(fix.latitude, fix.longitude, 0.0, *ORIGIN[:2], 0.0)
        assert (east, north, fix.altitude - ORIGIN[2]) == pytest.approx(place, abs=1e-6)


def test_lockstep_flight_takes_target_and_ends_with_name_of_lost_guidance(
    start: Start, tmp_path: Path
) -> None:
    command = start(
        "flight_cli.cli",
        "fly",
        str(scenario_file(tmp_path, 1e5, "osprey_route")),
        "--lockstep",
        "--runs",
        "runs",
    )
    command.wait_for_log(tmp_path / "runs", FIRST_CHUNKS)
    assert (
        "in force: altitude=60" in start("flight_cli.cli", "guide", "altitude=60").succeed().output
    )
    command.child("flight_guidance.main").kill()
    assert command.end() == 3
    summary = json.loads((tmp_path / "runs" / "latest" / "summary.json").read_text())
    assert summary["outcome"]["sentence"] == "guidance was killed by SIGKILL"


@pytest.fixture
def calm(tmp_path: Path) -> Path:
    """Return the osprey in calm air, without a route."""
    return in_calm_air(tmp_path / "calm.yaml")


class Flight:
    """A guidance node. The peer plays the aircraft and the controller."""

    def __init__(self, start: Start, peer_node: Peer, scenario: Path) -> None:
        self.peer = peer_node
        self.process = start(
            "flight_guidance.main", "--ros-args", "--params-file", str(scenario), *PATIENT
        )
        self.rng = np.random.default_rng(1)

    def send(self) -> None:
        """Send a y, a pose and a sample of internals with the present stamp."""
        now_ns = time.time_ns()
        pose = np.array([LEVEL.get(name, 0.0) for name in POSE])
        # a pose that stands still is refused
        pose[POSE.index("v_east")] = self.rng.normal(0.0, 0.01)
        self.peer.publish("y", to_message(now_ns, OUTPUTS, np.zeros(4), "/aircraft#1"))
        self.peer.publish("pose", to_message(now_ns, POSE, pose, "/aircraft#1"))
        self.peer.publish(
            "internals",
            to_message(
                now_ns, ["mode"], np.array([float(ControllerMode.ENGAGED)]), "/controller#1"
            ),
        )

    def until(self, condition: Callable[[], object], because: str) -> None:
        """Send until the condition is true."""
        self.peer.until(condition, because, each=self.send)

    def last(self, name: str) -> float:
        """Return the last value of a channel of `guidance`, or NaN before the first."""
        message = self.peer.last("guidance")
        return math.nan if message is None else float(message.position[message.name.index(name)])


@pytest.fixture
def flight(start: Start, peer_node: Peer, calm: Path) -> Flight:
    """Return guidance that has engaged."""
    flight_over_topics = Flight(start, peer_node, calm)
    flight_over_topics.until(lambda: peer_node.received["u_m"], "a u_m")
    return flight_over_topics


def test_command_and_page_say_what_guidance_took_and_refused(
    start: Start, peer_node: Peer, calm: Path
) -> None:
    flight = Flight(start, peer_node, calm)
    flight.until(lambda: peer_node.received["u_m"], "a u_m")
    good = start("flight_cli.cli", "guide", "heading=90", "altitude=60")
    flight.until(lambda: good.popen.poll() is not None, "the end of the command")
    assert "in force: heading=90, altitude=60" in good.succeed().output
    flight.until(
        lambda: (
            (flight.last("target.heading"), flight.last("target.altitude")) == (math.pi / 2.0, 60.0)
        ),
        "both targets in force",
    )
    rejected = start("flight_cli.cli", "guide", "phi=80")  # degrees
    flight.until(lambda: rejected.popen.poll() is not None, "the end of the command")
    assert rejected.end() == 1
    assert "error: refused: target.phi: found 80, expected -30 to 30 deg" in rejected.output

    with ControlClient("") as client, ThreadPoolExecutor(max_workers=1) as worker:

        def answer(method: Callable[..., Refusal | None], *arguments: object) -> Refusal | None:
            pending = worker.submit(method, *arguments)
            flight.until(pending.done, "an answer")
            return pending.result()

        assert answer(client.send_target, {"phi": 0.2}) is None
        flight.until(lambda: flight.last("target.phi") == 0.2, "the target in force")
        # The log has these values already; guidance refuses two lateral commands at once.
        refusal = answer(client.send_target, {"theta": 0.0, "leg": 0.0, "phi": 0.2})
        assert (
            str(refusal)
            == "target: found theta, leg, phi, expected one lateral and one vertical command at "
            "most"
        )
        assert str(answer(client.guide, "skip")) == "no route with a further leg is flown"
        assert (
            answer(client.send_route, [[0.0, 0.0, 50.0], [900.0, 0.0, 55.0], [900.0, 900.0, 55.0]])
            is None
        )
        flight.until(lambda: flight.last("mode.lateral") == Lateral.ROUTE, "a flown route")
        # a later guidance receives no route of before
        flight.until(
            lambda: peer_node.node.count_publishers("route") == 0, "a route that is withdrawn"
        )
        leg = flight.last("leg")
        assert answer(client.guide, "skip") is None
        flight.until(lambda: flight.last("leg") > leg, "the next leg")
        assert answer(client.guide, "hold") is None
        flight.until(lambda: flight.last("mode.lateral") == Lateral.HEADING, "the held heading")

        with flight.process.stopped():  # it takes nothing: a later request ends the wait
            pending = worker.submit(client.send_route, [[0.0, 0.0, 50.0], [900.0, 0.0, 55.0]])
            flight.until(
                lambda: peer_node.node.count_publishers("route") == 1, "the publisher of the route"
            )
            client.cancel()
            with refusing("cancelled by a later request"):
                pending.result()
            client.resume()
            before = len(peer_node.received["target"])
            pending = worker.submit(client.send_target, {"phi": 0.1})
            in_force = (["target.phi"], np.array([0.0]), "peer")  # another target stays in force
            peer_node.until(
                lambda: len(peer_node.received["target"]) > before,
                "a target",
                each=lambda: peer_node.publish("guidance", to_message(time.time_ns(), *in_force)),
            )
            client.cancel()
            with refusing("cancelled by a later request"):
                pending.result()
