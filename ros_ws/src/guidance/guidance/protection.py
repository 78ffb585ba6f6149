# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Protection: limits of bank, speed and climb, in that order, from the stall speed."""

import math

STALL_MARGIN = 1.1
"""Least ratio of the speed to the stall speed of a turn."""

FLOOR = 1.15
"""Speed floor over the stall speed."""


def bank_limit(limit: float, stall_speed: float, speed: float) -> float:
    """Largest bank, rad: min(phi_max, acos((1.1 V_s / V)^2)), for the load factor of a level turn is 1 / cos(phi)."""
    ratio = (STALL_MARGIN * stall_speed / speed) ** 2
    return min(limit, math.acos(min(ratio, 1.0)))


def speed_floor(stall_speed: float) -> float:
    """Least commanded speed, m/s: 1.15 V_s."""
    return FLOOR * stall_speed


def climb_limit(climb: float, sink: float, speed: float, floor: float) -> float:
    """Largest climb rate, m/s: ratio climb - (1 - ratio) sink, ratio = clip((V - 0.9 V_floor) / (0.1 V_floor), 0, 1).

    Below the floor pitch flies the speed: at nine tenths of it the aircraft sinks at its largest rate.
    """
    ratio = min(max((speed - 0.9 * floor) / (0.1 * floor), 0.0), 1.0)
    return ratio * climb - (1.0 - ratio) * sink
