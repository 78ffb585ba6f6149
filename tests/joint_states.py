# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""JointState messages of an independent publisher, serialised without ROS."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from flight_core.rates import NANOSECONDS

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"


def vector(stamp_ns: int, names: Sequence[str], values: Sequence[float], sender: str = "", **more: Sequence[float]) -> bytes:
    """A JointState of these channels; `velocity` and `effort` may be given."""
    types: dict[str, Any] = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, NANOSECONDS))
    header = types["std_msgs/msg/Header"](stamp, sender)
    fields = [np.array(field, dtype=np.float64) for field in (values, more.get("velocity", ()), more.get("effort", ()))]
    return bytes(STORE.serialize_cdr(types[JOINT_STATE](header, list(names), *fields), JOINT_STATE))
