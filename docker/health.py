# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Health check of a container (a watchdog).

Whether the loops of its nodes still publish to /diagnostics, at 1 Hz.

health.py [NODE ...] waits for one report of each given node, or of any node without arguments. Exit
status 0 when all reports arrived, 1 otherwise. A report of level WARN or ERROR is printed and
counts as healthy: the node runs.
"""

import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray

from flight_ros import transport
from flight_ros.topics import DIAGNOSTICS, NEWEST_SAMPLES

TIMEOUT = 4.0  # s: some tenths for discovery, one second for a report, the rest for a busy host


def main(names: list[str]) -> int:
    """Exit status for the given nodes."""
    transport.prepare()
    rclpy.init(args=["--ros-args", "--disable-external-lib-logs"])  # no log file for each check
    node = rclpy.create_node("health", start_parameter_services=False, enable_rosout=False)
    reports: dict[str, str] = {}

    def receive(message: DiagnosticArray) -> None:
        reports.update(
            {status.name.rpartition("/")[2]: status.message for status in message.status}
        )

    node.create_subscription(DIAGNOSTICS.type, DIAGNOSTICS.name, receive, NEWEST_SAMPLES)
    deadline = time.monotonic() + TIMEOUT
    while time.monotonic() < deadline and not (set(names) <= set(reports) if names else reports):
        rclpy.spin_once(node, timeout_sec=0.1)
    node.destroy_node()
    rclpy.try_shutdown()
    missing = (
        [name for name in names if name not in reports]
        if names
        else []
        if reports
        else ["any node"]
    )
    for name in missing:
        print(f"no report of {name} within {TIMEOUT:g} s")
    for name, sentence in reports.items():
        print(f"{name}: {sentence}")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
