# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Share a link between the bridge and a ground station, and cut it.

It is started in the autopilot's network: `python -m tests.sitl.shared_link SOCKET`. Bytes pass
between the autopilot's second serial port (TCP) and the bridge (UDP). The station sends a heartbeat
each second, both ways. The datagrams on SOCKET are `cut`, `join`, `silence`, `speak` and `take`.
The last one requests 4 Hz of all messages, as MAVProxy does.
"""

import select
import socket
import sys
import time
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

AUTOPILOT = ("127.0.0.1", 5763)
BRIDGE = ("127.0.0.1", 14551)
STATION = 253  # its system
TAKEN = 4  # Hz, the default of MAVProxy
BEAT = 1.0  # s


def main(path: str) -> None:
    """Pass the bytes on until the process ends."""
    control = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    control.bind(path)
    autopilot = socket.create_connection(AUTOPILOT, 5.0)
    autopilot.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    bridge = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bridge.bind(("127.0.0.1", 0))
    station = mavlink.MAVLink(
        None, srcSystem=STATION, srcComponent=mavlink.MAV_COMP_ID_MISSIONPLANNER
    )
    beat: Any = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3
    )
    take: Any = mavlink.MAVLink_request_data_stream_message(
        1, 1, mavlink.MAV_DATA_STREAM_ALL, TAKEN, 1
    )
    is_joined = speaks = True
    sent_at = 0.0
    print("ready", flush=True)
    while True:
        readable, _, _ = select.select([control, autopilot, bridge], [], [], 0.1)
        if control in readable:
            word = control.recv(100).decode()
            is_joined = {"cut": False, "join": True}.get(word, is_joined)
            speaks = {"silence": False, "speak": True}.get(word, speaks)
            if word == "take":
                autopilot.sendall(take.pack(station))
        if autopilot in readable and (received := autopilot.recv(4096)) and is_joined:
            bridge.sendto(received, BRIDGE)
        if bridge in readable and (answered := bridge.recv(4096)) and is_joined:
            autopilot.sendall(answered)
        if speaks and time.monotonic() - sent_at > BEAT:
            sent_at = time.monotonic()
            autopilot.sendall(beat.pack(station))
            if is_joined:
                bridge.sendto(beat.pack(station), BRIDGE)


if __name__ == "__main__":
    main(sys.argv[1])
