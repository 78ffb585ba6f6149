# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Monitor the liveliness of the nodes in a lockstep flight.

The monitor detects the loss of a peer by DDS liveliness, a watchdog inside the middleware.
"""

import time
from functools import partial
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from std_msgs.msg import String

from flight_ros.rclpy_private import take_messages
from flight_ros.topics import LIVELINESS, NODES

SHUTDOWN_GRACE_NS = 600_000_000
"""Time to wait for the report of a peer that has shut down. A peer sends a report if it shuts down
because it lost a role, and none if it ends for another reason."""

REPORT_TIMEOUT = Duration(seconds=0.2)
"""Longest wait until all peers have a report, after which the node ends. The lost peer never
acknowledges it."""

ROLES = NODES[:-1]  # all nodes except the bridge, which flies only in real time


class LivelinessMonitor:
    """Asserts the liveliness of a node on `alive/<role>` and monitors the other roles.

    The middleware sends the heartbeats. It reports the end of a process within the lease duration
    of `LIVELINESS`. For a process that ended before its first heartbeat, the report takes the lease
    duration of the participant, two seconds. A role can be lost only after it has appeared, because
    a flight may run without a recorder. The only message of a role is a report with the name of the
    lost role.
    """

    def __init__(self, node: Node, role: str) -> None:
        self._role = role
        # the first role whose heartbeats stopped, or which a peer reported as lost
        self._dead: str | None = None
        self._left: str | None = None  # the first role that shut down cleanly
        self._left_ns = 0
        self._publisher = node.create_publisher(String, f"alive/{role}", LIVELINESS)
        self._subscriptions = [
            node.create_subscription(
                String,
                f"alive/{peer}",
                self._on_report,
                LIVELINESS,
                event_callbacks=SubscriptionEventCallbacks(
                    liveliness=partial(self._on_liveliness, peer),
                    matched=partial(self._on_matched, peer),
                    use_default_callbacks=False,
                ),
            )
            for peer in ROLES
            if peer != role
        ]

    def lost_role(self) -> str | None:
        """Return the name of the lost role, or None if no role is lost.

        A role that shut down cleanly is taken as lost after SHUTDOWN_GRACE_NS. If a report names
        the role that ended first, this role is returned instead.
        """
        # the executor may serve a report only after the end of its publisher
        for subscription in self._subscriptions:
            for message, _ in take_messages(subscription, 1):
                self._on_report(message)
        if self._dead is not None or time.monotonic_ns() - self._left_ns < SHUTDOWN_GRACE_NS:
            return self._dead
        return self._left

    def report(self, role: str) -> None:
        """Publish the name of the lost role, so that all peers name the role that ended first."""
        self._publisher.publish(String(data=role))
        self._publisher.wait_for_all_acked(REPORT_TIMEOUT)

    def _on_report(self, message: String) -> None:
        if message.data in ROLES and message.data != self._role:
            self._dead = self._dead or message.data

    def _on_liveliness(self, role: str, event: Any) -> None:
        if event.alive_count > 0:  # alive, possibly as the role of a new flight
            self._dead = None if self._dead == role else self._dead
        elif event.not_alive_count_change > 0:
            self._dead = self._dead or role

    def _on_matched(self, role: str, event: Any) -> None:
        if event.current_count > 0:
            self._left = None if self._left == role else self._left
        elif event.current_count_change < 0 and self._left is None:
            self._left = role
            self._left_ns = time.monotonic_ns()
