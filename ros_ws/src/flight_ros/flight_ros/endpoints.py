# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check the compatibility of the publishers and subscribers of a topic.

Message type and quality of service (QoS) must match.
"""

import os
import time
from collections.abc import Iterable, Sequence

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo, TopicEndpointTypeEnum

from flight_core.outcome import Refusal
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS
from flight_core.text import bounded
from flight_ros.subscriptions import PolledSubscription
from flight_ros.throttle import Throttle
from flight_ros.topics import CLOCK, RECORDED, START, Y

DISCOVERY_POLL_PERIOD = 0.02  # s
# topics that a single node must publish: y, and those whose messages do not name their publisher
OF_ONE_NODE = (Y, START, RECORDED, CLOCK)
LOG_PERIOD_NS = 5 * NANOSECONDS  # time between two log lines on one mismatch


def type_name(message: type) -> str:
    """Return the name of a message class in the ROS graph, such as sensor_msgs/msg/JointState."""
    return f"{message.__module__.split('.')[0]}/msg/{message.__name__}"


def require_no_publishers(
    node: Node, topics: Iterable[str], expected: str, duration: float = 0.0
) -> None:
    """Raise ParameterError if a topic already has a publisher.

    The topics are watched for `duration`, s, because publishers are not discovered at once.
    `expected` says in the error what to do.
    """
    end = time.monotonic() + duration
    names = [node.resolve_topic_name(topic) for topic in topics]
    domain = f"ROS_DOMAIN_ID {os.environ.get('ROS_DOMAIN_ID', '0')}"
    while True:
        for name in names:
            count = node.count_publishers(name)
            require(count == 0, domain, f"{count} publishers of {name} already", expected)
        if time.monotonic() >= end:
            return
        time.sleep(DISCOVERY_POLL_PERIOD)


def mismatch(peer: TopicEndpointInfo, message_type: str, qos: QoSProfile) -> Refusal | None:
    """Say why a peer cannot exchange messages with a local endpoint of this type and QoS."""
    node = f"{peer.node_namespace.rstrip('/')}/{peer.node_name}"
    publishes = peer.endpoint_type == TopicEndpointTypeEnum.PUBLISHER
    verb = "publishes" if publishes else "subscribes"
    if peer.topic_type != message_type:
        return Refusal(
            f"{node} {verb}{'' if publishes else ' to'} {peer.topic_type}, expected {message_type}"
        )
    offered, requested = (peer.qos_profile, qos) if publishes else (qos, peer.qos_profile)
    compatibility, reason = qos_check_compatible(offered, requested)
    if compatibility != QoSCompatibility.ERROR:
        return None
    return Refusal(f"{node} {verb} with incompatible quality of service: {reason}")


class EndpointMonitor:
    """Logs an error for each peer that does not match a node and thus would stay silent."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._throttle = Throttle(LOG_PERIOD_NS)

    def mismatches(self, subscription: PolledSubscription) -> list[Refusal]:
        """Return a refusal for each publisher whose type or QoS does not fit a subscription."""
        kind = type_name(subscription.topic.type)
        peers = self._node.get_publishers_info_by_topic(subscription.name)
        return [refusal for peer in peers if (refusal := mismatch(peer, kind, subscription.qos))]

    def reason_against_publishers(self, subscription: PolledSubscription) -> Refusal | None:
        """Refuse publishers with different names on a topic that a single node must publish.

        A restarted node keeps its name, so it is not refused.
        """
        if subscription.topic not in OF_ONE_NODE:
            return None
        peers = self._node.get_publishers_info_by_topic(subscription.name)
        names = sorted({f"{peer.node_namespace.rstrip('/')}/{peer.node_name}" for peer in peers})
        if len(names) < 2:
            return None
        return Refusal(f"published by {', '.join(names)}, expected one node")

    def check_publishers(self, subscription: PolledSubscription) -> None:
        """Log an error for each publisher that does not match a subscription of the node.

        An error is also logged if several nodes publish a topic that a single node must publish.
        """
        refusals = [*self.mismatches(subscription), self.reason_against_publishers(subscription)]
        self._log(subscription.name, refusals)

    def check_subscribers(self, publisher: Publisher) -> None:
        """Log an error for each subscriber that does not match a publisher of the node."""
        topic = publisher.topic_name
        # The QoS of the publisher is taken from the graph, which reports it in the same terms as
        # that of the subscribers. A new publisher is not in the graph yet, so it is checked later.
        for endpoint in self._node.get_publishers_info_by_topic(topic):
            if endpoint.node_name == self._node.get_name():
                peers = self._node.get_subscriptions_info_by_topic(topic)
                self._log(
                    topic,
                    [mismatch(peer, endpoint.topic_type, endpoint.qos_profile) for peer in peers],
                )
                return

    def _log(self, topic: str, refusals: Sequence[Refusal | None]) -> None:
        for refusal in refusals:
            if refusal and self._throttle.is_due(f"{topic}: {refusal}"):
                self._node.get_logger().error(bounded(f"{topic}: {refusal}"))
