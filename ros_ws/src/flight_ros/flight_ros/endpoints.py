# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compatibility of the publishers and subscribers of a topic: message type and quality of service (QoS)."""

from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo, TopicEndpointTypeEnum


def type_name(message: type) -> str:
    """Name of a message class in the ROS graph, e.g. sensor_msgs/msg/JointState."""
    return f"{message.__module__.split('.')[0]}/msg/{message.__name__}"


def mismatch(topic: str, peer: TopicEndpointInfo, message_type: str, qos: QoSProfile | None) -> str:
    """Why a peer exchanges no messages with a local endpoint of this message type and QoS; empty if both match.

    Without a QoS only the message type is compared.
    """
    node = f"{peer.node_namespace.rstrip('/')}/{peer.node_name}"
    publishes = peer.endpoint_type == TopicEndpointTypeEnum.PUBLISHER
    verb = "publishes" if publishes else "subscribes"
    if peer.topic_type != message_type:
        return f"{topic}: {node} {verb}{'' if publishes else ' to'} {peer.topic_type}, expected {message_type}"
    if qos is not None:
        offered, requested = (peer.qos_profile, qos) if publishes else (qos, peer.qos_profile)
        compatibility, reason = qos_check_compatible(offered, requested)
        if compatibility == QoSCompatibility.ERROR:
            return f"{topic}: {node} {verb} with incompatible quality of service: {reason}"
    return ""
