# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the recorder over DDS.

The tests cover topics of ROS 2 itself, any offered quality of service, lost messages, and a forged
packet. tests/nodes/flight_recorder/test_recorder.py tests what it does with its messages.
"""

import re
import socket
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import FluidPressure, JointState, Temperature
from std_msgs.msg import String
from tests.ros.conftest import Recorder
from tests.ros.peer import OUTPUTS, Peer
from tests.ros.waiting import HostDelays

from flight_log.tape_reader import read_run
from flight_ros.messages import to_message
from flight_ros.topics import PUBLISH

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


PEER_TOPICS = ("/diagnostics",)


def diagnostics(peer_node: Peer) -> tuple[int, str, dict[str, str]]:
    """Return level, sentence and figures of the recorder's newest diagnostics."""
    for status in (message.status[0] for message in reversed(peer_node.received["/diagnostics"])):
        if status.name == "/recorder":
            return (
                status.level[0],
                status.message,
                {value.key: value.value for value in status.values},
            )
    return -1, "", {}


def recorded(peer_node: Peer, topic: str) -> int:
    return int(diagnostics(peer_node)[2].get(f"messages {topic}", 0))


def test_topics_of_ros_and_further_ones_recorded_with_any_offered_qos(
    recorder: Recorder, peer_node: Peer, tmp_path: Path
) -> None:
    node = peer_node.node
    node.get_logger().info("logged before the recorder started")
    for topic in ("/latched", "/mixed"):
        node.create_publisher(String, topic, LATCHED).publish(String(data="before"))
    process = recorder("run", "topics:=[/latched, relative/pressure, /late, /y, /mixed]").wait_for(
        "ready"
    )
    weak = node.create_publisher(FluidPressure, "/relative/pressure", BEST_EFFORT)
    late = node.create_publisher(Temperature, "/late", QoSProfile(depth=5))
    peer_node.until(lambda: recorded(peer_node, "/mixed") == 1, "the strong message")
    weaker = node.create_publisher(String, "/mixed", BEST_EFFORT)
    node.declare_parameter("gain", 3.0)
    process.wait_for("/mixed: now recorded as best_effort")

    def publish() -> None:
        weak.publish(FluidPressure())
        late.publish(Temperature(temperature=1.0))
        weaker.publish(String(data="weak"))

    least = {
        "/relative/pressure": 3,
        "/late": 3,
        "/mixed": 4,
        "/latched": 1,
        "/rosout": 2,
        "/parameter_events": 1,
    }
    peer_node.until(
        lambda: all(recorded(peer_node, topic) >= count for topic, count in least.items()),
        "each topic",
        each=publish,
    )
    process.interrupt().succeed()
    assert [line for line in process.lines if "[ERROR]" in line or line.startswith("error:")] == []
    by_topic: dict[str, list[Any]] = {topic: [] for topic in least}
    with AnyReader([tmp_path / "run"]) as reader:
        for connection, _, data in reader.messages():
            by_topic.setdefault(connection.topic, []).append(
                reader.deserialize(data, connection.msgtype)
            )
    assert {topic for topic, count in least.items() if len(by_topic[topic]) < count} == set()
    # published before the recorder started
    assert [message.data for message in by_topic["/latched"]] == ["before"]
    assert sum(message.data == "before" for message in by_topic["/mixed"]) == 1
    texts = [message.msg for message in by_topic["/rosout"]]
    assert "logged before the recorder started" in texts
    assert any("recording to" in text for text in texts)
    events = [event for event in by_topic["/parameter_events"] if event.node == "/peer"]
    assert [parameter.name for event in events for parameter in event.new_parameters] == ["gain"]


PLAIN = {
    "y": (1000.0, QoSProfile(depth=10)),
    "y_m": (500.0, BEST_EFFORT),
    "u": (100.0, QoSProfile(depth=10)),
    "truth": (20.0, BEST_EFFORT),
}
"""Rates of publishers, Hz, and qualities as rclpy and rclcpp have them by default, or of a
sensor."""


def test_plain_publishers_of_any_rate_are_recorded(
    recorder: Recorder, peer_node: Peer, tmp_path: Path
) -> None:
    process = recorder("run").wait_for("ready")
    publishers = {
        topic: peer_node.node.create_publisher(JointState, topic, qos)
        for topic, (_, qos) in PLAIN.items()
    }
    peer_node.until(
        lambda: all(publisher.get_subscription_count() for publisher in publishers.values()),
        "the subscriptions of the recorder",
    )
    sent_counts = dict.fromkeys(PLAIN, 0)
    begin = time.monotonic()

    def publish_due() -> None:
        elapsed = time.monotonic() - begin
        for topic, (rate, _) in PLAIN.items():
            while sent_counts[topic] <= elapsed * rate:
                sent_counts[topic] += 1
                publishers[topic].publish(to_message(time.time_ns(), OUTPUTS, np.zeros(4), ""))

    peer_node.until(lambda: sent_counts["truth"] > 40, "two seconds of samples", each=publish_due)
    process.interrupt().succeed()
    run = read_run(tmp_path / "run")
    stored = {topic: len(run.tape[topic].stamp_ns) for topic in PLAIN}
    lost_counts = {
        topic: int(run.metadata.get("rise_di_lost", {}).get(f"/{topic}", 0)) for topic in PLAIN
    }
    assert all(stored[topic] + lost_counts[topic] >= sent_counts[topic] - 1 for topic in PLAIN), (
        sent_counts,
        stored,
        lost_counts,
    )
    assert all(stored[topic] > 0.9 * sent_counts[topic] for topic in PLAIN), (
        sent_counts,
        stored,
        lost_counts,
    )
    assert [line for line in process.lines if "[ERROR]" in line or "waiting for" in line] == []


def forge_gap(domain: int, writer: bytes) -> None:
    """Send a GAP of a writer to all participants of this host.

    Its readers then take 100,000 samples as irrelevant. DDSI-RTPS 2.3: header 8.3.3, GAP 9.4.5.5
    with the sequence numbers from 1 on, ports 9.6.1.1.
    """
    # the first, the base of the set, and an empty set
    numbers = struct.pack("<iIiII", 0, 1, 0, 100_000, 0)
    body = b"\0\0\0\0" + writer[12:16] + numbers
    packet = (
        b"RTPS\x02\x03\x01\x0f" + writer[:12] + struct.pack("<BBH", 0x08, 0x01, len(body)) + body
    )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for participant in range(12):
            sender.sendto(packet, ("127.0.0.1", 7400 + 250 * domain + 11 + 2 * participant))


def test_forged_end_of_topic_named(
    recorder: Recorder, peer_node: Peer, domain: int, tmp_path: Path, host_delays: HostDelays
) -> None:
    """One packet ends the recording of a topic for ever, while its publisher continues."""
    process = recorder("run").wait_for("ready")

    def send() -> None:
        for topic in ("y", "y_m", "truth"):
            peer_node.publish(
                topic, to_message(time.time_ns(), OUTPUTS, np.zeros(4), f"/{topic}#1")
            )

    peer_node.until(
        lambda: recorded(peer_node, "/truth") > 100, "a hundred samples of the truth", each=send
    )
    (writer,) = peer_node.node.get_publishers_info_by_topic("/truth")
    forge_gap(domain, bytes(writer.endpoint_gid))
    begin = time.time()
    peer_node.until(
        lambda: process.has_logged("/truth: no message for 1 s while others go on"),
        "the silence of the truth, told",
        each=send,
    )
    assert time.time() - begin < 3.0 + host_delays.since(begin)  # 1.1 s, and what a busy host needs
    process.interrupt().succeed()
    notes = read_run(tmp_path / "run").tape.notes
    assert any(
        re.fullmatch(r"/truth: the recorder received nothing for [\d.]+ s, to the end", note)
        for note in notes
    )


def test_lost_messages_are_counted_and_reported(
    recorder: Recorder, peer_node: Peer, tmp_path: Path
) -> None:
    process = recorder("run")
    process.wait_for("ready")
    names = [f"x.{k}" for k in range(100)]
    # Made once: beside load the recorder must not stand still for longer than the lease of its
    # participant, 2 s, after which nothing that it misses is a loss.
    message = to_message(0, names, np.zeros(100), "peer")
    sent_count = 0
    publisher = peer_node.node.create_publisher(JointState, "truth", PUBLISH)
    peer_node.until(
        lambda: publisher.get_subscription_count() == 1, "the subscription of the recorder"
    )

    def send(count: int) -> None:
        nonlocal sent_count
        for _ in range(count):
            sent_count += 1
            message.header.stamp.nanosec = sent_count
            publisher.publish(message)

    with process.stopped():
        send(1500)  # a publisher keeps a history of 2000
    peer_node.until(
        lambda: recorded(peer_node, "/truth") == sent_count, "each message of the history"
    )
    assert "lost /truth" not in diagnostics(peer_node)[2]
    with process.stopped():
        send(6000)  # more than that history and the socket buffer hold
    peer_node.until(
        lambda: int(diagnostics(peer_node)[2].get("lost /truth", 0)) > 0, "a loss, told"
    )
    peer_node.until(
        lambda: (
            sent_count
            == recorded(peer_node, "/truth") + int(diagnostics(peer_node)[2]["lost /truth"])
        ),
        "each message recorded or lost",
    )
    process.interrupt().succeed()
    run = read_run(tmp_path / "run")
    lost_count = int(run.metadata["rise_di_lost"]["/truth"])
    assert lost_count > 0
    assert len(run.tape["truth"].stamp_ns) + lost_count == sent_count
    assert f"/truth: the recorder lost {lost_count} messages" in run.tape.notes
