# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Actuators between the command u and the aircraft: lag, rate limit, end stops, in this order."""

from typing import NamedTuple

from array_api_compat import array_namespace

from flight_core.vectors import Array

SHORTEST_LAG = 1e-30  # s, stands for no lag: exp(-dt / 1e-30) is exactly 0, in float32 too, and nothing is divided by 0


class Actuators(NamedTuple):
    """Parameters of m actuators, SI. An ideal one has lag 0 and infinite limits."""

    lag: Array  # (m,) time constant of the first-order response, s, 0 = none
    lower: Array  # (m,) lower end stop, deviation from trim, -inf = none
    upper: Array  # (m,) upper end stop, deviation from trim, inf = none
    rate: Array  # (m,) largest rate, units of u / s, inf = none


def step(position: Array, command: Array, dt: Array, params: Actuators) -> Array:
    """Actuator positions one step later, shape (m,), with the command held over the step.

        lagged  = command - (command - position) exp(-dt / lag)                exact solution of lag p_dot = command - p
        limited = position + clip(lagged - position, -rate dt, rate dt)        rate limit
        p+      = clip(limited, lower, upper)                                  end stops

    Each line is one property of the actuator, and works on what the line before leaves. An ideal actuator gives the command
    to the last bit: the difference vanishes, and the limits only choose between values.

    Shapes: position, command (m,), dt (). Units: SI, deviations from trim; dt > 0 in s.
    Source: the lag is the zero-order-hold equivalent of 1 / (lag s + 1); Franklin, Powell, Workman, Digital Control, 4.3.
    """
    xp = array_namespace(position)
    decay = xp.exp(-dt / xp.maximum(params.lag, xp.full_like(params.lag, SHORTEST_LAG)))
    lagged = command - (command - position) * decay
    reach = params.rate * dt
    limited = xp.minimum(xp.maximum(lagged, position - reach), position + reach)
    return xp.minimum(xp.maximum(limited, params.lower), params.upper)
