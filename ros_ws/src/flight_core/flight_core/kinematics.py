# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Euler's kinematics of bank and pitch, and their inverse in a coordinated turn.

Angles are in rad, rates in rad/s, and body axes are FRD. Arguments are Python floats, or arrays
with a value for each aircraft of a fleet. Source: R. W. Beard, T. W. McLain, Small Unmanned
Aircraft (2012), chapters 2, 3 and 9.
"""

import math

from flight_core.units import GRAVITY
from flight_core.vectors import Scalar, array_namespace

MAX_TILT = math.radians(80.0)
"""Limit of an angle in a tangent, or in a cosine that is a divisor. At 90 deg both would be
infinite."""


def euler_rates(
    phi: Scalar, theta: Scalar, p: Scalar, q: Scalar, r: Scalar
) -> tuple[Scalar, Scalar]:
    """Compute the rates of bank and pitch, rad/s.

    phi_dot = p + tan(theta) (q sin(phi) + r cos(phi)), theta_dot = q cos(phi) - r sin(phi).
    """
    xp = array_namespace(phi)
    turn = q * xp.sin(phi) + r * xp.cos(phi)
    return p + xp.tan(tilt(theta)) * turn, q * xp.cos(phi) - r * xp.sin(phi)


def heading_rate(phi: Scalar, theta: Scalar, q: Scalar, r: Scalar) -> Scalar:
    """Compute the rate of the heading, rad/s: psi_dot = (q sin(phi) + r cos(phi)) / cos(theta).

    Source: Stevens, Lewis, eq. (1.3-22).
    """
    xp = array_namespace(phi)
    return (q * xp.sin(phi) + r * xp.cos(phi)) / xp.cos(tilt(theta))


def turn_rate(phi: Scalar, theta: Scalar, theta_dot: Scalar, speed: Scalar) -> Scalar:
    """Compute the yaw rate r of a coordinated turn, rad/s, at the speed V in m/s.

    r = psi_dot cos(phi) cos(theta) - theta_dot sin(phi), psi_dot = g tan(phi) / V.
    """
    xp = array_namespace(phi)
    phi = tilt(phi)
    return GRAVITY * xp.tan(phi) / speed * xp.cos(phi) * xp.cos(theta) - theta_dot * xp.sin(phi)


def body_rates(
    phi: Scalar, theta: Scalar, phi_dot: Scalar, theta_dot: Scalar, r: Scalar
) -> tuple[Scalar, Scalar]:
    """Compute p and q from r and the rates of the attitude, as the inverse of `euler_rates`.

    q = (theta_dot + r sin(phi)) / cos(phi),  p = phi_dot - tan(theta) (q sin(phi) + r cos(phi))
    """
    xp = array_namespace(phi)
    phi = tilt(phi)
    q = (theta_dot + r * xp.sin(phi)) / xp.cos(phi)
    return phi_dot - xp.tan(tilt(theta)) * (q * xp.sin(phi) + r * xp.cos(phi)), q


def thrust_axis(phi: float, theta: float, psi: float) -> tuple[float, float, float]:
    """Return the unit vector of a thrust along the negative body z axis: north, east and up.

    The third column of the rotation from the body axes to north, east and down is the body z axis.
    The result is the opposite vector, with up in place of down. Source: Stevens, Lewis, eq.
    (1.3-20).
    """
    back = math.cos(phi) * math.sin(theta)
    right = math.sin(phi)
    north = -back * math.cos(psi) - right * math.sin(psi)
    east = -back * math.sin(psi) + right * math.cos(psi)
    return north, east, math.cos(phi) * math.cos(theta)


def tilt(angle: Scalar) -> Scalar:
    """Limit an angle to the range from -MAX_TILT to MAX_TILT."""
    return clip(angle, MAX_TILT)


def clip(value: Scalar, limit: Scalar) -> Scalar:
    """Limit a value to the range from -limit to limit."""
    xp = array_namespace(value)
    return xp.minimum(xp.maximum(value, -limit), limit)
