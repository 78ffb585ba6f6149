# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Derive limits of commands from the authority of the inputs.

The authority is the y_dot that an input can give to its output. At the start a rule gives it, and
later a model that is learned in flight.
"""

import math
from collections.abc import Mapping
from itertools import product
from typing import NamedTuple

from flight_core.channels import SIDES, UNKNOWN
from flight_core.units import GRAVITY

CLIMB = 0.7
SINK = 0.5
"""CLIMB and SINK are the fractions of the throttle's authority that a climb and a sink may use. The
rest holds the airspeed."""

REVERSALS = 9.3
"""Least period of path following, divided by bank / roll rate. A reversal of the bank takes
2 bank / roll rate, so this is the time of 4.65 reversals. With a period of 3.5 reversals the osprey
went into a limit cycle in turbulence."""


LEAST = 1e-3
"""Authority below which an input counts as without effect, units of y / s."""


YAWED_BANK = math.radians(10.0)
"""Largest bank without an aileron. The rudder alone can fly the turn of this bank even with level
wings, on the osprey in a sideslip of 6 deg."""


MEMORY = 10.0
"""Time over which the roll rate is compared with its command, s."""

ASKED = 2.0
"""Least `RollTest.asked` with which the test decides, divided by the square of the largest roll
rate, s. A constant command of the largest roll rate reaches it in about this time. Without an
aileron the osprey is by then 40 deg off its commanded bank. If it stays 7 deg off, `asked` reaches
the limit after a time of MEMORY. A turn of the osprey onto a course does not reach it."""

IGNORED = 0.3
"""A command counts as ignored if p follows less than this fraction of it. In strong turbulence the
osprey, and the c172p and the 737 of JSBSim, follow at least 0.8 of a command. With 0.3 of the
aileron's effect they follow at least 0.75, and without an aileron at most 0.05."""

FOLLOWED = 0.7
"""Least fraction of a command that counts as followed again. `attitude.yaw_for_bank` alone
rolls with up to half of the command."""


class Authority(NamedTuple):
    """Least rate at which each input can surely change its output from trim, units of y / s.

    The rate is 0 if the input has no effect, and UNKNOWN if no model is learned.
    """

    q: float = UNKNOWN  # rad/s^2
    p: float = UNKNOWN  # rad/s^2
    down: float = UNKNOWN  # deceleration of V, m/s^2
    up: float = UNKNOWN  # acceleration of V, m/s^2
    roll: float = UNKNOWN  # 0 if the measured p ignores its command according to `RollTest`


class RollTest(NamedTuple):
    """Tests whether p follows its command p_m, without a model and without u.

        a_dot = p_m^2 - a / MEMORY,   f_dot = p_m p - f / MEMORY

    By least squares, f / a is the fraction of the command that the aircraft follows. a grows with
    the roll that was commanded, and the test decides only if a is large enough.
    """

    asked: float = 0.0  # a, rad^2/s
    flown: float = 0.0  # f, rad^2/s
    is_ignored: bool = False

    def after(self, dt: float, command: float, p: float, largest: float) -> "RollTest":
        """Return the test after a further step of dt, s, with a command and a measured p, rad/s.

        `largest` is the largest command, rad/s. The verdict `is_ignored` can only change while
        `asked` is above ASKED largest^2.
        """
        memory = math.exp(-dt / MEMORY)
        asked = memory * self.asked + dt * command**2
        flown = memory * self.flown + dt * command * p
        is_ignored = self.is_ignored
        if asked > ASKED * largest**2:
            is_ignored = flown < (FOLLOWED if is_ignored else IGNORED) * asked
        return RollTest(asked, flown, is_ignored)


AUTHORITY = tuple(f"{side}.{name}" for side, name in product(SIDES, ("q", "p", "V")))
"""Channels of the topic `authority` that guidance takes."""


def authority_of(channels: Mapping[str, float]) -> Authority:
    """Read the authority from the channels of the topic `authority`.

    The topic has a value for each of two directions of an output. For q and p the smaller value is
    taken.
    """
    q = min(channels[f"{side}.q"] for side in SIDES)
    p = min(channels[f"{side}.p"] for side in SIDES)
    return Authority(q, p, *(channels[f"{side}.V"] for side in SIDES))


def climb_rates(down: float, up: float, speed: float) -> tuple[float, float]:
    """Compute the climb rate at full throttle and the sink rate at no throttle, m/s.

    The climb rate is CLIMB up V0 / g, and the sink rate is SINK down V0 / g. `up` and `down` are
    the authority of the throttle in the two directions, m/s^2, and `speed` is V0, m/s.
    """
    return CLIMB * up * speed / GRAVITY, SINK * down * speed / GRAVITY


def roll_rate(authority: float, frequency: float) -> float:
    """Compute the roll rate p_max for an authority of the aileron, rad/s.

    With this p_max, a step of the command asks for a third of the authority: the largest p_m_dot of
    the reference is then 0.4 w p_max. w is the natural frequency of the reference for p,
    `frequency`, rad/s.
    """
    return authority / (3.0 * 0.4 * frequency)


def least_period(bank: float, rate: float) -> float:
    """Compute the least period of path following, s, which lasts for REVERSALS bank / rate.

    A reversal of the largest bank, rad, at the roll rate `rate`, rad/s, then fits into it.
    """
    return REVERSALS * bank / rate
