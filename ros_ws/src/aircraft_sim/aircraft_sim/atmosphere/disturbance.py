# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute disturbances as functions of time: 1-cosine gusts, biases and sines on x_dot.

Assumption 2 requires that f is C1, and that f and f_dot are bounded. Gusts, sines, and biases with
a rise time meet it. A bias with a rise time of 0 is a step. It does not meet Assumption 2, so it
lies outside the theorem.
"""

from typing import NamedTuple

from flight_core.vectors import Array, array_namespace

AXES = ("longitudinal", "lateral", "vertical")
"""Axes of the wind, FRD axes of trim. Positive: tail wind, wind to the right, wind down."""

ROTARY = ("roll", "pitch", "yaw")
"""Axes of rotary gusts: the air about the aircraft turns with p_g, q_g, r_g, rad/s."""

AIR_STATE = {
    "longitudinal": "V",
    "lateral": "beta",
    "vertical": "alpha",
    "roll": "p",
    "pitch": "q",
    "yaw": "r",
}
"""For each axis, the state that wind along the axis changes relative to the air. In a wind w, the
states relative to the air are V - w and, for small angles, beta - w / V0 and alpha - w / V0. In
rotary gusts they are p - p_g, q - q_g and r - r_g."""

# s, replaces a rise time of 0, which would divide by 0. For every t > 0, t / 1e-30 is above 1 also
# in float32, so the bias rises in a step.
MIN_RISE = 1e-30


class Gusts(NamedTuple):
    """G discrete gusts. A gust with a speed of 0 is no gust."""

    start: Array  # (G,) instant of entry, s
    speed: Array  # (G,) peak speed U_ds, m/s
    length: Array  # (G,) distance H from entry to peak, m, > 0
    # (G,) time after which each gust is repeated, s, > 0, infinite for never; None if no gust is
    # repeated
    every: Array | None = None


class Bias(NamedTuple):
    """A bias on the derivative of each state. Where the value is 0, there is no bias."""

    start: Array  # (n,) start of the rise, s
    value: Array  # (n,) final value, [x]/s
    rise: Array  # (n,) rise time, s; 0 for a step


class Sines(NamedTuple):
    """A sine on the derivative of each state. Where the amplitude is 0, there is no sine."""

    amplitude: Array  # (n,) [x]/s
    frequency: Array  # (n,) rad/s
    phase: Array  # (n,) rad


def one_minus_cosine(t: Array, gusts: Gusts, airspeed: Array) -> Array:
    """Compute the speeds of the gusts, m/s, (G,): w = U_ds/2 (1 - cos(pi s/H)) up to s = 2H.

    s = V0 ((t - start) mod every). The speed is zero before the entry. It is zero again 2H/V0
    seconds after the entry, until the gust is repeated. The derivative is continuous and at most
    U_ds/2 pi V0/H, which meets Assumption 2. Source of the form: FAR/CS 25.341(a).
    """
    xp = array_namespace(gusts.speed)
    since = t - gusts.start
    if gusts.every is not None:
        since = xp.where(since > 0.0, since % gusts.every, since)
    # Minimum and maximum are several times faster than clip, which first checks the types of its
    # limits.
    s = xp.minimum(xp.maximum(airspeed * since / gusts.length, 0.0), 2.0)
    return gusts.speed / 2.0 * (1.0 - xp.cos(xp.pi * s))


def bias(t: Array, params: Bias) -> Array:
    """Compute the biases at t, shape (n,), [x]/s: value/2 (1 - cos(pi s)).

    s = (t - start)/rise clipped to [0, 1]. If rise > 0, the derivative is continuous and at most
    value/2 pi/rise. If rise = 0, the bias is a step: zero up to start, `value` afterwards.
    Assumption 2 does not hold at the instant of the step.
    """
    xp = array_namespace(params.value)
    s = xp.minimum(xp.maximum((t - params.start) / xp.maximum(params.rise, MIN_RISE), 0.0), 1.0)
    return params.value / 2.0 * (1.0 - xp.cos(xp.pi * s))


def sines(t: Array, params: Sines) -> Array:
    """Compute the sines at t, shape (n,), [x]/s: amplitude sin(frequency t + phase).

    The derivative is at most the product of amplitude and frequency.
    """
    return params.amplitude * array_namespace(params.amplitude).sin(
        params.frequency * t + params.phase
    )
