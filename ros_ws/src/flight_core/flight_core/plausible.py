# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The largest plausible values of the outputs of an aircraft.

A sample beyond them is wrong, and an aircraft beyond them is lost.
"""

from collections.abc import Sequence
from math import radians

import numpy as np

from flight_core.vectors import FloatArray

LARGEST_RATE = radians(2000.0)
"""rad/s, full scale of the gyros of autopilots: ICM-42688-P (TDK InvenSense, DS-000347), BMI088
(Bosch, BST-BMI088-DS001)."""

# m/s from trim, the speed of sound at sea level: ICAO Doc 7488, standard atmosphere
LARGEST_AIRSPEED = 340.0
LARGEST = 1e6  # SI, for other outputs: no state of an aircraft in flight comes near it

BY_NAME = {"p": LARGEST_RATE, "q": LARGEST_RATE, "r": LARGEST_RATE, "V": LARGEST_AIRSPEED}


def largest(names: Sequence[str]) -> FloatArray:
    """Return the largest absolute values of outputs, deviations from trim, (m,), SI."""
    return np.array([BY_NAME.get(name, LARGEST) for name in names])
