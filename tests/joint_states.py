# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Serialise messages of an independent publisher without ROS."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from flight_core.rates import NANOSECONDS

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
PATH = "nav_msgs/msg/Path"
PARAMETER_EVENT = "rcl_interfaces/msg/ParameterEvent"
NONE: Mapping[str, object] = MappingProxyType({})


def vector(
    stamp_ns: int,
    names: Sequence[str],
    values: Sequence[float],
    sender: str = "",
    **more: Sequence[float],
) -> bytes:
    """Return a JointState of these channels. `velocity` and `effort` may be given."""
    types: dict[str, Any] = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, NANOSECONDS))
    header = types["std_msgs/msg/Header"](stamp, sender)
    fields = [
        np.array(field, dtype=np.float64)
        for field in (values, more.get("velocity", ()), more.get("effort", ()))
    ]
    return bytes(STORE.serialize_cdr(types[JOINT_STATE](header, list(names), *fields), JOINT_STATE))


def path(*points: tuple[float, float, float], frame: str = "map") -> bytes:
    """Return a Path through points (north, east, altitude), without a stamp."""
    types: dict[str, Any] = STORE.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), frame)
    level = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    positions = [
        types["geometry_msgs/msg/Point"](east, north, altitude) for north, east, altitude in points
    ]
    poses = [types["geometry_msgs/msg/Pose"](position, level) for position in positions]
    stamped = [types["geometry_msgs/msg/PoseStamped"](header, pose) for pose in poses]
    return bytes(STORE.serialize_cdr(types[PATH](header, stamped), PATH))


def parameter_event(
    node: str,
    changed: Mapping[str, object],
    new: Mapping[str, object] = NONE,
    deleted: Mapping[str, object] = NONE,
    stamp_ns: int = 0,
) -> bytes:
    """Return the ParameterEvent of a node.

    Its parameters have changed, are new, or have no value any more (None).
    """
    types: dict[str, Any] = STORE.types
    kinds = {
        type(None): (0, ""),
        bool: (1, "bool"),
        float: (3, "double"),
        str: (4, "string"),
        list: (8, "double_array"),
    }
    empty: dict[str, Any] = {
        "bool_value": False,
        "integer_value": 0,
        "double_value": 0.0,
        "string_value": "",
    }
    for name, dtype in {
        "byte": np.uint8,
        "bool": bool,
        "integer": np.int64,
        "double": float,
    }.items():
        empty[f"{name}_array_value"] = np.zeros(0, dtype)

    def parameters(values: Mapping[str, object]) -> list[Any]:
        listed = []
        for name, value in values.items():
            number, kind = kinds[type(value)]
            field = (
                {f"{kind}_value": np.array(value) if isinstance(value, list) else value}
                if kind
                else {}
            )
            stored = types["rcl_interfaces/msg/ParameterValue"](
                **(empty | {"type": number, "string_array_value": []} | field)
            )
            listed.append(types["rcl_interfaces/msg/Parameter"](name, stored))
        return listed

    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, NANOSECONDS))
    event = types[PARAMETER_EVENT](
        stamp, node, parameters(new), parameters(changed), parameters(deleted)
    )
    return bytes(STORE.serialize_cdr(event, PARAMETER_EVENT))
