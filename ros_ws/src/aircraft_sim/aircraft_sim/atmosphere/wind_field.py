# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute wind that varies with the position: a profile over the height, and a microburst.

An aircraft flies in an air mass that moves with the wind at its start. Where the wind is another
one, the difference acts on the aircraft.
"""

import math
from typing import NamedTuple

import numpy as np

from aircraft_sim.pose import Start
from flight_core.vectors import FloatArray

LAYER = 12.5
PEAK_HEIGHT = math.log(LAYER) / (LAYER - 1.0)
"""LAYER is the ratio of z* to the height e of the boundary layer. PEAK_HEIGHT is the ratio of the
height of the largest outflow to z*."""

PEAK = 0.319086343 * (math.exp(-PEAK_HEIGHT) - math.exp(-LAYER * PEAK_HEIGHT))
"""Largest outflow u of a microburst, divided by l R. It is the product of two factors. The first is
the largest value of (1 - exp(-s^2)) / (2 s), at s = r / R = 1.1209. The second is exp(-z / z*) -
exp(-z / e) at the height z of the largest outflow."""


class Log(NamedTuple):
    """Logarithmic wind profile, as a factor on the wind at the reference height.

    The factor is ln(h / z0) / ln(h_ref / z0), and 0 below z0. Source: neutral surface layer,
    MIL-F-8785C, 3.7.3.2.
    """

    reference: float  # h_ref, m
    roughness: float  # z0, m

    def factor(self, height: float) -> float:
        """Return the wind at a height above the ground, m, divided by that at `reference`."""
        above = max(height / self.roughness, 1.0)
        return math.log(above) / math.log(self.reference / self.roughness)


class Power(NamedTuple):
    """Power law of the wind: a factor (h / h_ref)^a on the wind at h_ref; 0 on the ground."""

    reference: float  # h_ref, m
    exponent: float  # a

    def factor(self, height: float) -> float:
        """Return the wind at a height above the ground, m, divided by that at `reference`."""
        return float((max(height, 0.0) / self.reference) ** self.exponent)


class Table(NamedTuple):
    """Wind by height from a table, linear between its heights and constant beyond them."""

    height: tuple[float, ...]  # m, rising
    north: tuple[float, ...]  # m/s, positive if the air moves to the north
    east: tuple[float, ...]


class Microburst(NamedTuple):
    """A downdraft that spreads over the ground.

        u = l R^2 / (2 r) (1 - exp(-r^2 / R^2)) (exp(-z / z*) - exp(-z / e))   outward
        w = -l exp(-r^2 / R^2) (e (exp(-z / e) - 1) - z* (exp(-z / z*) - 1))   up

    Here l = speed / (PEAK R), z* = height / PEAK_HEIGHT and e = z* / LAYER. In `wind`, l is
    `scale`, z* is `far` and e is `near`. The flow is incompressible. Source: R. M. Oseguera, R. L.
    Bowles, A Simple, Analytic 3-Dimensional Downburst Model Based on Boundary Layer Stagnation
    Flow, NASA TM-100632 (1988).
    """

    north: float  # m, north of the centre
    east: float
    radius: float  # R, m, radius of the downdraft
    speed: float  # largest outflow, m/s
    height: float  # height of the largest outflow above the ground, m

    def wind(self, north: float, east: float, height: float) -> tuple[float, float, float]:
        """Return the wind at a place, m/s: to the north, to the east and down."""
        x = north - self.north
        y = east - self.east
        r = max(math.hypot(x, y), 1e-6 * self.radius)
        far = self.height / PEAK_HEIGHT
        near = far / LAYER
        z = max(height, 0.0)
        scale = self.speed / (PEAK * self.radius)
        core = math.exp(-((r / self.radius) ** 2))
        spread = math.exp(-z / far) - math.exp(-z / near)
        outward = scale * self.radius**2 / (2.0 * r) * (1.0 - core) * spread
        down = scale * core * (near * math.expm1(-z / near) - far * math.expm1(-z / far))
        return outward * x / r, outward * y / r, down


class WindField(NamedTuple):
    """Wind as a function of place.

    `wind` is the steady wind. With a profile `Log` or `Power`, it is the wind at the reference
    height.
    """

    wind: tuple[float, float]  # m/s to the north, to the east
    ground: float  # altitude of the ground, m, with the reference of the altitude in `pose`
    shear: Log | Power | Table | None = None
    microburst: Microburst | None = None

    def at(self, north: float, east: float, altitude: float) -> tuple[float, float, float]:
        """Return the wind at a place over ground, m/s: to the north, to the east and down."""
        height = altitude - self.ground
        shear = self.shear
        to_north, to_east = self.wind
        if isinstance(shear, Table):
            to_north = float(np.interp(height, shear.height, shear.north))
            to_east = float(np.interp(height, shear.height, shear.east))
        elif shear is not None:
            factor = shear.factor(height)
            to_north *= factor
            to_east *= factor
        if self.microburst is None:
            return to_north, to_east, 0.0
        outward = self.microburst.wind(north, east, height)
        return to_north + outward[0], to_east + outward[1], outward[2]


class RelativeWind:
    """Wind minus the wind at the start, in the axes of a flight.

    In these axes the flight begins at the origin and heads north. The air mass moves with the wind
    at the start, `carried`, to the north and to the east, m/s.
    """

    def __init__(self, field: WindField, start: Start, altitude: float) -> None:
        self._field = field
        self._start = start
        self.carried = field.at(start.north, start.east, altitude)[:2]
        self._cos = math.cos(start.heading)
        self._sin = math.sin(start.heading)

    def at(self, t: float, north: float, east: float, altitude: float) -> FloatArray:
        """Return the wind at a time and at a place of the flight, m/s, shape (3,).

        Its components are north, east and down.
        """
        cos = self._cos
        sin = self._sin
        x = self._start.north + self.carried[0] * t + cos * north - sin * east
        y = self._start.east + self.carried[1] * t + sin * north + cos * east
        to_north, to_east, down = self._field.at(x, y, altitude)
        to_north -= self.carried[0]
        to_east -= self.carried[1]
        return np.array([cos * to_north + sin * to_east, cos * to_east - sin * to_north, down])


def body_axes(phi: float, theta: float, psi: float) -> FloatArray:
    """Return the rotation matrix from north, east, down to body axes (FRD), shape (3, 3).

    Source: Stevens, Lewis, Aircraft Control and Simulation, 2nd ed. (2003), eq. (1.3-20).
    """
    sin_phi, sin_theta, sin_psi = map(math.sin, (phi, theta, psi))
    cos_phi, cos_theta, cos_psi = map(math.cos, (phi, theta, psi))
    tilted = sin_phi * sin_theta
    upright = cos_phi * sin_theta
    return np.array(
        [
            [cos_theta * cos_psi, cos_theta * sin_psi, -sin_theta],
            [
                tilted * cos_psi - cos_phi * sin_psi,
                tilted * sin_psi + cos_phi * cos_psi,
                sin_phi * cos_theta,
            ],
            [
                upright * cos_psi + sin_phi * sin_psi,
                upright * sin_psi - sin_phi * cos_psi,
                cos_phi * cos_theta,
            ],
        ]
    )
