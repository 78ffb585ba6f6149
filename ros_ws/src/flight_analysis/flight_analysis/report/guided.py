# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the metrics of a guided flight.

A flight is split into segments. Within a segment, guidance keeps its modes and commands. The
metrics of a segment are the errors of the quantities that guidance held, such as altitude and
course.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_analysis.closed_loop.guidance_replay import known_routes
from flight_analysis.metrics.errors import ErrorMetrics, best_pose, error_metrics
from flight_analysis.metrics.settling import settling_time
from flight_analysis.metrics.time_spans import sample_times
from flight_analysis.metrics.transients import SETTLING_DWELL
from flight_core.outcome import End
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_guidance.fence.zones import clearance
from flight_guidance.guidance_log import WIND
from flight_guidance.guidance_state import (
    LATERAL,
    TARGETS,
    Lateral,
    Vertical,
    bits,
)
from flight_guidance.notices import FAILED, LINK_AGE, Notice
from flight_guidance.params import GuidanceConfig
from flight_guidance.steering.path import Route, is_orbit, leg_places, lengths_after, route_outline

UNITS: Mapping[str, str] = {
    **dict.fromkeys(("phi", "theta", "heading", "course"), "rad"),
    **dict.fromkeys(("xtrack", "altitude"), "m"),
    **dict.fromkeys(("climb", "V"), "m/s"),
}
"""SI unit of each quantity that guidance holds."""

BANDS: Mapping[str, float] = {
    **dict.fromkeys(("phi", "theta"), math.radians(1.0)),
    **dict.fromkeys(("heading", "course"), math.radians(2.0)),
    **dict.fromkeys(("xtrack", "altitude"), 5.0),
    "climb": 0.5,
    "V": 1.0,
}
"""Half-width of the settling band by quantity, in rad, m or m/s."""


PATHS = (Lateral.ORBIT, Lateral.ROUTE, Lateral.PLACE)
"""Modes whose error is a distance in m, beside a path or from a place."""


@dataclass(frozen=True, kw_only=True)
class HoldErrors(ErrorMetrics):
    """The errors of a quantity that guidance held over a segment, in SI.

    Overshoot and settling are None if the segment begins inside the settling band.
    """

    quantity: str
    overshoot: float | None = None  # largest error on the other side of the command
    # settling time from the start of the segment, s; None if not settled by its end
    settling: float | None = None


class LegResult(StrEnum):
    """With which result a leg was flown."""

    FLOWN = "flown"
    MISSED = "missed"
    NOT_ENDED = "not ended"  # another command or the end of the flight came before


class FlownLeg(NamedTuple):
    """A leg of a route that guidance flew: the times of the leg and its result."""

    leg: int  # number of the leg, from 0 as in `target`
    start: float  # when the aircraft begins to fly to the leg, s
    joined: float | None  # when the aircraft has reached the line of the leg, s; None if never
    stop: float  # s
    result: LegResult
    missed: float  # distance from the end of the leg, m, if it was missed; else 0


@dataclass(frozen=True, kw_only=True)
class Segment:
    """A span of time in which guidance keeps its modes, its commands and its leg."""

    start: float  # s
    stop: float  # s
    leg: int | None  # number of the leg of a route, from 0 as in `target`
    lateral: HoldErrors
    vertical: HoldErrors
    V: HoldErrors


def segments(tape: Tape) -> list[Segment]:
    """Return the segments of a guided flight, found in the topic `guidance`.

    If several commands come less than SETTLING_DWELL apart, they begin only one segment.
    """
    t = tape.time("guidance")
    errors = control_errors(tape)
    times = sample_times(tape["guidance"].stamp_ns)
    log = tape["guidance"]
    targets = [f"target.{name}" for name in TARGETS]
    names = ["mode.lateral", "mode.vertical", "leg", *targets, "joining"]
    columns = np.column_stack([log[name] for name in names])
    # On a leg with an altitude profile, altitude and climb change all the time, so they begin no
    # segment.
    follows = [k for k, name in enumerate(names) if name in {"target.altitude", "target.climb"}]
    columns[np.ix_(log["mode.vertical"] == Vertical.PROFILE, follows)] = 0.0
    changes = np.any(np.diff(columns, axis=0) != 0.0, axis=1)
    starts = [0]
    for k in np.flatnonzero(changes) + 1:
        if t[k] - t[starts[-1]] >= SETTLING_DWELL:
            starts.append(int(k))
    result = []
    for first, after in zip(starts, [*starts[1:], len(t)], strict=True):
        # The segment ends with the modes and the commands of its last sample.
        last = after - 1
        lateral = Lateral(int(log["mode.lateral"][last]))
        vertical = Vertical(int(log["mode.vertical"][last]))
        on_path = "xtrack" if lateral in PATHS else lateral.name.lower()
        quantities = (
            on_path,
            "altitude" if vertical is Vertical.PROFILE else vertical.name.lower(),
            "V",
        )
        errors_of_segment = [
            _hold_errors(name, t[first:after], errors[name][first:after], times[first:after])
            for name in quantities
        ]
        leg = int(log["leg"][last]) if lateral is Lateral.ROUTE else None
        lateral_errors, vertical_errors, speed_errors = errors_of_segment
        result.append(
            Segment(
                start=float(t[first]),
                stop=float(t[min(after, len(t) - 1)]),
                leg=leg,
                lateral=lateral_errors,
                vertical=vertical_errors,
                V=speed_errors,
            )
        )
    return result


def flown_legs(tape: Tape) -> list[FlownLeg]:
    """Return the legs of routes that guidance flew, in order, each with its result.

    The topic `guidance` shows the legs and their results.
    """
    t = tape.time("guidance")
    log = tape["guidance"]
    legs = np.where(log["mode.lateral"] == Lateral.ROUTE, log["leg"], -1.0)
    # If a leg is commanded again, it counts as a new leg.
    commands = log["given"].astype(np.int64) & bits(("leg",))
    edges = np.flatnonzero((np.diff(legs) != 0.0) | (commands[1:] != 0)) + 1
    result = []
    for first, after in zip([0, *edges], [*edges, len(t)], strict=True):
        if legs[first] < 0.0 or first == after:
            continue
        on_leg = np.flatnonzero(log["joining"][first:after] == 0.0)
        ends = after < len(t) and not commands[after]
        ends = ends and legs[after] == legs[first] + 1.0
        distance = float(log["missed"][after]) if ends else 0.0
        outcome = LegResult.MISSED if distance else LegResult.FLOWN
        result.append(
            FlownLeg(
                leg=int(legs[first]),
                start=float(t[first]),
                joined=float(t[first + on_leg[0]]) if len(on_leg) else None,
                stop=float(t[min(after, len(t) - 1)]),
                result=outcome if ends else LegResult.NOT_ENDED,
                missed=distance,
            )
        )
    return result


def unflown_legs(tape: Tape, section: GuidanceConfig) -> range:
    """Return the numbers of the legs of the route that are not flown yet when the flight ends.

    The leg under way is not flown yet. The last leg of a route is left out, because it is an orbit
    without an end. The result is empty if a command replaced the route, or if the route is not in
    the log. If the fence, a lost pose or a lost link ended the route, the result has its remaining
    legs.
    """
    log = tape["guidance"]
    on_route = np.flatnonzero(log["mode.lateral"] == Lateral.ROUTE)
    if not len(on_route):
        return range(0)
    last = int(on_route[-1])
    limit = section.home.link_timeout or math.inf
    is_link_lost = last + 1 < len(log.stamp_ns) and log[LINK_AGE][last + 1] > limit
    replaced = (
        last + 1 < len(log.stamp_ns)
        and int(log["given"][last + 1]) & bits(LATERAL)
        and not is_link_lost
    )
    route = None if replaced else known_routes(tape, section).get(int(log["route"][last]))
    return range(0) if route is None else range(int(log["leg"][last]), len(route.legs) - 1)


def orbit_missed_by(tape: Tape, section: GuidanceConfig) -> float:
    """Return how far the aircraft is from the circle of the last orbit when the flight ends, m.

    The result is 0 if the distance is so small that a leg would be taken as flown. It is also 0 if
    the flight does not end on the last orbit of a route.
    """
    log = tape["guidance"]
    if log["mode.lateral"][-1] != Lateral.ROUTE or log["joining"][-1] != 0.0:
        return 0.0
    route = known_routes(tape, section).get(int(log["route"][-1]))
    leg = int(log["leg"][-1])
    if route is None or leg != len(route.legs) - 1 or not is_orbit(route.legs[leg]):
        return 0.0
    distance = abs(float(log["xtrack"][-1]))
    return distance if distance > route.near(leg) else 0.0


def touched_beside(tape: Tape, section: GuidanceConfig) -> float:
    """Return how far the aircraft is from the touch-down zone when the flight ends, m.

    The result is 0 if the aircraft is inside the zone, or if there is no zone.
    """
    pose = best_pose(tape)
    if section.touchdown is None or pose is None:
        return 0.0
    place = (pose["north"][-1:], pose["east"][-1:])
    return max(-float(clearance((section.touchdown.zone(),), *place)[0]), 0.0)


SCREEN = 15.24
"""Height over the threshold of a runway from which 14 CFR 23.2130 counts a landing, m (50 ft)."""


class Touch(NamedTuple):
    """The sink rate, position and speed at a touch-down, from the true pose if the log has it."""

    sink: float  # m/s
    sideways: float  # speed across the heading, m/s
    crab: float  # angle of the nose from the line of the runway, rad
    beside: float  # distance to the right of the line, m
    beyond: float  # distance along the line from the waypoint on the ground, m
    V: float  # airspeed, m/s
    V_screen: float | None  # airspeed at the height SCREEN, m/s; None if never there


def landing_touch(tape: Tape, section: GuidanceConfig | None) -> Touch | None:
    """Return the sink rate, position and speed at the touch-down of a landing.

    Returns None if guidance has no section `landing`, or if the flight did not end in a landing.
    """
    if section is None or section.landing is None or tape.outcome.end is not End.LANDED:
        return None
    landing = section.landing_on(section.plan(section.waypoints()))
    signal = best_pose(tape)
    if landing is None or signal is None:
        return None
    pose = {name: signal[name] for name in signal.names}
    end = {name: float(values[-1]) for name, values in pose.items()}
    line = np.array([math.cos(landing.course), math.sin(landing.course)])
    place = np.array([end["north"] - landing.place[0], end["east"] - landing.place[1]])
    speed = section.speed + tape["guidance"]["y.V"]
    above = np.flatnonzero(pose["altitude"] > landing.ground + SCREEN)
    low = None
    if len(above):
        row = np.searchsorted(tape["guidance"].stamp_ns, signal.stamp_ns[above[-1]])
        low = float(speed[min(int(row), len(speed) - 1)])
    across = end["v_east"] * math.cos(end["psi"]) - end["v_north"] * math.sin(end["psi"])
    return Touch(
        sink=-end["climb"],
        sideways=across,
        crab=math.remainder(end["psi"] - landing.course, 2.0 * math.pi),
        beside=float(line[0] * place[1] - line[1] * place[0]),
        beyond=float(line @ place),
        V=float(speed[-1]),
        V_screen=low,
    )


class Outside(NamedTuple):
    """How long and how far the aircraft was outside its limits while guidance flew."""

    outside_s: float
    farthest_m: float  # largest distance from the limits, m; 0 if always inside


def time_outside(tape: Tape, section: GuidanceConfig | None) -> Outside | None:
    """Return how long and how far the aircraft was outside the fence while guidance flew.

    The time from the first step of guidance on is examined. Returns None if there is no fence, or
    no pose from this step on.
    """
    fence = None if section is None else section.fence_zones()
    pose = _guided_pose(tape)
    if fence is None or pose is None:
        return None
    return _outside(tape, pose, clearance(fence.zones, pose["north"], pose["east"]))


def altitude_excess(tape: Tape, section: GuidanceConfig | None) -> Outside | None:
    """Return how long and how far the aircraft was above its ceiling or below its altitude floor.

    The time from the first step of guidance on is examined. Returns None if there are no such
    limits, or no pose from this step on.
    """
    pose = _guided_pose(tape)
    if section is None or (section.ceiling is None and section.altitude_floor is None):
        return None
    if pose is None:
        return None
    lowest, highest = section.altitudes()
    altitude = pose["altitude"]
    return _outside(tape, pose, np.minimum(altitude - lowest, highest - altitude))


def _guided_pose(tape: Tape) -> Signal | None:
    """Return the pose from the first step of guidance on, or None without pose or guidance."""
    pose = best_pose(tape)
    if pose is None or "guidance" not in tape or not len(tape["guidance"].stamp_ns):
        return None
    is_guided = pose.stamp_ns >= tape["guidance"].stamp_ns[0]
    if is_guided.any():
        return Signal(pose.stamp_ns[is_guided], pose.names, pose.values[is_guided])
    return None


def _outside(tape: Tape, pose: Signal, inside: FloatArray) -> Outside:
    """Return how long and how far the aircraft was outside its limits.

    `inside` has, for each pose, the distance by which the aircraft is inside the limits, (N,), m.
    The distance is negative outside.
    """
    t = (pose.stamp_ns - tape.start_ns) / NANOSECONDS
    lasted = float(np.sum(np.diff(t)[inside[:-1] < 0.0]))
    return Outside(lasted, max(float(-np.min(inside)), 0.0))


def mission_drawing(section: GuidanceConfig, routes: Sequence[Route]) -> dict[str, Any]:
    """Return what a map shows of a mission, as a dict that JSON can hold, with lengths in m.

    `route` has the points of the line of all routes, and `legs` has [number, north, east] for each
    leg. `to_end` has, for each leg of the last route, the length of the path from the end of this
    leg to the last orbit. `fence` and `home` come from the section `guidance` of the scenario.
    """
    legs: list[list[float]] = []
    outline: list[Any] = []
    for route in routes:
        legs += [[number, *place] for number, place in enumerate(leg_places(route))]
        outline += route_outline(route)
    fence = [zone.model_dump() for zone in section.fence.values()]
    return {
        "route": outline,
        "legs": legs,
        "to_end": lengths_after(routes[-1]) if routes else [],
        "fence": fence,
        "home": [section.home.north, section.home.east],
    }


def leg_results(legs: Sequence[Mapping[str, Any]]) -> str:
    """Say with which result each leg in a summary was flown. Returns "" if there are no legs.

    An example is "legs: 0 flown, 1 missed by 321 m, 2 not ended".
    """
    results = [
        f"{leg['leg']} {leg['result']}" + (f" by {leg['missed']:.0f} m" if leg["missed"] else "")
        for leg in legs
    ]
    return f"legs: {', '.join(results)}" if results else ""


def landing_results(landing: Mapping[str, Any] | None) -> str:
    """Describe the touch-down in a summary in a sentence. Returns "" if there was no landing."""
    if landing is None:
        return ""
    side = "right" if landing["beside"] > 0.0 else "left"
    screen = landing["V_screen"]
    parts = [
        f"a sink of {landing['sink']:.2f} m/s",
        f"{abs(landing['sideways']):.1f} m/s sideways",
        f"the nose {abs(math.degrees(landing['crab'])):.1f} deg off the line",
        f"{abs(landing['beside']):.1f} m to its {side}",
        f"{landing['beyond']:.0f} m beyond its waypoint",
        f"{landing['V']:.1f} m/s",
    ]
    parts += [] if screen is None else [f"at 50 ft {screen:.1f} m/s"]
    return f"landing: {', '.join(parts)}"


def control_errors(tape: Tape) -> dict[str, FloatArray]:
    """Return the errors of the quantities that guidance holds: measured less commanded, (N,) each.

    There is a value for each sample of the topic `guidance`. The cross-track error comes from the
    log, and is positive to the right. Errors of angles lie within half a turn.
    """
    log = tape["guidance"]
    pose = tape["guidance"].group("pose")
    measured = {
        "phi": pose["phi"],
        "heading": pose["psi"],
        "course": np.arctan2(pose["v_east"], pose["v_north"]),
        "theta": pose["theta"],
        "climb": pose["climb"],
        "altitude": pose["altitude"],
    }
    errors = {name: values - log[f"target.{name}"] for name, values in measured.items()}
    for name in (name for name in errors if UNITS[name] == "rad"):
        errors[name] = np.remainder(errors[name] + math.pi, 2.0 * math.pi) - math.pi
    # V in y is a deviation from the trim speed V0, and so is V in u_m, which is V_c - V0.
    V = log["y.V"] - log["u_m.V"] if "y.V" in log.names else flown_speed(tape, 0.0) - log["V_c"]
    return errors | {"xtrack": log["xtrack"], "V": V}


def distance(tape: Tape) -> float | None:
    """Return the length of the path over ground, m, or None if the log has no speed over ground.

    The length is the integral of the speed over ground.
    """
    pose = tape.signals.get("pose")
    if pose is None or not {"v_north", "v_east"} <= set(pose.names):
        return None
    return float(np.trapezoid(np.hypot(pose["v_north"], pose["v_east"]), tape.time("pose")))


def top_speed(tape: Tape, trim: float) -> float | None:
    """Return the largest airspeed of a flight, m/s, or None if y has no V.

    V in y is a deviation from trim, so the result is `trim` plus the largest V.
    """
    y = tape.signals.get("y")
    return None if y is None or "V" not in y.names else trim + float(np.max(y["V"]))


def flown_speed(tape: Tape, trim: float) -> FloatArray:
    """Return the airspeed at the samples of the topic `guidance`, m/s: the trim speed plus V of y.

    If y has no V, as for a multicopter, the result is the speed over ground.
    """
    log = tape["guidance"]
    over_ground: FloatArray = np.hypot(log["pose.v_north"], log["pose.v_east"])
    return trim + log["y.V"] if "y.V" in log.names else over_ground


def _hold_errors(quantity: str, t: FloatArray, error: FloatArray, times: FloatArray) -> HoldErrors:
    errors = HoldErrors(quantity=quantity, **asdict(error_metrics(error, times)))
    first = float(error[0])
    if abs(first) <= BANDS[quantity]:
        return errors
    overshoot = float(np.max(-error * math.copysign(1.0, first), initial=0.0))
    settling = settling_time(t, error, BANDS[quantity], math.inf)
    return replace(errors, overshoot=overshoot, settling=settling)


def guidance_notices(tape: Tape, section: GuidanceConfig | None) -> list[str]:
    """Return the notices that guidance gave in a flight, as sentences with the time."""
    if section is None or "guidance" not in tape:
        return []
    log = tape["guidance"]
    t = tape.time("guidance")
    routes = known_routes(tape, section)
    notes = []
    for number, k in zip(*np.unique(log["route"], return_index=True), strict=True):
        notes += [
            Notice(float(t[k]), text)
            for text in (routes[int(number)].notes if int(number) in routes else ())
        ]
    notices = notes + section.notices().read_log(t, {name: log[name] for name in log.names})
    return [f"guidance at t = {notice.t:.1f} s: {notice.text}" for notice in notices]


def guidance_summary(tape: Tape, section: GuidanceConfig | None = None) -> dict[str, Any] | None:
    """Return the metrics of a guided flight for `summary.json`, in SI.

    Returns None for a flight without guidance.
    """
    if "guidance" not in tape or len(tape["guidance"].stamp_ns) == 0:
        return None
    log = tape["guidance"]
    limits = log.group("limited")
    outside = time_outside(tape, section)
    altitude = altitude_excess(tape, section)
    touch = landing_touch(tape, section)
    return {
        "landing": None if touch is None else touch._asdict(),
        "segments": [asdict(segment) for segment in segments(tape)],
        "legs": [leg._asdict() for leg in flown_legs(tape)],
        "fence": None if outside is None else outside._asdict(),
        "altitude": None if altitude is None else altitude._asdict(),
        "wind": _mean_wind(tape),
        "bank": _largest(log["pose.phi"]),
        "age_pose": _largest(log["age.pose"]),
        "failed": int(log[FAILED][-1]),
        "limited": {name: float(np.mean(limits[name] != 0.0)) for name in limits.names},
    }


def _mean_wind(tape: Tape) -> dict[str, float]:
    """Return the mean components of the estimated wind, to the north and to the east, m/s."""
    log = tape["guidance"]
    return {name: float(np.mean(log[f"wind.{name}"])) for name in WIND}


def _largest(values: NDArray[np.float64]) -> float:
    return float(np.max(np.abs(values)))
