# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Attack a flight: subscribe to y, and publish u under the name of the controller.

python -m tests.ros.attacker SECONDS # ends early after ENOUGH samples of y and u

The environment selects its transport. It prints the number of received samples of y as JSON.
"""

import json
import sys
import time

import numpy as np
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from tests.ros.peer import INPUTS

from flight_ros.messages import Encoder
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import NEWEST_SAMPLES, U, Y

ENOUGH = 50  # samples of y received, and samples of u sent

# Compatible with every subscriber that does not request transient-local durability.
SEND = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


def main() -> None:
    """Attack."""
    (seconds,) = sys.argv[1:]
    rclpy.init()
    node = rclpy.create_node("attacker")
    subscription = PolledSubscription(node, Y, NEWEST_SAMPLES, raw=True)
    publisher = node.create_publisher(U.type, U.name, SEND)
    encoder = Encoder(INPUTS, "/controller#1")
    received = sent_count = 0
    deadline = time.monotonic() + float(seconds)
    while time.monotonic() < deadline and not (received >= ENOUGH and sent_count >= ENOUGH):
        received += len(subscription.take())
        publisher.publish(encoder.encode(time.time_ns(), np.array([0.0, 0.0, 0.02, 0.0])))
        sent_count += received > 0
        time.sleep(0.02)
    print(json.dumps({"received": received}), flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
