# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute live commands u_m up to their age limit, and what follows if the publisher is lost.

The commands that follow the last u_m are called the ending. Commands of zero rates alone would keep
the present bank, so the ending first levels the wings. It knows bank and pitch by dead reckoning
from the attitude that guidance sent with u_m.
"""

from typing import NamedTuple

import numpy as np

from flight_core.failsafe import failsafe_scale
from flight_core.kinematics import body_rates, euler_rates, tilt, turn_rate
from flight_core.rates import seconds
from flight_core.vectors import ChannelError, FloatArray, SampleFault


class LiveParams(NamedTuple):
    """Limits of u_m, and the gains of the ending, the commands that follow the last u_m."""

    max_age_ns: int  # age above which u_m has timed out
    levelling_ns: int  # time in which the ending levels the wings, before all commands are 0
    bounds: FloatArray  # largest absolute values of u_m, (m,)
    reach: FloatArray  # largest changes of u_m from step to step, (m,)
    speed: float | None  # trim speed V0, m/s; if None, the ending cannot level the aircraft
    # Indices of q, V, p and r in u_m. The index of r is None without a rudder. The whole tuple is
    # None if any other is missing.
    channels: tuple[int, int, int, int | None] | None
    gain: tuple[float, float]  # gains of the bank and of the pitch, 1/s
    roll_rate: float  # largest roll rate of the ending, rad/s


class Live(NamedTuple):
    """The last u_m, and the present attitude by dead reckoning from the attitude sent with u_m."""

    t_ns: int  # flight time at the stamp of u_m
    u_m: FloatArray  # (m,)
    attitude: tuple[float, float] | None  # present phi and theta, rad; None if they are not known


def take(t_ns: int, u_m: FloatArray, attitude: FloatArray | None, params: LiveParams) -> Live:
    """Return the state after a new u_m.

    Raises ChannelError, reason "bounds", if a command is out of bounds.
    """
    if (np.abs(u_m) > params.bounds).any():
        raise ChannelError(
            SampleFault.BOUNDS, f"{u_m.tolist()} is beyond the bounds {params.bounds.tolist()}"
        )
    return Live(t_ns, u_m, None if attitude is None else (float(attitude[0]), float(attitude[1])))


def commands(t_ns: int, live: Live, y_m: FloatArray, params: LiveParams) -> FloatArray:
    """Compute u_m at t, shape (m,): the last u_m up to its age limit, then the ending.

    If the attitude is known, the ending uses phi and theta by dead reckoning, and V = V0 + V_m. For
    `levelling_ns` the ending commands

        phi_dot_c = -k_phi phi, at most `roll_rate`; theta_dot_c = -k_theta theta

    p, q and r follow by the inverse of Euler's equations in a coordinated turn
    (`flight_core.kinematics`), and all other commands ramp to zero. After `levelling_ns` every
    command is zero. If the attitude is not known, every command is zero at once.
    """
    silent_ns = t_ns - live.t_ns - params.max_age_ns
    if silent_ns <= 0:
        return live.u_m
    if (
        silent_ns > params.levelling_ns
        or live.attitude is None
        or params.channels is None
        or params.speed is None
    ):
        return np.zeros_like(live.u_m)
    at_q, _, at_p, at_r = params.channels
    phi, theta = map(tilt, live.attitude)
    phi_dot = min(max(-params.gain[0] * phi, -params.roll_rate), params.roll_rate)
    theta_dot = -params.gain[1] * theta
    r = _turn(phi, theta, theta_dot, y_m, params)
    p, q = body_rates(phi, theta, phi_dot, theta_dot, r)
    u_m = failsafe_scale(silent_ns, 0, params.levelling_ns) * live.u_m
    u_m[[at_q, at_p]] = q, p
    if at_r is not None:
        u_m[at_r] = r
    return u_m


def dead_reckon(live: Live, y_m: FloatArray, period_ns: int, params: LiveParams) -> Live:
    """Return the state a period later, with the attitude integrated by Euler's equations.

    The rates are taken from the reference y_m, which the law tracks.
    """
    if live.attitude is None or params.channels is None or params.speed is None:
        return live
    at_q, _, at_p, at_r = params.channels
    p = float(y_m[at_p])
    q = float(y_m[at_q])
    dt = seconds(period_ns)
    phi, theta = live.attitude
    r = _turn(phi, theta, 0.0, y_m, params) if at_r is None else float(y_m[at_r])
    phi_dot, theta_dot = euler_rates(phi, theta, p, q, r)
    return live._replace(attitude=(phi + dt * phi_dot, theta + dt * theta_dot))


def _turn(phi: float, theta: float, theta_dot: float, y_m: FloatArray, params: LiveParams) -> float:
    """Compute r of a coordinated turn at the airspeed V0 + V_m, rad/s."""
    if params.channels is None or params.speed is None:
        return 0.0
    speed = max(params.speed + float(y_m[params.channels[1]]), params.speed / 2.0)
    return float(turn_rate(phi, theta, theta_dot, speed))
