# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute body rates that reach and hold a bank and a pitch, in a coordinated turn."""

import math
from typing import NamedTuple

from flight_core.kinematics import body_rates as inverse
from flight_core.kinematics import clip, tilt, turn_rate
from flight_core.units import GRAVITY
from flight_core.vectors import Scalar, array_namespace
from flight_guidance.steering.protection import forward

YAW_TO_BANK = 1.5
"""Gain from the error of the bank to the yaw rate, 1/s. A yaw rate of 0.1 rad/s rolls the osprey at
0.02 rad/s, and at 0.004 rad/s in the worst case if A and B are 30 % off."""

SKIDDING = 1.6
"""Bank of the osprey in a turn by the rudder, divided by the bank of a coordinated turn at the same
rate. It is above 1 because the sideslip rolls the aircraft further, and 1.3 to 1.7 if A and B are
30 % off."""

LARGEST_YAW = math.radians(20.0)
"""The yaw rate is limited to the turn rate of this bank, at which the rudder of the osprey is
deflected by half of its range."""


BANDWIDTH_RATIO = 4.0
"""Natural frequency of the reference model of a rate, divided by the gain of the loop around it, of
an angle or of the altitude. With a damping of 0.9 of the reference model, the loop of the angle has
a damping of 0.74."""

HEADING_RATIO = 3.5
"""k_phi divided by k_chi. If the bank follows its command with the lag 1 / k_phi, heading and
course have a damping of 0.94."""

ZERO_LIFT = 0.05
"""Angle below the axis of the body at which the lift is taken to be zero, rad."""


class AttitudeParams(NamedTuple):
    """Gains and limits of the attitude loop."""

    k_phi: float  # 1/s, of the bank
    k_theta: float  # 1/s, of the pitch
    roll_rate: float  # largest phi_dot, rad/s
    load: float  # largest change of the load factor, without unit
    n_alpha: Scalar  # slope of the load factor over the angle of attack, 1/rad
    k_beta: float  # 1/s; 0 if beta is not measured
    turn_lead: float = 0.0  # s, time by which r leads the bank


class BodyRates(NamedTuple):
    """Commands to the reference model, rad/s, in body axes (FRD)."""

    p: Scalar
    q: Scalar
    r: Scalar


def load_slope(alpha: Scalar) -> Scalar:
    """Return the slope of the load factor over the angle of attack at a load factor of 1, 1/rad.

    `alpha` is the angle of attack in trim, rad. The lift is proportional to alpha + ZERO_LIFT.
    """
    return 1.0 / (alpha + ZERO_LIFT)


def body_rates(
    phi_c: Scalar,
    theta_c: Scalar,
    phi: Scalar,
    theta: Scalar,
    r: Scalar,
    beta: Scalar,
    speed: Scalar,
    params: AttitudeParams,
) -> BodyRates:
    """Compute the rates that bring phi and theta to their commands.

    The inverse of Euler's equations in a coordinated turn gives the rates:

        phi_dot_c   = clip(k_phi (phi_c - phi), +-roll_rate),
            theta_dot_c = clip(k_theta (theta_c - theta), +-load g/V)
        r_m = psi_dot cos(phi_l) cos(theta) - theta_dot_c sin(phi_l) + k_beta beta,
            psi_dot = g tan(phi_l) / V,  phi_l = phi + turn_lead phi_dot_c
        q_m = (theta_dot_c + r sin(phi)) / cos(phi) + phi_dot_c tan(phi) / (cos(phi) n_alpha)
        p_m = phi_dot_c - tan(theta) (q_m sin(phi) + r cos(phi))

    n_alpha is the `load_slope`. q_m and p_m use the measured r, in case it does not track r_m
    exactly. `turn_lead` compensates the lag of the turn behind the bank. This lag comes from the
    reference model of r and from the sideslip in a roll. The last term of q_m anticipates the angle
    of attack that the turn needs. Angles are in rad, `speed` V in m/s. Source: R. W. Beard, T. W.
    McLain, Small Unmanned Aircraft (2012), chapters 2 and 9.
    """
    speed = forward(speed)
    phi_dot = clip(params.k_phi * (phi_c - phi), params.roll_rate)
    theta_dot = clip(params.k_theta * (theta_c - theta), params.load * GRAVITY / speed)
    lead = phi_dot * array_namespace(phi).tan(tilt(phi)) / params.n_alpha
    p, q = inverse(phi, theta, phi_dot, theta_dot + lead, r)
    turn = turn_rate(phi + params.turn_lead * phi_dot, theta, theta_dot, speed)
    return BodyRates(p, q, turn + params.k_beta * beta)


def yaw_for_bank(phi_c: Scalar, phi: Scalar, speed: Scalar) -> Scalar:
    """Compute the yaw rate for a bank without an aileron, rad/s, within +-g tan(LARGEST_YAW) / V.

    It is the sum of the yaw rate of the turn and a yaw rate that rolls the aircraft to the bank:

        r_m = g tan(phi_c) / V + k (SKIDDING phi_c - phi),  k = YAW_TO_BANK

    phi_c is the bank of a coordinated turn at the same rate. A yaw rolls an aircraft to the side of
    the yaw, because the outer wing is faster. The sideslip rolls it to the same side through the
    dihedral.
    """
    xp = array_namespace(phi)
    turn = GRAVITY / forward(speed)
    bank_error = SKIDDING * phi_c - phi
    return clip(turn * xp.tan(phi_c) + YAW_TO_BANK * bank_error, turn * math.tan(LARGEST_YAW))
