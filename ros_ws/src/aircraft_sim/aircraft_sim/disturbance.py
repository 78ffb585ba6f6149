# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Disturbances of the air."""

from typing import NamedTuple

from array_api_compat import array_namespace

from flight_core.vectors import Array


class Gusts(NamedTuple):
    """Discrete gusts, G of them. The speed 0 is exactly no gust."""

    start: Array  # (G,) instant of entry, s
    speed: Array  # (G,) peak speed U_ds, m/s
    length: Array  # (G,) distance H from entry to peak, m, > 0


def one_minus_cosine(t: Array, gusts: Gusts, airspeed: Array) -> Array:
    """Speed of each gust in m/s, shape (G,): w = U_ds/2 (1 - cos(pi s/H)), s = V0 (t - start) held inside [0, 2H].

    Zero before entry and after 2H/V0 seconds, with a continuous derivative throughout, as Assumption 2 asks of f.
    Source of the form: FAR/CS 25.341(a).
    """
    xp = array_namespace(gusts.speed)
    # minimum and maximum: several times faster than clip, which checks its bounds' types first
    s = xp.minimum(xp.maximum(airspeed * (t - gusts.start), 0.0 * gusts.length), 2.0 * gusts.length)
    return gusts.speed / 2.0 * (1.0 - xp.cos(xp.pi * s / gusts.length))
