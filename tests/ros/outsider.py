# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Somebody who has no business in a flight: hears y where it can, and commands the aircraft in the controller's name.

python -m tests.ros.outsider SECONDS [KEY_FILE]     # ends at once when it hears y and has sent u for a second

Its transport is what the environment says. With a key it signs. Prints how many samples of y it has heard, as JSON.
"""

import json
import sys
import time

import numpy as np
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy

from flight_core.authentication import MessageAuthenticator, read_key
from flight_ros.messages import Encoder
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import NEWEST_SAMPLES, U, Y

INPUTS = ("elevator", "thrust", "aileron", "rudder")
ENOUGH = 50  # samples of y, and as many u

# What any subscriber matches, whatever it asks for but what was kept.
SEND = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


def main() -> None:
    """Attack."""
    seconds, *keys = sys.argv[1:]
    rclpy.init()
    node = rclpy.create_node("outsider")
    subscription = PolledSubscription(node, Y, NEWEST_SAMPLES, raw=True)
    publisher = node.create_publisher(U.type, U.name, SEND)
    seal = MessageAuthenticator(read_key(keys[0], "key_file"), "/u", None) if keys else None
    encoder = Encoder(INPUTS, "/controller#1", seal)
    heard = sent = 0
    deadline = time.monotonic() + float(seconds)
    while time.monotonic() < deadline and not (heard >= ENOUGH and sent >= ENOUGH):
        heard += len(subscription.take())
        publisher.publish(encoder.encode(time.time_ns(), np.array([0.0, 0.0, 0.02, 0.0])))
        sent += heard > 0
        time.sleep(0.02)
    print(json.dumps({"heard": heard}), flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
