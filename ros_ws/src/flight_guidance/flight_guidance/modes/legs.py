# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly along a route: join its legs, follow them, and go on to the next leg."""

import math
from collections.abc import Callable, Mapping

from flight_core.vectors import Scalar, array_namespace
from flight_guidance.fence.fence import FenceAction
from flight_guidance.guidance_state import (
    GuidanceMode,
    GuidanceState,
    Lateral,
    TargetChannels,
    Vertical,
)
from flight_guidance.steering import path
from flight_guidance.steering.path import Arc, Leg, Loiter, Point, Route, Side

EXIT = 0.5
"""An aircraft leaves a circle up to this many seconds of flight beyond its end. Later it flies
another turn."""


LEVEL = 5.0
"""Largest difference from the altitude of the leg at which an aircraft may leave a loiter, m."""


def along_route(
    state: GuidanceState, pose: Mapping[str, float], dt: float, route: Route
) -> tuple[GuidanceState, float]:
    """Put the state on a leg when the aircraft has joined it, and on the next leg at its end.

    The second result says by how much the aircraft missed the end of the leg, m, or is 0.
    """
    position = (pose["north"], pose["east"])
    leg = route.legs[state.leg]
    near = route.near(state.leg)
    if state.joining is not Side.NONE:
        start, course = route.start(state.leg, state.target.along)
        if path.is_joined(start, course, near, position, course_and_speed(pose)[0]):
            state = on_leg(state, state.leg, route)
        return state, 0.0
    if isinstance(leg, Arc) and leg.loiter is not None and leg.end is not None:
        state = _loitering(state, leg, leg.loiter, pose, dt)
        ends = has_loitered(state, pose, route) and is_at_exit(
            leg, EXIT * course_and_speed(pose)[1], pose, position
        )
        return on_leg(state, state.leg + 1, route) if ends else state, 0.0
    if leg.end is None or not path.is_passed(leg, position):
        return state, 0.0
    # After a sharp corner, the aircraft must join the next leg by a circle.
    distance = math.dist(leg.end, position)
    return joining_state(
        state, state.leg + 1, 0.0, pose, route
    ), distance if distance > near else 0.0


def _loitering(
    state: GuidanceState, leg: Arc, loiter: Loiter, pose: Mapping[str, float], dt: float
) -> GuidanceState:
    """Return the state with the fraction of a loiter that is flown by now.

    The loiter begins when the aircraft is within 1 s of flight of the circle.
    """
    error, (course, ground_speed) = (
        path.error(leg, (pose["north"], pose["east"])),
        course_and_speed(pose),
    )
    if state.loitered == 0.0 and abs(error.e) > ground_speed:
        return state
    share = dt / loiter.wait if loiter.wait else 1.0
    if loiter.turns:
        along = ground_speed * math.cos(course - error.track)
        share = min(share, dt * along / (2.0 * math.pi * abs(leg.radius) * loiter.turns))
    return state._replace(loitered=min(state.loitered + share, 1.0))


def has_loitered(state: GuidanceState, pose: Mapping[str, float], route: Route) -> bool:
    """Return whether the loiter is flown, and the aircraft is at the altitude of the leg."""
    return state.loitered >= 1.0 and abs(pose["altitude"] - route.altitude[state.leg]) <= LEVEL


def is_at_exit(leg: Leg, reach: float, pose: Mapping[str, float], position: Point) -> bool:
    """Return whether an aircraft on a circle may leave the circle.

    It may if it is on course, and past the end of the circle by at most `reach`, m.
    """
    return leg.end is not None and bool(
        path.is_joined(leg.end, path.end_course(leg), reach, position, course_and_speed(pose)[0])
    )


def with_commands(
    state: GuidanceState,
    commands: Mapping[str, float],
    pose: Mapping[str, float],
    route: Route | None,
    channels: TargetChannels,
    follow: Callable[[GuidanceState, Route], tuple[GuidanceState, float]],
    join: Callable[[GuidanceState, int, float, Route], GuidanceState],
) -> tuple[GuidanceState, float]:
    """Return the state with new modes and commands in force.

    If a leg is passed, `follow` first sets the commands of the next leg. Then the given commands
    replace these. `join` returns the state on the way to a point of a leg. If there is a lateral
    command, the present leg is not followed any more, because the command may come with a new
    route. The second result is the distance by which the end of a leg was missed at this step, m.
    """
    lateral_names = channels.lateral.keys() & commands.keys()
    miss = 0.0
    on_route = (
        state.mode is GuidanceMode.ENGAGED and state.lateral is Lateral.ROUTE and not lateral_names
    )
    if on_route and route is not None:
        state, miss = follow(state, route)
    if not commands:
        return on_profile(state, pose, route), miss
    state = state._replace(target=state.target._replace(**commands))
    is_on_way = state.fence in {FenceAction.HOME, FenceAction.BACK, FenceAction.AROUND}
    if is_on_way and lateral_names:
        state = state._replace(fence=FenceAction.NONE)
    for name in commands:
        state = state._replace(
            lateral=channels.lateral.get(name, state.lateral),
            vertical=channels.vertical.get(name, state.vertical),
        )
    if "leg" in commands and route is not None:
        vertical = state.vertical
        state = join(state, int(commands["leg"]), commands.get("along", 0.0), route)
        state = state._replace(target=state.target._replace(**commands))
        if channels.vertical.keys() & commands.keys():
            state = state._replace(vertical=vertical)
    if state.vertical is Vertical.PROFILE and state.lateral is not Lateral.ROUTE:
        state = state._replace(vertical=Vertical.ALTITUDE)  # hold the present altitude
    return on_profile(state, pose, route), miss


def on_leg(state: GuidanceState, leg: int, route: Route) -> GuidanceState:
    """Put the state on a leg of the route, with the leg's altitude and airspeed."""
    target = state.target._replace(V=route.V[leg], along=0.0)
    return state._replace(
        leg=leg, target=target, vertical=Vertical.PROFILE, joining=Side.NONE, loitered=0.0
    )


def on_profile(
    state: GuidanceState, pose: Mapping[str, float], route: Route | None
) -> GuidanceState:
    """Return the state with the altitude and the climb rate of the leg as commands.

    Both are taken at the nearest point of the leg. If the aircraft has yet to join the leg, they
    are taken at the point where it joins.
    """
    flies = (
        state.mode is GuidanceMode.ENGAGED
        and state.lateral is Lateral.ROUTE
        and state.vertical is Vertical.PROFILE
    )
    if not flies or route is None:
        return state
    leg = route.legs[state.leg]
    climb = 0.0
    waits = path.is_orbit(leg) and leg.end is not None and state.loitered == 0.0
    if state.joining is not Side.NONE or waits:
        altitude = route.joining_altitude(state.leg, state.target.along)
    else:
        altitude, slope = route.profile(state.leg, path.nearest(leg, (pose["north"], pose["east"])))
        if slope:
            course = path.end_course(leg)
            climb = slope * (pose["v_north"] * math.cos(course) + pose["v_east"] * math.sin(course))
    return state._replace(target=state.target._replace(altitude=altitude, climb=climb))


def joining_state(
    state: GuidanceState, leg: int, along: float, pose: Mapping[str, float], route: Route
) -> GuidanceState:
    """Return the state on the way to a point of a leg, with this point's altitude and airspeed.

    If the point is near, the state is already on the leg.
    """
    state = on_leg(state, leg, route)
    leg_path = route.legs[leg]
    # Path following reaches an orbit from any distance, without a joining circle.
    if path.is_orbit(leg_path):
        return state
    start, course = route.start(leg, along)
    position = (pose["north"], pose["east"])
    course_flown, _ = course_and_speed(pose)
    side = Side(
        int(path.joining(start, course, route.radius, route.near(leg), position, course_flown))
    )
    # For an arc, the joining circle is the circle of the arc itself.
    is_near = side is Side.NONE
    if isinstance(leg_path, Arc) and not is_near:
        side = Side.RIGHT if leg_path.radius > 0.0 else Side.LEFT
    if not is_near and not along and route.from_V:
        state = state._replace(target=state.target._replace(V=route.from_V[leg]))
    target = state.target._replace(along=0.0 if is_near else along)
    return state._replace(joining=side, target=target)


def course_and_speed(pose: Mapping[str, Scalar]) -> tuple[Scalar, Scalar]:
    """Return the course, rad, and the speed over ground, m/s, at least 1."""
    v_north = pose["v_north"]
    v_east = pose["v_east"]
    xp = array_namespace(v_north)
    return xp.atan2(v_east, v_north), xp.maximum(xp.hypot(v_north, v_east), 1.0)
