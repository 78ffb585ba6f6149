# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Convert the units of airframe files.

Values are converted once, when they are loaded. After that, the code uses only SI and radians.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import pi
from types import MappingProxyType

import numpy as np

from flight_core.parameters import ParameterError, one_of
from flight_core.vectors import FloatArray

GRAVITY = 9.81  # standard gravity as rounded in the airframes, m/s^2
FOOT = 0.3048  # m, exact: the international foot of 1959
POUND = 0.45359237  # kg, exact: the international pound of 1959
POUND_FORCE = POUND * 9.80665  # N


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A unit: its value in SI, and its exponents of angle, length, time and mass."""

    si: float
    angle: int = 0
    length: int = 0
    time: int = 0
    mass: int = 0

    @property
    def dimension(self) -> tuple[int, int, int, int]:
        """Exponents of angle, length, time and mass."""
        return self.angle, self.length, self.time, self.mass


DIMENSIONLESS = (0, 0, 0, 0)
ANGLE = (1, 0, 0, 0)
LENGTH = (0, 1, 0, 0)
SPEED = (0, 1, -1, 0)
ANGULAR_RATE = (1, 0, -1, 0)

# Typical size of a state by its dimension, m/s and m. The weights of a design compare states after
# they are divided by their sizes.
SIZES = {SPEED: 1.0, LENGTH: 1.0}
ANGLE_SIZE = 0.1  # size of an angle, rad, of a rate, rad/s, and of a value without a dimension

BASE_UNITS: Mapping[str, Quantity] = MappingProxyType(
    {
        "1": Quantity(si=1.0),
        "%": Quantity(si=0.01),
        "rad": Quantity(si=1.0, angle=1),
        "deg": Quantity(si=pi / 180.0, angle=1),
        "crad": Quantity(si=0.01, angle=1),
        "mrad": Quantity(si=0.001, angle=1),
        "m": Quantity(si=1.0, length=1),
        "km": Quantity(si=1000.0, length=1),
        "cm": Quantity(si=0.01, length=1),
        "mm": Quantity(si=0.001, length=1),
        "ft": Quantity(si=FOOT, length=1),
        "in": Quantity(si=FOOT / 12.0, length=1),
        "mi": Quantity(si=5280.0 * FOOT, length=1),
        "nmi": Quantity(si=1852.0, length=1),
        "s": Quantity(si=1.0, time=1),
        "min": Quantity(si=60.0, time=1),
        "h": Quantity(si=3600.0, time=1),
        "kt": Quantity(si=1852.0 / 3600.0, length=1, time=-1),
        "mph": Quantity(si=5280.0 * FOOT / 3600.0, length=1, time=-1),
        "kg": Quantity(si=1.0, mass=1),
        "lb": Quantity(si=POUND, mass=1),
        "slug": Quantity(si=POUND_FORCE / FOOT, mass=1),
        "N": Quantity(si=1.0, length=1, time=-2, mass=1),
        "kN": Quantity(si=1000.0, length=1, time=-2, mass=1),
        "lbf": Quantity(si=POUND_FORCE, length=1, time=-2, mass=1),
    }
)
"""The units by name. Products, quotients and powers of these, such as ft/s^2, slug*ft^2 and deg/s,
are also units. Source: B. N. Taylor, A. Thompson, Guide for the Use of the International System of
Units, NIST SP 811, 2008, appendix B.
"""


@lru_cache(maxsize=256)
def quantity(unit: str, key: str = "unit") -> Quantity:
    """Return the SI value and the dimension of a unit, such as "ft/s^2".

    Raises ParameterError with `key` if the unit is not known.
    """
    total = Quantity(si=1.0)
    for part in re.findall(r"[*/]?[^*/]*", unit)[:-1] or [""]:
        factor = re.fullmatch(r"[*/]?([^^]*)(?:\^(-?[1-9]))?", part)
        name, power = factor.groups() if factor else (part, None)
        if name not in BASE_UNITS:
            known = f"{one_of(tuple(BASE_UNITS), name)}, or a product such as ft/s^2"
            raise ParameterError(f"{key}: found {unit!r}, expected {known}")
        exponent = (-1 if part.startswith("/") else 1) * int(power or 1)
        base = BASE_UNITS[name]
        si = total.si / base.si**-exponent if exponent < 0 else total.si * base.si**exponent
        total = Quantity(
            si=si,
            angle=total.angle + exponent * base.angle,
            length=total.length + exponent * base.length,
            time=total.time + exponent * base.time,
            mass=total.mass + exponent * base.mass,
        )
    return total


def unit_sizes(units: Iterable[str]) -> FloatArray:
    """Return the typical size of a value with each of these units, SI."""
    return np.array([SIZES.get(quantity(unit).dimension, ANGLE_SIZE) for unit in units])


def si_per_unit(unit: str) -> float:
    """Return the factor that converts a value in a unit to SI.

    Raises ParameterError if the unit is not known.
    """
    return quantity(unit).si


def in_si(value: str | float, key: str, like: str) -> float:
    """Return a number in SI, given such a number or a text with a unit, such as "176 ft/s".

    `like` is an SI unit of the same dimension. Raises ParameterError if the text has no finite
    number, an unknown unit, or a unit of another dimension.
    """
    match = re.fullmatch(
        r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?:\s*)(\D.*)?", str(value).strip()
    )
    if match is None:
        raise ParameterError(f"{key}: found {value!r}, expected a number in {like}, or with a unit")
    unit = quantity(match[2] or like, key)
    if unit.dimension != quantity(like).dimension:
        raise ParameterError(f"{key}: found {value!r}, expected a unit like {like}")
    return float(match[1]) * unit.si
