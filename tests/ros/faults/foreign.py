# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""An unexpected publisher of a topic of the flight, as a process of its own.

python -m tests.ros.faults.foreign storm TOPIC RATE SECONDS SEED    # valid vectors of random values
python -m tests.ros.faults.foreign relay TOPIC                      # the messages on standard input, one a line, in hex
"""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.publisher import Publisher

from flight_ros import transport
from flight_ros.messages import Encoder
from flight_ros.ticker import Ticker
from flight_ros.topics import PUBLISH, Y_M, U, Y

NAMES = {"y": ("q", "V", "p", "r"), "y_m": ("q", "V", "p", "r"), "u": ("elevator", "aileron", "rudder", "thrust")}
SUBSCRIBERS = 3  # the node that uses the topic, the recorder, the probe
BURST_NS = 1_000_000  # a thousand bursts a second: the sleep of Python cannot time single messages at 10 kHz
REPORT_PERIOD = 10.0  # s, of the lines that report missing subscribers


@contextmanager
def matched_publisher(topic: str) -> Iterator[Publisher]:
    """A publisher that all subscribers have discovered."""
    transport.prepare()
    context = Context()
    rclpy.init(context=context)
    node = Node("foreign", context=context)
    kind = {one.name: one for one in (Y, Y_M, U)}[topic]
    publisher = node.create_publisher(kind.type, kind.name, PUBLISH)
    report = time.monotonic() + REPORT_PERIOD
    while publisher.get_subscription_count() < SUBSCRIBERS:
        time.sleep(0.005)
        if time.monotonic() > report:
            report += REPORT_PERIOD
            known = sorted(one.node_name for one in node.get_subscriptions_info_by_topic(topic))
            print(f"{publisher.get_subscription_count()} of {SUBSCRIBERS} subscribers matched, known: {known}", flush=True)
    print(f"begins at {time.time():.6f}", flush=True)
    yield publisher
    node.destroy_node()
    context.try_shutdown()


def storm(topic: str, rate: float, duration: float, seed: int) -> None:
    """Flood a topic."""
    values = np.random.default_rng(seed).uniform(-1.0, 1.0, (1000, 4))
    encoder = Encoder(NAMES[topic], "/foreign")
    with matched_publisher(topic) as publisher:
        ticker, sent, begin = Ticker(BURST_NS, time.monotonic_ns()), 0, time.monotonic()
        while time.monotonic() - begin < duration:
            if (pause := ticker.remaining()) > 0:
                time.sleep(pause)
            while sent < rate * (time.monotonic() - begin):
                publisher.publish(encoder.encode(time.time_ns(), values[sent % len(values)]))
                sent += 1
            ticker.due()
        print(f"sent {sent} in {(time.monotonic() - begin):.3f} s", flush=True)


def relay(topic: str) -> None:
    """Publish the messages on standard input."""
    with matched_publisher(topic) as publisher:
        for line in sys.stdin:
            publisher.publish(bytes.fromhex(line))


if __name__ == "__main__":
    command, topic_name, *options = sys.argv[1:]
    if command == "storm":
        storm(topic_name, float(options[0]), float(options[1]), int(options[2]))
    else:
        relay(topic_name)
