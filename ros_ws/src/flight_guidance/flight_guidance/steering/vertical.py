# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the climb rate for an altitude, and the pitch for a climb rate."""

import math
from typing import NamedTuple

from flight_core.kinematics import clip
from flight_core.units import GRAVITY
from flight_core.vectors import Scalar, array_namespace
from flight_guidance.steering.protection import forward

STALL_ANGLE = 0.3
"""Angle of attack from zero lift to the stall, C_Lmax / C_Lalpha, rad. For a clean wing of aspect
ratio 7, C_Lmax is 1.45, and by lifting-line theory C_Lalpha is 4.9 1/rad."""


CLIMB_BANDWIDTH = 0.4
"""Bandwidth of the loop in which the airspeed controls the climb rate, 1/s. It is a third of the
osprey's bandwidth of V, where the second-order loop of V adds 2 atan(1/3) = 37 deg of lag."""


class VerticalParams(NamedTuple):
    """Gains and limits of the vertical loop."""

    k_h: float  # 1/s
    acceleration: float  # vertical acceleration a, of which `climb_for` uses half, m/s^2
    climb: float  # largest climb rate, m/s
    sink: float  # largest sink rate, m/s
    alpha_time: float  # time constant of the angle of attack's low-pass, s


def climb_for(error: Scalar, params: VerticalParams) -> Scalar:
    """Compute the climb rate, m/s, for an altitude error (command minus altitude), m.

        k_h e                                  if abs(e) <= e_l = a / (2 k_h^2)
        sign(e) sqrt(a (abs(e) - e_l / 2))     if abs(e) > e_l

    The result is limited to the range from -sink to climb. The two branches and their slopes agree
    at e_l. Far away the climb rate falls by a / 2 per second, which the aircraft can follow.
    """
    k_h = params.k_h
    a = params.acceleration
    near = a / (2.0 * k_h * k_h)
    xp = array_namespace(error)
    far = xp.copysign(xp.sqrt(a * xp.maximum(abs(error) - near / 2.0, 0.0)), error)
    return xp.minimum(
        xp.maximum(xp.where(abs(error) <= near, k_h * error, far), -params.sink), params.climb
    )


def slewed(value: Scalar, target: Scalar, rate: float, dt: float) -> Scalar:
    """Move a value towards a target by at most rate dt."""
    return value + clip(target - value, rate * dt)


def alpha_estimate(
    alpha: Scalar, theta: Scalar, climb: Scalar, speed: Scalar, dt: float, params: VerticalParams
) -> Scalar:
    """Advance the estimate of the angle of attack by a step, rad.

        alpha+ = alpha + (1 - exp(-dt/T)) (theta - gamma - alpha)

    The estimate is a low-pass of theta - gamma, where gamma = asin(climb / V). This filter replaces
    an integrator. It is bumpless, has no windup, and is correct at any bank, airspeed or trim.
    """
    return alpha + (1.0 - math.exp(-dt / params.alpha_time)) * (
        theta - path_angle(climb, speed) - alpha
    )


def pitch_for(climb: Scalar, speed: Scalar, alpha: Scalar) -> Scalar:
    """Compute the pitch for a climb rate, rad: theta_c = asin(climb / V) + alpha."""
    return path_angle(climb, speed) + alpha


def airspeed_increase_for(error: Scalar, speed: Scalar) -> Scalar:
    """Compute by how much to fly faster to correct an error of the climb rate, m/s.

    This serves an aircraft without an elevator. The increase is K V / (2 g) error. At a constant
    angle of attack the lift grows with V^2, so h_ddot = 2 g dV / V, and the error decays at K =
    CLIMB_BANDWIDTH.
    """
    return CLIMB_BANDWIDTH * speed / (2.0 * GRAVITY) * error


def path_lag(stall_speed: float, speed: float) -> float:
    """Compute by which time constant the flight path lags behind the pitch, s.

        T_L = V alpha_1 / g,  alpha_1 = 0.3 rad (V_s / V)^2

    alpha_1 is the angle of attack in level flight, measured from zero lift. Near level flight, V
    gamma_dot = g (alpha - alpha_1) / alpha_1.
    """
    return STALL_ANGLE * stall_speed**2 / (GRAVITY * speed)


def path_angle(climb: Scalar, speed: Scalar) -> Scalar:
    """Compute the flight path angle in the air mass, rad: asin(climb / V)."""
    return array_namespace(climb).asin(clip(climb / forward(speed), 1.0))
