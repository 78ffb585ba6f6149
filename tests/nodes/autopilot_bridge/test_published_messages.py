# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the map of PX4 with the real message package, if it is installed.

None of these packages is on PyPI. `make messages` builds each from its sources
(docs/autopilots-reference.md). Without them, tests/pure/autopilot_bridge/test_channel_map.py tests
each row with the published fields.
"""

from importlib import import_module
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

import pytest
from pytest import approx
from rclpy.serialization import deserialize_message, serialize_message
from std_srvs.srv import SetBool
from tests.maps import named_map
from tests.nodes.world import INPUTS, World, world_of
from tests.published_messages import PACKAGES, PUBLISHED, kind
from tests.pure.autopilot_bridge.test_channel_map import AIRSPEED, MAPS, MOTION, RATES, SENT

from autopilot_bridge.channel_map import (
    get_field,
    message_type,
    read_raw,
    set_field,
    to_channel,
    to_raw,
)
from autopilot_bridge.node import BridgeNode
from autopilot_bridge.params import ChannelMap

DO_SET_MODE = 176  # MAVLink's MAV_CMD_DO_SET_MODE, as PX4's VEHICLE_CMD_DO_SET_MODE
AS_PYTHON = {"float32": "float", "bool": "boolean"}  # as rclpy names the types of a definition


# tests/pure/autopilot_bridge/test_mavlink_link.py has those over MAVLink.
ROS_MAPS = [name for name in MAPS if named_map(name).link is None]


def needs(*packages: str) -> None:
    """Skip the test if a message package is not installed."""
    for package in packages:
        if find_spec(package) is None:
            pytest.skip(
                f"no {package}: make messages PACKAGE={package} SOURCE=FOLDER, the sources of "
                f"{PACKAGES[package]}"
            )


def needs_packages_of(channel_map: ChannelMap) -> None:
    needs(
        *sorted(
            {kind_.split("/")[0] for _, _, kind_ in channel_map.used_topics()} & PACKAGES.keys()
        )
    )


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_package_has_the_published_fields(name: str) -> None:
    needs(name.partition("/")[0])
    result: dict[str, str] = message_type(name).get_fields_and_field_types()  # type: ignore[attr-defined]
    for field, published in PUBLISHED[name].items():
        element, length, is_array, most = kind(published)
        element = AS_PYTHON.get(element, element)
        sequence = f"sequence<{element}, {most}>" if most else f"sequence<{element}>"
        expected = f"{element}[{length}]" if length else sequence if is_array else element
        assert result[field] == expected


def fill(message: Any, like: SimpleNamespace) -> Any:
    """Set the fields of a message to the values of a plain object."""
    for name, value in vars(like).items():
        if isinstance(value, SimpleNamespace):
            fill(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


@pytest.mark.parametrize("channels", ["qpr", "V"])
@pytest.mark.parametrize("name", ROS_MAPS)
def test_outputs_are_read_from_real_messages(name: str, channels: str) -> None:
    channel_map = named_map(name)
    needs_packages_of(channel_map)
    for channel in channels:
        row = channel_map.outputs[channel]
        message = fill(message_type(row.type)(), AIRSPEED[name] if channel == "V" else RATES[name])
        message = deserialize_message(serialize_message(message), type(message))
        value = to_channel(read_raw(message, row.field, row.function), row.conversion)
        assert value == approx(2.0 if channel == "V" else MOTION[channel], abs=1e-6)  # float32


@pytest.mark.parametrize("name", ROS_MAPS)
def test_inputs_are_written_into_real_messages(name: str) -> None:
    channel_map = named_map(name)
    needs_packages_of(channel_map)
    for (path, expected), row in zip(SENT[name].items(), channel_map.inputs.values(), strict=True):
        message = message_type(channel_map.messages[row.message].type)()
        for field, value in channel_map.messages[row.message].values.items():
            set_field(message, field, value)
        set_field(message, row.field, to_raw(row.trim + 0.1, row.conversion))
        message = deserialize_message(serialize_message(message), type(message))
        assert get_field(message, row.field) == approx(expected, abs=1e-3), path


class Px4:
    """A PX4 that publishes y and its mode, and receives the messages to which PX4 subscribes.

    A command changes its mode.
    """

    HOLD, OFFBOARD, ARMED = 4, 14, 2
    MODES = ((6.0, 0.0, OFFBOARD), (4.0, 3.0, HOLD))  # main mode and submode of DO_SET_MODE

    def __init__(self, world: World) -> None:
        types = import_module("px4_msgs.msg")
        self._world = world
        # Nose up and 2 m/s fast.
        odometry = fill(types.VehicleOdometry(q=[1.0, 0.0, 0.0, 0.0]), RATES["px4"])
        airspeed = fill(types.AirspeedValidated(), AIRSPEED["px4"])
        self._status = types.VehicleStatus(arming_state=self.ARMED, nav_state=self.HOLD)
        self._publishers = [
            (world.create_publisher(type(message), f"/fmu/out/{topic}", 5), message)
            for topic, message in (
                ("vehicle_odometry", odometry),
                ("airspeed_validated", airspeed),
                ("vehicle_status_v1", self._status),
                ("manual_control_setpoint", types.ManualControlSetpoint(valid=True)),
            )
        ]
        self.received: dict[str, list[Any]] = {}
        for topic in (
            "offboard_control_mode",
            "vehicle_torque_setpoint",
            "vehicle_thrust_setpoint",
            "vehicle_command",
        ):
            name = topic.title().replace("_", "")
            messages = self.received[name] = []
            world.create_subscription(getattr(types, name), f"/fmu/in/{topic}", messages.append, 5)

    def publish(self) -> None:
        """Publish y, the mode, and u with 0.02 rad of elevator.

        Offboard can only be entered with a heartbeat.
        """
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
        self._world.send("/u", dict.fromkeys(INPUTS, 0.0) | {"elevator": 0.02})

    @property
    def mode(self) -> int:
        """Return its nav_state."""
        return int(self._status.nav_state)


def test_bridge_flies_px4_in_offboard_and_returns_it_to_hold() -> None:
    """Heartbeats are sent from the request on, and setpoints in offboard.

    A release ends both, and requests Hold.
    """
    needs("px4_msgs")
    with world_of("-p", "map:=px4", "-p", "dry_run:=false") as world:
        world.start(BridgeNode)
        px4 = Px4(world)
        world.run(1.0, px4.publish)
        # V is captured: 0 until the engagement
        assert world.last("/y") == approx({**MOTION, "V": 0.0}, abs=1e-6)
        # A heartbeat before the request would keep PX4 in offboard.
        assert not any(px4.received.values())
        assert world.call("/bridge/engage", SetBool.Request(data=True)).success
        world.run(1.0, px4.publish)
        assert px4.mode == Px4.OFFBOARD
        assert px4.received["OffboardControlMode"][-1].thrust_and_torque
        assert list(px4.received["VehicleTorqueSetpoint"][-1].xyz) == approx(
            [0.0, 0.02 / 0.523599, 0.0], abs=1e-6
        )
        assert list(px4.received["VehicleThrustSetpoint"][-1].xyz) == approx(
            [0.5, 0.0, 0.0], abs=1e-6
        )
        assert world.call("/bridge/engage", SetBool.Request(data=False)).success
        world.run(1.0, px4.publish)
        assert px4.mode == Px4.HOLD
        for messages in px4.received.values():
            messages.clear()
        world.run(0.5, px4.publish)
        assert not any(px4.received.values())
