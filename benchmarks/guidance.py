# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Acceptance of guidance: holds, a rectangle and an orbit, by rule alone, in calm air and in
turbulence of 1.5 m/s.

    .venv/bin/python -m benchmarks.guidance [--only osprey_servo c172p] [--manoeuvres heading orbit]
    [--seeds 5]
    .venv/bin/python -m benchmarks.guidance --route
        # another route, on aircraft that guidance was not built with

The figures go to docs/evidence/guidance-*.csv, and docs/evidence.md is written from them. Flights
in one process. Each row is a figure with its limit; in turbulence it is the worst of all seeds. The
rectangle is flown without wind and with a wind of a fifth of the airspeed across its first leg. No
number is tuned to an aircraft. The 737 is identified first, which takes some minutes.
"""

import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from itertools import groupby
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from benchmarks import evidence
from benchmarks.evidence import row, split
from benchmarks.tables import new_table, parser_of
from rich.console import Console

from aircraft_sim.pose import wrapped
from flight_analysis.closed_loop.scenario import Scenario, parse_scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.channels import POSE
from flight_core.outcome import COMPLETED
from flight_core.rates import seconds
from flight_core.tape import Tape
from flight_core.units import GRAVITY
from flight_core.vectors import FloatArray, StampedVector
from flight_guidance.guidance import Guidance
from flight_guidance.guidance_state import Lateral, Mode
from flight_guidance.lateral import least_radius
from flight_guidance.params import GuidanceConfig
from flight_guidance.protection import FLOOR

SIGMA = 1.5  # m/s, of the turbulence
START = 5.0  # s, of the command
BANK, TURN, CLIMB, FASTER = math.radians(20.0), math.pi / 2.0, 100.0, 0.1  # rad, rad, m, of V0
WIND = 0.2  # of V0
RECTANGLE = ((0, 0, 0), (3, 0, 0), (3, 2.5, 0), (0, 2.5, 0), (0, 0, 0))
ROUTE = ((0, 0, 0), (3, 0, 10), (5, 2, 10), (5, 5, 0), (2.5, 6.25, 0), (2.5, 3, 0), (0, 2.375, 0))
"""Waypoints as of `round_route`. The second route turns by 45, 45, 63, 117 and -76 deg."""
LOW, LOW_WIND = (
    100.0,
    10.9,
)  # m and m/s at 20 ft, for an airframe without altitude: lateral intensity 1.5 m/s, MIL-F-8785C
SWITCH_PERIOD = 5.0  # s
FAULT = START + 10.0  # s, of a fault of pose, in a turn
ANGLE_NOISE = math.radians(0.5)
NOISE = dict.fromkeys(("phi", "theta", "beta"), ANGLE_NOISE) | {"psi": 2.0 * ANGLE_NOISE}
NOISE |= dict.fromkeys(("north", "east", "altitude"), 0.5) | dict.fromkeys(
    ("v_north", "v_east", "climb"), 0.2
)
"""Standard deviations of a poor estimator, rad, m and m/s, white."""


class Air(NamedTuple):
    """The air of a flight."""

    name: str
    seed: int | None = None
    across: float = 0.0  # wind to the east, of V0


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
    """How guidance receives pose: `aircraft.pose` of the scenario, and a fault for `fault` s from
    FAULT on.
    """

    measured: Mapping[str, Any] = MappingProxyType({})
    fault: float = 0.0  # s
    off: Mapping[str, float] | None = None  # what the fault adds; None: the last pose is repeated
    stamped: bool = False  # whether the repeated pose has a new stamp
    max_age: float = 0.2  # s, of the section


class FaultyPose(Guidance):
    """Guidance that receives pose with the fault. As the node does, it refuses a sample that is not
    newer or stands still.
    """

    def __init__(self, how: Pose, parameters: GuidanceConfig) -> None:
        super().__init__(parameters)
        self._how = how

    def take_pose(self, sample: StampedVector, now_ns: int) -> None:
        """Take a pose. Raises ChannelError as Guidance does."""
        how, last = self._how, self._pose or sample
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
    """A manoeuvre: the section of guidance and the duration, s; and its figures."""

    plan: Callable[[GuidanceConfig], tuple[dict[str, Any], float]]
    figures: Callable[
        [Tape, GuidanceConfig, bool], Iterator[Figure]
    ]  # the last: whether the air is calm
    winds: tuple[float, ...] = (0.0,)
    turbulent: bool = True
    pose: Pose = Pose()


def program(**channels: float) -> dict[str, Any]:
    """Commands from START on."""
    return {name: {"start": [START], "value": [value]} for name, value in channels.items()}


def after(tape: Tape, t: float, *names: str) -> tuple[FloatArray, ...]:
    """Channels of `guidance` from t on."""
    keep = tape.time("guidance") >= t
    return tuple(tape["guidance"][name][keep] for name in names)


def settled(tape: Tape, name: str, target: float, band: float) -> float:
    """Time from START until a channel stays within a band, s."""
    t, outside = tape.time("guidance"), np.abs(tape["guidance"][name] - target) > band
    return float(t[np.flatnonzero(outside)[-1]] - START) if outside.any() else 0.0


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def of_phi(tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Overshoot and settling of a step of the bank; rms in turbulence."""
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
    """Overshoot of a turn, and what it costs in altitude and airspeed."""
    psi, altitude, V, commanded = after(tape, START, "pose.psi", "pose.altitude", "y.V", "target.V")
    yield Figure("overshoot (%)", 100.0 * (np.unwrap(psi).max() / TURN - 1.0), 2.0 if calm else 5.0)
    yield Figure("altitude (m)", np.abs(altitude - altitude[0]).max(), 5.0 if calm else 15.0)
    yield Figure("V (m/s)", np.abs(section.speed + V - commanded).max(), 2.0 if calm else 5.0)


def of_pose(tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Heading and altitude as received over the last 10 s, the true bank then, and how long the
    wings were levelled.
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
    stale = after(tape, 0.0, "mode")[0] != Mode.ENGAGED
    yield Figure(
        "pose stale (s)", float(stale.sum()) * seconds(section.params().period_ns), math.inf
    )


def of_altitude(tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Overshoot of a climb and what it costs in airspeed."""
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
    """Overshoot of an acceleration and what it costs in altitude; rms of V in turbulence over that
    of the wind.
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
    """Largest cross-track error from 30 s on and before the last orbit, in s of flight."""
    leg, xtrack = after(tape, 30.0, "leg", "xtrack")
    flown = np.abs(xtrack[leg < leg.max()])
    if leg.max() < 2.0 * waypoints - 3.0:  # lines, fillets between them, and the orbit
        yield Figure("legs flown", leg.max(), -math.inf)
    yield Figure("cross-track (s)", flown.max() / section.speed, 0.35 if calm else 0.5)


def of_orbit(tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Rms of the cross-track error, in s of flight."""
    end = tape.time("guidance")[-1]
    yield Figure(
        "rms (s)",
        rms(after(tape, end - lap(section), "xtrack")[0]) / section.speed,
        0.02 if calm else 0.15,
    )


def of_switch(tape: Tape, section: GuidanceConfig, calm: bool) -> Iterator[Figure]:
    """Largest jump of u within 20 ms of a change of the mode, in percent of the range of each
    input.
    """
    t, u = tape.time("u"), tape["u"].values
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
    """How far the bank is beyond its limit, and the airspeed below nine tenths of the floor, in any
    manoeuvre.
    """
    phi, V = tape["truth"]["x.phi"], tape["guidance"]["y.V"]
    limit = 2.0 if calm else 3.0
    yield Figure(
        "bank beyond (deg)",
        math.degrees(np.abs(phi).max() - section.bank),
        limit if pose == Pose() else LATE,
    )
    floor = section.params().limits.stall_speed * FLOOR
    yield Figure("V below 0.9 floor (m/s)", 0.9 * floor - (section.speed + V.min()), 0.0)


def lap(section: GuidanceConfig) -> float:
    """Time round the smallest orbit, s."""
    return 2.0 * math.pi * section.least_radius() / section.speed


def round_route(
    places: Sequence[tuple[float, float, float]], section: GuidanceConfig
) -> tuple[dict[str, Any], float]:
    """A route over places: north and east in least radii, which the fillets have, and altitude over
    that of trim, m.
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
"""Commands one after another; altitude and theta count from those of trim."""


def turn_round(section: GuidanceConfig) -> tuple[dict[str, Any], float]:
    """A turn to the right onto the heading at which psi jumps, 180 deg."""
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
"""A pose worse than the true one."""


def switching(section: GuidanceConfig) -> tuple[dict[str, Any], float]:
    """A change of both modes every SWITCH_PERIOD."""
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


def prepared(scenario: Scenario) -> Scenario:
    """A scenario with guidance by rule in calm air, without the commands and the gusts of its
    own.
    """
    aircraft: dict[str, Any] = {"gusts": {}, "turbulence": None}
    if not scenario.aircraft.is_jsbsim:
        aircraft |= {"kinematics": "euler"}
    live = {"speed": scenario.aircraft.channels().speed}
    reference = {"live": live, "pulses": {}, "sines": {}, "coordinated_turn": None}
    return scenario.vary(aircraft=aircraft, reference_model=reference).vary(guidance={})


@cache
def aircraft_of(name: str) -> Scenario:
    """The scenario of an aircraft, with guidance, and the stall speed as `rise-di identify
    --guidance` writes it.
    """
    scenario = prepared(original_of(name))
    if name not in CONDITIONS:
        return scenario
    from flight_design.identification.step_identification import slowest_trim  # noqa: PLC0415 - for these aircraft alone

    return scenario.vary(
        guidance={"stall_speed": slowest_trim(scenario.aircraft.flight_condition())}
    )


@cache
def original_of(name: str) -> Scenario:
    """The scenario of an aircraft, with the commands and the gusts of its own."""
    if name == "osprey_servo":
        slower = {"rate": 100.0, "step": 0.005}  # as the law: four times faster than with 500 Hz
        return find_scenario(name).vary(aircraft=slower, reference_model={"rate": 100.0})
    if name in {"c172p", "f16"}:
        return find_scenario(f"jsbsim_{name}")
    from flight_design.identification.step_identification import identify  # noqa: PLC0415 - for this aircraft alone

    return parse_scenario(
        identify(name, *CONDITIONS[name]).text.encode(), Path(f"jsbsim_{name}.yaml")
    )


AIRCRAFT = ("osprey_servo", "c172p", "737", "f16")
OTHERS = {"c182": (56.6, 1219.0), "A320": (154.0, 6096.0), "F4N": (180.0, 4572.0)}
"""Aircraft of JSBSim on which nothing of guidance was tried while it was built: a light aircraft,
an airliner, a fighter."""

CONDITIONS: Mapping[str, tuple[float, float]] = {"737": (154.0, 6096.0), **OTHERS}
"""Trim speed, m/s, and altitude, m, of the aircraft that are identified."""


def flown(scenario: Scenario, manoeuvre: Manoeuvre, air: Air) -> Iterator[Figure]:
    """The figures of a flight."""
    guidance = scenario.guidance
    if guidance is None:
        raise ValueError(f"{scenario.name} has no guidance")
    speed, altitude = guidance.speed, scenario.aircraft.altitude or 0.0
    section, duration = manoeuvre.plan(guidance.model_copy(update={"wind": air.across * speed}))
    section |= {"wind": air.across * speed, "max_age": manoeuvre.pose.max_age}
    for name in ("altitude", "theta"):
        if name in section.get("program", {}):
            offset = altitude if name == "altitude" else trim_pitch(scenario)
            section["program"][name]["value"] = [
                offset + value for value in section["program"][name]["value"]
            ]
    if "route" in section:
        section["route"]["altitude"] = [altitude + above for above in section["route"]["altitude"]]
    aircraft: dict[str, Any] = {
        "wind": [0.0, air.across * speed],
        "pose": dict(manoeuvre.pose.measured),
    }
    if manoeuvre.figures is of_switch:
        aircraft["sensors"] = {}  # noise moves u by itself
    if air.seed is not None:
        aircraft["turbulence"] = turbulence(scenario, air.seed)
    varied = scenario.vary(flight={"duration": duration}, aircraft=aircraft, guidance=section)
    controller = scenario.controller
    RANGES.clear()
    if controller.lower and controller.upper:
        RANGES.update(
            {
                name: high - low
                for name, low, high in zip(
                    controller.inputs, controller.lower, controller.upper, strict=True
                )
            }
        )
    tape = simulate(varied, guide=partial(FaultyPose, manoeuvre.pose))
    if tape.outcome != COMPLETED:
        yield Figure(f"lost: {tape.outcome}", math.inf, 0.0)
        return
    calm = air.seed is None
    yield from manoeuvre.figures(tape, guidance, calm)
    yield from of_limits(tape, guidance, calm, manoeuvre.pose)


def turbulence(scenario: Scenario, seed: int) -> dict[str, Any]:
    """The section `aircraft.turbulence`, with SIGMA."""
    altitude = scenario.aircraft.altitude or 0.0
    low = (
        {"altitude": LOW, "wind": LOW_WIND}
        if altitude == 0.0
        else {"altitude": altitude, "sigma": SIGMA}
    )
    return low | {"seed": seed}


def trim_pitch(scenario: Scenario) -> float:
    """Pitch in trim, rad."""
    return float(simulate(scenario.vary(flight={"duration": 0.1}))["guidance"]["pose.theta"][0])


EXEMPT = {("f16", "heading", "altitude (m)"): 40.0, ("f16", "orbit", "rms (s)"): 0.05}
"""Limits of an aircraft whose rudder is at its stop in turns: its own yaw damper feeds r back
without a washout."""
LATE = 5.0
"""Limit of the bank beyond its limit with a poor pose, deg. A pose 0.4 s old costs 8 deg at p_max
where nothing predicts."""


class Row(NamedTuple):
    """The worst value of a figure over the seeds."""

    aircraft: str
    manoeuvre: str
    air: str
    figure: Figure


class Job(NamedTuple):
    """One flight: of a manoeuvre by its title, in the air that a row names."""

    title: str
    shown: str
    air: Air


def jobs(manoeuvres: Mapping[str, Manoeuvre], seeds: int) -> Iterator[Job]:
    """The flights of one aircraft, those of a row beside each other."""
    for title, manoeuvre in manoeuvres.items():
        for across in manoeuvre.winds:
            wind = f", wind {across:g} V" if across else ""
            yield Job(title, f"calm{wind}", Air("calm", None, across))
            for seed in range(seeds if manoeuvre.turbulent else 0):
                yield Job(
                    title, f"turbulence{wind}, {seeds} seeds", Air("turbulence", seed + 1, across)
                )


def fly(scenario: Scenario, job: Job) -> list[Figure]:
    """The figures of one flight."""
    return list(flown(scenario, {**MANOEUVRES, **OTHER_ROUTE}[job.title], job.air))


def rows(
    name: str,
    manoeuvres: Mapping[str, Manoeuvre],
    seeds: int,
    over: Callable[..., Iterable[list[Figure]]] = map,
) -> Iterator[Row]:
    """All rows of an aircraft, as they are flown by `over`, which is `map` or that of a pool of
    processes.
    """
    several = list(jobs(manoeuvres, seeds))
    done = zip(several, over(partial(fly, aircraft_of(name)), several), strict=True)
    for (title, shown), those in groupby(done, key=lambda flight: flight[0][:2]):
        worst: dict[str, Figure] = {}
        for figure in (figure for _, figures in those for figure in figures):
            own = max(figure.limit, EXEMPT.get((name, title, figure.name), figure.limit))
            worst[figure.name] = max(
                figure._replace(limit=own),
                worst.get(figure.name, figure),
                key=lambda same: same.value,
            )
        yield from (Row(name, title, shown, figure) for figure in worst.values())


def main() -> None:
    """Fly, store the results and write the page; exit status 1 where a limit is not met or a point
    is lost.
    """
    parser = parser_of(__doc__)
    parser.add_argument("--only", nargs="*", choices=AIRCRAFT, default=AIRCRAFT, help="aircraft")
    parser.add_argument(
        "--manoeuvres",
        nargs="*",
        choices=[*MANOEUVRES],
        default=[*MANOEUVRES],
        help="manoeuvres; not stored",
    )
    parser.add_argument("--seeds", type=int, default=5, help="of the turbulence")
    parser.add_argument(
        "--route", action="store_true", help=f"another route, on {', '.join(OTHERS)}, instead"
    )
    options = parser.parse_args()
    if options.route:
        begun = origin(f"--route --seeds {options.seeds}")
        flown = [
            kept for name in OTHERS for kept in fly_manoeuvres(name, OTHER_ROUTE, options.seeds)
        ]
        store("route", (figure_row(kept.aircraft, kept) for kept in flown), begun)
        sys.exit(any(kept.figure.missed for kept in flown))
    failed = 0
    for name in options.only:
        begun = origin(f"--only {name} --seeds {options.seeds}")
        flown = fly_manoeuvres(
            name, {title: MANOEUVRES[title] for title in options.manoeuvres}, options.seeds
        )
        if len(options.manoeuvres) == len(MANOEUVRES):
            store(name, (figure_row(kept.manoeuvre, kept) for kept in flown), begun)
        failed += any(kept.figure.missed for kept in flown)
    sys.exit(failed > 0)


def origin(options: str) -> evidence.Origin:
    """The origin of figures that this program begins to measure with these options."""
    return evidence.origin(f"python -m benchmarks.guidance {options}")


def store(name: str, figures: Iterable[evidence.Row], begun: evidence.Origin) -> None:
    """Write the rows of evidence of a measurement, and the page."""
    evidence.write(f"guidance-{name}", figures, begun)


def figure_row(about: str, flown: Row) -> evidence.Row:
    """The row of evidence of a figure; a limit that is infinite is none."""
    name, unit = split(flown.figure.name)
    limit = None if flown.figure.limit == math.inf else flown.figure.limit
    return row(f"{about}, {flown.air}: {name}", float(flown.figure.value), unit, at_most=limit)


def fly_manoeuvres(name: str, manoeuvres: Mapping[str, Manoeuvre], seeds: int) -> list[Row]:
    """Fly the manoeuvres of an aircraft and print the table."""
    table = new_table(
        f"Guidance by rule, {name}", ("manoeuvre", "air", "figure", "worst", "limit", ""), texts=3
    )
    kept = []
    with ProcessPoolExecutor() as pool:
        for flown in rows(name, manoeuvres, seeds, pool.map):
            figure = flown.figure
            verdict = "missed" if figure.missed else ""
            cells = (
                flown.manoeuvre,
                flown.air,
                figure.name,
                f"{figure.value:.3g}",
                f"{figure.limit:.3g}",
                verdict,
            )
            print(name, *cells, sep="\t", file=sys.stderr, flush=True)
            table.add_row(*cells)
            kept.append(flown)
    Console().print(table)
    return kept


if __name__ == "__main__":
    main()
