# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What the stack takes from inside rclpy does what the public interface beside it does."""

import ast
from pathlib import Path

import pytest
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Empty, Int64
from tests.conftest import REPOSITORY
from tests.ros.peer import Peer

from flight_ros import rclpy_private

pytestmark = pytest.mark.package("flight_ros")

SOURCES = REPOSITORY / "ros_ws" / "src"
FILES = sorted(path for path in SOURCES.glob("*/**/*.py") if path.name != "rclpy_private.py")


def test_private_names_of_rclpy_are_in_one_file() -> None:
    files = [str(path.relative_to(SOURCES)) for path in FILES if has_private_names(path)]
    assert not files, "\n".join(files)


def has_private_names(path: Path) -> bool:
    """Whether a file imports rclpy.impl, or reads a `handle` beside an import of rclpy."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    modules = [node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    reads_handle = any(isinstance(node, ast.Attribute) and node.attr == "handle" for node in nodes)
    return any(name.startswith("rclpy.impl") or (name.startswith("rclpy") and reads_handle) for name in modules)


def test_serialised_message_taken_without_executor(peer_node: Peer) -> None:
    context = peer_node.node.context
    subscription = peer_node.node.create_subscription(Int64, "number", lambda _: None, QoSProfile(depth=10), raw=True)
    publish = peer_node.node.create_publisher(Int64, "number", QoSProfile(depth=10)).publish
    wait_set = rclpy_private.WaitSet([subscription], context)
    assert not wait_set.wait(0)
    peer_node.until(lambda: peer_node.node.count_subscribers("number") == 1, "the subscription")
    peer_node.until(lambda: wait_set.wait(1_000_000), "a message", each=lambda: publish(serialize_message(Int64(data=7))))
    raw, information = rclpy_private.take_messages(subscription, 1)[0]
    assert deserialize_message(raw, Int64).data == 7
    assert information["source_timestamp"] <= information["received_timestamp"]


def test_bytes_that_are_no_message_raise_error_that_nodes_catch() -> None:
    with pytest.raises(rclpy_private.DeserializationError):
        deserialize_message(b"\x00", Int64)


def test_participant_is_in_graph_until_it_destroyed(peer_node: Peer) -> None:
    participant = rclpy_private.create_participant("_early", peer_node.node.context)
    peer_node.until(lambda: "_early" in peer_node.node.get_node_names(), "the participant")
    rclpy_private.destroy_participant(participant)
    peer_node.until(lambda: "_early" not in peer_node.node.get_node_names(), "no participant")


def test_ready_callback_executed_and_raises_what_it_raises(peer_node: Peer) -> None:
    context: Context = peer_node.node.context
    node = Node("served", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def fail(_: Empty) -> None:
        raise RuntimeError("of the callback")

    node.create_subscription(Empty, "call", fail, QoSProfile(depth=1))
    publisher = peer_node.node.create_publisher(Empty, "call", QoSProfile(depth=1))
    while (execute := rclpy_private.ready_callback(executor)) is not None:
        execute()  # what rclpy itself has to do for a new node
    found = []

    def look() -> None:
        publisher.publish(Empty())
        if (execute := rclpy_private.ready_callback(executor)) is not None:
            try:
                execute()
            except RuntimeError as error:
                found.append(str(error))

    peer_node.until(lambda: bool(found), "the exception of the callback", each=look)
    assert found[0] == "of the callback"
    node.destroy_node()
