# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A foreign process that floods a topic with vectors that look well.

python -m tests.ros.faults.foreign TOPIC RATE SECONDS SEED
"""

import sys
import time

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.node import Node

from flight_ros import transport
from flight_ros.messages import Encoder
from flight_ros.ticker import Ticker
from flight_ros.topics import PUBLISH, Y_M, U, Y

NAMES = {"y": ("q", "V", "p", "r"), "y_m": ("q", "V", "p", "r"), "u": ("elevator", "aileron", "rudder", "thrust")}
BURST_NS = 1_000_000  # a thousand bursts a second: one by one is more than Python's sleep can do


def main(topic: str, rate: float, duration: float, seed: int) -> None:
    """Flood it, from the moment somebody listens."""
    random = np.random.default_rng(seed)
    values = random.uniform(-1.0, 1.0, (1000, 4))
    transport.prepare()
    context = Context()
    rclpy.init(context=context)
    node = Node("foreign", context=context)
    kind = {one.name: one for one in (Y, Y_M, U)}[topic]
    publisher = node.create_publisher(kind.type, kind.name, PUBLISH)
    encoder = Encoder(NAMES[topic], "/foreign")
    while publisher.get_subscription_count() < 3:  # the node that flies with it, the recorder, the probe
        time.sleep(0.005)
    print(f"begins at {time.time():.6f}", flush=True)
    ticker, sent, begin = Ticker(BURST_NS, time.monotonic_ns()), 0, time.monotonic()
    while time.monotonic() - begin < duration:
        if (pause := ticker.remaining()) > 0:
            time.sleep(pause)
        while sent < rate * (time.monotonic() - begin):
            publisher.publish(encoder.encode(time.time_ns(), values[sent % len(values)]))
            sent += 1
        ticker.due()
    print(f"sent {sent} in {(time.monotonic() - begin):.3f} s", flush=True)
    node.destroy_node()
    context.try_shutdown()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
