# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A foreign process that publishes on a topic of the flight.

python -m tests.ros.faults.foreign storm TOPIC RATE SECONDS SEED    # vectors that look well
python -m tests.ros.faults.foreign relay TOPIC                      # what comes on the standard input, a message a line, in hex
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
LISTENERS = 3  # the node that flies with it, the recorder, the probe
BURST_NS = 1_000_000  # a thousand bursts a second: one by one is more than Python's sleep can do
LONG = 10.0  # s, after which it says whom it has found


@contextmanager
def publisher_of(topic: str) -> Iterator[Publisher]:
    """A publisher that all who listen have found."""
    transport.prepare()
    context = Context()
    rclpy.init(context=context)
    node = Node("foreign", context=context)
    kind = {one.name: one for one in (Y, Y_M, U)}[topic]
    publisher = node.create_publisher(kind.type, kind.name, PUBLISH)
    say = time.monotonic() + LONG
    while publisher.get_subscription_count() < LISTENERS:
        time.sleep(0.005)
        if time.monotonic() > say:
            say += LONG
            known = sorted(one.node_name for one in node.get_subscriptions_info_by_topic(topic))
            print(f"found by {publisher.get_subscription_count()} of {LISTENERS}, knows of {known}", flush=True)
    print(f"begins at {time.time():.6f}", flush=True)
    yield publisher
    node.destroy_node()
    context.try_shutdown()


def storm(topic: str, rate: float, duration: float, seed: int) -> None:
    """Flood a topic."""
    values = np.random.default_rng(seed).uniform(-1.0, 1.0, (1000, 4))
    encoder = Encoder(NAMES[topic], "/foreign")
    with publisher_of(topic) as publisher:
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
    """Publish what comes on the standard input."""
    with publisher_of(topic) as publisher:
        for line in sys.stdin:
            publisher.publish(bytes.fromhex(line))


if __name__ == "__main__":
    what, on, *told = sys.argv[1:]
    if what == "storm":
        storm(on, float(told[0]), float(told[1]), int(told[2]))
    else:
        relay(on)
