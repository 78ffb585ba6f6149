# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""CPU time and losses of the recorder at 1 kHz on six topics, and the size of its file compared with that of rosbags' Writer.

Another process publishes y, y_m, u, u_m, internals and truth, as wide and as noisy as those of the scenario osprey_servo. Then
the same messages, in the order recorded, go through rosbags.rosbag2.Writer: plain, and with its chunks compressed.

    .venv/bin/python benchmarks/recorder.py [--duration 60] [--rate 1000]
"""

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from flight_analysis.closed_loop.simulate import simulate
from flight_bringup.scenarios import find_scenario
from flight_core.rates import period_ns
from flight_core.vectors import FloatArray
from flight_ros import transport
from flight_ros.messages import Encoder
from flight_ros.ticker import Ticker
from flight_ros.topics import INTERNALS, PUBLISH, TRUTH, U_M, Y_M, Topic, U, Y

TOPICS = (Y, Y_M, U, U_M, INTERNALS, TRUTH)


def publish(rate: float, duration: float) -> None:
    """Publish on each topic for the duration or until SIGTERM. Print "matched" first and the number sent at the end."""
    tape = simulate(find_scenario("osprey_servo").vary(flight={"duration": 5.0}))
    transport.prepare()
    context = Context()
    rclpy.init(context=context)
    node = Node("publisher", context=context)

    def samples(topic: Topic) -> tuple[Encoder, list[FloatArray]]:
        signal_ = tape["y_m" if topic is U_M else topic.name]
        return Encoder(signal_.names, "/publisher"), list(signal_.values)

    sources = [(node.create_publisher(topic.type, topic.name, PUBLISH), *samples(topic)) for topic in TOPICS]
    ended = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.append(True))
    while not ended and not all(publisher.get_subscription_count() for publisher, *_ in sources):
        time.sleep(0.01)
    print("matched", flush=True)
    ticker, sent, missed = Ticker(period_ns(rate, "rate"), time.monotonic_ns()), 0, 0
    begin = time.monotonic()
    while not ended and time.monotonic() - begin < duration:
        if (pause := ticker.remaining()) > 0:
            time.sleep(pause)
        if (tick := ticker.due()) is None:
            continue
        now_ns = time.time_ns()
        for publisher, encoder, rows in sources:
            publisher.publish(encoder.encode(now_ns, rows[sent % len(rows)]))
        sent += 1
        missed += tick.missed
    for publisher, *_ in sources:
        publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=5.0))
    print(json.dumps({"sent": sent * len(sources), "missed": missed, "seconds": time.monotonic() - begin}), flush=True)
    node.destroy_node()
    context.try_shutdown()


def record(run: Path, rate: float, duration: float) -> tuple[dict[str, float], float]:
    """The publisher's counts, and the processor time of the recorder from the first message to the last, s."""
    scenario = find_scenario("osprey_servo").path
    options = ("--ros-args", "--params-file", str(scenario), "-p", f"directory:={run}")
    recorder = psutil.Popen([sys.executable, "-m", "flight_recorder.main", *options], stderr=subprocess.DEVNULL)
    command = [sys.executable, __file__, "--publish", f"--rate={rate}", f"--duration={duration}"]
    publisher = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)  # noqa: S603 - this file
    try:
        if publisher.stdout is None or publisher.stdout.readline() != "matched\n":
            sys.exit("error: the publisher did not find the recorder")
        before = recorder.cpu_times()
        sent = json.loads(publisher.stdout.readline())
        after = recorder.cpu_times()
    finally:
        publisher.terminate()
        recorder.terminate()
        publisher.wait()
        recorder.wait()
    return sent, after.user + after.system - before.user - before.system


def written_by_rosbags(run: Path, folder: Path, compression: CompressionMode) -> float:
    """Bytes per message of the same messages in a bag of rosbags' Writer."""
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    if compression is not CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with AnyReader([run]) as reader, writer:
        connections = {
            one.topic: writer.add_connection(one.topic, one.msgtype, typestore=reader.typestore)
            for one in reader.connections
            if one.topic.lstrip("/") in {topic.name for topic in TOPICS}
        }
        count = 0
        for one, stamp_ns, data in reader.messages([c for c in reader.connections if c.topic in connections]):
            writer.write(connections[one.topic], stamp_ns, data)
            count += 1
    return sum(path.stat().st_size for path in folder.rglob("*.mcap")) / count


def main() -> None:
    """Record, and print counts and sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--duration", type=float, default=60.0, help="how long to publish, s")
    parser.add_argument("--rate", type=float, default=1000.0, help="of each topic, Hz")
    parser.add_argument("--publish", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.publish:
        publish(arguments.rate, arguments.duration)
        return
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        sent, processor = record(run, arguments.rate, arguments.duration)
        with AnyReader([run]) as reader:
            counts = {one.topic: one.msgcount for one in reader.connections}
        kept = sum(counts[f"/{topic.name}"] for topic in TOPICS)
        size = sum(path.stat().st_size for path in run.glob("*.mcap"))
        lost = {topic.name: sent["sent"] / len(TOPICS) - counts[f"/{topic.name}"] for topic in TOPICS}
        print(f"sent {sent['sent']:.0f} messages in {sent['seconds']:.1f} s, {sent['missed']:.0f} ticks missed; lost:", end=" ")
        print(", ".join(f"{name} {count:.0f}" for name, count in lost.items()))
        print(f"recorder: {100 * processor / sent['seconds']:.1f} % of one core, {1e6 * processor / kept:.1f} us a message")
        print(f"bytes a message: {size / kept:.1f}")
        for compression in (CompressionMode.NONE, CompressionMode.STORAGE):
            mean_size = written_by_rosbags(run, Path(folder) / compression.name, compression)
            print(f"  rosbags Writer, {compression.name.lower()}: {mean_size:.1f}")


if __name__ == "__main__":
    main()
