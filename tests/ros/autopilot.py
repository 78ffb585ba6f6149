# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulate an autopilot with ArduPilot's DDS interface, as a process.

python -m tests.ros.autopilot SCENARIO RELEASE_AFTER

It simulates the aircraft section of the scenario at its rate and publishes y as AP_DDS does (ENU
and FLU, best effort, depth five). It subscribes to Joy as AP_DDS does: axes are scaled to full
deflection, NaN releases a channel at once, and all channels are released after RELEASE_AFTER
seconds without Joy. A released channel is at trim. It imports nothing from the bridge. It prints "y
STAMP q V p r" without noise, and "timeout" when the channels are released without Joy.

With a third word `odometry` it is a simulator for the map of this name. It then sends Imu and
Odometry in the frames of REP 103, and takes the last Float64 of each effector.
"""

import math
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import TwistStamped, Vector3Stamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu, Joy
from std_msgs.msg import Float64

from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario import load_scenario
from flight_ros import transport

QOS = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
SPEED = 25.0  # m/s, trim
FULL = math.radians(30.0)  # of the surfaces
FULL_THRUST = 20.0  # N
ENU_OF_NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FLU_OF_FRD = np.diag([1, -1, -1])


class Autopilot:
    """The simulated aircraft, its publishers and its subscription."""

    def __init__(
        self,
        scenario: Path,
        release_after: float,
        node: Any,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._simulator = Simulator(load_scenario(scenario).aircraft)
        self._release_after = release_after
        self._monotonic = monotonic
        self.node = node
        self._twist = self.node.create_publisher(TwistStamped, "/ap/twist/filtered", QOS)
        self._airspeed = self.node.create_publisher(Vector3Stamped, "/ap/airspeed", QOS)
        self.node.create_subscription(Joy, "/ap/joy", self._on_joy, QOS)
        self._axes = [math.nan] * 4
        self._received = 0.0

    def _on_joy(self, message: Joy) -> None:
        if len(message.axes) >= 4:  # messages with fewer axes are ignored
            self._axes = [float(axis) for axis in message.axes[:4]]
            self._received = self._monotonic()

    def _u(self) -> list[float]:
        """Elevator, thrust, aileron, rudder from trim, in rad and as a fraction of full thrust.

        Half throttle is trim.
        """
        if (
            any(math.isfinite(axis) for axis in self._axes)
            and self._monotonic() - self._received > self._release_after
        ):
            self._axes = [math.nan] * 4
            print("timeout", flush=True)
        roll, pitch, throttle, yaw = self._axes
        u = [pitch * FULL, (throttle + 1.0) / 2.0 - 0.5, roll * FULL, yaw * FULL]
        return [value if math.isfinite(value) else 0.0 for value in u]

    @property
    def period(self) -> float:
        """Return the time between two samples of y, s."""
        return self._simulator.period_ns / 1e9

    def step(self, number: int) -> None:
        """Simulate to a sample and publish it."""
        (sample,) = self._simulator.sample(number, np.array(self._u()))
        self._publish(*sample.value.tolist())

    def truth(self) -> list[float]:
        """Return q, V, p, r of the last sample without noise."""
        places = [self._simulator.truth_names.index(f"x.{name}") for name in ("q", "V", "p", "r")]
        truth: list[float] = self._simulator.truth()[places].tolist()
        return truth

    def fly(self) -> None:
        """Simulate and publish until the process ends."""
        begin = time.monotonic()
        number = 0
        while True:
            while (rest := begin + number * self.period - time.monotonic()) > 0.0:
                rclpy.spin_once(self.node, timeout_sec=rest)
            self.step(number)
            print("y", time.time_ns(), *self.truth(), flush=True)
            # Samples are skipped after a stop of the process.
            number = max(number + 1, int((time.monotonic() - begin) / self.period))

    def _publish(self, q: float, V: float, p: float, r: float) -> None:
        twist = TwistStamped()
        airspeed = Vector3Stamped()
        for message in (twist, airspeed):
            message.header.stamp.sec = 12  # like a time since boot: not the host's clock
            message.header.frame_id = "base_link"
        twist.twist.linear.y = SPEED + V  # north, in ENU
        twist.twist.angular.x = p
        twist.twist.angular.y = -q
        twist.twist.angular.z = -r
        alpha = 0.05
        airspeed.vector.x = (SPEED + V) * math.cos(alpha)
        airspeed.vector.z = (SPEED + V) * math.sin(alpha)
        self._twist.publish(twist)
        self._airspeed.publish(airspeed)


class Odometer(Autopilot):
    """A simulator that publishes Imu and Odometry.

    It takes commands for the joints and for the thrust.
    """

    def __init__(self, scenario: Path, release_after: float, node: Any) -> None:
        super().__init__(scenario, release_after, node)
        self._imu = self.node.create_publisher(Imu, "sim/imu", 10)
        self._odometry = self.node.create_publisher(Odometry, "sim/odom", 10)
        self._commands = {
            "elevator": 0.0,
            "thrust": FULL_THRUST / 2.0,
            "aileron": 0.0,
            "rudder": 0.0,
        }
        for name in self._commands:
            self.node.create_subscription(Float64, f"sim/{name}", partial(self._hold, name), 10)

    def _hold(self, name: str, message: Float64) -> None:
        self._commands[name] = message.data

    def _u(self) -> list[float]:
        elevator, thrust, aileron, rudder = self._commands.values()
        return [elevator, thrust / FULL_THRUST - 0.5, aileron, rudder]

    def _publish(self, q: float, V: float, p: float, r: float) -> None:
        imu = Imu()
        odometry = Odometry()
        for message in (imu, odometry):
            message.header.stamp.sec = 12  # simulated time
        imu.angular_velocity.x = p
        imu.angular_velocity.y = -q
        imu.angular_velocity.z = -r
        phi, theta, psi, north, east, altitude, v_north, v_east, climb, _ = (
            self._simulator.pose().tolist()
        )
        attitude = Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix()
        turn = Rotation.from_matrix(ENU_OF_NED @ attitude @ FLU_OF_FRD)
        place = odometry.pose.pose
        velocity = odometry.twist.twist.linear
        place.position.x = east
        place.position.y = north
        place.position.z = altitude
        place.orientation.x, place.orientation.y, place.orientation.z, place.orientation.w = (
            turn.as_quat().tolist()
        )
        velocity.x, velocity.y, velocity.z = turn.inv().apply([v_east, v_north, climb]).tolist()
        self._imu.publish(imu)
        self._odometry.publish(odometry)


if __name__ == "__main__":
    transport.prepare()
    rclpy.init()
    kind = Odometer if "odometry" in sys.argv[3:] else Autopilot
    kind(Path(sys.argv[1]), float(sys.argv[2]), Node("ap")).fly()
