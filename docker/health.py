# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Health of a container: whether its nodes still report on /diagnostics, which they do at 1 Hz out of the loop that flies.

health.py [NODE ...] waits for one report of each node named, or of any node where none is named. Exit status 0 when they came,
1 otherwise. A level that a node reports, such as an aircraft's whose controller is silent, is printed, and is not its health.
"""

import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray

from flight_ros import transport
from flight_ros.topics import DIAGNOSTICS, NEWEST_SAMPLES

PATIENCE = 4.0  # s: some tenths to be matched, a report within the second after, and as long again for a busy machine


def main(names: list[str]) -> int:
    """Exit status for the nodes named."""
    transport.prepare()
    rclpy.init(args=["--ros-args", "--disable-external-lib-logs"])  # no log file a check
    node = rclpy.create_node("health", start_parameter_services=False, enable_rosout=False)
    heard: dict[str, str] = {}

    def hear(message: DiagnosticArray) -> None:
        heard.update({status.name.rpartition("/")[2]: status.message for status in message.status})

    node.create_subscription(DIAGNOSTICS.type, DIAGNOSTICS.name, hear, NEWEST_SAMPLES)
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline and not (set(names) <= set(heard) if names else heard):
        rclpy.spin_once(node, timeout_sec=0.1)
    node.destroy_node()
    rclpy.try_shutdown()
    missing = [name for name in names if name not in heard] if names else [] if heard else ["any node"]
    for name in missing:
        print(f"no report of {name} within {PATIENCE:g} s")
    for name, sentence in heard.items():
        print(f"{name}: {sentence}")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
