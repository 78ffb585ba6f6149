# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Convert a pose to odometry by REP 103.

The axes of the map frame are east, north and up. Those of the body frame are forward, left and up.
"""

import math
from collections.abc import Mapping

# Frames of REP 105, with axes east, north, up and forward, left, up.
MAP = "map"
BODY = "base_link"
ROUTE_FRAMES = (MAP, "")  # frames of a route that guidance takes


def quaternion(phi: float, theta: float, psi: float) -> tuple[float, float, float, float]:
    """Compute the orientation x, y, z, w of forward-left-up in east-north-up.

    The rotation is R_z(pi/2 - psi) R_y(-theta) R_x(phi), with angles in rad.
    """
    (cr, sr), (cp, sp), (cy, sy) = (
        (math.cos(angle / 2.0), math.sin(angle / 2.0))
        for angle in (phi, -theta, math.pi / 2.0 - psi)
    )
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def body_velocity(pose: Mapping[str, float]) -> tuple[float, float, float]:
    """Return the velocity over ground of a pose in the body frame, m/s: forward, left, up."""
    phi = pose["phi"]
    theta = pose["theta"]
    psi = pose["psi"]
    along = pose["v_north"] * math.cos(psi) + pose["v_east"] * math.sin(psi)
    right = pose["v_east"] * math.cos(psi) - pose["v_north"] * math.sin(psi)
    forward = along * math.cos(theta) + pose["climb"] * math.sin(theta)
    down = along * math.sin(theta) - pose["climb"] * math.cos(theta)
    return (
        forward,
        -right * math.cos(phi) - down * math.sin(phi),
        right * math.sin(phi) - down * math.cos(phi),
    )
