# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the quality of service (QoS) of recorded topics.

This module finds the strongest compatible profile, and writes profiles as rosbag2 does.
"""

from collections.abc import Sequence

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from flight_core.rates import NANOSECONDS
from flight_ros.topics import RECORD

INFINITE_NS = 2**63 - 1  # rmw: RMW_DURATION_INFINITE


def strongest_compatible(offered: Sequence[QoSProfile]) -> QoSProfile:
    """Return the strongest profile that is compatible with all offered profiles."""
    reliable = all(profile.reliability == ReliabilityPolicy.RELIABLE for profile in offered)
    # A late subscriber asks for the earlier messages, and only a reliable one can ask.
    durable = reliable and all(
        profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in offered
    )
    return QoSProfile(
        depth=RECORD.depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if durable else DurabilityPolicy.VOLATILE,
    )


def rosbag2_profiles(offered: Sequence[QoSProfile]) -> list[dict[str, object]]:
    """Return profiles in the form in which rosbag2 stores them."""
    return [
        {
            "history": qos.history.short_key,
            "depth": qos.depth,
            "reliability": qos.reliability.short_key,
            "durability": qos.durability.short_key,
            "deadline": _duration(qos.deadline),
            "lifespan": _duration(qos.lifespan),
            "liveliness": "automatic",
            "liveliness_lease_duration": _duration(qos.liveliness_lease_duration),
            "avoid_ros_namespace_conventions": False,
        }
        for qos in offered
    ]


def _duration(duration: Duration) -> dict[str, int]:
    # 0 means that the duration is not set
    sec, nsec = divmod(duration.nanoseconds or INFINITE_NS, NANOSECONDS)
    return {"sec": sec, "nsec": nsec}
