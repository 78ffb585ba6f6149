# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Who else takes part in a lockstep flight, and whether they all live."""

import time
from functools import partial
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from std_msgs.msg import Empty

from flight_ros.topics import LIVELINESS

SHUTDOWN_GRACE_NS = 600_000_000
"""How much later a busy process may notice a death than another one that has left over it."""

ROLES = ("aircraft", "reference_model", "controller", "recorder")


class LivelinessMonitor:
    """A node of a lockstep flight shows on `alive/<role>` that it lives, and watches the others do.

    The middleware keeps the signs of life going, and notices within the lease of `LIVELINESS` that a process has gone, whatever
    ended it; where it went before its first sign of life, within the lease of its participant, two seconds. A role that was
    never seen is not missed: a flight may do without a recorder.
    """

    def __init__(self, node: Node, role: str) -> None:
        self._dead = ""  # the first role whose signs of life have stopped
        self._left = ""  # the first one that has taken its leave
        self._left_ns = 0
        self._publisher = node.create_publisher(Empty, f"alive/{role}", LIVELINESS)
        self._subscriptions = [
            node.create_subscription(
                Empty,
                f"alive/{other}",
                lambda _: None,
                LIVELINESS,
                event_callbacks=SubscriptionEventCallbacks(
                    liveliness=partial(self._changed, other), matched=partial(self._matched, other)
                ),
            )
            for other in ROLES
            if other != role
        ]

    def missing(self) -> str:
        """The role that was there and no longer is, empty where all are.

        One that has taken its leave may have done so because another died, which is then about to be noticed here too.
        """
        if self._dead or not self._left or time.monotonic_ns() - self._left_ns < SHUTDOWN_GRACE_NS:
            return self._dead
        return self._left

    def _changed(self, role: str, event: Any) -> None:
        if event.alive_count > 0:  # one of the role lives: perhaps a new one, after that of a flight before
            self._dead = "" if self._dead == role else self._dead
        elif event.not_alive_count_change > 0:
            self._dead = self._dead or role

    def _matched(self, role: str, event: Any) -> None:
        if event.current_count > 0:
            self._left = "" if self._left == role else self._left
        elif event.current_count_change < 0 and not self._left:
            self._left, self._left_ns = role, time.monotonic_ns()
