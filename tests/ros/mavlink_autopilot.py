# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulate an autopilot with ArduPilot's MAVLink interface, as a process.

python -m tests.ros.mavlink_autopilot SCENARIO PORT

It simulates the aircraft section of the scenario, sends ATTITUDE, VFR_HUD and more to a UDP port of
this host at 50 Hz, and takes RC_CHANNELS_OVERRIDE of system 255: 0 releases a channel, 65535 leaves
it. It imports nothing from the bridge. It prints "ready", and "channels ROLL PITCH THROTTLE YAW",
us, whenever they change.
"""

import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario import load_scenario

SPEED = 25.0  # m/s, trim
PER_US = math.radians(30.0) / 500.0  # rad of a surface
STICKS = (1500, 1500, 1500, 1500)  # of the transmitter: roll, pitch, throttle, yaw
LEAVE = 65535
OVERRIDE_TIME = (b"RC_OVERRIDE_TIME", 0.5)  # s, the only parameter


def fly(scenario: Path, port: int) -> None:
    """Simulate and send until the process ends."""
    simulator = Simulator(load_scenario(scenario).aircraft)
    connection: Any = mavutil.mavlink_connection(
        f"udpout:127.0.0.1:{port}", source_system=1, source_component=1, dialect="ardupilotmega"
    )
    send = connection.mav
    period = simulator.period_ns / 1e9
    places = [simulator.truth_names.index(f"x.{name}") for name in ("q", "V", "p", "r")]
    begin = time.monotonic()
    number = 0
    channels = list(STICKS)
    print("ready", flush=True)
    while True:
        while (message := connection.recv_msg()) is not None:
            if message.get_type() == "COMMAND_LONG":
                send.command_ack_send(message.command, 0)
            elif message.get_type() == "PARAM_REQUEST_READ":
                send.param_value_send(
                    OVERRIDE_TIME[0], OVERRIDE_TIME[1], mavlink.MAV_PARAM_TYPE_REAL32, 1, 0
                )
            elif message.get_type() == "RC_CHANNELS_OVERRIDE" and message.get_srcSystem() == 255:
                pulses = [getattr(message, f"chan{k}_raw") for k in range(1, 5)]
                before = channels
                channels = [
                    STICKS[k] if us == 0 else before[k] if us == LEAVE else us
                    for k, us in enumerate(pulses)
                ]
                if channels != before:
                    print("channels", *channels, flush=True)
        roll, pitch, throttle, yaw = ((us - 1500) * PER_US for us in channels)
        simulator.sample(number, np.array([pitch, throttle / PER_US / 1000.0, roll, yaw]))
        q, V, p, r = simulator.truth()[places].tolist()
        ms = round(1e3 * number * period)
        send.attitude_send(ms, 0.0, 0.0, 0.0, p, q, r)
        send.vfr_hud_send(SPEED + V, SPEED + V, 0, 50, 100.0, 0.0)
        send.local_position_ned_send(ms, 0.0, 0.0, -100.0, SPEED, 0.0, 0.0)
        send.rc_channels_send(ms, 16, *channels, *[1500] * 14, 255)
        if number % 10 == 0:
            send.heartbeat_send(
                mavlink.MAV_TYPE_FIXED_WING, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 128, 0, 4
            )
            send.extended_sys_state_send(0, 2)
        number = max(number + 1, int((time.monotonic() - begin) / period))
        time.sleep(max(begin + number * period - time.monotonic(), 0.0))


if __name__ == "__main__":
    fly(Path(sys.argv[1]), int(sys.argv[2]))
