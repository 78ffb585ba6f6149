# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute commands u_m(t) with bounded derivative, as a pure function of time.

Equation (2) requires bounded u_m and u_m_dot, so the edges of a pulse are ramps, never steps.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flight_core.vectors import Array, FloatArray


class Line(NamedTuple):
    """A piecewise linear signal through points, held before the first and after the last point."""

    time: FloatArray  # increasing times, s, (N,)
    value: FloatArray  # (N,) in the channel's unit


class Edge(NamedTuple):
    """A change of the command by `change`, linear from `start` to `stop`."""

    start: float  # s
    stop: float  # s
    change: float  # in the channel's unit

    def line(self) -> Line:
        """Return the edge as a signal that is 0 before `start` and `change` after `stop`."""
        return Line(np.array([self.start, self.stop]), np.array([0.0, self.change]))


class Polyline(NamedTuple):
    """The sum of the piecewise linear signals of m channels, with K common knots."""

    time: FloatArray  # increasing times of the knots, s, (K,)
    value: FloatArray  # values at the knots, (K, m)
    slope: FloatArray  # slope from each knot to the next, (K, m), per s; 0 after the last
    area: FloatArray  # integral from the first knot, (K, m)

    @classmethod
    def through(cls, lines: Sequence[Sequence[Line]]) -> "Polyline":
        """Return the sum of the lines of each channel. The first knot is at t = 0 or earlier."""
        every = [line for channel in lines for line in channel]
        time = np.unique(np.concatenate([[0.0], *(line.time for line in every)]))
        value = np.zeros((len(time), len(lines)))
        for column, channel in enumerate(lines):
            for line in channel:
                value[:, column] += np.interp(time, line.time, line.value)
        length = np.diff(time)[:, None]
        slope = np.zeros_like(value)
        slope[:-1] = np.diff(value, axis=0) / length
        area = np.zeros_like(value)
        area[1:] = np.cumsum(length * (value[:-1] + value[1:]) / 2.0, axis=0)
        return cls(time, value, slope, area)


class Chirps(NamedTuple):
    """A linear chirp for each channel, with amplitude 0 on a channel without a chirp."""

    amplitude: FloatArray  # (m,)
    start: FloatArray  # (m,) s
    duration: FloatArray  # duration of the sweep, (m,), s, > 0
    frequency: FloatArray  # frequency at the start, (m,), rad/s, > 0
    sweep: FloatArray  # change of the frequency, (m,), rad/s^2, not 0


class Profile(NamedTuple):
    """Commands on m channels, with at most E edges per channel.

    Unused edges have the change 0. Times are in s, and values in the channel's unit.
    """

    time: Array  # start of each edge, (m, E)
    change: Array  # change by each edge, (m, E); a pulse has two edges, a doublet three
    rise: Array  # duration of each edge, (), s, > 0
    amplitude: Array  # amplitude of the sine, (m,)
    frequency: Array  # frequency of the sine, (m,), rad/s, > 0
    phase: Array  # phase of the sine, (m,), rad
    # 1 on the channel whose integral is the bank angle of a coordinated turn, else 0, (m,)
    bank_rate: Array
    # g/V0 (rad/s) on the channel to which the turn rate g/V0 sin(bank) is added, else 0, (m,)
    turn_rate: Array
    lines: Polyline | None = None  # ramps and recorded commands
    chirps: Chirps | None = None


def command(t: Array, profile: Profile) -> FloatArray:
    """Compute u_m(t), shape (m,), or (T, m) at T instants together.

        u_m = w(t) + turn_rate sin(phi(t)),  phi(t) = bank_rate . integral_0^t w
        w_i = sum_k change_ik G(t - time_ik) + amplitude_i sin(frequency_i t + phase_i)
              + lines_i(t) + chirps_i(t),  G(s) = clip(s / rise, 0, 1)

    The integrals of all four terms have closed forms, so the function needs no state. The integral
    of G is r^2 / (2 rise) + max(s - rise, 0), with r = s clipped to [0, rise]. g/V0 sin(phi) is the
    turn rate of a coordinated turn.
    """
    t = np.asarray(t, dtype=np.float64)
    since = t[..., None, None] - profile.time
    elapsed = np.maximum(since, 0.0)
    rising = np.minimum(elapsed, profile.rise)
    angle = profile.frequency * t[..., None] + profile.phase
    # a matrix product with ones sums over the edges, several times faster than np.sum
    ones = np.ones_like(profile.change[0, :])
    w = (profile.change * rising) @ ones / profile.rise + profile.amplitude * np.sin(angle)
    w_integral = (
        profile.change * (rising * rising / (2.0 * profile.rise) + elapsed - rising)
    ) @ ones
    w_integral = w_integral + profile.amplitude / profile.frequency * (
        np.cos(profile.phase) - np.cos(angle)
    )
    further = []
    if profile.lines is not None:
        further.append(polyline(t, profile.lines))
    if profile.chirps is not None:
        further.append(linear_chirp(t, profile.chirps))
    for signal, integral in further:
        w = w + signal
        w_integral = w_integral + integral
    u_m: FloatArray = w + profile.turn_rate * np.sin(w_integral @ profile.bank_rate)[..., None]
    return u_m


def polyline(t: FloatArray, lines: Polyline) -> tuple[FloatArray, FloatArray]:
    """Evaluate piecewise linear signals and their integrals at t, each of shape t.shape + (m,).

    Let s = t - time_k be the time since the last knot k. Then the signal is value_k + slope_k s,
    and its integral is area_k + value_k s + slope_k s^2 / 2.
    """
    k = np.maximum(np.searchsorted(lines.time, t, side="right") - 1, 0)
    since = np.maximum(t - lines.time[k], 0.0)[..., None]
    value = lines.value[k]
    change = lines.slope[k] * since
    return value + change, lines.area[k] + since * (value + change / 2.0)


def linear_chirp(t: FloatArray, chirps: Chirps) -> tuple[FloatArray, FloatArray]:
    """Evaluate linear chirps and their integrals at t, each of shape t.shape + (m,).

    amplitude sin(theta), theta = frequency s + sweep s^2 / 2, s = t - start in [0, duration].
    After the sweep, the last frequency continues until the next zero, so that the chirp does not
    end with a step. With c = frequency^2 / (2 sweep) and x = (frequency + sweep s) / sqrt(pi
    abs(sweep)), the integral is given by Fresnel's S and C:

        sqrt(pi / abs(sweep)) (cos c (S(x) - S(x_0)) - sign(sweep) sin c (C(x) - C(x_0)))

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, 7.3.1 and 7.3.2.
    """
    from scipy.special import fresnel  # noqa: PLC0415 - takes 0.1 s, and few commands need it

    frequency, sweep = chirps.frequency, chirps.sweep
    since = t[..., None] - chirps.start
    s = np.clip(since, 0.0, chirps.duration)
    last_frequency = frequency + sweep * chirps.duration
    swept = (frequency + last_frequency) / 2.0 * chirps.duration
    end = np.pi * np.ceil(swept / np.pi)
    sweeping = (frequency + sweep * s / 2.0) * s
    theta = np.minimum(sweeping + last_frequency * np.maximum(since - s, 0.0), end)
    wave = np.where(theta < end, np.sin(theta), 0.0)

    scale = np.sqrt(np.pi * np.abs(sweep))
    c = frequency * frequency / (2.0 * sweep)
    S, C = fresnel((frequency + sweep * s) / scale)
    S_0, C_0 = fresnel(frequency / scale)
    sweep_integral = np.cos(c) * (S - S_0) - np.sign(sweep) * np.sin(c) * (C - C_0)
    tail = (np.cos(sweeping) - np.cos(theta)) / last_frequency
    integral = sweep_integral * scale / np.abs(sweep) + tail
    return chirps.amplitude * wave, chirps.amplitude * integral
