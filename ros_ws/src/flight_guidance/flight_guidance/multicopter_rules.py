# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Numbers by rule of a multicopter's guidance, and the routes that a multicopter flies."""

import math
from collections.abc import Mapping, Sequence

from flight_core.parameters import require
from flight_core.units import GRAVITY
from flight_guidance import path, reach
from flight_guidance.feasibility import speeds
from flight_guidance.guidance_state import LARGEST, MulticopterParams
from flight_guidance.path import Arc, Route
from flight_guidance.route_file import Waypoint

BRAKING = 0.3
"""Part of the acceleration of the largest tilt for a fillet and for a stop: the drag and the errors
take the rest."""

CLIMB = 0.5
SINK = 0.3
"""Largest climb and sink rate over the speed where the parameters have none."""


def gains(
    frequency: Mapping[str, float], bank: float, drag: float, roll_authority: float
) -> MulticopterParams:
    """Gains by the reference model's natural frequencies w, rad/s, and the largest tilt, rad.

        k_tilt = w / 4,  k_v = k_tilt / 3,  k_p = k_v / 2,  lead = 1 / k_tilt,  k_psi = w_r / 4,
            braking = BRAKING g tan(bank)

    with the lesser w of p and q. With a reference of damping 0.9 the tilt has a phase margin of 65
    deg, velocity and place together have 44 deg and a largest sensitivity of 1.5; the lead is the
    delay of the tilt behind a ramp.
    """
    w = min(frequency["p"], frequency["q"])
    k_tilt = w / 4.0
    k_v = k_tilt / 3.0
    fastest = min(2.0 * k_tilt * bank, reach.roll_rate(roll_authority, w))
    return MulticopterParams(
        drag=drag,
        k_tilt=k_tilt,
        k_psi=frequency["r"] / 4.0,
        k_v=k_v,
        k_p=k_v / 2.0,
        lead=1.0 / k_tilt,
        braking=BRAKING * GRAVITY * math.tan(bank),
        tilt_rate=fastest,
        yaw_rate=frequency["r"] / 2.0,
    )


def route_through(
    waypoints: Sequence[Waypoint],
    speed: float,
    radius: float | None,
    braking: float,
    bounds: tuple[float, float, float],
) -> Route:
    """Lines with fillets through waypoints, and a hover at the last one: its leg is a circle of the
    radius of the fillets within which the place counts as reached.

    `speed`: over ground where a waypoint names none, m/s; `bounds`: least and largest altitude, m,
    and largest speed, m/s. Altitudes change along the lines. Raises ParameterError for a waypoint
    beyond the bounds, and for circles and waits, which a multicopter does not fly.
    """
    lowest, highest, fastest = bounds
    require(len(waypoints) >= 2, "route", f"{len(waypoints)} waypoints", "two or more")
    flown = speeds(waypoints, speed)
    for k, (waypoint, fast) in enumerate(zip(waypoints, flown, strict=True)):
        key = f"route[{k}]"
        known = max(abs(waypoint.north), abs(waypoint.east)) <= LARGEST
        place = f"north {waypoint.north:g}, east {waypoint.east:g} m"
        require(known, key, place, f"finite values, at most {LARGEST:g} m either way")
        fits = lowest <= waypoint.altitude <= highest
        expected = f"{lowest:g} to {highest:g} m"
        require(fits, f"{key}.altitude", f"{waypoint.altitude:g} m", expected)
        require(fast <= fastest, f"{key}.V", f"{fast:g} m/s", f"at most {fastest:g} m/s")
        circles = waypoint.loiters or waypoint.departure != waypoint.altitude
        expected = "none: a multicopter hovers at the last waypoint alone"
        require(not circles, key, "turns, a wait or a leave", expected)
    least = max(flown) ** 2 / braking
    radius = radius or float(math.ceil(10.0 * least) / 10.0)
    expected = f"at least {least:.1f} m at {max(flown):g} m/s"
    require(radius >= 0.99 * least, "radius", f"{radius:g} m", expected)
    points = [waypoint.point for waypoint in waypoints]
    legs = (*path.filleted(points, radius), Arc(points[-1], radius))
    numbers = path.leads(legs)
    before = [max(k - 1, 0) for k in numbers]
    ends = []
    for leg, to, start in zip(legs, numbers, before, strict=True):
        level = isinstance(leg, Arc) and leg.end is not None
        ends.append(waypoints[start if level else to].altitude)
    return Route(
        legs,
        tuple(ends),
        tuple(flown[k] for k in numbers),
        tuple(waypoints[k].altitude for k in before),
        tuple(flown[k] for k in before),
        slopes=True,
    )
