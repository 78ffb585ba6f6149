# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The pose in FlightGear: its packet by the places of net_fdm.hxx, version 24, and its way over UDP."""

import math
import socket
import struct
import time

import numpy as np
import pytest
from tests.ros.conftest import Start
from tests.ros.peer import Peer

from flight_bringup.flightgear import packet
from flight_guidance.route_file import Origin, geographic, local
from flight_ros.messages import Encoder
from flight_ros.topics import POSE

pytestmark = pytest.mark.package("flight_bringup")

ORIGIN = Origin(47.38, 8.54)
FLOWN = {
    "phi": 0.1,
    "theta": 0.2,
    "psi": -1.0,
    "north": 300.0,
    "east": -40.0,
    "altitude": 50.0,
    "climb": 3.048,
    "v_north": 18.52,
}


def fields(raw: bytes) -> dict[str, float]:
    """Fields by offset: of a C compiler and of flightgear-python 2.1.0, which read this packet alike."""
    assert len(raw) == 408
    places = {"version": ("I", 0), "longitude": ("d", 8), "latitude": ("d", 16), "altitude": ("d", 24)}
    places |= {name: ("f", at) for name, at in (("phi", 36), ("theta", 40), ("psi", 44), ("climb", 72), ("v_north", 76))}
    places |= {"engines": ("I", 120), "tanks": ("I", 284), "wheels": ("I", 304), "time": ("I", 356), "visibility": ("f", 364)}
    return {name: struct.unpack_from(f">{kind}", raw, at)[0] for name, (kind, at) in places.items()}


def test_packet_has_fields_in_places_and_units_of_flightgear() -> None:
    found = fields(packet(FLOWN, ORIGIN, 400.0, 1_700_000_000))
    north, east = local(math.degrees(found["latitude"]), math.degrees(found["longitude"]), ORIGIN)
    assert (north, east, found["altitude"]) == pytest.approx((300.0, -40.0, 450.0), abs=1e-6)
    assert (found["phi"], found["theta"], found["psi"]) == pytest.approx((0.1, 0.2, -1.0))
    assert (found["climb"], found["v_north"]) == pytest.approx((10.0, 18.52 / 0.3048))  # ft/s
    numbers = {name: found[name] for name in ("version", "engines", "tanks", "wheels", "time", "visibility")}
    assert numbers == {"version": 24, "engines": 1, "tanks": 0, "wheels": 3, "time": 1_700_000_000, "visibility": 20_000.0}


@pytest.mark.parametrize("origin", [ORIGIN, Origin(-75.0, 179.99), Origin(0.0, 0.0)])
def test_geographic_is_inverse_of_local(origin: Origin) -> None:
    there = geographic(20_000.0, -30_000.0, origin)
    assert local(there.latitude, there.longitude, origin) == pytest.approx((20_000.0, -30_000.0), abs=1e-3)


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

        words = ("--origin", "47.38,8.54", "--altitude", "400", "--to", f"127.0.0.1:{viewer.getsockname()[1]}")
        command = start("flight_cli.cli", "flightgear", "--namespace", "uav1", *words)
        peer_node.until(lambda: bool(received), each=send)
    assert fields(received[0])["altitude"] == 450.0
    command.interrupt()
    assert command.end() == 130
    assert "Traceback" not in command.output
