# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure CPU time and losses of the recorder at 1 kHz on six topics.

Another process publishes y, y_m, u, u_m, internals and truth, as wide and as noisy as those of the
scenario osprey_servo. Then rosbags.rosbag2.Writer writes the same messages in the recorded order,
once plain and once with compressed chunks. The size of the recorder's file is compared with those
of this Writer.

    .venv/bin/python -m benchmarks.speed --only recorder
"""

import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from benchmarks.nodes import open_node, termination, ticks
from benchmarks.processes import Child
from rclpy.duration import Duration
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_ros.messages import Encoder
from flight_ros.topics import INTERNALS, PUBLISH, TRUTH, U_M, Y_M, U, Y

TOPICS = (Y, Y_M, U, U_M, INTERNALS, TRUTH)


def publish(rate: float, duration: float) -> None:
    """Publish on each topic for the duration or until SIGTERM.

    Prints "matched" first, and the number of messages sent at the end.
    """
    tape = simulate(find_scenario("osprey_servo", 5.0))
    has_ended = termination()
    sent_count = 0
    missed_count = 0
    with open_node("publisher") as node:
        publishers = [node.create_publisher(topic.type, topic.name, PUBLISH) for topic in TOPICS]
        signals = [tape["y_m" if topic is U_M else topic.name] for topic in TOPICS]
        encoders = [Encoder(signal.names, "/publisher") for signal in signals]
        sources = list(
            zip(publishers, encoders, (list(signal.values) for signal in signals), strict=True)
        )
        while not has_ended.is_set() and not all(
            publisher.get_subscription_count() for publisher in publishers
        ):
            time.sleep(0.01)
        print("matched", flush=True)
        begin = time.monotonic()
        for tick in ticks(rate):
            if has_ended.is_set() or time.monotonic() - begin >= duration:
                break
            now_ns = time.time_ns()
            for publisher, encoder, rows in sources:
                publisher.publish(encoder.encode(now_ns, rows[sent_count % len(rows)]))
            sent_count += 1
            missed_count += tick.missed
        for publisher in publishers:
            publisher.wait_for_all_acked(Duration(seconds=5.0))
        print(
            json.dumps(
                {
                    "sent": sent_count * len(TOPICS),
                    "missed": missed_count,
                    "seconds": time.monotonic() - begin,
                }
            ),
            flush=True,
        )


def record(run: Path, rate: float, duration: float) -> tuple[dict[str, float], float]:
    """Return the publisher's counts, and the processor time of the recorder, s.

    The processor time covers the messages from the first to the last one.
    """
    scenario = find_scenario("osprey_servo").path
    options = ("--ros-args", "--params-file", str(scenario), "-p", f"directory:={run}")
    with (
        Child("flight_recorder.main", *options) as recorder,
        Child("benchmarks.recorder", f"{rate}", f"{duration}") as publisher,
    ):
        if publisher.popen.stdout.readline() != "matched\n":
            sys.exit("error: the publisher did not find the recorder")
        before = recorder.popen.cpu_times()
        counts = json.loads(publisher.popen.stdout.readline())
        after = recorder.popen.cpu_times()
    return counts, after.user + after.system - before.user - before.system


class Rewritten(NamedTuple):
    """The messages of a run, written again by rosbags' Writer."""

    counts: Counter[str]  # number of messages by topic
    cpu: float  # processor time for each message, us
    size: float  # size of the file for each message, bytes


def rewrite(run: Path, folder: Path, compression: CompressionMode) -> Rewritten:
    """Read the messages of a run on TOPICS, then write them to a bag with rosbags' Writer.

    The processor time is that of writing alone.
    """
    names = {f"/{topic.name}" for topic in TOPICS}
    with AnyReader([run]) as reader:
        connections = [connection for connection in reader.connections if connection.topic in names]
        messages = list(reader.messages(connections))
        begin_ns = time.process_time_ns()
        writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        if compression is not CompressionMode.NONE:
            writer.set_compression(compression, CompressionFormat.ZSTD)
        with writer:
            copies = {
                connection.id: writer.add_connection(
                    connection.topic, connection.msgtype, typestore=reader.typestore
                )
                for connection in connections
            }
            for connection, stamp_ns, data in messages:
                writer.write(copies[connection.id], stamp_ns, data)
        took_us = (time.process_time_ns() - begin_ns) / 1e3
    counts = Counter(connection.topic.lstrip("/") for connection, *_ in messages)
    return Rewritten(counts, took_us / len(messages), mcap_size(folder) / len(messages))


def mcap_size(folder: Path) -> int:
    """Return the bytes of the MCAP files of a run or a bag."""
    return sum(path.stat().st_size for path in folder.rglob("*.mcap"))


if __name__ == "__main__":
    publish(*map(float, sys.argv[1:]))
