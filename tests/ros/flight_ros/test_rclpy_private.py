# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the private parts of rclpy in use do the same as its public interface."""

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Empty, Int64
from tests.ros.peer import Peer

from flight_ros import rclpy_private


def test_messages_participants_and_callbacks_without_an_executor(peer_node: Peer) -> None:
    context = peer_node.node.context
    participant = rclpy_private.create_participant("_early", context)
    peer_node.until(lambda: "_early" in peer_node.node.get_node_names(), "the participant")
    rclpy_private.destroy_participant(participant)
    peer_node.until(lambda: "_early" not in peer_node.node.get_node_names(), "no participant")

    subscription = peer_node.node.create_subscription(
        Int64, "number", lambda _: None, QoSProfile(depth=10), raw=True
    )
    publish = peer_node.node.create_publisher(Int64, "number", QoSProfile(depth=10)).publish
    wait_set = rclpy_private.WaitSet([subscription], context)
    assert not wait_set.wait(0)
    peer_node.until(lambda: peer_node.node.count_subscribers("number") == 1, "the subscription")
    peer_node.until(
        lambda: wait_set.wait(1_000_000),
        "a message",
        each=lambda: publish(serialize_message(Int64(data=7))),
    )
    raw, information = rclpy_private.take_messages(subscription, 1)[0]
    assert deserialize_message(raw, Int64).data == 7
    assert information["source_timestamp"] <= information["received_timestamp"]

    node = Node("served", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def fail(_: Empty) -> None:
        raise RuntimeError("of the callback")

    node.create_subscription(Empty, "call", fail, QoSProfile(depth=1))
    publisher = peer_node.node.create_publisher(Empty, "call", QoSProfile(depth=1))
    while (execute := rclpy_private.ready_callback(executor)) is not None:
        execute()  # what rclpy itself has to do for a new node
    raised: list[str] = []

    def look() -> None:
        publisher.publish(Empty())
        if (execute := rclpy_private.ready_callback(executor)) is not None:
            try:
                execute()
            except RuntimeError as error:
                raised.append(str(error))

    peer_node.until(lambda: "of the callback" in raised, "the exception of the callback", each=look)
    node.destroy_node()
