# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Euler's kinematics of bank and pitch, and their inverse in a coordinated turn. Angles in rad, rates in rad/s, body axes FRD.

Source: R. W. Beard, T. W. McLain, Small Unmanned Aircraft (2012), chapters 2, 3 and 9.
"""

import math

from flight_core.units import GRAVITY

MAX_TILT = math.radians(80.0)
"""Limit of phi in cos(phi) and of theta in tan(theta), which are singular at 90 deg."""


def euler_rates(phi: float, theta: float, p: float, q: float, r: float) -> tuple[float, float]:
    """phi_dot = p + tan(theta) (q sin(phi) + r cos(phi)) and theta_dot = q cos(phi) - r sin(phi)."""
    turn = q * math.sin(phi) + r * math.cos(phi)
    return p + math.tan(tilt(theta)) * turn, q * math.cos(phi) - r * math.sin(phi)


def turn_rate(phi: float, theta: float, theta_dot: float, speed: float) -> float:
    """R of a coordinated turn: psi_dot cos(phi) cos(theta) - theta_dot sin(phi), psi_dot = g tan(phi) / V; speed V in m/s."""
    phi = tilt(phi)
    return GRAVITY * math.tan(phi) / speed * math.cos(phi) * math.cos(theta) - theta_dot * math.sin(phi)


def body_rates(phi: float, theta: float, phi_dot: float, theta_dot: float, r: float) -> tuple[float, float]:
    """P and q that turn the attitude at these rates beside r, the inverse of `euler_rates`:

    q = (theta_dot + r sin(phi)) / cos(phi),  p = phi_dot - tan(theta) (q sin(phi) + r cos(phi))
    """  # noqa: D400, D415 - what follows is an equation
    phi = tilt(phi)
    q = (theta_dot + r * math.sin(phi)) / math.cos(phi)
    return phi_dot - math.tan(tilt(theta)) * (q * math.sin(phi) + r * math.cos(phi)), q


def tilt(angle: float) -> float:
    """An angle within +-MAX_TILT."""
    return min(max(angle, -MAX_TILT), MAX_TILT)
