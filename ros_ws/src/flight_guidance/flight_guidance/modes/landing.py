# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a landing at the end of a line of a route: flare, alignment of the nose, and go-around.

The line to a waypoint on the ground is the glide path. Guidance follows it like any leg of a route,
down to the flare. Below the height of the flare, the landing adds commands at each step. They are
in the log, so a landing can be computed again from the log like any flight.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from flight_core.kinematics import clip
from flight_core.parameters import require
from flight_core.units import GRAVITY
from flight_guidance.fence.zones import Zone, clearance
from flight_guidance.guidance_state import GuidanceMode, GuidanceParams, GuidanceState, Lateral
from flight_guidance.modes.legs import course_and_speed
from flight_guidance.sections import LandingConfig
from flight_guidance.steering import path
from flight_guidance.steering.path import Line, Point, Route, Side

FLARE = 5.0
"""Height of the flare, in s of sink on the glide path. The flight path lags the pitch by 2 s."""

STRAIGHT_DEG = 1.0
STRAIGHT = math.radians(STRAIGHT_DEG)
"""Largest corner at the waypoint on the ground, because the wings must stay level there."""

WING_LOW = math.radians(5.0)
"""Largest bank near the ground, rad: a low wing of 2.5 m per metre of height touches at 22 deg."""

YAW_GAIN = 1.0
"""Gain from the angle between the nose and the line to the yaw rate, 1/s. In 2 s the crab angle is
gone."""

FASTEST_YAW = math.radians(6.0)
"""Largest yaw rate of the landing, rad/s."""


class Landing(NamedTuple):
    """The geometry and the limits of a landing at the end of a line of a route."""

    leg: int  # number of the leg that is the glide path
    around: int  # number of the leg that a go-around flies
    place: Point  # end of the glide path, on the ground
    ground: float  # m, altitude of this place
    course: float  # rad, course of the glide path
    slope: float  # slope of the glide path (climb over distance), which is below 0
    flare: float  # m, height at which the flare begins
    sink: float  # m/s, sink rate at touchdown
    decrab: float  # m, height below which the nose is turned along the line
    V: float  # m/s, airspeed from the flare on
    box: Zone | None  # the zone in which the aircraft must touch down; None for any place


def landing_at(
    place: Point, route: Route, section: LandingConfig, box: Zone | None, params: GuidanceParams
) -> Landing:
    """Return the landing at a place on the ground to which a route leads.

    Raises ParameterError unless a line of the route descends to the place and the next line goes
    straight on.
    """
    key = f"landing.waypoint {section.waypoint}"
    lines = [k for k, leg in enumerate(route.legs) if isinstance(leg, Line)]
    # m of a line that the fillet of the largest permitted corner cuts off
    fillet = max(route.radius * math.tan(STRAIGHT / 2.0), 1.0)
    pairs = [
        (leg, around)
        for leg, around in pairwise(lines)
        if math.dist(path.outline(route.legs[leg], place)[-1], place) <= fillet
    ]
    straight = f"a line to it, and one on to the next waypoint within {STRAIGHT_DEG:g} deg of it"
    require(bool(pairs), key, "a corner, a circle or no line", straight)
    leg, around = pairs[0]
    line = route.legs[leg]
    ground, slope = route.profile(leg, path.length(line))
    require(slope < 0.0, key, f"a line with the slope {slope:g}", "one that descends")
    speed = route.V[leg]
    return Landing(
        leg=leg,
        around=around,
        place=place,
        ground=ground,
        course=path.end_course(line),
        slope=slope,
        flare=section.flare or FLARE * -slope * speed,
        sink=section.sink,
        decrab=section.decrab,
        V=section.V or speed,
        box=box,
    )


def flare_climb(height: float, path_sink: float, landing: Landing) -> float:
    """Compute the climb rate that the flare commands at a height, m/s.

    It changes linearly with the height, m, from the climb rate on the glide path to -sink.
    `path_sink` is the sink rate on the glide path, m/s. If it is below the `sink` of the landing,
    the climb rate is -sink at every height.
    """
    share = min(max(height / landing.flare, 0.0), 1.0)
    return -(landing.sink + max(path_sink - landing.sink, 0.0) * share)


def time_to_touch(height: float, path_sink: float, landing: Landing) -> float:
    """Compute the time until the wheels touch the ground in the flare, s.

    The time is the integral of dh / sink(h), where -sink(h) is `flare_climb`.
    """
    rate = max(path_sink - landing.sink, 1e-3) / landing.flare
    return math.log1p(rate * max(height, 0.0) / landing.sink) / rate


class Lander:
    """Gives the commands of a landing, step by step."""

    def __init__(self, landing: Landing, params: GuidanceParams) -> None:
        self._landing = landing
        self._params = params
        self._flares = False

    def leave(self) -> None:
        """End the flare, because the operator or the commands over time ask for something else."""
        self._flares = False

    def commands(
        self, state: GuidanceState, pose: Mapping[str, float], route: Route
    ) -> dict[str, float]:
        """Return the commands for the step after `state`; none above the flare."""
        landing = self._landing
        height = pose["altitude"] - landing.ground
        if state.mode is not GuidanceMode.ENGAGED:
            return {}
        on_line = (
            state.lateral is Lateral.ROUTE
            and state.leg == landing.leg
            and state.joining is Side.NONE
        )
        self._flares = self._flares or (on_line and height <= landing.flare)
        if not self._flares:
            return {}
        course, ground_speed = course_and_speed(pose)
        path_sink = min(-landing.slope * ground_speed, self._params.vertical.sink)
        if height > landing.decrab and self._is_outside_box(height, path_sink, pose):
            self._flares = False
            return self._go_around(pose, route)
        height_ahead = height + self._params.vertical.alpha_time * pose["climb"]
        commands = {"climb": flare_climb(height_ahead, path_sink, landing), "V": landing.V}
        if height > landing.decrab or "r" not in self._params.outputs:
            return commands
        return commands | self._along_line(pose, math.sin(course - landing.course) * ground_speed)

    def _is_outside_box(self, height: float, path_sink: float, pose: Mapping[str, float]) -> bool:
        """Return whether the aircraft would touch down outside of the zone `box`."""
        if self._landing.box is None:
            return False
        time = time_to_touch(height, path_sink, self._landing)
        north, east = (
            np.array([pose[axis] + time * pose[f"v_{axis}"]]) for axis in ("north", "east")
        )
        return float(clearance((self._landing.box,), north, east)[0]) < 0.0

    def _go_around(self, pose: Mapping[str, float], route: Route) -> dict[str, float]:
        """Return the commands that fly the line of the go-around, from its nearest point on."""
        leg = self._landing.around
        along = path.nearest(route.legs[leg], (pose["north"], pose["east"]))
        return {"leg": float(leg), "along": along}

    def _along_line(self, pose: Mapping[str, float], drift: float) -> dict[str, float]:
        """Return the commands that turn the nose along the line and lower the upwind wing.

        `drift` is the speed across the line, m/s, and e the distance from the line, m. Both are
        positive to the right. The law is

            r = k (course - psi),  g tan(phi) = -w^2 e - 2 zeta w drift,  w = 2 pi / P

        k is YAW_GAIN, and course is the course of the line. P and zeta are the period and the
        damping of path following.
        """
        landing = self._landing
        w = 2.0 * math.pi / self._params.path.period
        north, east = pose["north"] - landing.place[0], pose["east"] - landing.place[1]
        offset = east * math.cos(landing.course) - north * math.sin(landing.course)
        acceleration = -(w**2) * offset - 2.0 * self._params.path.damping * w * drift
        yaw_error = math.remainder(landing.course - pose["psi"], 2.0 * math.pi)
        return {
            "phi": clip(math.atan(acceleration / GRAVITY), WING_LOW),
            "r": clip(YAW_GAIN * yaw_error, FASTEST_YAW),
        }
