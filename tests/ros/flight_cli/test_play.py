# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test rise-di play: subscribers get every byte of a recorded flight in time.

A controller computes the same u again.
"""

import time
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from tests.ros.conftest import Start
from tests.ros.peer import Peer, peer, stamp_ns
from tests.ros.waiting import HostDelays, until

from flight_core.rates import NANOSECONDS
from flight_log.message_definitions import definition
from flight_log.playback import read_playback
from flight_log.tape_reader import read_run
from flight_ros.messages import stamp_of, to_message
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import CLOCK, INTERNALS, LOCKSTEP, Y_M, Topic, U, Y

MS = 1_000_000


class Receiver:
    """A subscriber to topics.

    It has the bytes of their messages, and when they were sent.
    """

    def __init__(self, node: Node, *topics: Topic) -> None:
        self._polled_subscriptions = [
            PolledSubscription(node, topic, LOCKSTEP, raw=True) for topic in topics
        ]
        self.received: dict[str, list[bytes]] = {topic.name: [] for topic in topics}
        self.sent: dict[str, list[int]] = {topic.name: [] for topic in topics}

    def take(self) -> None:
        """Take the messages that have arrived."""
        for subscription in self._polled_subscriptions:
            for received in subscription.take():
                self.received[subscription.topic.name].append(bytes(received.message))
                self.sent[subscription.topic.name].append(received.sent_ns)

    def until(self, topic: Topic, count: int) -> None:
        """Wait for a number of messages of a topic."""
        messages = self.received[topic.name]

        def enough() -> bool:
            self.take()
            return len(messages) >= count

        until(enough, f"{count} messages of {topic.name}")


def of(run: Path, topic: str) -> list[bytes]:
    return [message.data for message in read_playback(run, [topic]).messages]


def test_flight_played_byte_by_byte_with_timing_and_clock_and_in_a_loop(
    run: Path, start: Start, peer_node: Peer, host_delays: HostDelays
) -> None:
    receiving = Receiver(peer_node.node, Y, Y_M, CLOCK)
    process = start(
        "flight_cli.cli",
        "play",
        str(run),
        "--topics",
        "y,y_m",
        "--stamps",
        "recorded",
        "--rate",
        "2",
    )
    receiving.until(Y, 1001)
    receiving.until(Y_M, 1001)
    process.succeed()
    receiving.until(CLOCK, 201)
    assert receiving.received["y"] == of(run, "y")
    assert receiving.received["y_m"] == of(run, "y_m")
    assert [stamp_of(clock) for clock in receiving.received[CLOCK.name]] == [
        k * 10 * MS for k in range(201)
    ]
    # 2 s at twice the rate, on absolute deadlines: host delays do not accumulate
    instants = np.array(receiving.sent["y"])
    late = (instants - instants[0]) / NANOSECONDS - np.arange(1001) * 0.001
    assert np.median(np.abs(late)) < 0.02 + host_delays.since(instants[0] / NANOSECONDS)

    looped = Receiver(peer_node.node, Y)
    loop = start("flight_cli.cli", "play", str(run), "--topics", "y", "--start", "1.9", "--loop")
    looped.until(Y, 3 * 51 + 1)
    loop.interrupt()
    begin = time.time()
    assert loop.end() == 130
    assert time.time() - begin < 3.0 + host_delays.since(begin)
    assert "Traceback" not in loop.output
    stamps = [stamp_of(message) for message in looped.received["y"]]
    assert stamps == sorted(stamps)  # also from one pass to the next


def test_topics_that_cannot_be_sent_are_skipped_and_those_with_a_publisher_refused(
    start: Start, tmp_path: Path, domain: int, peer_node: Peer
) -> None:
    """The log has a type that is not installed, a name that ROS does not allow, JSON, and y."""
    y = serialize_message(to_message(1, ("q",), np.zeros(1), "peer"))
    log = tmp_path / "mixed.mcap"
    with log.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        for topic, kind, encoding in (
            ("/y", "sensor_msgs/msg/JointState", "cdr"),
            ("/strange", "nowhere_msgs/msg/Thing", "cdr"),
            ("/no name", "sensor_msgs/msg/JointState", "cdr"),
            ("/json", "sensor_msgs/msg/JointState", "json"),
        ):
            schema = writer.register_schema(
                kind, "ros2msg", definition("sensor_msgs/msg/JointState").text.encode()
            )
            channel = writer.register_channel(topic, encoding, schema)
            writer.add_message(channel, 1, y, 1)
        writer.finish()  # type: ignore[no-untyped-call]
    receiving = Receiver(peer_node.node, Y)
    process = start("flight_cli.cli", "play", str(log), "--stamps", "recorded").succeed()
    receiving.until(Y, 1)
    (warning,) = [line for line in process.lines if line.startswith("warning:")]
    assert "without CDR, or of a message type that is not installed" in warning
    assert [topic for topic in ("/strange", "/no name", "/json", "/y ") if topic in warning] == [
        "/strange",
        "/no name",
        "/json",
    ]

    peer_node.publish("y", to_message(0, ("q",), np.zeros(1), "peer"))
    second_player = start("flight_cli.cli", "play", str(log))
    assert second_player.end() == 2
    (message,) = [line for line in second_player.lines if line.startswith("error:")]
    sentence = "found 1 publishers of /y already, expected no publisher: set ROS_DOMAIN"
    assert message.startswith(f"error: ROS_DOMAIN_ID {domain}: {sentence}")


def contents(payloads: list[bytes]) -> list[tuple[int, list[str], bytes]]:
    """Return stamps, names and the bytes of the values.

    A log of one process names no publisher.
    """
    messages = [deserialize_message(payload, JointState) for payload in payloads]
    return [(stamp_ns(each), each.name, each.position.tobytes()) for each in messages]


def test_controller_reproduces_flight_to_the_bit(
    run: Path, start: Start, start_node: Start, peer_node: Peer
) -> None:
    u = of(run, "u")
    internals = of(run, "internals")
    receiving = Receiver(peer_node.node, U, INTERNALS)
    start_node("rise_di_controller", "-p", "lockstep:=true", "-p", "y_rate:=500.0").wait_for(
        "ready"
    )
    process = start(
        "flight_cli.cli",
        "play",
        str(run),
        "--topics",
        "y,y_m",
        "--stamps",
        "recorded",
        "--rate",
        "3",
    )
    receiving.until(U, len(u))
    receiving.until(INTERNALS, len(internals))
    process.succeed()
    assert contents(receiving.received["u"]) == contents(u)
    assert contents(receiving.received["internals"]) == contents(internals)


def test_controller_in_real_time_follows_flight_with_stamps_moved_to_now(
    run: Path, start: Start, start_node: Start, host_delays: HostDelays
) -> None:
    # The recorded aircraft does not respond to this u, and these ticks use other samples of y than
    # the recorded ones. So both u are close but not equal. In 2 s the recorded u reaches 0.06.
    largest = np.abs(read_run(run).tape["u"].values).max()
    # again where the host did not run: the controller held u, or ramped it to trim
    for _ in range(3):
        begin = time.time()
        with peer() as peer_node:
            receiving = Receiver(peer_node.node, Y)
            node = start_node("rise_di_controller").wait_for("ready")
            process = start("flight_cli.cli", "play", str(run), "--topics", "y,y_m")
            node.wait_for("WAITING -> ENGAGED")
            peer_node.until(lambda: process.popen.poll() is not None, "the end of the player")  # noqa: B023 - of this flight
            process.succeed()
            receiving.until(Y, 1001)
            u = peer_node.u()
        node.interrupt().succeed()
        if host_delays.since(begin) < 0.1 or np.abs(u).max() == pytest.approx(largest, rel=0.3):
            break
    assert len(u) > 50
    assert np.abs(u).max() == pytest.approx(largest, rel=0.3)
    stamps = np.array([stamp_of(message) for message in receiving.received["y"]])
    assert set(np.diff(stamps)) == {2 * MS}
    late = np.median(np.abs(stamps - np.array(receiving.sent["y"]))) / NANOSECONDS
    assert late < 0.05 + host_delays.since(stamps[0] / NANOSECONDS)  # as fresh as they were
    received, recorded = (
        [payload[:4] + payload[12:] for payload in y]
        for y in (receiving.received["y"], of(run, "y"))
    )
    assert received == recorded
