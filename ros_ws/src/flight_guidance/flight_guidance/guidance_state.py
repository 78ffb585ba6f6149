# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Types of guidance: modes, targets, parameters, and the inputs and state of a step."""

from collections.abc import Collection, Mapping
from enum import IntEnum
from typing import NamedTuple

from flight_core.vectors import Scalar
from flight_guidance.fence.fence import FenceAction
from flight_guidance.fence.zones import Fence
from flight_guidance.reach import Authority
from flight_guidance.steering.attitude import AttitudeParams
from flight_guidance.steering.lateral import (
    PathParams,
)
from flight_guidance.steering.path import Side
from flight_guidance.steering.vertical import (
    VerticalParams,
)
from flight_guidance.steering.wind import Wind

LARGEST = 1e9
"""Largest value of pose, y and target, SI. The squares of much larger values overflow. The orbit of
the moon is 4e8 m away."""


class GuidanceMode(IntEnum):
    """The mode of guidance."""

    OFF = 0  # no u_m is published
    ENGAGED = 1
    DEAD_RECKONING = 2  # the pose is stale: wings level, with an attitude from the rates in y
    POSE_LOST = 3  # the pose has been stale for longer: rates are zero


class Lateral(IntEnum):
    """What guidance controls by the bank."""

    PHI = 0
    HEADING = 1
    COURSE = 2
    ORBIT = 3
    ROUTE = 4
    PLACE = 5  # a place to fly to and hover at; only for a multicopter


class Vertical(IntEnum):
    """What guidance controls by the pitch."""

    THETA = 0
    CLIMB = 1
    ALTITUDE = 2
    PROFILE = 3  # the altitude along the leg of the route


class Target(NamedTuple):
    """Commands by channel; the commands of the active modes take effect."""

    phi: float = 0.0  # rad
    heading: float = 0.0  # rad from true north
    course: float = 0.0  # rad from true north, over ground
    north: float = 0.0  # m, centre of the orbit
    east: float = 0.0  # m
    radius: float = 0.0  # m, positive clockwise from above
    leg: float = 0.0  # number of the leg of the route
    theta: float = 0.0  # rad
    climb: Scalar = 0.0  # m/s
    altitude: Scalar = 0.0  # m
    V: Scalar = 0.0  # airspeed, m/s, absolute
    # m, distance along a line of the route from its start at which the aircraft joins the line
    along: float = 0.0
    r: float = 0.0  # rad/s, in the mode of phi: added to the r of a coordinated turn


TARGETS = Target._fields


LATERAL: Mapping[str, Lateral] = {
    **dict.fromkeys(("phi", "r"), Lateral.PHI),
    "heading": Lateral.HEADING,
    "course": Lateral.COURSE,
    **dict.fromkeys(("north", "east", "radius"), Lateral.ORBIT),
    **dict.fromkeys(("leg", "along"), Lateral.ROUTE),
}


VERTICAL: Mapping[str, Vertical] = {
    "theta": Vertical.THETA,
    "climb": Vertical.CLIMB,
    "altitude": Vertical.ALTITUDE,
}


class TargetChannels(NamedTuple):
    """The channels of Target that an airplane or a multicopter takes."""

    lateral: Mapping[str, Lateral]
    vertical: Mapping[str, Vertical]
    further: tuple[str, ...]  # channels that belong to no mode
    together: Mapping[Lateral, tuple[str, ...]]  # channels of a mode that must come in one message

    def known(self) -> tuple[str, ...]:
        """Return all channels of Target that the aircraft takes, in the order of TARGETS."""
        names = {*self.lateral, *self.vertical, *self.further}
        return tuple(name for name in TARGETS if name in names)


AIRPLANE = TargetChannels(LATERAL, VERTICAL, ("V",), {Lateral.ORBIT: ("north", "east", "radius")})
MULTICOPTER = TargetChannels(
    {
        **dict.fromkeys(("phi", "theta"), Lateral.PHI),
        "course": Lateral.COURSE,
        **dict.fromkeys(("north", "east"), Lateral.PLACE),
        **dict.fromkeys(("leg", "along"), Lateral.ROUTE),
    },
    {"climb": Vertical.CLIMB, "altitude": Vertical.ALTITUDE},
    ("heading", "V"),
    {Lateral.PHI: ("phi", "theta"), Lateral.PLACE: ("north", "east")},
)


class MulticopterParams(NamedTuple):
    """Gains and limits of a multicopter's guidance."""

    drag: float  # d, deceleration divided by the airspeed, 1/s
    k_tilt: float  # gain of the direction of the thrust, 1/s
    k_psi: float  # gain of the heading, 1/s
    k_v: float  # gain of the velocity, 1/s
    k_p: float  # gain of the place, 1/s
    lead: float  # s, delay of the tilt behind its command
    braking: float  # m/s^2, largest acceleration for a stop and in a fillet
    tilt_rate: float  # rad/s
    yaw_rate: float  # rad/s


class Home(NamedTuple):
    """The place to which an aircraft flies home, and its altitude."""

    north: float = 0.0  # m
    east: float = 0.0  # m
    altitude: float | None = None  # m; if None, the altitude at which the aircraft turns home
    after_loss: bool = False  # whether the aircraft flies home when the pose returns after a loss


class CommandLimits(NamedTuple):
    """Limits of the commands that guidance takes."""

    bank: float  # rad
    least_pitch: float  # rad
    largest_pitch: float  # rad
    floor: float  # m/s, least airspeed
    stall_speed: float  # m/s
    radius: float  # m, least radius of an orbit
    largest_speed: float  # m/s
    lowest: float  # m, least altitude
    highest: float  # m, largest altitude


class GuidanceParams(NamedTuple):
    """Parameters of a step of guidance."""

    outputs: tuple[str, ...]  # names of y and u_m, in their order
    period_ns: int
    speed: float  # trim speed V0, m/s
    k_chi: float  # gain of heading and course, 1/s
    attitude: AttitudeParams
    vertical: VerticalParams
    path: PathParams
    limits: CommandLimits
    slew: tuple[float, ...]  # largest derivative of each value of u_m
    max_age_ns: int
    hold_ns: int
    # s, lag of the turn behind the bank that remains after `attitude.turn_lead`
    turn_lag: float = 0.0
    fence: Fence | None = None
    home: Home = Home()
    link_timeout_ns: int = 0  # ns, largest age of the operator's link; 0 without a limit
    dead: tuple[str, ...] = ()  # outputs whose input has no effect; they get no command
    # whether the ailerons roll the aircraft; if not, the yaw rate controls the bank
    rolls: bool = True
    channels: TargetChannels = AIRPLANE
    multicopter: MulticopterParams | None = None  # None for an airplane


class Begin(IntEnum):
    """Whether and how the filters start again at the measured values."""

    NO = 0
    AGAIN = 1  # keep modes and commands (bumpless transfer)
    HOLD = 2  # hold the present heading, altitude and airspeed


class Inputs(NamedTuple):
    """Inputs of a step of guidance."""

    t_ns: int
    begin: Begin
    pose: tuple[float, ...]  # the last pose, in the order of POSE
    pose_age_ns: int
    y: tuple[float, ...]  # the last y, in the order of u_m
    # New commands by channel of Target. The channels also choose the modes.
    commands: Mapping[str, float]
    authority: Authority = Authority()  # authority of the inputs, as learned and tested in flight


class GuidanceState(NamedTuple):
    """State of guidance after a step."""

    t_ns: int
    mode: GuidanceMode
    lateral: Lateral
    vertical: Vertical
    target: Target
    leg: int  # number of the leg of the route
    phi: float  # rad, bank of the attitude, by dead reckoning while the pose is stale
    theta: float
    alpha: float  # estimated angle of attack, rad
    alpha_trim: float  # estimated angle of attack at the first step, rad
    slip: float  # acceleration of a turn that is lost by sideslip, m/s^2
    climb_c: float  # commanded climb rate, m/s
    V_c: float  # commanded airspeed, m/s
    u_m: tuple[float, ...]
    joining: Side = Side.NONE  # side of the circle that leads onto the leg
    wind: Wind = (0.0, 0.0)  # estimated velocity of the air: north, east, m/s
    fence: FenceAction = FenceAction.NONE
    loitered: float = 0.0  # fraction of a loiter's turns or wait that is flown
    psi: Scalar = 0.0  # estimated heading, rad
    # velocity in the pose of this step, m/s, from which the wind of a multicopter follows
    velocity: Wind = (0.0, 0.0)


class StepCommands(NamedTuple):
    """Results of a step that the log needs and that are no part of the state."""

    phi_c: float = 0.0
    theta_c: float = 0.0
    xtrack: float = 0.0  # cross-track error, m, positive to the right of the path
    # m, distance to the end of the leg, or to the point where the aircraft joins it
    to_go: float = 0.0
    track: float = 0.0  # course of the path at the nearest point, rad
    # m, distance from the end of a leg that ended at this step and counts as missed, else 0
    missed: float = 0.0
    clearance: float = LARGEST  # m, distance from the fence
    predicted: float = LARGEST  # m, least clearance that the better turn away from the fence keeps
    is_bank_limited: bool = False
    is_theta_limited: bool = False
    is_climb_limited: bool = False
    is_V_limited: bool = False
    is_slew_limited: bool = False


def bits(names: Collection[str]) -> int:
    """Encode the names of commands as the channel `given` of the log: bit k for TARGETS[k]."""
    return sum(1 << k for k, name in enumerate(TARGETS) if name in names)


CARRIED = ("mode", "lateral", "vertical", "target", "leg", "joining", "fence", "loitered")
"""Fields of the state that stay if the filters start again. The mode is one of them, because the
step must still see that the pose was lost, so that it levels the wings."""


def begun_again(
    holding: GuidanceState,
    state: GuidanceState | None,
    inputs: Inputs,
    params: GuidanceParams,
    *further: str,
) -> GuidanceState:
    """Return the state `holding`, with some fields taken over from the last state, `state`.

    `holding` is a state that holds the measured values. The fields in CARRIED and `further` are
    taken over from `state`. If `inputs.begin` is HOLD, or if there is no last state, the result is
    `holding` itself. If the last state is within the age limit of u_m, its u_m is taken over too,
    because the reference model still flies this u_m.
    """
    if state is None or inputs.begin is Begin.HOLD:
        return holding
    again = holding._replace(**{name: getattr(state, name) for name in (*CARRIED, *further)})
    return again._replace(u_m=state.u_m) if inputs.t_ns - state.t_ns <= params.max_age_ns else again
