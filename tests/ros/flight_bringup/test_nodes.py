# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test each node alone: a failed start, waiting for a publisher, and a clean shutdown."""

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

PEER_TOPICS = ("/diagnostics",)
NODES = {
    "aircraft_sim": "aircraft",
    "reference_model": "reference_model",
    "rise_di_controller": "controller",
    "flight_recorder": "recorder",
}


def test_node_that_cannot_start_ends_with_status_2_and_one_sentence(start: Start) -> None:
    """tests/nodes/flight_ros/test_node_parameters.py tests the sentences on single parameters."""
    no_profile = ("env", "FASTRTPS_DEFAULT_PROFILES_FILE=/nowhere/profile.xml")
    nodes = {
        "failed to initialize rcl: Couldn't parse params file": start(
            "rise_di_controller.main", "--ros-args", "--params-file", "nowhere.yaml"
        ),
        "FASTRTPS_DEFAULT_PROFILES_FILE: /nowhere/profile.xml cannot be read": start(
            "aircraft_sim.main", within=no_profile
        ),
    }
    usage = start("rise_di_controller.main", "--help").succeed()
    assert usage.output.startswith("usage: ")
    for sentence, node in nodes.items():
        assert node.end() == 2
        assert any(line.startswith(f"error: {sentence}") for line in node.lines), node.output
        assert "Traceback" not in node.output
    # the recorder has a default for each parameter
    for package, executable in NODES.items() - {("flight_recorder", "recorder")}:
        script = REPOSITORY / "ros_ws" / "install" / package / "lib" / package / executable
        process = subprocess.run(
            [script], capture_output=True, text=True, timeout=HANG, check=False
        )
        assert process.returncode == 2
        assert (
            f"error: {executable}: found no parameters, expected a section for /{executable}"
            in process.stderr
        )


def test_waiting_nodes_report_unfit_publishers_and_shut_down_cleanly(start_node: Start) -> None:
    controller = start_node("rise_di_controller", "-r", "__ns:=/alone")
    aircraft = start_node("aircraft_sim")
    controller.wait_for("waiting for /alone/y: no publisher")
    aircraft.wait_for("waiting for /u: no publisher")
    with peer(topics=()) as peer_node:
        peer_node.node.create_publisher(Float64MultiArray, "u", QoSProfile(depth=1))
        aircraft.wait_for(
            "/u: /peer publishes std_msgs/msg/Float64MultiArray, expected "
            "sensor_msgs/msg/JointState"
        )
        recorder = start_node("flight_recorder")
        peer_node.node.create_publisher(
            JointState, "truth", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        )
        # the recorder names the publisher, or asks for less before the check of the graph
        sentences = (
            "/truth: /peer publishes with incompatible",
            "/truth: now recorded as best_effort",
        )
        recorder.until(
            lambda: any(sentence in recorder.output for sentence in sentences),
            "a sentence on truth",
        )
    controller.interrupt()
    recorder.popen.terminate()
    for _ in range(
        50
        # a lock in the signal handler would deadlock: the second signal interrupts the first
        # handler
    ):
        aircraft.popen.send_signal(signal.SIGTERM)
        aircraft.popen.send_signal(signal.SIGINT)
    for node in (controller, recorder, aircraft):
        assert "Traceback" not in node.succeed().output


def test_start_has_early_participant_and_late_replies_leave_controller_ticks(
    start_node: Start, peer_node: Peer
) -> None:
    """The middleware blocks for 0.1 s before a reply whose reader does not match.

    The reader here requires another durability.
    """
    stopped = start_node("rise_di_controller")
    early_participant = f"_start_{stopped.popen.pid}"
    # The start may be faster than the discovery.
    peer_node.until(
        lambda: early_participant in peer_node.node.get_node_names() or "ready" in stopped.output,
        "the early participant, or a node that is ready",
    )
    stopped.popen.send_signal(signal.SIGTERM)
    assert "Traceback" not in stopped.succeed().output

    node = start_node("rise_di_controller").wait_for("ready")
    peer_node.until(
        lambda: set(peer_node.node.get_node_names()) == {"peer", "controller"},
        "no early participant",
    )
    unmatched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    client = peer_node.node.create_client(
        SetParameters, "controller/set_parameters", qos_profile=unmatched
    )
    request = SetParameters.Request(parameters=[Parameter("k_g", value=0.5).to_parameter_msg()])

    def changes() -> list[float]:
        return [
            float(stamp) for stamp in re.findall(r"\[([\d.]+)\] \[controller\]: k_g: ", node.output)
        ]

    peer_node.until(
        lambda: len(changes()) >= 3,
        "three changes of a gain",
        each=lambda: client.call_async(request),
    )
    assert np.diff(changes()).min() > 0.9  # s; without a pause 0.11


def test_no_module_imported_by_ready_node(
    start_node: Start, monkeypatch: pytest.MonkeyPatch, peer_node: Peer
) -> None:
    # A library function that imports modules at its first call would do so inside a tick.
    monkeypatch.setenv("PYTHONPROFILEIMPORTTIME", "1")
    nodes = [start_node(package) for package in NODES]

    def reports(name: str) -> int:
        return sum(
            message.status[0].name == f"/{name}" for message in peer_node.received["/diagnostics"]
        )

    peer_node.until(
        lambda: all(reports(name) >= 3 for name in NODES.values()), "three reports of each node"
    )
    assert any("ENGAGED" in node.output for node in nodes)
    for node in nodes:
        assert [
            line
            for line in node.output.partition("]: ready")[2].splitlines()
            if "import time:" in line
        ] == []


def test_node_of_longer_period_has_lower_real_time_priority(start_node: Start) -> None:
    packages = {"reference_model": 50, "rise_di_controller": 49, "flight_recorder": 47}
    nodes = {
        package: start_node(package, within=with_policy("--fifo", "50")) for package in packages
    }
    for package, node in nodes.items():
        threads = psutil.Process(node.wait_for("ready").popen.pid).threads()
        assert {os.sched_getparam(thread.id).sched_priority for thread in threads} == {
            packages[package]
        }
        node.interrupt().succeed()
