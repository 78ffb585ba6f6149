# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Choose gains and limits of a multicopter's guidance by rule, and plan its routes."""

import math
from collections.abc import Mapping, Sequence

from flight_core.parameters import require
from flight_core.units import GRAVITY
from flight_guidance import reach
from flight_guidance.feasibility import Performance, as_route, require_bounds, speeds
from flight_guidance.guidance_state import MulticopterParams
from flight_guidance.routes.route_file import Waypoint
from flight_guidance.steering import path
from flight_guidance.steering.attitude import BANDWIDTH_RATIO
from flight_guidance.steering.path import Arc, Leg, Loiter, Route

BRAKING = 0.3
"""Fraction of the acceleration at the largest tilt that is used in a fillet and for a stop. The
rest is left for drag and errors."""

CLIMB = 0.5
SINK = 0.3
"""Largest climb and sink rate as fractions of the speed, if the parameters have none."""


def gains(
    frequency: Mapping[str, float], bank: float, drag: float, roll_authority: float
) -> MulticopterParams:
    """Choose the gains of a multicopter's guidance.

        k_tilt = w / 4,  k_v = k_tilt / 3,  k_p = k_v / 2,  lead = 1 / k_tilt,  k_psi = w_r / 4,
            braking = BRAKING g tan(bank)

    In the reference model, w is the lower of the natural frequencies of p and q, and w_r is the
    natural frequency of r, rad/s. `bank` is the largest tilt, rad. With a reference model of
    damping 0.9, the loop of the tilt has a phase margin of 65 deg. The loops of velocity and place
    together have a phase margin of 44 deg and a largest sensitivity of 1.5. The lead is the delay
    of the tilt behind a ramp.
    """
    w = min(frequency["p"], frequency["q"])
    k_tilt = w / BANDWIDTH_RATIO
    k_v = k_tilt / 3.0
    fastest = min(2.0 * k_tilt * bank, reach.roll_rate(roll_authority, w))
    return MulticopterParams(
        drag=drag,
        k_tilt=k_tilt,
        k_psi=frequency["r"] / BANDWIDTH_RATIO,
        k_v=k_v,
        k_p=k_v / 2.0,
        lead=1.0 / k_tilt,
        braking=BRAKING * GRAVITY * math.tan(bank),
        tilt_rate=fastest,
        yaw_rate=frequency["r"] / 2.0,
    )


def route_through(
    waypoints: Sequence[Waypoint], radius: float | None, braking: float, can: Performance
) -> Route:
    """Plan lines with fillets through waypoints, and hovers at the last one and at each `wait`.

    The aircraft reaches a hover by a line without a fillet. The leg of a hover is a circle with the
    radius of the fillets, and the aircraft hovers at its centre. Altitudes change along the lines.
    `braking`, m/s^2, bounds the curvature. Raises ParameterError for a waypoint beyond the bounds,
    and for circles, which a multicopter does not fly.
    """
    require(len(waypoints) >= 2, "route", f"{len(waypoints)} waypoints", "two or more")
    require_bounds(waypoints, can)
    for k, waypoint in enumerate(waypoints):
        circles = waypoint.turns > 0.0 or waypoint.departure != waypoint.altitude
        expected = "neither: a multicopter flies no circle; `wait` hovers"
        require(not circles, f"route[{k}]", "turns or a leave", expected)
    fastest = max(speeds(waypoints, can.speed))
    least = fastest**2 / braking
    radius = radius or math.ceil(10.0 * least) / 10.0
    expected = f"at least {least:.1f} m at {fastest:g} m/s"
    require(radius >= 0.99 * least, "radius", f"{radius:g} m", expected)
    return as_route(tuple(_legs(waypoints, radius)), waypoints, can.speed, slopes=True)


def _legs(waypoints: Sequence[Waypoint], radius: float) -> list[Leg]:
    """Plan lines with fillets between the hovers. The last hover lasts for ever."""
    points = [waypoint.point for waypoint in waypoints]
    legs: list[Leg] = []
    first = 0
    for k, waypoint in enumerate(waypoints[:-1]):
        if waypoint.wait:
            legs += path.filleted(points[first : k + 1], radius, first)
            legs.append(Arc(points[k], radius, points[k], Loiter(wait=waypoint.wait)))
            first = k
    legs += path.filleted(points[first:], radius, first)
    return [*legs, Arc(points[-1], radius)]
