# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Commands u_m(t): pulses and sines with bounded derivative, as a pure function of time.

Equation (2) requires bounded u_m and u_m_dot, so the edges of a pulse are ramps, never steps.
"""

from typing import NamedTuple

from flight_core.vectors import Array, array_namespace


class Profile(NamedTuple):
    """Commands on m channels, at most E edges a channel (unused edges have change 0).

    Times are in s, values in the channel's unit.
    """

    time: Array  # (m, E) start of each edge
    change: Array  # (m, E) change of the command by each edge; a pulse is two edges
    rise: Array  # () duration of each edge, > 0
    amplitude: Array  # (m,) of the sine
    frequency: Array  # (m,) rad/s, > 0
    phase: Array  # (m,) rad
    # (m,) 1 on the channel whose integral is the bank angle of a coordinated turn, else 0
    bank_rate: Array
    # (m,) g/V0 (rad/s) on the channel to which the turn rate g/V0 sin(bank) is added, else 0
    turn_rate: Array


def command(t: Array, profile: Profile) -> Array:
    """u_m(t), shape (m,), or (T, m) at T instants together.

    u_m = w(t) + turn_rate sin(phi(t)),  phi(t) = bank_rate . integral_0^t w
    w_i = sum_k change_ik G(t - time_ik) + amplitude_i sin(frequency_i t + phase_i),
        G(s) = clip(s / rise, 0, 1)

    The two integrals have closed forms, so the function has no state: the integral of G is r^2 / (2
    rise) + max(s - rise, 0), with r = s clipped to [0, rise]. g/V0 sin(phi) is the turn rate of a
    coordinated turn.
    """
    xp = array_namespace(profile.change)
    t = xp.asarray(t)[..., None]
    since = t[..., None] - profile.time
    elapsed = xp.maximum(since, 0.0 * since)
    rising = xp.minimum(elapsed, profile.rise + 0.0 * elapsed)
    angle = profile.frequency * t + profile.phase
    # a product with it sums over the edges several times faster than xp.sum
    ones = xp.ones_like(profile.change[0, :])
    w = (profile.change * rising) @ ones / profile.rise + profile.amplitude * xp.sin(angle)
    w_integral = (
        profile.change * (rising * rising / (2.0 * profile.rise) + elapsed - rising)
    ) @ ones
    w_integral = w_integral + profile.amplitude / profile.frequency * (
        xp.cos(profile.phase) - xp.cos(angle)
    )
    return w + profile.turn_rate * xp.sin(w_integral @ profile.bank_rate)[..., None]
