# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the wind: the velocity over ground minus the velocity through the air.

The wind has a north and an east component.
"""

import math

from flight_core.vectors import Scalar, array_namespace

WIND_TIME = 5.0
"""Time constant of the estimated wind, s. It is longer than a gust that the aircraft flies
through, and shorter than a leg."""

Wind = tuple[Scalar, Scalar]  # velocity of the air: north, east, m/s


def wind_of(v_north: Scalar, v_east: Scalar, climb: Scalar, heading: Scalar, speed: Scalar) -> Wind:
    """Compute the wind from the velocity over ground and the airspeed, m/s.

    The wind is v_g - sqrt(V^2 - climb^2) [cos, sin](heading). `heading` is psi + beta, rad, the
    direction of flight through the air.
    """
    xp = array_namespace(speed)
    level = xp.sqrt(xp.maximum(speed**2 - climb**2, 0.0))
    return v_north - level * xp.cos(heading), v_east - level * xp.sin(heading)


def wind_estimate(wind: Wind, measured: Wind, dt: float) -> Wind:
    """Advance the estimate of the wind by a step, as a low-pass of the measured wind.

    wind+ = wind + (1 - exp(-dt/T)) (measured - wind), T = WIND_TIME
    """
    share = 1.0 - math.exp(-dt / WIND_TIME)
    north, east = (
        before + share * (now - before) for before, now in zip(wind, measured, strict=True)
    )
    return north, east
