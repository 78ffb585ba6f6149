# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What is published of the message types that the channel maps use beside common_interfaces: names and types of fields.

Only the fields that a map names. Read in the definitions at the commits below; tests/ros/test_published_messages.py compares
them with the packages where those are installed.
"""

import re
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

PACKAGES = {
    "px4_msgs": "PX4/px4_msgs v1.16.2, 392e831c",
    "mavros_msgs": "mavlink/mavros 2.12.0, f8f462dd",
    "rosflight_msgs": "rosflight/rosflight_ros_pkgs v2.0.1, cefdb425",
    "rosplane_msgs": "rosflight/rosplane, ba7e114a",
}

HEADER = "std_msgs/Header"
MODES = ("position", "velocity", "acceleration", "attitude", "body_rate", "thrust_and_torque", "direct_actuator")

PUBLISHED: dict[str, dict[str, str]] = {
    "px4_msgs/msg/VehicleOdometry": {"angular_velocity": "float32[3]"},
    "px4_msgs/msg/AirspeedValidated": {"true_airspeed_m_s": "float32"},
    "px4_msgs/msg/VehicleTorqueSetpoint": {"xyz": "float32[3]"},
    "px4_msgs/msg/VehicleThrustSetpoint": {"xyz": "float32[3]"},
    "px4_msgs/msg/OffboardControlMode": dict.fromkeys(MODES, "bool"),
    "px4_msgs/msg/ManualControlSetpoint": {"aux1": "float32"},
    "mavros_msgs/msg/VfrHud": {"header": HEADER, "airspeed": "float32"},
    "mavros_msgs/msg/OverrideRCIn": {"channels": "uint16[18]"},
    "mavros_msgs/msg/RCIn": {"channels": "uint16[]"},
    "rosflight_msgs/msg/Command": {"header": HEADER, "mode": "uint8", "ignore": "uint16", "u": "float32[10]"},
    "rosflight_msgs/msg/Status": {"rc_override": "uint16"},
    "rosplane_msgs/msg/State": {"header": HEADER, "p": "float32", "q": "float32", "r": "float32", "va": "float32"},
}

FOREIGN_MAPS = ("px4", "mavros", "rosflight")
"""Maps whose rows name them."""


class Kind(NamedTuple):
    """The type of a field."""

    element: str
    length: int | None  # of an array that has one
    is_array: bool


def kind(field: str) -> Kind:
    """A type as a definition states it, such as float32, float32[3] or uint16[]."""
    found = re.fullmatch(r"([\w/]+)(\[(\d*)\])?", field)
    assert found is not None, field
    return Kind(found[1], int(found[3]) if found[3] else None, found[2] is not None)


def blank(type_name: str) -> SimpleNamespace:
    """An object with the published fields at zero, as rclpy makes them: arrays of NumPy, of the very width."""
    made = SimpleNamespace()
    for name, field in PUBLISHED[type_name].items():
        element, length, is_array = kind(field)
        if element == HEADER:
            value: object = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0))
        elif is_array:
            value = np.zeros(length or 18, dtype=element)  # 18 as many as MAVLink has channels
        else:
            value = {"f": 0.0, "u": 0, "b": False}[element[0]]
        setattr(made, name, value)
    return made
