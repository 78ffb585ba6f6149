# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide the fields of the message types that the channel maps use, as published.

common_interfaces lacks these types. There are only the fields that a map uses, from the definitions
of the releases below. tests/nodes/autopilot_bridge/test_published_messages.py compares them with
the installed packages.
"""

import re
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

PACKAGES = {
    "ardupilot_msgs": "ArduPilot/ardupilot, Tools/ros2/ardupilot_msgs, March 2026",
    "px4_msgs": "PX4/px4_msgs v1.16.2, 392e831c",
}

HEADER = "std_msgs/Header"
MODES = (
    "position",
    "velocity",
    "acceleration",
    "attitude",
    "body_rate",
    "thrust_and_torque",
    "direct_actuator",
)

PUBLISHED: dict[str, dict[str, str]] = {
    "ardupilot_msgs/msg/Airspeed": {"true_airspeed": "geometry_msgs/Vector3"},
    "ardupilot_msgs/msg/Rc": {"channels": "int16[<=32]"},
    "ardupilot_msgs/msg/Status": {"mode": "uint8", "armed": "bool", "flying": "bool"},
    "px4_msgs/msg/VehicleOdometry": {
        "angular_velocity": "float32[3]",
        "position": "float32[3]",
        "velocity": "float32[3]",
        "q": "float32[4]",
    },
    "px4_msgs/msg/AirspeedValidated": {"true_airspeed_m_s": "float32"},
    "px4_msgs/msg/VehicleTorqueSetpoint": {"xyz": "float32[3]"},
    "px4_msgs/msg/VehicleThrustSetpoint": {"xyz": "float32[3]"},
    "px4_msgs/msg/OffboardControlMode": dict.fromkeys(MODES, "bool"),
    "px4_msgs/msg/ManualControlSetpoint": {"aux1": "float32", "valid": "bool"},
    "px4_msgs/msg/VehicleStatus": {"arming_state": "uint8", "nav_state": "uint8"},
    "px4_msgs/msg/VehicleCommand": {
        "command": "uint32",
        **dict.fromkeys(("param1", "param2", "param3"), "float32"),
        **dict.fromkeys(("target_system", "target_component"), "uint8"),
        "source_system": "uint8",
        "from_external": "bool",
    },
}

FOREIGN_MAPS = ("px4",)
"""Maps that use these types."""


class Kind(NamedTuple):
    """The type of a field."""

    element: str
    length: int | None  # of an array of fixed length
    is_array: bool
    most: int | None  # elements of an array of bounded length


def kind(field: str) -> Kind:
    """Parse the type of a field, such as float32, float32[3], uint16[] or int16[<=32]."""
    match = re.fullmatch(r"([\w/]+)(\[(?:<=(\d+)|(\d*))\])?", field)
    assert match is not None, field
    most, length = (int(number) if number else None for number in match.groups()[2:])
    return Kind(match[1], length, match[2] is not None, most)


def blank(type_name: str) -> SimpleNamespace:
    """Return an object with the published fields at zero, as rclpy creates them.

    Arrays are NumPy arrays with the type of the field.
    """
    message = SimpleNamespace()
    for name, field in PUBLISHED[type_name].items():
        element, length, is_array, _ = kind(field)
        if element == HEADER:
            value: object = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0))
        elif is_array:
            value = np.zeros(length or 18, dtype=element)  # MAVLink has 18 channels
        else:
            value = {"f": 0.0, "u": 0, "b": False}[element[0]]
        setattr(message, name, value)
    return message
