# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Command the guidance of a running flight, for `rise-di guide` and the live page."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import NoReturn

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseStamped
from nav_msgs.msg import Path
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from std_srvs.srv import Trigger

from flight_core.outcome import Refusal
from flight_core.parameters import ParameterError
from flight_guidance.guidance_state import TARGETS
from flight_guidance.odometry import MAP
from flight_ros.client import Client
from flight_ros.messages import Encoder, NamedDecoder
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import (
    GUIDANCE,
    NEWEST_SAMPLES,
    PUBLISH,
    RECORD_FOREIGN,
    ROSOUT,
    ROUTE,
    TARGET,
    Topic,
)

TARGET_TIMEOUT = 3.0  # s, longest wait until guidance takes a target at one of its ticks
TARGET_PERIOD = 0.2  # s, time between two equal targets
# s, time between two targets without channels, which keep the operator's link alive
LINK_PERIOD = 1.0
REFUSED = "sample refused: "  # text before the reason in the log of a node
ROUTE_TIMEOUT = 3.0  # s, longest wait until the middleware of guidance confirms a route
ROUTE_POLL_PERIOD = Duration(seconds=0.05)
NAME = "guidance"


class GuidanceClient(Client):
    """Sends commands to the guidance of a running flight.

    Each method returns the reason if guidance refuses its command, and None if not.
    """

    def __init__(
        self, name: str = "operator", namespace: str = "", parent: Client | None = None
    ) -> None:
        super().__init__(name, namespace, parent)
        self._guidance = PolledSubscription(self._node, GUIDANCE, NEWEST_SAMPLES, raw=True)
        self._decoder = NamedDecoder()
        self._log = PolledSubscription(self._node, ROSOUT, RECORD_FOREIGN)

    def call(self, service: str) -> Refusal | None:
        """Call a service of guidance that has no arguments: hold, skip, resume or home."""
        message = self._call(
            Trigger, f"{NAME}/{service}", Trigger.Request(), "a flight with guidance"
        ).message
        return Refusal(str(message)) if message else None

    def send_route(self, points: Sequence[Sequence[float]]) -> Refusal | None:
        """Publish a route of waypoints, each north, east and altitude in m."""
        places = [
            Point(x=float(east), y=float(north), z=float(altitude))
            for north, east, altitude in points
        ]
        route = Path(poses=[PoseStamped(pose=Pose(position=place)) for place in places])
        route.header.frame_id = MAP
        publisher = self._node.create_publisher(ROUTE.type, ROUTE.name, PUBLISH)
        try:
            subscribed = (
                f"{publisher.topic_name}: no subscriber, expected a flight with "
                "guidance in this domain"
            )
            self._spin_until(lambda: self._is_matched_by_guidance(publisher), subscribed)
            self._log.take()
            publisher.publish(route)
            unconfirmed = f"guidance did not confirm its reception in {ROUTE_TIMEOUT:g} s"
            self._spin_until(
                lambda: publisher.wait_for_all_acked(ROUTE_POLL_PERIOD), unconfirmed, ROUTE_TIMEOUT
            )
            return self._reason_against(ROUTE, lambda: self._has_taken({"leg": 0.0}), None)
        finally:
            # A guidance node that starts later must not receive the route and fly it.
            self._node.destroy_publisher(publisher)

    def _is_matched_by_guidance(self, publisher: Publisher) -> bool:
        """Return whether guidance is among the matched subscribers of a topic.

        The result is False as long as a subscriber in the graph is not matched.
        """
        names = [
            endpoint.node_name
            for endpoint in self._node.get_subscriptions_info_by_topic(publisher.topic_name)
        ]
        return NAME in names and len(names) <= publisher.get_subscription_count()

    def _reason_against(
        self, topic: Topic, is_taken: Callable[[], bool], unknown: Refusal | None
    ) -> Refusal | None:
        """Wait until guidance has taken a message or refused it; return the reason of a refusal.

        Returns None if guidance has taken the message. Returns `unknown` if guidance has neither
        taken nor refused the message within TARGET_TIMEOUT.
        """
        reasons: list[Refusal] = []

        def is_answered() -> bool:
            if is_taken():
                reasons.clear()
                return True
            reasons.extend(self._refusals(topic))
            return bool(reasons)

        try:
            self._spin_until(is_answered, "", TARGET_TIMEOUT)
        except ParameterError:
            if self._cancelled.is_set():
                raise
            return unknown
        return reasons[-1] if reasons else None

    def _refusals(self, topic: Topic) -> list[Refusal]:
        """Return why guidance has refused messages of a topic since the last call.

        The reasons come from the log of the nodes.
        """
        texts = [
            arrival.message.msg
            for arrival in self._log.take()
            if arrival.message.name.split(".")[-1] == NAME
        ]
        parts = [text.partition(REFUSED) for text in texts]
        namespace = self._node.get_namespace().rstrip("/")
        return [
            Refusal(reason)
            for before, _, reason in parts
            if reason and before == f"{namespace}/{topic.name}: "
        ]

    def _has_taken(self, values: Mapping[str, float]) -> bool:
        """Return whether guidance has logged these commands since the last call."""
        mask = sum(1 << TARGETS.index(name) for name in values)

        def has_taken(sample: Mapping[str, float]) -> bool:
            is_new = int(sample.get("given", 0.0)) & mask == mask
            return is_new and all(
                sample.get(f"target.{name}") == value for name, value in values.items()
            )

        return any(map(has_taken, self._received()))

    def _received(self) -> list[dict[str, float]]:
        """Return the channels of the samples of `guidance` since the last call."""
        return [sample.channels for sample in self._decoded(self._guidance, self._decoder.decode)]


class TargetClient(GuidanceClient):
    """Sends targets to guidance, and keeps the operator's link alive."""

    def __init__(self, namespace: str = "", parent: Client | None = None) -> None:
        super().__init__("operator", namespace, parent)
        self._publisher = self._node.create_publisher(TARGET.type, TARGET.name, PUBLISH)
        self._last_sending = -TARGET_PERIOD  # monotonic time of the last target, s
        self._silent = (
            f"{self._guidance.name}: not received, expected a flight with guidance in this domain"
        )

    def send(self, values: Mapping[str, float]) -> Refusal | None:
        """Publish commands by channel until guidance has taken them.

        Returns the reason if guidance refuses them, else None.
        """
        self._spin_until(lambda: bool(self._received()), self._silent)
        self._log.take()
        unknown = Refusal(f"guidance did not take them in {TARGET_TIMEOUT:g} s; its log says why")
        return self._reason_against(TARGET, lambda: self._published(values), unknown)

    def keep_link(self) -> None:
        """Publish a target without channels, to tell guidance that an operator is there."""
        self._publish({})

    def hold_link(self) -> NoReturn:
        """Keep the operator's link alive by a message every LINK_PERIOD.

        Raises ParameterError if no guidance flies in the domain.
        """
        while True:
            self._spin_until(lambda: bool(self._received()), self._silent)
            self.keep_link()
            time.sleep(LINK_PERIOD)

    def _published(self, values: Mapping[str, float]) -> bool:
        if time.monotonic() - self._last_sending > TARGET_PERIOD:
            self._last_sending = time.monotonic()
            self._publish(values)
        return self._has_taken(values)

    def _publish(self, values: Mapping[str, float]) -> None:
        encoder = Encoder([*values], self._node.get_fully_qualified_name())
        self._publisher.publish(encoder.encode(time.time_ns(), np.array([*values.values()])))
