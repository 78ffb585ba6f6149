# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Units of airframe files. Values are converted to SI once, at load; the code uses SI and radians."""

import math
from collections.abc import Mapping
from types import MappingProxyType

GRAVITY = 9.81  # standard gravity as rounded in the airframes, m/s^2

SI_PER_UNIT: Mapping[str, float] = MappingProxyType(
    {
        "rad": 1.0,
        "deg": math.pi / 180.0,
        "crad": 0.01,
        "rad/s": 1.0,
        "deg/s": math.pi / 180.0,
        "crad/s": 0.01,
        "m/s": 1.0,
        "ft/s": 0.3048,  # exact: the international foot of 1959
        "1": 1.0,
        "%": 0.01,
    }
)
"""SI value (rad, rad/s, m/s, 1) of a unit: value_SI = value * SI_PER_UNIT[unit]."""
