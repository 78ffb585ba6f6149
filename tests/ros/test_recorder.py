# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder: recorded topics, QoS, missing topics, lost messages, a full disk."""

import re
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from lifecycle_msgs.msg import State
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import FluidPressure, JointState, Temperature
from std_msgs.msg import String
from tests.recordings import count_messages, messages
from tests.ros.conftest import Process, Recorder
from tests.ros.peer import OUTPUTS, Peer
from tests.ros.waiting import HostDelays
from tests.small_disk import small_disk

from flight_core.rates import period_ns
from flight_log.tape_reader import read_run
from flight_ros.messages import to_message
from flight_ros.topics import PUBLISH, RECORDED, publisher_qos

pytestmark = pytest.mark.package("flight_recorder")

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


PEER_TOPICS = ("/diagnostics",)


def diagnostics(peer_node: Peer) -> tuple[int, str, dict[str, str]]:
    """Level, sentence and figures of the recorder's newest diagnostics."""
    for status in (message.status[0] for message in reversed(peer_node.received["/diagnostics"])):
        if status.name == "/recorder":
            return status.level[0], status.message, {value.key: value.value for value in status.values}
    return -1, "", {}


def recorded(peer_node: Peer, topic: str) -> int:
    return int(diagnostics(peer_node)[2].get(f"messages {topic}", 0))


def errors(process: Process) -> list[str]:
    return [line for line in process.lines if "[ERROR]" in line or line.startswith("error:")]


# Recorded topics


def test_rosout_and_parameter_events_are_recorded(recorder: Recorder, peer_node: Peer, tmp_path: Path) -> None:
    peer_node.node.get_logger().info("logged before the recorder started")
    process = recorder("run")
    peer_node.until(lambda: recorded(peer_node, "/rosout") > 1)
    peer_node.node.declare_parameter("gain", 3.0)
    peer_node.until(lambda: recorded(peer_node, "/parameter_events") > 0)
    process.interrupt().succeed()
    with AnyReader([tmp_path / "run"]) as reader:
        recorded_messages = [
            (connection.topic, reader.deserialize(data, connection.msgtype)) for connection, _, data in reader.messages()
        ]
    texts = [message.msg for topic, message in recorded_messages if topic == "/rosout"]  # type: ignore[attr-defined]
    assert "logged before the recorder started" in texts
    assert any("recording to" in text for text in texts)
    events = [message for topic, message in recorded_messages if topic == "/parameter_events"]
    assert [parameter.name for event in events for parameter in event.new_parameters if event.node == "/peer"] == ["gain"]  # type: ignore[attr-defined]


def test_further_topics_recorded_with_any_offered_qos(recorder: Recorder, peer_node: Peer, tmp_path: Path) -> None:
    latched = peer_node.node.create_publisher(String, "/latched", LATCHED)
    latched.publish(String(data="before"))
    process = recorder("run", "topics:=[/latched, relative/pressure, /late, /y]")
    process.wait_for("ready")
    weak = peer_node.node.create_publisher(FluidPressure, "/relative/pressure", BEST_EFFORT)
    peer_node.until(lambda: recorded(peer_node, "/relative/pressure") > 2, each=lambda: weak.publish(FluidPressure()))
    late = peer_node.node.create_publisher(Temperature, "/late", QoSProfile(depth=5))
    peer_node.until(lambda: recorded(peer_node, "/late") > 2, each=lambda: late.publish(Temperature(temperature=1.0)))
    peer_node.until(lambda: recorded(peer_node, "/latched") > 0)
    process.interrupt().succeed()
    counts = count_messages(tmp_path / "run")
    assert counts["/latched"] == 1  # published before the recorder started
    assert counts["/relative/pressure"] > 2
    assert counts["/late"] > 2
    assert errors(process) == []


def test_later_publisher_with_weaker_qos_recorded(recorder: Recorder, peer_node: Peer, tmp_path: Path) -> None:
    strong = peer_node.node.create_publisher(String, "/mixed", LATCHED)
    strong.publish(String(data="strong"))
    process = recorder("run", "topics:=[/mixed]")
    peer_node.until(lambda: recorded(peer_node, "/mixed") == 1)
    weak = peer_node.node.create_publisher(String, "/mixed", BEST_EFFORT)
    process.wait_for("/mixed: now recorded with best_effort")
    peer_node.until(lambda: recorded(peer_node, "/mixed") > 3, each=lambda: weak.publish(String(data="weak")))
    process.interrupt().succeed()
    texts = [data for topic, _, data in messages(tmp_path / "run") if topic == "/mixed"]
    assert sum(b"strong" in text for text in texts) == 1
    assert sum(b"weak" in text for text in texts) > 2


def test_a_topic_without_a_publisher_is_named(recorder: Recorder, peer_node: Peer) -> None:
    process = recorder("run", "topics:=[/never]")
    process.wait_for("no publisher of /never; recording starts with the first publisher")
    peer_node.until(lambda: diagnostics(peer_node)[2].get("missing /never") == "no publisher")
    process.interrupt().succeed()
    assert "[WARN]" in next(line for line in process.lines if "/never is not in the log: it had no publisher" in line)


def test_flight_of_which_part_recorded_is_no_silent_failure(recorder: Recorder, peer_node: Peer) -> None:
    process = recorder("run").wait_for("ready")

    def send() -> None:
        peer_node.publish("y", to_message(time.time_ns(), OUTPUTS, np.zeros(4), "/aircraft#1"))

    peer_node.until(lambda: all(process.has_logged(f"waiting for /{topic}: no publisher") for topic in ("y_m", "u")), each=send)
    assert "waiting for /y:" not in process.output


def test_log_reaches_as_far_as_oldest_of_y_y_m_and_u(recorder: Recorder, peer_node: Peer) -> None:
    spans: list[Time] = []
    peer_node.node.create_subscription(RECORDED.type, RECORDED.name, spans.append, PUBLISH)
    recorder("run").wait_for("ready")

    def send() -> None:
        peer_node.send()
        peer_node.command(0.0, 0.0, 0.0, 0.0, age=5.0)

    peer_node.until(lambda: spans, each=send)
    assert time.time() - spans[0].sec - spans[0].nanosec / 1e9 > 5.0


def test_flight_that_falls_silent_named_each_time(recorder: Recorder, peer_node: Peer) -> None:
    process = recorder("run").wait_for("ready")

    def silences() -> int:
        return sum("no y, y_m or u for 3 s" in line for line in process.lines)

    def send() -> None:
        peer_node.publish("y", to_message(time.time_ns(), OUTPUTS, np.zeros(4), "/aircraft#1"))

    def pause(count: int) -> None:
        before = recorded(peer_node, "/y")
        peer_node.until(lambda: recorded(peer_node, "/y") > before, each=send)
        assert silences() == count - 1
        peer_node.until(lambda: silences() == count)

    pause(1)
    pause(2)


def test_topic_that_stops_while_others_go_on_named(recorder: Recorder, peer_node: Peer, tmp_path: Path) -> None:
    """A WARN, an entry of the log, and in a record of the log; the outcome that the flight left is in the log, too."""
    process = recorder("run").wait_for("ready")

    def send(*topics: str) -> None:
        for topic in topics:
            peer_node.publish(topic, to_message(time.time_ns(), OUTPUTS, np.zeros(4), f"/{topic}#1"))

    peer_node.until(lambda: recorded(peer_node, "/y") > 100, each=lambda: send("y", "y_m", "truth"))
    named = "/y: no message for 1 s while others go on"
    peer_node.until(lambda: process.has_logged(named), each=lambda: send("y_m", "truth"))
    assert "no message for 1 s" not in process.output.replace(named, "")
    peer_node.until(lambda: process.has_logged("/y: received again after"), each=lambda: send("y", "y_m", "truth"))
    (tmp_path / "run" / "outcome").write_text("interrupted", encoding="utf-8")
    process.interrupt().succeed()
    log = read_run(tmp_path / "run")
    assert log.tape.outcome == "interrupted"
    assert re.fullmatch(r"/y: the recorder received nothing for [\d.]+ s", log.tape.notes[-1])
    texts = [data for topic, _, data in messages(tmp_path / "run") if topic == "/rosout"]
    assert any(named.encode() in text for text in texts)


def forge_gap(domain: int, writer: bytes) -> None:
    """Send a GAP of a writer to all participants of this host: its readers take 100,000 samples as irrelevant.

    DDSI-RTPS 2.3: header 8.3.3, GAP 9.4.5.5 with the sequence numbers from 1 on, ports 9.6.1.1.
    """
    numbers = struct.pack("<iIiII", 0, 1, 0, 100_000, 0)  # the first, the base of the set, and an empty set
    body = b"\0\0\0\0" + writer[12:16] + numbers
    packet = b"RTPS\x02\x03\x01\x0f" + writer[:12] + struct.pack("<BBH", 0x08, 0x01, len(body)) + body
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for participant in range(12):
            sender.sendto(packet, ("127.0.0.1", 7400 + 250 * domain + 11 + 2 * participant))


def test_forged_end_of_topic_named(
    recorder: Recorder, peer_node: Peer, domain: int, tmp_path: Path, host_delays: HostDelays
) -> None:
    """One packet ends the recording of a topic for good, while its publisher goes on."""
    process = recorder("run").wait_for("ready")

    def send() -> None:
        for topic in ("y", "y_m", "truth"):
            peer_node.publish(topic, to_message(time.time_ns(), OUTPUTS, np.zeros(4), f"/{topic}#1"))

    peer_node.until(lambda: recorded(peer_node, "/truth") > 100, each=send)
    (writer,) = peer_node.node.get_publishers_info_by_topic("/truth")
    forge_gap(domain, bytes(writer.endpoint_gid))
    begin = time.time()
    peer_node.until(lambda: process.has_logged("/truth: no message for 1 s while others go on"), each=send)
    assert time.time() - begin < 3.0 + host_delays.since(begin)  # 1.1 s, and what a busy host needs
    process.interrupt().succeed()
    notes = read_run(tmp_path / "run").tape.notes
    assert any(re.fullmatch(r"/truth: the recorder received nothing for [\d.]+ s, to the end", note) for note in notes)


def test_topic_whose_type_is_not_installed_named(recorder: Recorder, peer_node: Peer, tmp_path: Path) -> None:
    # The recorder runs in this folder. Its packages precede the installed ones, and its lifecycle_msgs has no messages.
    (tmp_path / "lifecycle_msgs").mkdir()
    (tmp_path / "lifecycle_msgs" / "__init__.py").touch()
    peer_node.node.create_publisher(State, "/strange", LATCHED)
    process = recorder("run", "topics:=[/strange]")
    process.wait_for("/strange is not recorded: its type lifecycle_msgs/msg/State is not installed")
    process.interrupt().succeed()


def test_a_publisher_of_another_type_is_named(recorder: Recorder, peer_node: Peer) -> None:
    peer_node.node.create_publisher(String, "/u_m", LATCHED)
    process = recorder("run")
    process.wait_for("/u_m: /peer publishes std_msgs/msg/String, expected sensor_msgs/msg/JointState")
    process.interrupt().succeed()


def test_an_invalid_topic_name_is_rejected(recorder: Recorder, tmp_path: Path) -> None:
    process = recorder("run", "topics:=[a topic]")
    assert process.end() == 2
    assert errors(process) == ["error: recorder.topics: found 'a topic', expected the name of a topic"]
    assert not (tmp_path / "run").exists()


def test_lost_messages_are_counted_and_reported(recorder: Recorder, peer_node: Peer, tmp_path: Path) -> None:
    process = recorder("run")
    process.wait_for("ready")
    names, sent = [f"x.{k}" for k in range(100)], 0
    publisher = peer_node.node.create_publisher(JointState, "truth", PUBLISH)
    peer_node.until(lambda: publisher.get_subscription_count() == 1)

    def send(count: int) -> None:
        nonlocal sent
        for _ in range(count):
            sent += 1
            publisher.publish(to_message(sent, names, np.full(100, float(sent)), "peer"))

    with process.stopped():
        send(1500)  # a publisher keeps a history of 2000
    peer_node.until(lambda: recorded(peer_node, "/truth") == sent)
    assert "lost /truth" not in diagnostics(peer_node)[2]
    with process.stopped():
        send(8000)  # more than that history and the socket buffer hold
    peer_node.until(lambda: int(diagnostics(peer_node)[2].get("lost /truth", 0)) > 0)
    peer_node.until(lambda: sent == recorded(peer_node, "/truth") + int(diagnostics(peer_node)[2]["lost /truth"]))
    process.interrupt().succeed()
    run = read_run(tmp_path / "run")
    lost = int(run.metadata["rise_di_lost"]["/truth"])
    assert lost > 0
    assert len(run.tape["truth"].stamp_ns) + lost == sent
    assert f"/truth: the recorder lost {lost} messages" in run.tape.notes


def test_second_publisher_of_topic_is_no_loss(recorder: Recorder, peer_node: Peer) -> None:
    process = recorder("run")
    process.wait_for("ready")
    publishers = [peer_node.node.create_publisher(JointState, "y", PUBLISH) for _ in range(2)]
    peer_node.until(lambda: all(publisher.get_subscription_count() == 1 for publisher in publishers))
    for number in range(50):  # their sequences begin apart
        publishers[0].publish(to_message(number, OUTPUTS, np.zeros(4), "/aircraft#0"))
    for number in range(50, 100):
        for sender, publisher in enumerate(publishers):
            publisher.publish(to_message(number, OUTPUTS, np.zeros(4), f"/aircraft#{sender}"))
    for number in range(100, 125):  # now under one name, taken at two ticks of the recorder or more
        for publisher in publishers:
            publisher.publish(to_message(number, OUTPUTS, np.zeros(4), "/aircraft#0"))
        if number in {112, 124}:
            peer_node.until(lambda count=2 * number - 48: recorded(peer_node, "/y") == count)  # type: ignore[misc]
    assert "lost /y" not in diagnostics(peer_node)[2]


# A full disk


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", 3_000_000) as folder:
        yield folder


@pytest.mark.usefixtures("publisher")
@pytest.mark.parametrize(
    ("least", "reason"),
    [("0.0", "no space left for "), ("1.2", r"min_free: found \d\.\d MB free in .*, expected at least 1.2 MB")],
)
def test_full_disk_ends_recording_with_one_error_and_not_flight(
    least: str, reason: str, recorder: Recorder, peer_node: Peer, disk: Path
) -> None:
    process = recorder(disk / "run", f"min_free:={least}", "lockstep:=true")
    process.wait_for("recording ended")
    peer_node.until(lambda: diagnostics(peer_node)[0] == 2)
    _, sentence, figures = diagnostics(peer_node)
    assert re.match(f"recording ended: {reason}", sentence)
    # The node goes on: in lockstep the aircraft waits for the topic `recorded`.
    received: list[object] = []
    peer_node.node.create_subscription(Time, "recorded", received.append, QoSProfile(depth=10))
    peer_node.until(lambda: len(received) > 5)
    process.interrupt().succeed()
    (error,) = errors(process)
    assert "recording ended" in error
    counts = {f"messages {topic}": str(count) for topic, count in count_messages(disk / "run").items()}
    assert counts == {key: value for key, value in figures.items() if key.startswith("messages ") and value != "0"}
    assert read_run(disk / "run").tape.notes == ()


def test_too_little_space_at_start_rejected(recorder: Recorder, disk: Path) -> None:
    process = recorder(disk / "run")
    assert process.end() == 2
    sentence = r"error: recorder.min_free: found 3.0 MB free in .*/disk/run, expected at least 100 MB"
    assert re.fullmatch(sentence, process.lines[-1])


@pytest.mark.parametrize(("rate", "depth"), [(0.1, 1), (100.0, 200), (500.0, 1000), (1000.0, 2000), (5000.0, 2000)])
def test_publisher_keeps_history_of_two_seconds_for_recorder(rate: float, depth: int) -> None:
    assert publisher_qos(period_ns(rate, "rate")).depth == depth
