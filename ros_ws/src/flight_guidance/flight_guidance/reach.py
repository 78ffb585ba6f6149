# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Limits of commands by what the inputs can do.

At the start they follow by rule, later from a model that is learned in flight.
"""

import math
from collections.abc import Mapping
from itertools import product
from typing import NamedTuple

from flight_core.channels import SIDES, UNKNOWN
from flight_core.units import GRAVITY

CLIMB = 0.7
SINK = 0.5
"""Fractions of the throttle's authority for a climb and a sink; the rest holds the airspeed."""

REVERSALS = 9.3
"""Least period of path following over bank / roll rate. A bank reversal takes 2 bank / roll rate.
With a period of 3.5 reversals the osprey cycled in turbulence, so 4.65 are required."""


LEAST = 1e-3
"""units/s; an input with less authority has no effect."""


YAWED_BANK = math.radians(10.0)
"""Largest bank without an aileron: the rudder also flies its turn with level wings, in a sideslip
of 6 deg of the osprey."""


MEMORY = 10.0
"""s, over which the roll rate is compared with its command."""

ASKED = 2.0
"""s of the largest roll rate: how much command is evidence. Without an aileron the osprey is then
40 deg from its bank, or 7 deg for MEMORY. A turn of the osprey onto a course asks for less."""

IGNORED = 0.3
"""Largest fraction of a command that counts as ignored. In strong turbulence the osprey, the c172p
and the 737 of JSBSim have at least 0.8, and 0.75 with 0.3 of the aileron; without an aileron at
most 0.05."""

FOLLOWED = 0.7
"""Least fraction that counts as followed again. `attitude.yaw_for_bank` alone rolls with up to half
of the command."""


class Authority(NamedTuple):
    """Least change of an output by its input from trim, units/s.

    It is 0 without an effect, and UNKNOWN without a learned model.
    """

    q: float = UNKNOWN  # rad/s^2
    p: float = UNKNOWN  # rad/s^2
    down: float = UNKNOWN  # of V, m/s^2
    up: float = UNKNOWN
    roll: float = UNKNOWN  # 0 if the measured p ignores its command, by `RollTest`


class RollTest(NamedTuple):
    """Tells whether p follows its command p_m, without a model and without u.

        a_dot = p_m^2 - a / MEMORY,   f_dot = p_m p - f / MEMORY

    f / a is the fraction of the command that the aircraft flies, by least squares.
    """

    asked: float = 0.0  # a, rad^2/s
    flown: float = 0.0  # f, rad^2/s
    ignored: bool = False

    def after(self, dt: float, command: float, p: float, largest: float) -> "RollTest":
        """Return the test after a step of a command, at most `largest`, and a measured p, rad/s.

        Without ASKED of evidence the verdict stays.
        """
        memory = math.exp(-dt / MEMORY)
        asked = memory * self.asked + dt * command**2
        flown = memory * self.flown + dt * command * p
        ignored = self.ignored
        if asked > ASKED * largest**2:
            ignored = flown < (FOLLOWED if ignored else IGNORED) * asked
        return RollTest(asked, flown, ignored)


AUTHORITY = tuple(f"{side}.{name}" for side, name in product(SIDES, ("q", "p", "V")))
"""Channels of the topic `authority` that guidance takes."""


def authority_of(channels: Mapping[str, float]) -> Authority:
    """Read the channels of the topic; q and p count with the lesser of both ways."""
    q = min(channels[f"{side}.q"] for side in SIDES)
    p = min(channels[f"{side}.p"] for side in SIDES)
    return Authority(q, p, *(channels[f"{side}.V"] for side in SIDES))


def climb_rates(down: float, up: float, speed: float) -> tuple[float, float]:
    """Compute the climb and sink rate that full throttle up and down gives, m/s.

    They are a V0 / g, times the fractions CLIMB and SINK.
    """
    return CLIMB * up * speed / GRAVITY, SINK * down * speed / GRAVITY


def roll_rate(authority: float, frequency: float) -> float:
    """Compute the roll rate p_max, rad/s.

    0.4 w p_max, the largest p_m_dot of the reference after a step, is then a third of the
    authority.
    """
    return authority / (3.0 * 0.4 * frequency)


def least_period(bank: float, rate: float) -> float:
    """Compute the least period of path following for reversals of a bank at a roll rate, s."""
    return REVERSALS * bank / rate
