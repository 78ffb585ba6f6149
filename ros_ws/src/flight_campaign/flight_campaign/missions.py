# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Missions of a fleet: the aircraft of a guided scenario fly the route, with a reference model,
pose and guidance per aircraft.

The last axis of every array is the aircraft. The equations come from the nodes:
`flight_guidance.lateral_modes.follow`, `modes.command`, `aircraft_sim.pose`,
`reference_model.model`.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from numpy.typing import NDArray

from aircraft_sim import pose as pose_model
from aircraft_sim.effector_faults import STOPPED
from aircraft_sim.sections import StartConfig
from aircraft_sim.state_space_model import POSE_STATES
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.metrics import CAPTURE_TIME
from flight_campaign.campaign_course import ENGAGE, HOLD, STEP, Course, Segments
from flight_core.channels import POSE
from flight_core.kinematics import heading_rate
from flight_core.parameters import ParameterError, require
from flight_core.rates import divide, period_ns, seconds
from flight_core.vectors import Array, FloatArray
from flight_guidance import guidance_state, lateral_modes, modes, path, targets
from flight_guidance.fence import Escape, last_safe_turn
from flight_guidance.guidance_state import (
    GuidanceParams,
    GuidanceState,
    Lateral,
    Mode,
    Target,
    Vertical,
)
from flight_guidance.lateral import PathError
from flight_guidance.params import GuidanceConfig
from flight_guidance.path import Line, Route
from reference_model import model


class Legs(NamedTuple):
    """The L legs of a route, shapes (L,), points (2, L): north, east, m."""

    is_line: Array
    origin: Array  # start of a line, centre of an arc
    track: Array  # course of a line, rad; 0 of an arc
    radius: Array  # of an arc, m, positive to the right; 1 of a line
    end: Array
    end_course: Array  # rad
    has_end: Array  # all but the orbit round the last waypoint
    entry: Array  # curvature of the following leg, 1/m; of the orbit its own
    altitude: Array  # m
    V: Array  # m/s
    start: Array  # where a line or an arc begins
    start_course: Array  # rad
    start_curvature: Array  # 1/m
    # the circle onto the leg that the leg itself is: the radius of an arc over the radius of the
    # route; 0 of a line
    turn: Array
    near: Array  # m, from the end, within which the leg counts as flown
    from_altitude: Array  # m, of the waypoint that the leg leaves
    slope: Array  # of the altitude along a line, 1
    from_V: Array  # m/s


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("action", "legs", "radius", "Phi", "Gamma", "C", "wind"),
    meta_fields=("guidance", "outputs", "states", "speed", "period"),
)
@dataclass(frozen=True)
class Mission:
    """Common parameters of a fleet. m outputs, in the reference model's order; n states of the
    reference model.
    """

    action: Array  # (T,) of guidance at the ticks: HOLD, ENGAGE or STEP
    legs: Legs
    radius: Array  # of fillets, joining circles and the last orbit, m
    Phi: Array  # (n, n): x_m a tick later, with u_m held
    Gamma: Array  # (n, m)
    C: Array  # (m, n), rows in the law's order
    wind: Array  # (2,) steady, to the north and to the east, m/s
    # Constants of the compiled loop:
    guidance: GuidanceParams
    outputs: tuple[str, ...]  # in the law's order
    states: tuple[int | None, ...]  # the POSE_STATES in x; None: the airframe has no such state
    speed: float  # trim speed V0, m/s
    period: float  # s, of the ticks


class MissionState(NamedTuple):
    """State of the N missions from tick to tick."""

    x_m: Array  # (n, N)
    y_m_before: Array  # (late, m, N) newest first
    y_m: Array  # (m, N) the reference of the law at the last tick
    y: Array  # (m, N) the last one that arrived
    u_m: Array  # (m, N)
    alpha: Array  # (N,) as in GuidanceState
    alpha_trim: Array
    slip: Array
    climb_c: Array
    V_c: Array
    leg: Array
    joining: Array
    air: Array  # (2, N) the estimated wind, as in GuidanceState, m/s
    psi: Array  # rad
    position: Array  # (3, N) north, east, up, relative to the air, m
    psi_dot: Array
    velocity: Array  # (3, N)
    samples: Array  # (N,) on the route
    xtrack_max: Array
    xtrack_squares: Array
    altitude_squares: Array
    phi_max: Array
    missed: Array  # legs
    fence: Array  # action of the fence, as in GuidanceState
    home_altitude: Array  # m
    clearance: Array  # m, the least one from the fence
    from_home: Array  # m


def _require_aileron(scenario: Scenario) -> None:
    """Raises ParameterError for a fault after which the aileron no longer follows u: these flights
    do not compare p with its command.
    """
    aileron = scenario.controller.inputs[scenario.controller.outputs.index("p")]
    dead = [
        fault.subject
        for fault in scenario.aircraft.actuators.read_faults()
        if fault.input == aileron and fault.kind in STOPPED
    ]
    require(
        not dead,
        "aircraft.actuators.faults",
        ", ".join(dead),
        "none of the roll in a campaign of missions, in which no yaw rate flies the bank",
    )


def require_mission(scenario: Scenario) -> GuidanceConfig:
    """The section `guidance` of a scenario. Raises ParameterError for a guidance beyond a campaign
    of missions.
    """
    guidance = scenario.guidance
    aircraft = scenario.aircraft
    reference = scenario.reference_model
    if guidance is None or guidance.route is None:
        expected = "a route, whose cross-track error is the score of a campaign of missions"
        raise ParameterError(f"guidance.route: found none, expected {expected}")
    require(
        not aircraft.is_jsbsim,
        "airframe",
        aircraft.airframe,
        "an airframe with matrices, which a campaign varies",
    )
    without_feedforward = scenario.controller.guard().nominal is None
    require(
        without_feedforward,
        "controller.feedforward",
        "a model",
        "none where guidance commands the reference",
    )
    require(
        aircraft.start == StartConfig(),
        "aircraft.start",
        "another place",
        "the origin in a campaign of missions",
    )
    require(
        not guidance.program,
        "guidance.program",
        ", ".join(guidance.program),
        "a route alone in a campaign of missions",
    )
    require(
        guidance.landing is None,
        "guidance.landing",
        "a landing",
        "none in a campaign of missions",
    )
    require(
        not reference.live.bounds,
        "reference_model.live.bounds",
        "bounds",
        "none in a campaign of missions",
    )
    _require_aileron(scenario)
    profile = reference.profile()
    commanded = bool(profile.change.any() or profile.amplitude.any())
    require(
        not commanded,
        "reference_model",
        "a profile of commands",
        "none beside guidance in a campaign of missions",
    )
    return guidance


def build(scenario: Scenario, course: Course) -> Mission:
    """The mission of a guided scenario over a course.

    Raises ParameterError as `require_mission`, and for a rate of guidance that does not meet the
    ticks.
    """
    guidance = require_mission(scenario)
    aircraft = scenario.aircraft
    reference = scenario.reference_model
    params = guidance.params()
    names = scenario.controller.outputs
    tick_ns = period_ns(scenario.controller.rate, "controller.rate")
    every = divide(params.period_ns, tick_ns, "controller.rate", "a period of guidance")

    action = np.full(len(course.segments.t), HOLD, dtype=np.int32)
    first = int(np.argmax(course.segments.phase == ENGAGE))
    begins = -(-first // every) * every
    action[begins::every] = STEP
    action[begins] = ENGAGE

    reference_ns = period_ns(reference.rate, "reference_model.rate")
    matrices = reference.model()
    stepper = model.stepper(seconds(reference_ns), matrices)
    n, m = matrices.B_m.shape
    Phi = np.eye(n)
    Gamma = np.zeros((n, m))
    held = stepper.Gamma @ np.tile(np.eye(m), (3, 1))
    for _ in range(divide(tick_ns, reference_ns, "reference_model.rate", "a tick")):
        Phi = stepper.Phi @ Phi
        Gamma = stepper.Phi @ Gamma + held
    order = [reference.outputs.index(name) for name in names]
    route = guidance.plan(guidance.waypoints())
    loiters = any(path.is_orbit(leg) for leg in route.legs[:-1])
    require(
        not loiters,
        "guidance.route",
        "circles round a waypoint",
        "lines and fillets alone in a campaign of missions",
    )
    airframe = aircraft.load()[0]
    states = list(airframe.states)
    places = tuple(states.index(name) if name in states else None for name in POSE_STATES)
    shared = (Phi, Gamma, matrices.C[order], np.array(aircraft.wind))
    return Mission(
        action,
        legs_of(route),
        np.array(route.radius),
        *shared,
        params,
        tuple(names),
        places,
        float(airframe.speed),
        seconds(tick_ns),
    )


def legs_of(route: Route) -> Legs:
    """A route as arrays."""

    def points(chosen: list[path.Point]) -> FloatArray:
        return np.array(chosen, dtype=np.float64).T

    legs = route.legs
    lines: NDArray[np.bool_] = np.array([isinstance(leg, Line) for leg in legs])
    ends = [leg.end is not None for leg in legs]
    starts = [route.start(number) for number in range(len(legs))]
    curvature = np.array([0.0 if isinstance(leg, Line) else 1.0 / leg.radius for leg in legs])
    return Legs(
        lines,
        points([leg.start if isinstance(leg, Line) else leg.centre for leg in legs]),
        np.array(
            [path.course_of(leg.start, leg.end) if isinstance(leg, Line) else 0.0 for leg in legs]
        ),
        np.array([1.0 if isinstance(leg, Line) else leg.radius for leg in legs]),
        points([leg.end or (0.0, 0.0) for leg in legs]),
        np.array([path.end_course(leg) if leg.end is not None else 0.0 for leg in legs]),
        np.array(ends),
        np.append(curvature[1:], curvature[-1]),
        np.array(route.altitude),
        np.array(route.V),
        points([start for start, _ in starts]),
        np.array([course for _, course in starts]),
        curvature,
        np.sign(curvature),
        np.array([route.near(number) for number in range(len(legs))]),
        np.array(route.from_altitude),
        np.array([route.profile(number, 0.0)[1] for number in range(len(legs))]),
        np.array(route.from_V),
    )


def initial_state(count: int, late: int, mission: Mission) -> MissionState:
    """N aircraft in trim, heading north, y `late` ticks old."""
    n, m = mission.Gamma.shape
    none = jnp.zeros(count)
    zeros = jnp.zeros((m, count))
    velocity = jnp.zeros((3, count)).at[0].set(mission.speed)
    return MissionState(
        jnp.zeros((n, count)),
        jnp.zeros((late, m, count)),
        zeros,
        zeros,
        zeros,
        none,
        none,
        none,
        none,
        none,
        jnp.zeros(count, dtype=np.int64),
        none,
        jnp.zeros((2, count)),
        none,
        jnp.zeros((3, count)),
        none,
        velocity,
        *(none,) * 8,
        none + guidance_state.LARGEST,
        none,
    )


def reference(state: MissionState, mission: Mission) -> tuple[MissionState, Array, Array, Array]:
    """The state with y_m of a tick; y_m at the tick, y_m at the stamp of y, and the slope; shapes
    (m, N).
    """
    y_m = mission.C @ state.x_m
    arriving = jnp.concatenate([y_m[None], state.y_m_before])
    sampled = arriving[-1]
    slope = (sampled - state.y_m) / mission.period
    return state._replace(y_m_before=arriving[:-1], y_m=sampled), y_m, sampled, slope


def guide(
    state: MissionState, x: Array, y: Array, segment: Segments, action: Array, mission: Mission
) -> MissionState:
    """The state after guidance at a tick, from x (n, N), and an arriving y in the law's order, (m,
    N).
    """
    y = jnp.where(segment.phase == HOLD, state.y, y)
    state = state._replace(y=y)
    pose = _pose(state, x, segment.t, mission)
    y_of = dict(zip(mission.outputs, y, strict=True))
    speed = modes.true_airspeed(y_of["V"], mission.guidance)
    course = jnp.atan2(pose["v_east"], pose["v_north"])
    now = _GuidanceStep(
        state, mission, mission.guidance, pose, y_of, speed, (pose["north"], pose["east"]), course
    )
    return jax.lax.switch(action, (lambda: state, now.begin, now.step))


class _GuidanceStep(NamedTuple):
    """A step of guidance of N missions: the state before, the pose, y, the airspeed, and position
    and course over ground.
    """

    state: MissionState
    mission: Mission
    params: GuidanceParams
    pose: dict[str, Array]
    y_of: dict[str, Array]
    speed: Array
    position: path.Point
    course: Array

    def _legs_at(self, numbers: Array) -> Legs:
        return jax.tree.map(lambda values: jnp.asarray(values)[..., numbers], self.mission.legs)

    def _passed(self, leg: Legs, place: path.Point) -> Array:
        return leg.has_end & path.is_beyond((leg.end[0], leg.end[1]), leg.end_course, place)

    def _entered(self, leg: Legs, following: Legs, place: path.Point) -> Array:
        return self._passed(leg, place) & (following.is_line | ~self._passed(following, place))

    def _joins(self, leg: Legs) -> Array:
        """Side of the circle onto a leg, 0 near the leg."""
        start = (leg.start[0], leg.start[1])
        side = path.joining(
            start, leg.start_course, self.mission.radius, leg.near, self.position, self.course
        )
        return jnp.where(leg.has_end, jnp.where(leg.is_line, side, jnp.abs(side) * leg.turn), 0.0)

    def _onto(self, leg: Legs, place: path.Point) -> Array:
        return path.joined(
            (leg.start[0], leg.start[1]), leg.start_course, leg.near, place, self.course
        )

    def _off_path(self, leg: Legs, joining: Array) -> PathError:
        """The error from a leg, or from the circle onto the leg."""
        origin, start = (leg.origin[0], leg.origin[1]), (leg.start[0], leg.start[1])
        joins_leg = joining != 0.0
        line = path.line_error(origin, leg.track, self.position)
        circle = path.circle_error(origin, leg.radius, self.position)
        radius = jnp.where(joins_leg, joining, 1.0) * self.mission.radius
        centre = path.joining_centre(start, leg.start_course, radius)
        way = path.circle_error(centre, radius, self.position)
        on_leg = [jnp.where(leg.is_line, *pair) for pair in zip(line, circle, strict=True)]
        return PathError(*(jnp.where(joins_leg, *pair) for pair in zip(way, on_leg, strict=True)))

    def _fly(
        self, before: GuidanceState, number: Array, joining: Array, missed: Array
    ) -> MissionState:
        leg, following, joins_leg = self._legs_at(number), self._legs_at(number + 1), joining != 0.0
        error = self._off_path(leg, joining)

        def begins(place: path.Point) -> Array:
            return jnp.where(
                joins_leg, self._onto(leg, place), self._entered(leg, following, place)
            )

        entry = jnp.where(joins_leg, leg.start_curvature, leg.entry)
        altitude, climb = (
            jnp.where(joins_leg, *pair)
            for pair in zip((leg.from_altitude, 0.0), _profile(leg, self.pose), strict=True)
        )
        escape, home_altitude, homing, error = self._within_fence(before, error)
        if self.params.fence is not None:
            entry = jnp.where(homing, error.curvature, entry)
            altitude = jnp.where(homing, home_altitude, altitude)
        climb = jnp.where(homing, 0.0, climb)
        wanted = lateral_modes.follow(
            error, entry, begins, before.slip, self.pose, self.speed, self.params
        )
        wanted = lateral_modes.escaping_bank(escape, wanted, self.pose, self.speed, self.params)
        target = Target(altitude=altitude, climb=climb, V=jnp.where(joins_leg, leg.from_V, leg.V))
        flies = before._replace(
            mode=Mode.ENGAGED, lateral=Lateral.ROUTE, vertical=Vertical.PROFILE, target=target
        )
        after, _ = modes.command(
            flies, self.pose, self.y_of, wanted, seconds(self.params.period_ns), self.params
        )
        off, counts = self.pose["altitude"] - altitude, leg.has_end & ~joins_leg & ~homing
        return self.state._replace(
            u_m=jnp.stack(after.u_m),
            alpha=after.alpha,
            alpha_trim=after.alpha_trim,
            slip=after.slip,
            climb_c=after.climb_c,
            V_c=after.V_c,
            leg=number,
            joining=joining,
            air=jnp.stack(after.wind),
            samples=self.state.samples + counts,
            xtrack_max=jnp.maximum(self.state.xtrack_max, jnp.where(counts, jnp.abs(error.e), 0.0)),
            xtrack_squares=self.state.xtrack_squares + jnp.where(counts, error.e**2, 0.0),
            altitude_squares=self.state.altitude_squares + jnp.where(counts, off**2, 0.0),
            phi_max=jnp.maximum(self.state.phi_max, jnp.abs(self.pose["phi"])),
            missed=self.state.missed + missed,
            fence=escape.action,
            home_altitude=home_altitude,
            clearance=jnp.minimum(self.state.clearance, escape.clearance),
            from_home=jnp.hypot(
                self.pose["north"] - self.params.home.north,
                self.pose["east"] - self.params.home.east,
            ),
        )

    def begin(self) -> MissionState:
        return self._fly(
            modes.holding(0, self.pose, self.speed, self.params),
            0 * self.state.leg,
            self._joins(self._legs_at(0 * self.state.leg)),
            0.0 * self.state.missed,
        )

    def step(self) -> MissionState:
        before = modes.holding(0, self.pose, self.speed, self.params)._replace(
            alpha=self.state.alpha,
            alpha_trim=self.state.alpha_trim,
            slip=self.state.slip,
            climb_c=self.state.climb_c,
            V_c=self.state.V_c,
            u_m=tuple(self.state.u_m),
            wind=(self.state.air[0], self.state.air[1]),
        )
        leg, joins_leg = self._legs_at(self.state.leg), self.state.joining != 0.0
        ends = self._passed(leg, self.position) & ~joins_leg & (self.state.fence == 0.0)
        missed = ends & (
            jnp.hypot(self.position[0] - leg.end[0], self.position[1] - leg.end[1]) > leg.near
        )
        number = jnp.where(ends, self.state.leg + 1, self.state.leg)
        still = jnp.where(joins_leg & ~self._onto(leg, self.position), self.state.joining, 0.0)
        return self._fly(
            before, number, jnp.where(ends, self._joins(self._legs_at(number)), still), missed
        )

    def _within_fence(
        self, before: GuidanceState, error: PathError
    ) -> tuple[Escape, Array, Array, PathError]:
        """The action of the fence, the altitude of the flight home, whether the aircraft flies
        home, and the path error.
        """
        escape, home_altitude, homing = (
            Escape(self.state.fence, False, self.state.clearance, 0.0, 0.0),
            self.state.home_altitude,
            self.state.fence != 0.0,
        )
        if self.params.fence is not None:
            escape = last_safe_turn(
                self.params.fence,
                self.state.fence,
                modes.motion_of(before, self.pose, self.y_of, self.speed, self.params),
            )
            homing = escape.action != 0.0
            home = targets.home(self.pose, self.params)
            home_altitude = jnp.where(escape.begins, home["altitude"], self.state.home_altitude)
            orbit = path.circle_error(
                (home["north"], home["east"]), jnp.asarray(home["radius"]), self.position
            )
            error = PathError(
                *(jnp.where(homing, *pair) for pair in zip(orbit, error, strict=True))
            )
        return escape, home_altitude, homing, error


def _profile(leg: Legs, pose: dict[str, Array]) -> tuple[Array, Array]:
    """Altitude, m, and climb rate, m/s, of a leg at the nearest point, as `Route.profile`."""
    north = jnp.cos(leg.end_course)
    east = jnp.sin(leg.end_course)
    to_go = north * (leg.end[0] - pose["north"]) + east * (leg.end[1] - pose["east"])
    length = jnp.hypot(leg.end[0] - leg.start[0], leg.end[1] - leg.start[1])
    climb = leg.slope * (pose["v_north"] * north + pose["v_east"] * east)
    return leg.altitude - leg.slope * jnp.clip(to_go, 0.0, length), climb


def advance(state: MissionState, x: Array, mission: Mission) -> MissionState:
    """The state a tick later, from x then: reference model, and pose by the trapezoidal rule."""
    V, alpha, beta, phi, theta, q, r = _states(x, mission)
    half = mission.period / 2.0
    psi_dot = heading_rate(phi, theta, q, r)
    psi = state.psi + half * (state.psi_dot + psi_dot)
    velocity = jnp.stack(pose_model.velocity(mission.speed + V, alpha, beta, phi, theta, psi))
    return state._replace(
        x_m=mission.Phi @ state.x_m + mission.Gamma @ state.u_m,
        psi=psi,
        psi_dot=psi_dot,
        position=state.position + half * (state.velocity + velocity),
        velocity=velocity,
    )


def _states(x: Array, mission: Mission) -> list[Array]:
    """The POSE_STATES, deviations from trim, shapes (N,)."""
    return [0.0 * x[0] if place is None else x[place] for place in mission.states]


def _pose(state: MissionState, x: Array, t: Array, mission: Mission) -> dict[str, Array]:
    """The pose over ground by channel of `channels.POSE`, shapes (N,); psi is not wrapped."""
    _, _, beta, phi, theta, *_ = _states(x, mission)
    north, east, altitude = state.position
    v_north, v_east, climb = state.velocity
    values = (
        *(phi, theta, state.psi, north + mission.wind[0] * t, east + mission.wind[1] * t, altitude),
        *(v_north + mission.wind[0], v_east + mission.wind[1], climb, beta),
    )
    return dict(zip(POSE, values, strict=True))


def figures(state: MissionState, mission: Mission) -> dict[str, Array]:
    """Score, cross-track error and altitude error on the route, largest bank, with a fence the last
    distance from home.

    Shapes (N,), SI.

    The score is the largest cross-track error in half seconds of flight at V0. The orbit round the
    last waypoint, which begins at the centre, is left out.
    """
    samples = jnp.maximum(state.samples, 1.0)
    fenced = {"max.breach": jnp.maximum(-state.clearance, 0.0), "home": state.from_home}
    return {
        "score": state.xtrack_max / (CAPTURE_TIME * mission.speed),
        "max.xtrack": state.xtrack_max,
        "rms.xtrack": jnp.sqrt(state.xtrack_squares / samples),
        "rms.altitude": jnp.sqrt(state.altitude_squares / samples),
        "max.phi": state.phi_max,
        "missed": state.missed,
        **({} if mission.guidance.fence is None else fenced),
    }
