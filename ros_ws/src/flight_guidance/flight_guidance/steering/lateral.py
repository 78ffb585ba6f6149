# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the acceleration to the right that holds a heading or course, or follows a path.

The bank follows from this acceleration.
"""

import math
from typing import NamedTuple

from flight_core.kinematics import clip
from flight_core.units import GRAVITY
from flight_core.vectors import Scalar, array_namespace
from flight_guidance import reach
from flight_guidance.steering.protection import forward

# Largest fraction of a turn that may be lost by sideslip. The fraction is 0.09 for the f16 of
# JSBSim in an orbit, with the rudder at its stop.
LARGEST_SLIP = 0.2

HEADING_TIME = 2.0
"""Time constant of `heading_estimate`, s. It covers ten poses of a receiver of 5 Hz. With it, a
gyro bias of 1 mrad/s causes an error of the heading of 0.1 deg."""


class PathError(NamedTuple):
    """Position of the aircraft relative to a path."""

    e: Scalar  # cross-track error, m, positive to the right of the path
    track: Scalar  # course of the path at its nearest point, rad
    curvature: Scalar  # curvature of the path at this point, 1/m, positive to the right


class PathParams(NamedTuple):
    """Parameters of path following."""

    period: float  # P, s
    damping: float  # zeta, without unit
    capture: float  # rad, largest angle to the path at which the aircraft approaches it


def turn_towards(difference: Scalar) -> Scalar:
    """Return how hard to turn towards a course, from -1 to 1, given the difference of courses, rad.

    Up to 90 deg it is the sine of the difference, and beyond that 1 with the sign of the sine. With
    the sine alone, an aircraft on the opposite course would not turn.
    """
    xp = array_namespace(difference)
    sine = xp.sin(difference)
    return xp.where(xp.cos(difference) > 0.0, sine, xp.copysign(1.0, sine))


def heading_estimate(psi: float, measured: float | None, psi_dot: float, dt: float) -> float:
    """Advance the estimated heading by a step, rad.

    `psi_dot` is the heading rate that follows from y, rad/s. `measured` is the heading of pose, or
    None if pose is stale.

        psi+ = psi + dt psi_dot + (1 - exp(-dt/T)) (measured - psi - dt psi_dot),  T = HEADING_TIME

    This is a complementary filter. It smooths the noise of the pose, and the gyro keeps it free of
    lag. A bias of the gyro causes an error of T times the bias.
    """
    heading = psi + dt * psi_dot
    innovation = 0.0 if measured is None else math.remainder(measured - heading, 2.0 * math.pi)
    return math.remainder(
        heading + (1.0 - math.exp(-dt / HEADING_TIME)) * innovation, 2.0 * math.pi
    )


def course_acceleration(course_c: float, course: float, speed: float, k: float) -> float:
    """Compute the acceleration to the right that turns onto a course, m/s^2.

    It is a = k V turn_towards(course_c - course).
    """
    return float(k * speed * turn_towards(math.remainder(course_c - course, 2.0 * math.pi)))


def path_acceleration(
    error: PathError, course: Scalar, ground_speed: Scalar, params: PathParams
) -> Scalar:
    """Compute the acceleration to the right that follows a path, m/s^2.

        x       = min(abs(e) / (v_g P zeta), 1),  look-ahead angle l = pi/2 (1 - x)^2
        bearing = track - sign(e) min(pi/2 - l, max(capture, acos(1 / max(1 - kappa e, 1))))
        a       = (4 pi zeta / P) v_g turn_towards(bearing - course)
                  + sin(l)^2 v_g^2 cos(course - track) kappa / (1 - kappa e)

    `error` has the distance e, the course `track` and the curvature kappa of the path. `params` has
    P, zeta and capture. v_g is the speed over ground, m/s.

    Outside a circle of radius R, at the distance d from its centre, 1 - kappa e = d / R. The angle
    between the tangent to the circle and the track is acos(R / d), so a distant aircraft flies
    along the tangent. Near a line e'' + 2 zeta w e' + w^2 e = 0 with w = 2 pi / P. The equations
    use the velocity over ground, so they also hold in a wind. On the inner side of an arc, e is
    limited to half of the radius. Source: PX4-Autopilot, src/lib/npfg/DirectionalGuidance.cpp,
    without the adaptation to wind.
    """
    e, track, kappa = error
    xp = array_namespace(e)
    x = xp.minimum(abs(e) / (forward(ground_speed) * params.period * params.damping), 1.0)
    look_ahead = math.pi / 2.0 * (1.0 - x) ** 2
    tangent = xp.acos(1.0 / xp.maximum(1.0 - kappa * e, 1.0))
    bearing = track - xp.copysign(
        xp.minimum(math.pi / 2.0 - look_ahead, xp.maximum(tangent, params.capture)), e
    )
    feedback = (
        4.0
        * math.pi
        * params.damping
        / params.period
        * ground_speed
        * turn_towards(bearing - course)
    )
    bend = kappa / (1.0 - xp.minimum(kappa * e, 0.5))
    return feedback + xp.sin(look_ahead) ** 2 * bend * ground_speed**2 * xp.cos(course - track)


def slip_estimate(
    slip: Scalar, turn: Scalar, acceleration: Scalar, rolling: Scalar, dt: float, time: float
) -> Scalar:
    """Advance the estimate of the acceleration that a turn loses by sideslip, m/s^2.

    `turn` = g tan(phi), `acceleration` = V psi_dot:

        slip+ = slip + (1 - exp(-dt/T)) max(1 - rolling / 0.2, 0) (turn - acceleration - slip),
        within +-LARGEST_SLIP abs(turn)

    T is `time`, s, and `rolling` is abs(p) / p_max. Because the turn lags the bank by the reference
    model of r, a roll looks like a sideslip, so the estimate rests while the aircraft rolls. A bias
    of the gyro of r looks like a sideslip, too. In straight flight the bound is 0, so the bias has
    no effect. Path following adds the estimate to its acceleration, so that an aircraft stays on an
    arc in a turn that is not coordinated.
    """
    steady = array_namespace(slip).maximum(1.0 - rolling / 0.2, 0.0)
    return clip(
        slip + (1.0 - math.exp(-dt / time)) * steady * (turn - acceleration - slip),
        LARGEST_SLIP * abs(turn),
    )


def bank_for(acceleration: Scalar, path_angle: Scalar, limit: float) -> Scalar:
    """Compute the bank of a coordinated turn, rad: atan(a / (g cos(gamma))) within +-limit."""
    xp = array_namespace(acceleration)
    return clip(xp.atan(acceleration / (GRAVITY * xp.cos(path_angle))), limit)


def least_period(speed: float, bank: float, roll_rate: float) -> float:
    """Compute the least period of path following, s.

        max(14, 1.5 V / (g tan(phi_max)), 9.3 phi_max / p_max)

    The last term is `reach.least_period`.
    """
    return max(14.0, 1.5 * speed / (GRAVITY * math.tan(bank)), reach.least_period(bank, roll_rate))


def largest_wind(speed: float, wind: float, bank: float) -> float:
    """Compute the largest wind in which the aircraft can fly the circle for `wind`, m/s.

    In this wind, the circle of `least_radius` for `wind` needs the largest bank. The result is (V +
    W) sqrt(tan(b) / tan(0.8 b)) - V, for the `speed` V and `wind` W, m/s, and the largest `bank` b,
    rad.
    """
    return (speed + wind) * math.sqrt(math.tan(bank) / math.tan(0.8 * bank)) - speed


def least_radius(speed: float, wind: float, bank: float) -> float:
    """Compute the least radius of a circle in a wind, m: (V + W)^2 / (g tan(0.8 phi_max))."""
    return (speed + wind) ** 2 / (GRAVITY * math.tan(0.8 * bank))
