# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the pose of the aircraft: attitude, position and velocity over ground.

Its values are absolute, not deviations from trim. Guidance and the log use the pose. The position
is in a local tangent plane. Its origin is below the aircraft at t = 0, unless a scenario starts the
aircraft elsewhere. A steady wind moves the air mass as a whole. So the flight relative to the air
is the same as in still air, and only the pose includes the wind (Galilean invariance).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flight_core.channels import POSE
from flight_core.vectors import FloatArray, Scalar, array_namespace

PSI, NORTH, V_NORTH = (POSE.index(name) for name in ("psi", "north", "v_north"))

RATE = 50.0
"""Highest rate of pose if `pose.rate` is not given, Hz. The aircraft publishes pose at every k-th
instant, with the least k for which the rate is not higher."""


def every(rate: float) -> int:
    """Return k if every k-th sample of an aircraft at the rate `rate`, Hz, has a pose."""
    return max(1, math.ceil(rate / RATE))


def wrapped(angle: float) -> float:
    """Return an angle wrapped to (-pi, pi], rad."""
    return angle - 2.0 * math.pi * math.ceil(angle / (2.0 * math.pi) - 0.5)


def velocity(
    speed: Scalar, alpha: Scalar, beta: Scalar, phi: Scalar, theta: Scalar, psi: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """Compute the velocity to the north, to the east and up, m/s.

    `speed` is the airspeed, m/s, and the angles are in rad:

        [v_north, v_east, -climb] = R_z(psi) R_y(theta) R_x(phi) V [cos(alpha) cos(beta), sin(beta),
        sin(alpha) cos(beta)]

    Source: B. L. Stevens, F. L. Lewis, Aircraft Control and Simulation, 2nd ed. (2003), eqs.
    (1.3-20), (2.3-6).
    """
    xp = array_namespace(phi)
    sin = xp.sin
    cos = xp.cos
    u = speed * cos(alpha) * cos(beta)
    v = speed * sin(beta)
    w = speed * sin(alpha) * cos(beta)
    right = v * cos(phi) - w * sin(phi)
    down = v * sin(phi) + w * cos(phi)
    forward = u * cos(theta) + down * sin(theta)
    climb = u * sin(theta) - down * cos(theta)
    north = cos(psi)
    east = sin(psi)
    return forward * north - right * east, forward * east + right * north, climb


class Start(NamedTuple):
    """Where the aircraft is at t = 0, to the north and to the east, m, and its heading, rad."""

    north: float = 0.0
    east: float = 0.0
    heading: float = 0.0


def over_ground(pose: FloatArray, t: float, wind: Sequence[float], start: Start) -> FloatArray:
    """Convert a pose relative to the air mass into a pose over ground, after t s of steady wind.

    The wind is in m/s to the north and to the east. The given pose belongs to a flight that starts
    at the origin and heads north. The pose is rotated by the heading at the start, and moved to the
    place of the start.
    """
    values = pose.tolist()
    if start.heading:
        sin = math.sin(start.heading)
        cos = math.cos(start.heading)
        for i in (NORTH, V_NORTH):
            north, east = values[i : i + 2]
            values[i : i + 2] = cos * north - sin * east, sin * north + cos * east
        values[PSI] = wrapped(values[PSI] + start.heading)
    for i, (speed, place) in enumerate(zip(wind, (start.north, start.east), strict=True)):
        values[NORTH + i] += place + speed * t
        values[V_NORTH + i] += speed
    return np.array(values)
