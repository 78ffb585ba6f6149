# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Each node alone: parameter errors, waiting for a publisher, clean shutdown."""

import os
import re
import signal
import subprocess

import numpy as np
import psutil
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from tests.conftest import REPOSITORY, with_policy
from tests.ros.conftest import Start
from tests.ros.peer import Peer, peer
from tests.ros.waiting import HANG

pytestmark = pytest.mark.package("flight_bringup")

PEER_TOPICS = ("/diagnostics",)
NODES = {
    "aircraft_sim": "aircraft",
    "reference_model": "reference_model",
    "rise_di_controller": "controller",
    "flight_recorder": "recorder",
}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "error: controller: found no parameters, expected a section for /controller"),
        (("--ros-args", "--params-file", "nowhere.yaml"), "error: failed to initialize rcl: Couldn't parse params file"),
    ],
)
def test_invalid_parameters_end_node_with_status_2_and_one_sentence(
    arguments: tuple[str, ...], sentence: str, start: Start
) -> None:
    """tests/nodes/test_node_parameters.py has the sentences."""
    node = start("rise_di_controller.main", *arguments)
    assert node.end() == 2
    assert any(line.startswith(sentence) for line in node.lines), node.output
    assert "Traceback" not in node.output


def test_node_shows_usage_without_middleware(start: Start) -> None:
    node = start("rise_di_controller.main", "--help")
    node.succeed()
    assert node.lines[0].startswith("usage: ")


@pytest.mark.parametrize(
    ("package", "waits_for", "number"),
    [("rise_di_controller", "/y", signal.SIGINT), ("aircraft_sim", "/u", signal.SIGTERM)],
)
def test_node_without_publisher_warns_keeps_waiting_and_shuts_down_cleanly(
    package: str, waits_for: str, number: signal.Signals, start_node: Start
) -> None:
    node = start_node(package).wait_for(f"waiting for {waits_for}: no publisher")
    assert node.popen.poll() is None
    node.popen.send_signal(number)
    assert node.end() == 0
    assert "Traceback" not in node.output


def test_node_stopped_during_start_shuts_down_cleanly(start_node: Start, peer_node: Peer) -> None:
    node = start_node("rise_di_controller")
    early_participant = f"_start_{node.popen.pid}"
    # The start may be faster than the discovery.
    peer_node.until(
        lambda: early_participant in peer_node.node.get_node_names() or "ready" in node.output,
        "the early participant, or a node that is ready",
    )
    node.popen.send_signal(signal.SIGTERM)
    assert node.end() == 0
    assert "Traceback" not in node.output


def test_early_participant_destroyed_once_node_exists(start_node: Start, peer_node: Peer) -> None:
    start_node("rise_di_controller").wait_for("ready")
    peer_node.until(lambda: set(peer_node.node.get_node_names()) == {"peer", "controller"}, "no early participant")


def test_no_module_imported_by_ready_node(start_node: Start, monkeypatch: pytest.MonkeyPatch, peer_node: Peer) -> None:
    # A library function that imports modules at its first call would do so inside a tick.
    monkeypatch.setenv("PYTHONPROFILEIMPORTTIME", "1")
    nodes = [start_node(package) for package in NODES]

    def reports(name: str) -> int:
        return sum(message.status[0].name == f"/{name}" for message in peer_node.received["/diagnostics"])

    peer_node.until(lambda: all(reports(name) >= 3 for name in NODES.values()), "three reports of each node")
    assert any("ENGAGED" in node.output for node in nodes)
    for node in nodes:
        assert [line for line in node.output.partition("]: ready")[2].splitlines() if "import time:" in line] == []


def test_requests_whose_replies_do_not_arrive_leave_controller_ticks(start_node: Start, peer_node: Peer) -> None:
    """The middleware blocks for 0.1 s before a reply whose reader does not match: here one that requires another durability."""
    node = start_node("rise_di_controller").wait_for("ready")
    unmatched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    client = peer_node.node.create_client(SetParameters, "controller/set_parameters", qos_profile=unmatched)
    request = SetParameters.Request(parameters=[Parameter("k_g", value=0.5).to_parameter_msg()])

    def changes() -> list[float]:
        return [float(stamp) for stamp in re.findall(r"\[([\d.]+)\] \[controller\]: k_g: ", node.output)]

    peer_node.until(lambda: len(changes()) >= 3, "three changes of a gain", each=lambda: client.call_async(request))
    assert np.diff(changes()).min() > 0.9  # s; without a pause 0.11


def test_burst_of_signals_ends_node_as_one_signal_does(start_node: Start) -> None:
    # A lock in the signal handler would deadlock here: the second signal interrupts the first handler.
    node = start_node("aircraft_sim").wait_for("waiting for /u")
    for _ in range(50):
        node.popen.send_signal(signal.SIGTERM)
        node.popen.send_signal(signal.SIGINT)
    assert node.end() == 0


def test_missing_transport_profile_is_error_before_start(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "/nowhere/profile.xml")
    node = start("aircraft_sim.main")
    assert node.end() == 2
    assert node.lines[0].startswith("error: FASTRTPS_DEFAULT_PROFILES_FILE: /nowhere/profile.xml cannot be read")


def test_node_of_longer_period_has_lower_real_time_priority(start_node: Start) -> None:
    packages = {"reference_model": 50, "rise_di_controller": 49, "flight_recorder": 47}
    nodes = {package: start_node(package, within=with_policy("--fifo", "50")) for package in packages}
    for package, node in nodes.items():
        threads = psutil.Process(node.wait_for("ready").popen.pid).threads()
        assert {os.sched_getparam(thread.id).sched_priority for thread in threads} == {packages[package]}
        node.interrupt().succeed()


def test_incompatible_type_and_quality_of_service_reported_with_peer(start_node: Start) -> None:
    with peer(topics=()) as peer_node:
        process = start_node("aircraft_sim")
        peer_node.node.create_publisher(Float64MultiArray, "u", QoSProfile(depth=1))
        process.wait_for("/u: /peer publishes std_msgs/msg/Float64MultiArray, expected sensor_msgs/msg/JointState")
        recorder = start_node("flight_recorder")
        peer_node.node.create_publisher(JointState, "truth", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
        recorder.wait_for("/truth: /peer publishes with incompatible quality of service")


def test_installed_executables_run() -> None:
    for package, executable in NODES.items():
        script = REPOSITORY / "ros_ws" / "install" / package / "lib" / package / executable
        process = subprocess.run([script], capture_output=True, text=True, timeout=HANG, check=False)
        assert process.returncode == 2
        assert f"error: {executable}: found no parameters" in process.stderr
