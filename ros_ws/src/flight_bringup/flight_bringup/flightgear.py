# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A pose as the packet FGNetFDM of FlightGear, version 24: 408 bytes, big-endian.

Source: FlightGear, src/Network/net_fdm.hxx.
"""

import math
import struct
from collections.abc import Mapping

from flight_core.units import FOOT
from flight_guidance.route_file import Origin, geographic

VERSION = 24
PACKET = struct.Struct(
    ">II3d"  # version, padding; longitude, latitude, rad, altitude above sea level, m
    "f3f2f3f"  # height above ground, m; phi, theta, psi; alpha, beta; their rates, rad and rad/s
    # calibrated airspeed, knots, climb, ft/s; velocity to the north, to the east and down, ft/s
    "2f3f3f3f2f"  # velocity and acceleration in body axes, ft/s and ft/s^2; stall warning, slip
    "I4I36f"  # engines: number, states, nine figures of four engines
    "I4fI3I9f"  # tanks; wheels
    "Iif10f"  # time, its warp, s; visibility, m; control surfaces, normalised
)
KNOT = 1852.0 / 3600.0  # m/s, exact
VISIBILITY = 20_000.0  # m
ENGINES = 1
RUNNING = 2
WHEELS = 3


def packet(pose: Mapping[str, float], origin: Origin, ground: float, seconds: int) -> bytes:
    """The packet of a pose, `channels.POSE` as far as known. `ground`: altitude of the origin, m;
    `seconds`: system time.
    """

    def value(name: str) -> float:
        return pose.get(name, 0.0)

    latitude, longitude = map(math.radians, geographic(value("north"), value("east"), origin))
    speed = math.hypot(value("v_north"), value("v_east"), value("climb"))
    return PACKET.pack(
        *(VERSION, 0, longitude, latitude, ground + value("altitude")),
        *(
            value("altitude"),
            value("phi"),
            value("theta"),
            value("psi"),
            0.0,
            value("beta"),
            0.0,
            0.0,
            0.0,
        ),
        *(
            speed / KNOT,
            value("climb") / FOOT,
            value("v_north") / FOOT,
            value("v_east") / FOOT,
            -value("climb") / FOOT,
        ),
        *(speed / FOOT, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        *(ENGINES, RUNNING, 0, 0, 0, *[0.0] * 36),
        *(0, *[0.0] * 4, WHEELS, 0, 0, 0, *[0.0] * 9),
        *(seconds, 0, VISIBILITY, *[0.0] * 10),
    )
