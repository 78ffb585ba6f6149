# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The bridge with the real messages of PX4 over DDS, where px4_msgs is installed."""

from importlib import import_module
from typing import Any

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool
from tests.nodes.test_published_messages import fill, needs
from tests.pure.test_channel_map import AIRSPEED, MOTION, RATES
from tests.ros.conftest import Start
from tests.ros.peer import Peer, peer

pytestmark = pytest.mark.package("autopilot_bridge")

BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
STORED = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.TRANSIENT_LOCAL)
DO_SET_MODE = 176  # MAVLink's MAV_CMD_DO_SET_MODE, as PX4's VEHICLE_CMD_DO_SET_MODE


class Px4:
    """Publishes y and its mode as PX4 does, and takes the messages to which PX4 subscribes: a command changes the mode."""

    HOLD, OFFBOARD, ARMED = 4, 14, 2
    MODES = ((6.0, 0.0, OFFBOARD), (4.0, 3.0, HOLD))  # main mode and submode of DO_SET_MODE

    def __init__(self, peer_node: Peer) -> None:
        types, node = import_module("px4_msgs.msg"), peer_node.node
        self._peer = peer_node
        # nose up and 2 m/s fast
        odometry, airspeed = fill(types.VehicleOdometry(), RATES["px4"]), fill(types.AirspeedValidated(), AIRSPEED["px4"])
        self._status = types.VehicleStatus(arming_state=self.ARMED, nav_state=self.HOLD)
        self._publishers = [
            (node.create_publisher(type(message), f"/fmu/out/{topic}", STORED), message)
            for topic, message in (
                ("vehicle_odometry", odometry),
                ("airspeed_validated", airspeed),
                ("vehicle_status_v1", self._status),
                ("manual_control_setpoint", types.ManualControlSetpoint(valid=True)),
            )
        ]
        self.received: dict[str, list[Any]] = {}
        for topic in ("offboard_control_mode", "vehicle_torque_setpoint", "vehicle_thrust_setpoint", "vehicle_command"):
            name = topic.title().replace("_", "")
            received = self.received[name] = []
            node.create_subscription(getattr(types, name), f"/fmu/in/{topic}", received.append, BEST_EFFORT)

    def publish(self) -> None:
        """Publish y, the mode, and u: elevator 0.02 rad. Offboard is entered with a heartbeat alone."""
        commands = [
            (command.param2, command.param3)
            for command in self.received["VehicleCommand"][-1:]
            if command.command == DO_SET_MODE
        ]
        for main, sub, nav_state in self.MODES:
            if commands == [(main, sub)] and self.received["OffboardControlMode"]:
                self._status.nav_state = nav_state
        for publisher, message in self._publishers:
            publisher.publish(message)
        self._peer.command(0.02, 0.0, 0.0, 0.0)

    @property
    def mode(self) -> int:
        """Its nav_state."""
        return int(self._status.nav_state)


def test_bridge_flies_px4_in_offboard_and_returns_it_to_hold(start: Start) -> None:
    """Heartbeats from the request on, setpoints in offboard; a release ends both and requests Hold."""
    needs("px4_msgs")
    start("autopilot_bridge.main", "--ros-args", "-p", "map:=px4", "-p", "dry_run:=false").wait_for("ready")
    with peer(topics=("y",)) as peer_node:
        px4 = Px4(peer_node)
        peer_node.until(lambda: bool(peer_node.received["y"]), each=px4.publish)
        y = peer_node.received["y"][-1]
        # V is captured: 0 until the engagement
        assert dict(zip(y.name, y.position, strict=True)) == pytest.approx({**MOTION, "V": 0.0}, abs=1e-6)
        assert not any(px4.received.values())  # a heartbeat before the request would keep PX4 in offboard
        client = peer_node.node.create_client(SetBool, "bridge/engage")

        def request(engaged: bool) -> None:
            peer_node.until(client.service_is_ready, each=px4.publish)
            future = client.call_async(SetBool.Request(data=engaged))
            peer_node.until(future.done, each=px4.publish)
            assert future.result().success, future.result().message

        request(engaged=True)
        peer_node.until(lambda: len(px4.received["VehicleThrustSetpoint"]) > 5, each=px4.publish)
        assert px4.mode == Px4.OFFBOARD
        assert px4.received["OffboardControlMode"][-1].thrust_and_torque
        assert list(px4.received["VehicleTorqueSetpoint"][-1].xyz) == pytest.approx([0.0, 0.02 / 0.523599, 0.0], abs=1e-6)
        assert list(px4.received["VehicleThrustSetpoint"][-1].xyz) == pytest.approx([0.5, 0.0, 0.0], abs=1e-6)
        request(engaged=False)
        peer_node.until(lambda: px4.mode == Px4.HOLD, each=px4.publish)
        peer_node.spin(0.2)  # for messages in transit
        for messages in px4.received.values():
            messages.clear()
        peer_node.spin(0.5)
        assert not any(px4.received.values())
