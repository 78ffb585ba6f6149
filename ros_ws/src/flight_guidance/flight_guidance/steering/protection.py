# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Limit the bank, the airspeed and the climb rate, in this order.

The limits follow from the stall speed and the commanded airspeed.
"""

from flight_core.units import GRAVITY
from flight_core.vectors import Scalar, array_namespace

STALL_MARGIN = 1.1
"""Least ratio of the airspeed to the stall speed in a turn."""

FLOOR = 1.15
"""Ratio of the speed floor to the stall speed."""

FASTEST = 1.4
"""Ratio of the largest airspeed to the trim speed if the aircraft has no given limit."""

BAND = 0.1
"""Width of the band below the speed floor, as a fraction of the floor, in which the climb becomes a
sink. The band above the largest speed is as wide, as a fraction of this speed. The floor of 1.15
stall speeds therefore leaves 1.035 stall speeds at the lower end of its band."""

LEAST_SHORTFALL = 0.05
"""Least d of `climb_range`, as a fraction of the trim speed. If V differs from its command by more
than d, climb or sink is limited. At 2 d the limit is zero."""

BANDWIDTH = 0.4
"""Largest bandwidth with which a limited climb or sink controls V, rad/s. It is a choice of this
project."""

LEAST_SPEED = 0.1
"""Least airspeed used as a divisor, m/s. No aircraft flies at it, and a flow from behind counts as
no flow."""


def forward(speed: Scalar) -> Scalar:
    """Limit a speed from below, so that it can be a divisor, m/s: max(V, LEAST_SPEED)."""
    return array_namespace(speed).maximum(speed, LEAST_SPEED)


def bank_limit(limit: float, stall_speed: float, speed: Scalar) -> Scalar:
    """Compute the largest bank, rad: min(phi_max, acos((1.1 V_s / V)^2)), with STALL_MARGIN = 1.1.

    The load factor of a level turn is 1 / cos(phi). At a V of 1.1 V_s or less the bank is 0.
    """
    xp = array_namespace(speed)
    ratio = STALL_MARGIN * stall_speed / forward(speed)
    return xp.minimum(limit, xp.acos(xp.minimum(ratio**2, 1.0)))


def speed_floor(stall_speed: float) -> float:
    """Compute the least speed that may be commanded, m/s: 1.15 V_s."""
    return FLOOR * stall_speed


def _share(value: Scalar) -> Scalar:
    xp = array_namespace(value)
    return xp.minimum(xp.maximum(value, 0.0), 1.0)


def climb_limit(climb: float, sink: float, speed: Scalar, floor: float) -> Scalar:
    """Compute the largest climb rate, m/s: ratio climb - (1 - ratio) sink.

    ratio = clip((V - 0.9 V_floor) / (0.1 V_floor), 0, 1), with BAND = 0.1. So below the floor the
    pitch controls the airspeed. At nine tenths of the floor the aircraft sinks at its largest rate.
    """
    ratio = _share((speed - (1.0 - BAND) * floor) / (BAND * floor))
    return ratio * climb - (1.0 - ratio) * sink


def sink_limit(climb: float, sink: float, speed: Scalar, largest: float) -> Scalar:
    """Compute the least climb rate, m/s: (1 - ratio) climb - ratio sink.

    ratio = clip((1.1 V_max - V) / (0.1 V_max), 0, 1), with BAND = 0.1. This is the counterpart of
    `climb_limit`: above the largest airspeed V_max, the pitch controls the airspeed.
    """
    ratio = _share(((1.0 + BAND) * largest - speed) / (BAND * largest))
    return (1.0 - ratio) * climb - ratio * sink


def climb_range(
    climb: float, sink: float, shortfall: Scalar, speed: float
) -> tuple[Scalar, Scalar]:
    """Compute the least and the largest climb rate, m/s, for an airspeed error V_c - V, m/s.

    If a throttle at its stop cannot hold V, the error grows, and the climb or sink is reduced:

        least   = -sink clip(2 + shortfall / d, 0, 1),   d = max(0.05 V0, g sink / (0.4 V0))
        largest = climb clip(2 - shortfall / d, 0, 1),   d = max(0.05 V0, g climb / (0.4 V0))

    `shortfall` is the error, and `speed` is V0, m/s. The factors are LEAST_SHORTFALL and BANDWIDTH:
    with V_dot = -g climb / V, the second term of d limits the bandwidth with which the climb
    controls V.
    """
    margins = (
        max(LEAST_SHORTFALL * speed, GRAVITY * rate / (BANDWIDTH * speed)) for rate in (sink, climb)
    )
    ratios = (sign * shortfall / d for sign, d in zip((-1.0, 1.0), margins, strict=True))
    least, largest = (_share(2.0 - ratio) for ratio in ratios)
    return -sink * least, climb * largest
