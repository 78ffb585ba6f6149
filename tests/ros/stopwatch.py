# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure the age of u on the aircraft's host, to compare it with what the aircraft tells.

It needs only rclpy, and runs as python -m tests.ros.stopwatch. It prints "told MEAN measured MEAN",
s, for each report of the aircraft.
"""

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState

KEY = "age of u mean (s)"


class Stopwatch(Node):  # type: ignore[misc]
    """The ages of all u since the last report."""

    def __init__(self) -> None:
        super().__init__("stopwatch")
        self._ages: list[float] = []
        self.create_subscription(JointState, "u", self._take, qos_profile_sensor_data)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._compare, 10)

    def _take(self, message: JointState) -> None:
        stamp = message.header.stamp
        self._ages.append(
            self.get_clock().now().nanoseconds / 1e9 - stamp.sec - stamp.nanosec / 1e9
        )

    def _compare(self, message: DiagnosticArray) -> None:
        ages_told = [
            float(value.value)
            for status in message.status
            for value in status.values
            if value.key == KEY
        ]
        if ages_told and self._ages:
            print(
                f"told {ages_told[0]:.4f} measured {sum(self._ages) / len(self._ages):.4f}",
                flush=True,
            )
        if any(status.name == "/aircraft" for status in message.status):
            self._ages.clear()


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Stopwatch())
