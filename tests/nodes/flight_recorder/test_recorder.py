# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the recorder's node.

The tests cover its topics and their qualities, lost messages, silences, a full disk, and the end of
the log.
"""

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lifecycle_msgs.msg import State
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from sensor_msgs.msg import FluidPressure, JointState, Temperature
from std_msgs.msg import String
from tests.conftest import refusing
from tests.nodes.world import OUTPUTS, World, diagnostics, parameters, world_of
from tests.recordings import count_messages, messages
from tests.small_disk import small_disk

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.outcome import INTERRUPTED
from flight_core.rates import NANOSECONDS, period_ns
from flight_log.disk import is_locked
from flight_log.follow import Follower, Messages
from flight_log.repair import repair
from flight_log.tape_reader import read_run
from flight_recorder.node import RecorderNode
from flight_ros.messages import Encoder, stamp_of
from flight_ros.topics import PUBLISH, publisher_qos

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
LOOP = ("y", "y_m", "u")


class Recording:
    """A recorder, and the publishers of a flight."""

    def __init__(self, world: World, folder: Path) -> None:
        self.world = world
        self.folder = folder
        self.node: Any = world.start(RecorderNode)

    def send(self, *topics: str, age: float = 0.0) -> None:
        """Publish a named vector on each topic."""
        for topic in topics:
            self.world.send(f"/{topic}", dict.fromkeys(OUTPUTS, 0.0), f"/{topic}#1", age)

    def run(self, duration: float, *topics: str) -> None:
        """Run for a duration, s, with these topics."""
        self.world.run(duration, lambda: self.send(*topics))

    def figures(self) -> dict[str, str]:
        """Return the figures of the newest diagnostics."""
        return diagnostics(self.world, "/recorder")[1]

    def logged(self, *parts: str) -> list[str]:
        """Return the lines with all parts."""
        return [line for line in self.node.log.lines if all(part in line for part in parts)]

    def end(self) -> Any:
        """End the node, and return its log."""
        self.world.end(self.node)
        return read_run(self.folder)


@contextmanager
def recording(scenario: Scenario, folder: Path, **values: object) -> Iterator[Recording]:
    """Yield a recorder of a scenario with other parameters."""
    given = {f"recorder.{name}": value for name, value in {"directory": folder, **values}.items()}
    with world_of("--params-file", str(scenario.path), *parameters(given)) as world:
        yield Recording(world, folder)


@pytest.fixture
def recorder(osprey_gust: Scenario, tmp_path: Path) -> Iterator[Recording]:
    with recording(osprey_gust, tmp_path / "run") as made:
        yield made


def test_log_has_each_message_and_the_outcome_that_the_flight_left(recorder: Recording) -> None:
    recorder.run(1.0, *LOOP, "truth")
    (recorder.folder / "outcome").write_text(INTERRUPTED.text())
    log = recorder.end()
    sent = {
        topic: [raw for _, raw in recorder.world.sent[topic]]
        for topic in ("/y", "/y_m", "/u", "/truth")
    }
    stored: dict[str, list[bytes]] = {topic: [] for topic in sent}
    for topic, _, data in messages(recorder.folder):
        if topic in stored:
            stored[topic].append(data)
    assert stored == sent
    assert (log.tape.outcome, log.tape.notes) == (INTERRUPTED, ())


def test_further_topics_recorded_from_their_first_publisher_on_with_its_qos(
    osprey_gust: Scenario, tmp_path: Path
) -> None:
    topics = "[/latched, relative/pressure, /late, /never]"
    with recording(osprey_gust, tmp_path / "run", topics=topics) as recorder:
        recorder.run(3.5)
        assert recorder.logged(
            "no publisher of /latched, /relative/pressure, /late, /never; recording starts with "
            "the first"
        )
        assert recorder.figures()["missing /never"] == "no publisher"
        for topic, kind, qos in (
            ("/latched", String, LATCHED),
            ("/relative/pressure", FluidPressure, BEST_EFFORT),
            ("/late", Temperature, QoSProfile(depth=5)),
        ):
            publisher = recorder.world.publisher(kind, topic, qos)
            recorder.run(0.2)
            (subscription,) = (
                each for each in recorder.world.subscriptions if each.topic_name == topic
            )
            requested = subscription.endpoint.qos_profile
            assert requested.reliability == qos.reliability
            assert (requested.durability == DurabilityPolicy.TRANSIENT_LOCAL) is (qos is LATCHED)
            publisher.publish(kind())
        recorder.run(0.2, "y")
        recorder.end()
        counts = count_messages(recorder.folder)
        assert [counts[topic] for topic in ("/latched", "/relative/pressure", "/late")] == [1, 1, 1]
        assert recorder.logged("[WARNING] /never is not in the log: it had no publisher")
        assert not recorder.logged("[ERROR]")


def test_later_publisher_with_weaker_qos_recorded(recorder: Recording) -> None:
    strong = recorder.world.publisher(JointState, "/u_m", PUBLISH)
    strong.publish(Encoder(OUTPUTS, "/strong#1").encode(1, np.zeros(4)))
    recorder.run(0.3)
    weak = recorder.world.publisher(JointState, "/u_m", BEST_EFFORT)
    recorder.run(0.3)
    assert recorder.logged(
        "/u_m: now recorded as best_effort and volatile: its publishers offer no more"
    )
    (subscription,) = (each for each in recorder.world.subscriptions if each.topic_name == "/u_m")
    assert subscription.endpoint.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    weak.publish(Encoder(OUTPUTS, "/weak#2").encode(2, np.zeros(4)))
    recorder.run(0.2)
    recorder.end()
    texts = [data for topic, _, data in messages(recorder.folder) if topic == "/u_m"]
    assert [b"strong" in text for text in texts] == [True, False]


@pytest.mark.parametrize(
    "qos", [QoSProfile(depth=10), BEST_EFFORT], ids=["reliable", "best_effort"]
)
@pytest.mark.parametrize("topic", ["y", "y_m", "u", "truth", "internals", "pose"])
def test_topic_of_any_publisher_is_recorded_with_the_quality_that_it_offers(
    topic: str, qos: QoSProfile, recorder: Recording
) -> None:
    """A subscription that asks for more than a publisher offers receives nothing."""
    plain = recorder.world.publisher(JointState, f"/{topic}", qos)
    recorder.run(1.5)
    (subscription,) = (
        each for each in recorder.world.subscriptions if each.topic_name == f"/{topic}"
    )
    requested = subscription.endpoint.qos_profile
    assert qos_check_compatible(qos, requested)[0] != QoSCompatibility.ERROR
    assert requested.reliability == qos.reliability
    plain.publish(Encoder(OUTPUTS, "/mine").encode(1, np.zeros(4)))
    recorder.run(0.2)
    assert not recorder.logged("[ERROR]")
    recorder.end()
    assert count_messages(recorder.folder)[f"/{topic}"] == 1


def test_weaker_publisher_beside_that_of_stack_is_named_and_costs_the_log_nothing(
    recorder: Recording,
) -> None:
    recorder.run(0.5, *LOOP)
    recorder.world.publisher(JointState, "/y", BEST_EFFORT, "/second")
    recorder.run(1.5, *LOOP)
    (subscription,) = (each for each in recorder.world.subscriptions if each.topic_name == "/y")
    assert subscription.endpoint.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert recorder.logged("[ERROR] /y: /second publishes with incompatible quality of service")


def test_flight_of_which_part_is_recorded_is_no_silent_failure(recorder: Recording) -> None:
    recorder.run(4.0, "y")
    for topic in ("y_m", "u"):
        assert recorder.logged(f"[WARNING] waiting for /{topic}: no publisher")
    assert not recorder.logged("waiting for /y:")


def test_log_of_remapped_topics_names_them_as_the_stack_does(
    osprey_gust: Scenario, tmp_path: Path
) -> None:
    """The topics of the file keep the names with which they were sent."""
    names = {"y": "/sensors/y", "u": "/act/command", "y_m": "/uav1/ref/y_m"}
    remaps = [word for name, topic in names.items() for word in ("-r", f"{name}:={topic}")]
    arguments = (
        "--params-file",
        str(osprey_gust.path),
        "-r",
        "__ns:=/uav1",
        "-p",
        f"directory:={tmp_path / 'run'}",
    )
    with world_of(*arguments, *remaps) as world:
        recorder = Recording(world, tmp_path / "run")
        recorder.run(
            1.0, *(topic.removeprefix("/") for topic in names.values()), "uav1/truth", "elsewhere"
        )
        recorder.world.end(recorder.node)
    assert {topic for topic, count in count_messages(tmp_path / "run").items() if count} >= {
        *names.values(),
        "/uav1/truth",
    }
    for folder in (tmp_path / "run", tmp_path / "repaired"):
        log = read_run(folder)
        assert log.namespace == "/uav1"
        assert {"y", "y_m", "u", "truth"} <= log.tape.signals.keys()
        output: set[str] = set()
        for record in Follower(folder, lambda topic, _: 1e9).read():
            output |= {record.topic} if isinstance(record, Messages) else set()
        assert {"/uav1/y", "/uav1/y_m", "/uav1/u", "/uav1/truth"} <= output
        if folder.name == "run":
            shutil.copytree(folder, tmp_path / "repaired")
            file = next((tmp_path / "repaired").glob("*.mcap"))
            file.write_bytes(file.read_bytes()[:-100])
            repair(tmp_path / "repaired")


def test_log_reaches_as_far_as_oldest_of_y_y_m_and_u(recorder: Recording) -> None:
    def send() -> None:
        recorder.send("y", "y_m")
        recorder.send("u", age=5.0)

    recorder.world.run(0.5, send)
    spans = [stamp_of(raw) for _, raw in recorder.world.sent["/recorded"]]
    assert spans
    assert all(
        any(sample.stamp_ns == span for sample in recorder.world.vectors("/u")) for span in spans
    )


def test_flight_that_falls_silent_named_each_time(recorder: Recording) -> None:
    for count in (1, 2):
        recorder.run(1.0, "y")
        recorder.run(2.5)
        assert len(recorder.logged("no y, y_m or u for 3 s")) == count - 1
        recorder.run(1.0)
        assert len(recorder.logged("no y, y_m or u for 3 s")) == count


def test_topic_that_stops_while_others_go_on_named_and_noted(recorder: Recording) -> None:
    """A silence gives a warning, a figure of the diagnostics and a note in the log.

    It also has a note if it lasts to the end.
    """
    recorder.run(1.0, "y", "y_m", "truth")
    recorder.run(2.5, "y_m", "truth")
    assert len(recorder.logged("no message for 1 s while others go on")) == 1
    assert recorder.logged("[WARNING] /y: no message for 1 s while others go on")
    assert recorder.figures()["silent /y"] == "no message"
    recorder.run(0.5, "y", "y_m", "truth")
    assert recorder.logged("/y: received again after 2.5 s")
    recorder.run(2.0, "y", "y_m")
    notes = recorder.end().tape.notes
    assert "/y: the recorder received nothing for 2.5 s" in notes
    assert any(
        re.fullmatch(r"/truth: the recorder received nothing for [\d.]+ s, to the end", note)
        for note in notes
    )


def test_topic_without_its_publisher_is_no_silence(recorder: Recording) -> None:
    recorder.run(1.0, "y", "y_m", "truth")
    recorder.world.leave("/y")
    recorder.run(2.5, "y_m", "truth")
    assert not recorder.logged("no message for 1 s")


def test_lost_messages_are_counted_and_reported(recorder: Recording) -> None:
    publisher = recorder.world.publisher(JointState, "/truth")
    encoder = Encoder(OUTPUTS, "/aircraft#1")

    def send(count: int) -> None:
        for k in range(count):
            publisher.publish(encoder.encode(k, np.zeros(4)))

    send(50)
    recorder.run(0.2)
    publisher.lose(7)
    send(50)
    recorder.run(0.2)
    publisher.lose(5)
    send(1)
    recorder.run(1.5)
    assert recorder.figures()["messages /truth"] == "101"
    assert recorder.figures()["lost /truth"] == "12"
    log = recorder.end()
    assert log.metadata["rise_di_lost"] == {"/truth": "12"}
    assert "/truth: the recorder lost 12 messages" in log.tape.notes


def test_each_topic_that_loses_messages_has_its_own_line(recorder: Recording) -> None:
    """After a loss on several topics at once, each topic has its own line.

    A single topic has at most one line in two seconds.
    """
    names = ("/y", "/y_m", "/u", "/truth", "/pose")
    publishers = [recorder.world.publisher(JointState, name) for name in names]
    encoder = Encoder(OUTPUTS, "/aircraft#1")

    def send(first: int) -> None:
        for k in range(first, first + 50):
            for publisher in publishers:
                publisher.publish(encoder.encode(k, np.zeros(4)))
        recorder.run(0.2)

    send(0)
    for number, publisher in enumerate(publishers):
        publisher.lose(7 + number)
    send(50)
    for publisher in publishers:
        publisher.lose(3)
    send(100)
    lines = recorder.logged("messages lost")
    assert len(lines) == len(names)
    for number, name in enumerate(names):
        assert recorder.logged(f"{name}: {7 + number} messages lost")
    recorder.run(2.0)
    for publisher in publishers:
        publisher.lose(4)
    send(150)
    assert len(recorder.logged(": 4 messages lost")) == len(names)


def test_file_is_locked_as_long_as_the_recorder_holds_it(recorder: Recording) -> None:
    """So no repair changes a log that is being written, and a page follows it to its end."""
    recorder.run(0.5, *LOOP)
    (path,) = recorder.folder.glob("*.mcap")
    assert is_locked(path)
    recorder.end()
    assert not is_locked(path)


def test_second_publisher_of_topic_is_no_loss(recorder: Recording) -> None:
    publishers = [recorder.world.publisher(JointState, "/y") for _ in range(2)]

    def send(number: int, sender: str, publisher: int) -> None:
        publishers[publisher].publish(Encoder(OUTPUTS, sender).encode(number, np.zeros(4)))

    # Their sequences begin apart.
    for number in range(50):
        send(number, "/aircraft#0", 0)
    for number in range(50, 100):
        for publisher in range(2):
            send(number, f"/aircraft#{publisher}", publisher)
    # Now under one name, taken at several ticks of the recorder.
    for number in range(100, 125):
        for publisher in range(2):
            send(number, "/aircraft#0", publisher)
        recorder.run(0.02)
    recorder.run(1.0)
    assert recorder.figures()["messages /y"] == "200"
    assert "lost /y" not in recorder.figures()


def test_type_that_is_not_installed_or_another_one_named(
    osprey_gust: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with recording(osprey_gust, tmp_path / "run", topics="[/strange]") as recorder:
        publisher = recorder.world.publisher(State, "/strange", LATCHED)
        renamed = publisher.endpoint._replace(topic_type="nowhere_msgs/msg/Thing")
        recorder.world.graph[recorder.world.graph.index(publisher.endpoint)] = renamed
        recorder.world.publisher(String, "/u_m", LATCHED)
        recorder.run(1.5)
        assert recorder.logged(
            "/strange is not recorded: its type nowhere_msgs/msg/Thing is not installed"
        )
        assert recorder.logged(
            "/u_m: /peer publishes std_msgs/msg/String, expected sensor_msgs/msg/JointState"
        )


def test_an_invalid_topic_name_is_rejected(osprey_gust: Scenario, tmp_path: Path) -> None:
    refusal = "recorder.topics: found 'a topic', expected the name of a topic"
    with (
        refusing(refusal),
        recording(osprey_gust, tmp_path / "run", topics="[a topic]"),
    ):
        pass
    assert not (tmp_path / "run").exists()


# A full disk


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", 3_000_000) as folder:
        yield folder


@pytest.mark.parametrize(
    "least, reason",
    [
        ("0.0", "no space left for "),
        ("1.2", r"min_free: found \d\.\d MB free in .*, expected at least 1.2 MB"),
    ],
)
def test_full_disk_ends_recording_with_one_error_and_not_flight(
    least: str, reason: str, osprey_gust: Scenario, disk: Path
) -> None:
    names = tuple(f"x.{k}" for k in range(100))
    with recording(osprey_gust, disk / "run", min_free=least, lockstep="true") as recorder:
        encoder = Encoder(names, "/aircraft#1")
        number = 0
        publisher = recorder.world.publisher(JointState, "/truth")

        def send() -> None:
            nonlocal number
            for _ in range(10):
                number += 1
                values = np.random.default_rng(number).normal(size=len(names))  # not compressible
                publisher.publish(encoder.encode(number * NANOSECONDS // 1000, values))

        recorder.world.until(
            lambda: recorder.logged("recording ended"), "the end of the recording", send
        )
        recorder.world.run(1.1, send)
        sentence, figures = diagnostics(recorder.world, "/recorder")
        assert re.match(f"recording ended: {reason}", sentence)
        # The node goes on: in lockstep the aircraft waits for the topic `recorded`.
        assert stamp_of(recorder.world.sent["/recorded"][-1][1]) == number * NANOSECONDS // 1000
        log = recorder.end()
        assert len(recorder.logged("[ERROR]")) == 1
        counts = {
            f"messages {topic}": str(count) for topic, count in count_messages(disk / "run").items()
        }
        assert counts == {
            key: value
            for key, value in figures.items()
            if key.startswith("messages ") and value != "0"
        }
        assert log.tape.notes == ()


def test_too_little_space_at_start_rejected(osprey_gust: Scenario, disk: Path) -> None:
    refusal = r"recorder.min_free: found 3.0 MB free in .*/disk/run, expected at least 100 MB"
    with refusing(refusal), recording(osprey_gust, disk / "run"):
        pass


@pytest.mark.parametrize(
    "rate, depth", [(0.1, 1), (100.0, 200), (500.0, 1000), (1000.0, 2000), (5000.0, 2000)]
)
def test_publisher_keeps_history_of_two_seconds_for_recorder(rate: float, depth: int) -> None:
    assert publisher_qos(period_ns(rate, "rate")).depth == depth
