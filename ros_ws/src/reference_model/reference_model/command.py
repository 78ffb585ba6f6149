# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Commands u_m(t): pulses and sines with bounded derivative, as a pure function of time.

Equation (2) asks for u_m and u_m_dot bounded, so a pulse has ramps for edges, never steps.
"""

from typing import NamedTuple

from array_api_compat import array_namespace

from flight_core.vectors import Array


class Profile(NamedTuple):
    """Commands on m channels, K pulses each at most (unused ones have value 0). Times in s, values in the channel's unit."""

    start: Array  # (m, K) instant at which a pulse begins to rise
    stop: Array  # (m, K) instant at which it begins to fall
    value: Array  # (m, K) height of the plateau
    rise: Array  # () duration of each edge, > 0
    amplitude: Array  # (m,) of the sine
    frequency: Array  # (m,) rad/s, > 0
    phase: Array  # (m,) rad
    bank_rate: Array  # (m,) 1 on the channel whose integral is the bank angle of a coordinated turn, else 0
    turn_rate: Array  # (m,) g/V0 (rad/s) on the channel that takes the turn rate g/V0 sin(bank), else 0


def command(t: Array, profile: Profile) -> Array:
    """u_m(t), shape (m,).

    u_m = w(t) + turn_rate sin(phi(t)),  phi(t) = bank_rate . integral_0^t w
    w_i = sum_k value_ik (G(t - start_ik) - G(t - stop_ik)) + amplitude_i sin(frequency_i t + phase_i)
    G(s) = clip(s / rise, 0, 1)

    Both integrals are closed forms, so no state is carried. The turn rate g/V0 sin(phi) is that of a coordinated turn.
    """
    xp = array_namespace(profile.value)
    rise = profile.rise

    def edge(s: Array) -> tuple[Array, Array]:
        """G(s) and its integral from 0: r^2 / (2 rise) + max(s - rise, 0) with r = s held inside [0, rise]."""
        past = xp.maximum(s, 0.0 * s)
        rising = xp.minimum(past, rise + 0.0 * s)
        return rising / rise, rising * rising / (2.0 * rise) + (past - rising)

    rise_up, rise_up_integral = edge(t - profile.start)
    fall, fall_integral = edge(t - profile.stop)
    angle = profile.frequency * t + profile.phase
    w = xp.sum(profile.value * (rise_up - fall), axis=1) + profile.amplitude * xp.sin(angle)
    w_integral = xp.sum(profile.value * (rise_up_integral - fall_integral), axis=1)
    w_integral = w_integral + profile.amplitude / profile.frequency * (xp.cos(profile.phase) - xp.cos(angle))
    bank = xp.sum(profile.bank_rate * w_integral)
    return w + profile.turn_rate * xp.sin(bank)
