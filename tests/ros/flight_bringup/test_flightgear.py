# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The way of the pose to FlightGear over UDP; tests/nodes/flight_bringup/test_flightgear.py has its
packet.
"""

import socket
import time

import numpy as np
from tests.nodes.flight_bringup.test_flightgear import FLOWN, fields
from tests.ros.conftest import Start
from tests.ros.peer import Peer

from flight_ros.messages import Encoder
from flight_ros.topics import POSE


def test_pose_of_flight_reaches_flightgear(start: Start, peer_node: Peer) -> None:
    publisher = peer_node.node.create_publisher(POSE.type, "/uav1/pose", 10)
    encoder = Encoder([*FLOWN], "/uav1/aircraft#1")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as viewer:
        viewer.bind(("127.0.0.1", 0))
        viewer.setblocking(False)
        received: list[bytes] = []

        def send() -> None:
            publisher.publish(encoder.encode(time.time_ns(), np.array([*FLOWN.values()])))
            try:
                received.append(viewer.recv(1000))
            except BlockingIOError:
                return

        words = (
            "--set",
            "origin=47.38,8.54",
            "--set",
            "altitude=400",
            f"--flightgear=127.0.0.1:{viewer.getsockname()[1]}",
        )
        command = start("flight_cli.cli", "watch", "--namespace", "uav1", *words)
        peer_node.until(lambda: bool(received), "a packet for FlightGear", each=send)
    assert [fields(raw)["altitude"] for raw in received] == [450.0]  # m above sea level
    command.interrupt()
    assert command.end() == 130
    assert "Traceback" not in command.output
