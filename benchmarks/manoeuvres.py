# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The manoeuvres of `benchmarks.guidance`.

A manoeuvre has the commands of a flight, and its figures with their limits.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.pose import wrapped
from flight_core.channels import POSE
from flight_core.rates import seconds
from flight_core.tape import Tape
from flight_core.units import GRAVITY
from flight_core.vectors import FloatArray, StampedVector
from flight_guidance.guidance import Guidance
from flight_guidance.guidance_state import GuidanceMode, Lateral
from flight_guidance.params import GuidanceConfig
from flight_guidance.steering.lateral import least_radius
from flight_guidance.steering.protection import FLOOR

SIGMA = 1.5  # intensity of the turbulence, m/s
START = 5.0  # instant of the command, s
BANK = math.radians(20.0)  # commanded bank, rad
TURN = math.pi / 2.0  # commanded change of the heading, rad
CLIMB = 100.0  # commanded change of the altitude, m
FASTER = 0.1  # commanded change of V, as a share of V0
WIND = 0.2  # as a share of V0
RECTANGLE = ((0, 0, 0), (3, 0, 0), (3, 2.5, 0), (0, 2.5, 0), (0, 0, 0))
ROUTE = ((0, 0, 0), (3, 0, 10), (5, 2, 10), (5, 5, 0), (2.5, 6.25, 0), (2.5, 3, 0), (0, 2.375, 0))
"""Waypoints as `round_route` takes them. ROUTE turns by 45, 45, 63, 117 and -76 deg."""
LOW = 100.0  # m
LOW_WIND = 10.9  # m/s at 20 ft
"""Altitude and wind of the turbulence for an airframe without an altitude. By MIL-F-8785C its
lateral intensity is then 1.5 m/s."""
SWITCH_PERIOD = 5.0  # time from one of SWITCHES to the next, s
FAULT = START + 10.0  # instant at which a fault of pose begins, in a turn, s
ANGLE_NOISE = math.radians(0.5)
NOISE = dict.fromkeys(("phi", "theta", "beta"), ANGLE_NOISE) | {"psi": 2.0 * ANGLE_NOISE}
NOISE |= dict.fromkeys(("north", "east", "altitude"), 0.5) | dict.fromkeys(
    ("v_north", "v_east", "climb"), 0.2
)
"""Standard deviations of the white noise of a poor estimator, rad, m and m/s."""


LATE = 5.0
"""Largest permitted excess of the bank over its limit with a poor pose, deg. If nothing predicted
the bank, a pose that is 0.4 s old would cost 8 deg at p_max."""


class Air(NamedTuple):
    """The air of a flight."""

    name: str
    seed: int | None = None
    across: float = 0.0  # wind to the east, as a share of V0


class Figure(NamedTuple):
    """A figure of a flight and its limit."""

    name: str
    value: float
    limit: float

    @property
    def missed(self) -> bool:
        """Whether the value is beyond the limit."""
        return self.value > self.limit


class Pose(NamedTuple):
    """How guidance receives pose: how it is measured, and a fault that begins at FAULT."""

    measured: Mapping[str, Any] = MappingProxyType({})  # section `aircraft.pose` of the scenario
    fault: float = 0.0  # duration of the fault, s
    off: Mapping[str, float] | None = None  # what the fault adds; None: the last pose is repeated
    stamped: bool = False  # whether the repeated pose has a new stamp
    max_age: float = 0.2  # key `max_age` of guidance, s


class FaultyPose(Guidance):
    """Guidance that receives pose with the fault.

    As the node does, it refuses a sample that is not newer or stands still.
    """

    def __init__(self, how: Pose, parameters: GuidanceConfig) -> None:
        super().__init__(parameters)
        self._how = how

    def take_pose(self, sample: StampedVector, now_ns: int) -> None:
        """Take a pose. Raises ChannelError as Guidance does."""
        how = self._how
        last = self._pose or sample
        if 0.0 <= seconds(now_ns) - FAULT < how.fault:
            if how.off is None:
                sample = last._replace(stamp_ns=sample.stamp_ns) if how.stamped else last
            else:
                off = dict(
                    zip(POSE, sample.value + [how.off.get(name, 0.0) for name in POSE], strict=True)
                )
                off["psi"] = wrapped(off["psi"])
                sample = sample._replace(value=np.array([*off.values()]))
        super().take_pose(sample, now_ns)


class Manoeuvre(NamedTuple):
    """A manoeuvre."""

    # returns the section of guidance, and the duration, s
    plan: Callable[[GuidanceConfig], tuple[dict[str, Any], float]]
    # yields the figures of a flight; the last argument says whether the air is calm
    figures: Callable[[Tape, GuidanceConfig, bool], Iterator[Figure]]
    winds: tuple[float, ...] = (0.0,)  # winds to the east, each a share of V0
    turbulent: bool = True
    pose: Pose = Pose()


def program(**channels: float) -> dict[str, Any]:
    """Return the section `program` with a constant command of each channel from START on."""
    return {name: {"start": [START], "value": [value]} for name, value in channels.items()}


def after(tape: Tape, t: float, *names: str) -> tuple[FloatArray, ...]:
    """Return channels of the topic `guidance` from the instant t, s, on."""
    keep = tape.time("guidance") >= t
    return tuple(tape["guidance"][name][keep] for name in names)


def settled(tape: Tape, name: str, target: float, band: float) -> float:
    """Return the time from START until a channel stays within a band, s."""
    t = tape.time("guidance")
    outside = np.abs(tape["guidance"][name] - target) > band
    return float(t[np.flatnonzero(outside)[-1]] - START) if outside.any() else 0.0


def rms(values: FloatArray) -> float:
    """Compute the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def of_phi(tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Return overshoot and settling of a step of the bank, and the rms in turbulence."""
    if calm:
        yield Figure(
            "overshoot (%)", 100.0 * (tape["guidance"]["pose.phi"].max() / BANK - 1.0), 8.0
        )
        yield Figure(
            "settled to 1 deg (s)", settled(tape, "pose.phi", BANK, math.radians(1.0)), 4.0
        )
    else:
        yield Figure(
            "rms (deg)", math.degrees(rms(after(tape, START + 5.0, "pose.phi")[0] - BANK)), 3.0
        )


def of_heading(tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Return the overshoot of a turn, and what it costs in altitude and airspeed."""
    psi, altitude, V, commanded = after(tape, START, "pose.psi", "pose.altitude", "y.V", "target.V")
    yield Figure("overshoot (%)", 100.0 * (np.unwrap(psi).max() / TURN - 1.0), 2.0 if calm else 5.0)
    yield Figure("altitude (m)", np.abs(altitude - altitude[0]).max(), 5.0 if calm else 15.0)
    yield Figure("V (m/s)", np.abs(section.speed + V - commanded).max(), 2.0 if calm else 5.0)


def of_pose(tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Return errors of heading and altitude, and the true bank, over the last 10 s.

    The errors use pose as guidance receives it. Also returns how long pose was stale; guidance
    levels the wings meanwhile.
    """
    end = tape.time("guidance")[-1] - 10.0
    psi, altitude, wanted, lateral = after(
        tape, end, "pose.psi", "pose.altitude", "target.altitude", "mode.lateral"
    )
    if lateral[0] == Lateral.HEADING:  # not after a loss of pose
        yield Figure(
            "heading (deg)",
            math.degrees(abs(float(np.mean(np.mod(psi, 2.0 * math.pi))) - math.pi)),
            1.0,
        )
    yield Figure("altitude (m)", abs(float(np.mean(altitude - wanted))), 1.0)
    yield Figure(
        "bank at the end (deg)",
        math.degrees(np.abs(tape["truth"]["x.phi"][tape.time("truth") > end]).max()),
        5.0,
    )
    stale = after(tape, 0.0, "mode")[0] != GuidanceMode.ENGAGED
    yield Figure(
        "pose stale (s)", float(stale.sum()) * seconds(section.params().period_ns), math.inf
    )


def of_altitude(tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Return the overshoot of a climb, and what it costs in airspeed."""
    altitude, V = after(tape, START, "pose.altitude", "y.V")
    start = tape["guidance"]["target.altitude"][0]
    yield Figure(
        "overshoot (%)", 100.0 * ((altitude.max() - start) / CLIMB - 1.0), 3.0 if calm else 20.0
    )
    if calm:
        yield Figure("V (m/s)", np.abs(V).max(), 4.0)
    else:
        yield Figure("V below 0.8 V0 (m/s)", 0.8 * section.speed - (section.speed + V.min()), 2.0)


def of_speed(tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Return the overshoot of an acceleration, and what it costs in altitude.

    In turbulence, return the rms of V over that of the wind instead.
    """
    altitude, V = after(tape, START, "pose.altitude", "y.V")
    step = FASTER * section.speed
    if calm:
        yield Figure("overshoot (%)", 100.0 * (V.max() / step - 1.0), 5.0)
        yield Figure("altitude (m)", np.abs(altitude - altitude[0]).max(), 3.0)
    else:
        end = tape.time("guidance")[-1]
        late = after(tape, end - 60.0, "y.V")[0]
        yield Figure("rms over wind's", rms(late - step) / SIGMA, 1.2)


def of_route(waypoints: int, tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Return the largest cross-track error between 30 s and the last orbit, in s of flight at V0.

    Also returns the number of legs if the flight did not reach the last orbit.
    """
    leg, xtrack = after(tape, 30.0, "leg", "xtrack")
    leg_errors = np.abs(xtrack[leg < leg.max()])
    if leg.max() < 2.0 * waypoints - 3.0:  # lines, fillets between them, and the orbit
        yield Figure("legs flown", leg.max(), -math.inf)
    yield Figure("cross-track (s)", leg_errors.max() / section.speed, 0.35 if calm else 0.5)


def of_orbit(tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Return the rms of the cross-track error on the last lap, in s of flight at V0."""
    end = tape.time("guidance")[-1]
    yield Figure(
        "rms (s)",
        rms(after(tape, end - lap(section), "xtrack")[0]) / section.speed,
        0.02 if calm else 0.15,
    )


def of_switch(tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Return by how much u jumps at most within 20 ms of a change of the mode.

    The jump of each input is in percent of its range.
    """
    t = tape.time("u")
    u = tape["u"].values
    span = u.max(axis=0) - u.min(axis=0)
    limits = np.array(
        [RANGES.get(name, width) for name, width in zip(tape["u"].names, span, strict=True)]
    )
    jumps = [
        np.abs(u[at + 2] - u[at]) / limits
        for at in np.searchsorted(t, START + SWITCH_PERIOD * np.arange(len(SWITCHES)))
    ]
    yield Figure("jump of u (% of range)", 100.0 * float(np.max(jumps)), 2.0)


RANGES: dict[str, float] = {}
"""Range of each input of the aircraft that flies."""


def of_limits(tape: Tape, section: GuidanceConfig, calm: bool, pose: Pose) -> Iterator[Figure]:
    """Return how far the bank exceeds its limit, and how far V falls below 0.9 of its floor.

    Every manoeuvre has these figures.
    """
    phi = tape["truth"]["x.phi"]
    V = tape["guidance"]["y.V"]
    limit = 2.0 if calm else 3.0
    yield Figure(
        "bank beyond (deg)",
        math.degrees(np.abs(phi).max() - section.bank),
        limit if pose == Pose() else LATE,
    )
    floor = section.params().limits.stall_speed * FLOOR
    yield Figure("V below 0.9 floor (m/s)", 0.9 * floor - (section.speed + V.min()), 0.0)


def lap(section: GuidanceConfig) -> float:
    """Return the time round the smallest orbit, s."""
    return 2.0 * math.pi * section.least_radius() / section.speed


def round_route(
    places: Sequence[tuple[float, float, float]], section: GuidanceConfig
) -> tuple[dict[str, Any], float]:
    """Return a route over places, and the time to fly it, s.

    A place has north and east in least radii, and its altitude over that of trim, m. The fillets
    have the least radius.
    """
    radius = float(math.ceil(least_radius(section.speed, section.wind, section.bank)))
    north, east, altitude = np.transpose(places) * [[radius], [radius], [1.0]]
    route = {"north": north.tolist(), "east": east.tolist(), "altitude": altitude.tolist()}
    length = float(np.hypot(np.diff(north), np.diff(east)).sum())
    return {"route": route, "radius": radius}, length / (section.speed - section.wind)


SWITCHES: tuple[dict[str, float], ...] = (
    {"phi": 0.3},
    {"heading": 0.5, "climb": 0.5},
    {"course": -0.5, "altitude": 0.0},
    {"phi": -0.2, "theta": 0.0},
    {"heading": 1.0, "altitude": 0.0},
)
"""Commands that follow each other each SWITCH_PERIOD; altitude and theta are those above trim."""


def turn_round(section: GuidanceConfig) -> tuple[dict[str, Any], float]:
    """Return a turn to the right onto 180 deg, at which psi jumps, and its duration, s."""
    duration = math.pi * section.speed / (GRAVITY * math.tan(section.bank)) + 40.0
    return {
        "program": {"heading": {"start": [START, START + 5.0], "value": [TURN, math.pi]}}
    }, FAULT + duration


POSES: Mapping[str, Pose] = {
    "5 Hz": Pose({"rate": 5.0}),
    "0.2 s late": Pose({"delay": 0.2}),
    "noisy": Pose({"noise": NOISE}),
    "5 Hz, 0.2 s late, noisy": Pose({"rate": 5.0, "delay": 0.2, "noise": NOISE}, max_age=0.5),
    "frozen for 8 s": Pose(fault=8.0),
    "frozen for 8 s, new stamps": Pose(fault=8.0, stamped=True),
    "frozen for 20 s": Pose(fault=20.0),
    "jump": Pose(
        fault=math.inf,
        off={"psi": math.radians(30.0), "north": 100.0, "east": 100.0, "altitude": 30.0},
    ),
    "one sample off": Pose(
        fault=0.02, off={"phi": 1.0, "theta": 0.3, "psi": math.pi, "altitude": 100.0, "climb": 20.0}
    ),
}
"""Ways to receive a pose that is worse than the true one."""


def switching(section: GuidanceConfig) -> tuple[dict[str, Any], float]:
    """Return SWITCHES, which change the lateral and the vertical mode, and their duration, s."""
    steps: dict[str, dict[str, list[float]]] = {}
    for k, switch in enumerate(SWITCHES):
        for name, value in switch.items():
            channel = steps.setdefault(name, {"start": [], "value": []})
            channel["start"].append(START + SWITCH_PERIOD * k)
            channel["value"].append(value)
    return {"program": steps}, START + SWITCH_PERIOD * len(SWITCHES)


MANOEUVRES: Mapping[str, Manoeuvre] = {
    "phi": Manoeuvre(lambda _: ({"program": program(phi=BANK)}, 30.0), of_phi),
    "heading": Manoeuvre(
        lambda section: (
            {"program": program(heading=TURN)},
            START + TURN * section.speed / (GRAVITY * math.tan(section.bank)) + 40.0,
        ),
        of_heading,
    ),
    "altitude": Manoeuvre(
        lambda section: (
            {"program": program(altitude=CLIMB)},
            START + CLIMB / section.climb_limits()[0] + 60.0,
        ),
        of_altitude,
    ),
    "V": Manoeuvre(
        lambda section: (
            {"program": program(V=(1.0 + FASTER) * section.speed)},
            START
            + FASTER * section.speed / section.params().slew[section.outputs.index("V")]
            + 80.0,
        ),
        of_speed,
    ),
    "rectangle": Manoeuvre(
        partial(round_route, RECTANGLE), partial(of_route, len(RECTANGLE)), (0.0, WIND)
    ),
    "orbit": Manoeuvre(
        lambda section: (
            {
                "program": program(
                    north=0.0,
                    east=section.least_radius() + 1.0,
                    radius=section.least_radius() + 1.0,
                )
            },
            2.0 * lap(section) + 30.0,
        ),
        of_orbit,
    ),
    "switch": Manoeuvre(switching, of_switch, turbulent=False),
    **{
        f"pose: {name}": Manoeuvre(turn_round, of_pose, turbulent=False, pose=pose)
        for name, pose in POSES.items()
    },
}
OTHER_ROUTE = {
    "route": Manoeuvre(partial(round_route, ROUTE), partial(of_route, len(ROUTE)), (0.0, WIND))
}
