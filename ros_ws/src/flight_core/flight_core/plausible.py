# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Give the largest plausible values of the outputs of an aircraft.

A measured sample beyond these values is wrong. A simulated aircraft beyond them is lost.
"""

from collections.abc import Sequence
from math import radians

import numpy as np

from flight_core.vectors import FloatArray

LARGEST_RATE = radians(2000.0)
"""Full scale of the gyros of autopilots, rad/s: ICM-42688-P (TDK InvenSense, DS-000347), BMI088
(Bosch, BST-BMI088-DS001)."""

# Largest deviation of the airspeed from trim, m/s, which is the speed of sound at sea level (ICAO
# Doc 7488, standard atmosphere).
LARGEST_AIRSPEED = 340.0
LARGEST = 1e6  # bound for other outputs, SI, far above any state of an aircraft in flight

BY_NAME = {"p": LARGEST_RATE, "q": LARGEST_RATE, "r": LARGEST_RATE, "V": LARGEST_AIRSPEED}


def largest(names: Sequence[str]) -> FloatArray:
    """Return the largest plausible deviation of each output from trim, (m,), SI."""
    return np.array([BY_NAME.get(name, LARGEST) for name in names])
