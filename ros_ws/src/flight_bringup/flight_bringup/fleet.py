# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a fleet: several aircraft at once over topics.

Every aircraft has a separate namespace, nodes, log and report.
"""

import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from flight_analysis.closed_loop.scenario import Scenario, require_guidable
from flight_analysis.closed_loop.scenario_library import find_scenario, with_route
from flight_analysis.report.run_folder import new_run
from flight_analysis.report.separation import SEPARATION
from flight_bringup.fly import POLL_PERIOD, Steps, follow, with_file
from flight_bringup.graph import FIRST_STAGE, LEAD, absolute_namespace, second_stage
from flight_bringup.interrupt import DeferredInterrupt, handle_signals
from flight_bringup.processes import FlightProcesses, start_instants
from flight_core.arguments import FilePath, as_path
from flight_core.environment import MAX_PARTICIPANTS, require_ros_environment
from flight_core.fields import Field
from flight_core.files import read_yaml
from flight_core.outcome import COMPLETED, INTERRUPTED, Outcome, never_flew
from flight_core.parameters import Config, NonNegative, Number, ParameterError, Positive, require
from flight_core.scenario_file import PARAMETERS
from flight_guidance.routes.route_file import Origin, read_route

if TYPE_CHECKING:
    from flight_bringup.monitor import FlightMonitor

BEGIN_TIME = 0.05  # s by which each aircraft delays t = 0, because all nodes receive t = 0 at once
A_FLEET = "a file of a fleet (.yaml): aircraft by name"
Degrees = Annotated[float, Field(ge=-180, le=180)]
Overrides = dict[str, dict[str, object]]


def is_fleet(name: FilePath) -> bool:
    """Return whether a path leads to a fleet file.

    A fleet file has a mapping `aircraft` with the aircraft by name. A scenario file has a section
    `aircraft` as well, but this section contains `ros__parameters`.
    """
    with suppress(ParameterError):
        content = read_yaml(Path(name), str(name), A_FLEET)
        aircraft = content.get("aircraft", {}) if isinstance(content, Mapping) else {}
        is_section = isinstance(aircraft, Mapping) and PARAMETERS in aircraft
        return isinstance(content, Mapping) and "aircraft" in content and not is_section
    return False


class AircraftOfFleet(Config):
    """An aircraft of a fleet, as the fleet file describes it."""

    scenario: str | None = Field(
        default=None, description="name or path of a scenario; by default the fleet's"
    )
    set: Overrides = Field(
        default={}, description="parameters that replace the scenario's, by section"
    )
    start: dict[str, Number] = Field(
        default={}, description="where it is at its t = 0: north, east, m, and heading, rad"
    )
    delay: NonNegative = Field(
        default=0.0, description="time from t = 0 of the fleet to its t = 0, s"
    )
    route: str | None = Field(
        default=None, description="path of a route file, flown from the start"
    )


class FleetConfig(Config):
    """The content of a fleet file. Paths in the file are relative to the folder of the file."""

    scenario: str = Field(
        default="osprey_route", description="scenario of the aircraft that name none"
    )
    duration: Positive | None = Field(
        default=None, description="flight time of each aircraft, s; by default its scenario's"
    )
    lockstep: bool = Field(
        default=False, description="fly as fast as the machine allows, in lockstep, each by itself"
    )
    composed: bool = Field(default=False, description="run all nodes of an aircraft in one process")
    use_sim_time: bool = Field(default=False, description="fly by the /clock of a simulator")
    set: Overrides = Field(
        default={},
        description="parameters of all aircraft, by section: a shared wind, for instance",
    )
    origin: Annotated[tuple[Degrees, ...], Field(min_length=2, max_length=2)] | None = Field(
        default=None,
        description="latitude and longitude of north = east = 0, degrees; by default the home "
        "of each route",
    )
    separation: NonNegative = Field(
        default=SEPARATION,
        description="least distance of two aircraft, m; less is a shortfall; 0: not judged",
    )
    aircraft: Annotated[dict[str, AircraftOfFleet | None], Field(min_length=1)] = Field(
        description="the aircraft by name"
    )


@dataclass(frozen=True)
class Member:
    """An aircraft of a fleet, with its scenario and its name, which is also its namespace.

    t = 0 of the aircraft is `delay` s after t = 0 of the fleet.
    """

    name: str
    scenario: Scenario
    delay: float = 0.0


@dataclass(frozen=True)
class Fleet:
    """A fleet that has been read and validated."""

    name: str
    members: tuple[Member, ...]
    lockstep: bool = False
    composed: bool = False
    use_sim_time: bool = False
    separation: float = SEPARATION  # m, least distance between two aircraft

    def participants(self) -> int:
        """Return the number of DDS participants: one for the command, and one for each process."""
        scenarios = [member.scenario for member in self.members]
        if self.composed:
            # A learner has a separate process even if the other nodes share one.
            return 1 + sum(1 + scenario.has_learner() for scenario in scenarios)
        return 1 + sum(len(FIRST_STAGE) + len(second_stage(scenario)) for scenario in scenarios)


def read_fleet(
    file: FilePath, duration: float | None = None, *, use_sim_time: bool = False
) -> Fleet:
    """Read a fleet file.

    `duration`, s, replaces the duration in the file. If `use_sim_time` is True, the fleet flies by
    the topic /clock. Raises ParameterError if the file is invalid.
    """
    path = as_path(file, "fleet", A_FLEET)
    content = read_yaml(path, str(path), A_FLEET)
    require(isinstance(content, Mapping), str(path), "no mapping", A_FLEET)
    config = FleetConfig.validate_mapping(content, path.stem)
    members = []
    for name, section in config.aircraft.items():
        aircraft = section or AircraftOfFleet()
        try:
            namespace = absolute_namespace(name)
            require(namespace.count("/") == 1, "name", repr(name), "one word")
            members.append(
                Member(name, _scenario(config, aircraft, path.parent, duration), aircraft.delay)
            )
        except ParameterError as error:
            raise ParameterError(f"{path.stem}.aircraft.{name}: {error}") from None
        late = config.lockstep and aircraft.delay > 0.0
        require(
            not late,
            f"{path.stem}.aircraft.{name}.delay",
            f"{aircraft.delay:g} s",
            "0 in lockstep, which has no common time",
        )
    # The following checks concern the fleet as a whole.
    by_clock = use_sim_time or config.use_sim_time
    require(
        not (by_clock and config.lockstep),
        f"{path.stem}.use_sim_time",
        "true in lockstep, which has no clock",
        "one of the two",
    )
    fleet = Fleet(
        name=path.stem,
        members=tuple(members),
        lockstep=config.lockstep,
        composed=config.composed,
        use_sim_time=by_clock,
        separation=config.separation,
    )
    cheaper = "" if config.composed else "; composed: true takes one for each aircraft"
    participants = f"{fleet.participants()} participants of the middleware"
    require(
        fleet.participants() <= MAX_PARTICIPANTS,
        path.stem,
        participants,
        f"at most {MAX_PARTICIPANTS}{cheaper}",
    )
    return fleet


def _scenario(
    config: FleetConfig, aircraft: AircraftOfFleet, folder: Path, duration: float | None
) -> Scenario:
    """Return the scenario of an aircraft.

    Raises ParameterError if a scenario or a route is missing or invalid.
    """
    name = aircraft.scenario or config.scenario
    scenario = find_scenario(
        folder / name if name.endswith(".yaml") else name, with_route=aircraft.route is None
    )
    for changes in (config.set, aircraft.set):
        scenario = scenario.vary(**_nested(scenario, changes))
    if aircraft.start:
        scenario = scenario.vary(aircraft={"start": aircraft.start})
    if (seconds := duration or config.duration) is not None:
        scenario = scenario.vary(flight={"duration": seconds})
    if aircraft.route is not None:
        origin = None if config.origin is None else Origin(*config.origin)
        scenario = with_route(scenario, read_route(folder / aircraft.route, origin))
    require_guidable(scenario)
    return scenario


def _nested(
    scenario: Scenario, changes: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Return the changes of a scenario, completed so that each change replaces a whole group.

    A change that is a mapping gives new values only to some parameters of a group. The other
    parameters of the group are added, with their values in the scenario.
    """

    def merged(old: Any, new: Any) -> Any:
        if not (isinstance(new, Mapping) and isinstance(old, Config)):
            return new
        values = {key: getattr(old, key) for key in old.model_fields}
        return values | {key: merged(values.get(key), value) for key, value in new.items()}

    tree = {}
    for name, section in changes.items():
        config = getattr(scenario, name, None)
        tree[name] = {
            key: merged(getattr(config, key, None), value) for key, value in section.items()
        }
    return tree


@dataclass
class _Flight:
    """The flight of one aircraft of a fleet, from its start to its end."""

    member: Member
    run: Path
    monitor: "FlightMonitor"
    progress: Callable[[float, str], None]
    processes: FlightProcesses | None = None
    steps: Steps | None = None
    outcome: Outcome = INTERRUPTED
    stopping: threading.Thread | None = None

    def start(self, fleet: Fleet, pause: Callable[[float], None]) -> None:
        """Start the processes. In a real-time flight, also wait until the processes are ready.

        `pause` sleeps for a duration, s, between two checks. The flights of a fleet are started one
        after the other, because a host should not start many processes at once.
        """
        self.progress(0.0, "starting")
        try:
            self.processes = FlightProcesses(
                with_file(self.member.scenario, self.run, absolute_namespace(self.member.name)),
                self.run,
                self.monitor,
                lockstep=fleet.lockstep,
                one_process=fleet.composed,
                namespace=absolute_namespace(self.member.name),
                announce=self._announce,
                pause=pause,
            ).__enter__()
        except ParameterError as error:
            self.outcome = never_flew(str(error))
        else:
            if (outcome := self.processes.match()) is not None:
                self.end(outcome)
            elif fleet.lockstep:
                self.begin((0.0, 0.0))

    def begin(self, start: tuple[float, float]) -> None:
        """Begin the flight, given t = 0 of the fleet in `start`.

        `start` has t = 0 by the system clock and by the monotonic clock, s. If the flight is in
        lockstep, nothing happens here, because the flight has begun already.
        """
        if self.processes is None or self.stopping is not None:
            return
        outcome = self.processes.begin((start[0] + self.member.delay, start[1] + self.member.delay))
        if outcome is not None:
            self.end(outcome)
        else:
            self.steps = follow(self.processes, self.progress)

    def step(self) -> bool:
        """Check the flight once, and return whether it goes on."""
        if self.steps is not None:
            try:
                next(self.steps)
            except StopIteration as end:
                self.end(end.value)
        return self.steps is not None

    def end(self, outcome: Outcome) -> None:
        """End the flight with an outcome, and stop its processes in another thread.

        A recorder takes a while to close its log, and in the meantime the other flights go on.
        """
        self.outcome = outcome
        self.steps = None
        self.progress(
            self.member.scenario.flight.duration if outcome == COMPLETED else 0.0, str(outcome)
        )
        if self.processes is not None and self.stopping is None:
            self.processes.outcome = outcome
            self.stopping = threading.Thread(target=self.processes.stop)
            self.stopping.start()

    def _announce(self, line: str) -> None:
        self.progress(self.member.scenario.flight.duration, f"{self.outcome}; {line}")

    def join(self) -> None:
        """Wait until the processes of the flight have stopped."""
        if self.stopping is not None:
            self.stopping.join()


@dataclass(frozen=True)
class MemberFlight:
    """The result of one aircraft's flight in a fleet: its outcome, and the folder of its run."""

    member: Member
    run: Path
    outcome: Outcome


def new_runs(fleet: Fleet, runs: Path) -> list[Path]:
    """Create the folder of each aircraft's run, and return the folders."""
    return [new_run(member.scenario, runs, f"{member.name}-") for member in fleet.members]


def fly_fleet(
    fleet: Fleet, runs: Sequence[Path], progress: Callable[[str, float, str], None]
) -> list[MemberFlight]:
    """Fly a fleet over topics, with a run for each aircraft.

    `progress` is called with the name of an aircraft, its flight time, s, and a text.

    If the fleet flies in real time, its aircraft share t = 0, which is set when every node is
    ready. An aircraft with a delay begins later by its delay. If an aircraft ends early, or never
    begins, the others fly on. Ctrl-C ends all flights. Raises ParameterError if no aircraft can
    begin.
    """
    require_ros_environment()
    from flight_bringup.monitor import FlightMonitor  # noqa: PLC0415 - loads rclpy, which other commands do not need

    flights: list[_Flight] = []
    interrupt = DeferredInterrupt(only_in_pauses=True)
    with handle_signals(interrupt), ExitStack() as stack:
        try:
            for member, run in zip(fleet.members, runs, strict=True):
                outputs = member.scenario.controller.outputs
                namespace = absolute_namespace(member.name)
                monitor = stack.enter_context(
                    FlightMonitor(
                        outputs,
                        lockstep=fleet.lockstep,
                        use_sim_time=fleet.use_sim_time,
                        namespace=namespace,
                    )
                )
                flights.append(_Flight(member, run, monitor, partial(progress, member.name)))
            for flight in flights:
                flight.start(fleet, interrupt.pause)
            _begin(flights, fleet)
            while True:
                going = [flight.step() for flight in flights]
                if not any(going):
                    break
                interrupt.pause(POLL_PERIOD)
        except KeyboardInterrupt:
            pass
        finally:
            # A second Ctrl-C must not interrupt FlightProcesses.stop, which runs in another thread.
            with handle_signals(signal.SIG_IGN):
                for flight in flights:
                    flight.end(flight.outcome)
                for flight in flights:
                    flight.join()
    return [MemberFlight(flight.member, flight.run, flight.outcome) for flight in flights]


def _begin(flights: Sequence[_Flight], fleet: Fleet) -> None:
    """Begin all flights with a common t = 0. Lockstep flights have begun already."""
    if not fleet.lockstep:
        start = start_instants(LEAD + BEGIN_TIME * len(flights), flights[0].monitor)
        for flight in flights:
            flight.begin(start)
