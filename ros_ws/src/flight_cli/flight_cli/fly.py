# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di fly`, which flies a scenario over topics or in one process."""

import os
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import typer
from rich.console import Console

from flight_analysis.closed_loop.learning_loop import Learn
from flight_analysis.closed_loop.scenario import Scenario, limits_beyond_stops, opposite_signs
from flight_analysis.closed_loop.scenario_library import find_scenario, with_route
from flight_analysis.report.run_folder import new_run, remove_empty
from flight_analysis.report.run_report import (
    UnwrittenReportError,
    write_empty_summary,
    write_report,
)
from flight_bringup.fleet import Fleet, is_fleet, new_runs
from flight_bringup.fly import fly_in_process, fly_over_topics, with_file
from flight_bringup.graph import (
    Autopilot,
    absolute_namespace,
    find_autopilot,
    require_limits,
    second_stage,
)
from flight_bringup.host import cores_given, shortage
from flight_cli.fleet import fly_fleet_file, open_fleet
from flight_cli.output import (
    flight_progress,
    print_json,
    show_errors,
    show_flight,
    show_outcome,
)
from flight_cli.route_options import RouteWords, parse_origin
from flight_cli.settings import settings_option, with_settings
from flight_cli.words import (
    argument,
    json_option,
    map_names,
    option,
    rare_option,
    require_unused,
    scenario_names,
    warn,
)
from flight_core.environment import require_ros_environment
from flight_core.files import display_path
from flight_core.installation import require_package
from flight_core.outcome import End, Outcome, Refusal
from flight_core.parameters import ParameterError, require
from flight_guidance.routes.route_file import ENDINGS, read_fence_file
from flight_guidance.routes.route_formats import FENCES

SPARE_CORES = 4  # with only two, a browser without a GPU costs the flight samples
# Options that only a flight of one aircraft can have.
OF_AIRCRAFT = (
    "settings",
    "in_process",
    "lockstep",
    "composed",
    "bridge",
    "send",
    "route",
    "fence",
    "namespace",
    "learn",
    "quiet",
)


@dataclass(frozen=True, kw_only=True)
class Fly(RouteWords):
    """Fly a scenario or a fleet over ROS 2 topics.

    The flight is in real time, with a process for each node. If this host has too few resources for
    this, the flight is in lockstep with one process for each aircraft, and a sentence says so.

    Exit status: 0 completed or landed; 2 bad input; 3 ended early or never flew; 4 completed or
    landed, but with a fault that the outcome states with its figure (errors, time engaged, speed,
    height, fence, route, touch-down zone, log); 7 the host became too busy for real time, and
    nothing else is wrong; 130 interrupted. For a fleet it is the severest status of its aircraft.
    """

    context: typer.Context
    scenario: str = argument(
        "Name of a scenario, or path of a scenario file (.yaml) or of a fleet file.",
        default="osprey_servo",
        autocompletion=scenario_names,
    )
    duration: float | None = option("Duration, s; by default as in the scenario.")
    settings: list[str] | None = settings_option()
    in_process: bool = option("Fly in one process without ROS, as fast as it goes.", default=False)
    lockstep: bool = option(
        "Fly in lockstep over topics: as fast as possible, and repeatable to the byte.",
        default=False,
    )
    real_time: bool = option(
        "Fly in real time even if this host has too few resources for it.", default=False
    )
    composed: bool = rare_option(
        "Fly with all nodes in one process. It takes a third of the processor time, but a busy "
        "host gives one process less than four, which matters in real time.",
        default=False,
    )
    use_sim_time: bool = rare_option(
        "Fly by the /clock of a simulator, which may run at any speed, in place of real time.",
        default=False,
    )
    bridge: str | None = option(
        "Fly an autopilot by a channel map, in place of the aircraft; without --send a dry run.",
        metavar="MAP",
        autocompletion=map_names,
    )
    route: Path | None = option(
        f"Route file to fly: {', '.join(ENDINGS)}. Guidance starts with it.", metavar="FILE"
    )
    fence: Path | None = rare_option(
        f"File with a fence to keep: {', '.join(FENCES)}. Its rally points are home.",
        metavar="FILE",
    )
    learn: bool = rare_option(
        "Learn A and B in flight from the signs and sizes of the law, without any model.",
        default=False,
    )
    send: bool = option("Send commands to the autopilot once the bridge is engaged.", default=False)
    watch: bool = option("Serve the live page of the flight while it lasts.", default=False)
    namespace: str = rare_option(
        "Namespace of all nodes, as in uav1; each aircraft in this domain needs its own.",
        default="",
    )
    runs: Path = rare_option("Folder in which the folder of the run is made.", default=Path("runs"))
    verbose: bool = rare_option(
        "Print all tables and notes, as rise-di report does.", "--verbose", "-v", default=False
    )
    quiet: bool = rare_option(
        "Print only the headline of the outcome.", "--quiet", "-q", default=False
    )
    as_json: bool = json_option()

    def execute(self) -> None:
        """Fly, write the report, and print the results."""
        if is_fleet(self.scenario):
            expected = "a scenario, or the key in the file of the fleet"
            require_unused(self, OF_AIRCRAFT, expected, "a fleet beside it")
            self._fly_fleet()
        scenario = self._scenario()
        self._require_one_length()
        namespace = absolute_namespace(self.namespace)
        stepping = self.lockstep or scenario.flight.lockstep
        autopilot = self._autopilot(stepping=stepping)
        _require_flyable(scenario, autopilot, in_process=self.in_process)
        if autopilot is None:
            for sentence in limits_beyond_stops(scenario) + opposite_signs(scenario):
                warn(f"warning: {sentence}")
        composed = self.composed
        if self._is_host_decisive(scenario) and not stepping:
            stepping = _falls_back(shortage([scenario], cores_given, composed=composed))
            composed = composed or stepping
        learn = _learner(scenario)
        run = new_run(scenario, self.runs)
        self.context.call_on_close(partial(remove_empty, run))
        scenario = with_file(scenario, run, namespace)
        self._watch(run)
        by_clock = self.use_sim_time or (scenario.flight.use_sim_time and not stepping)
        is_quiet = self.as_json or self.quiet
        with flight_progress(scenario.flight.duration, quiet=is_quiet) as (progress, announce):
            if self.in_process:
                outcome = fly_in_process(scenario, run, progress, learn, announce)
            else:
                outcome = fly_over_topics(
                    scenario,
                    run,
                    progress,
                    lockstep=stepping,
                    one_process=composed,
                    use_sim_time=by_clock,
                    autopilot=autopilot,
                    namespace=namespace,
                    announce=announce,
                )
            if outcome.end is End.COMPLETED:
                # Only the report says whether the flight is a success, and it is not written yet.
                progress(scenario.flight.duration, "flown")
        status = _report(
            scenario,
            run,
            outcome,
            as_json=self.as_json,
            verbose=self.verbose,
            quiet=self.quiet,
        )
        raise typer.Exit(status)

    def _scenario(self) -> Scenario:
        """Return the scenario with the settings, the route and the fence of the options.

        Raises ParameterError if options contradict each other.
        """
        library_scenario = find_scenario(
            self.scenario, self.duration, with_route=self.route is None
        )
        scenario = with_settings(library_scenario, self.settings)
        self._require_one_way(stepping=self.lockstep or scenario.flight.lockstep)
        files = self.route or self.fence
        scenario = _that_learns(scenario) if self.learn else scenario
        needs = {"origin": files, "altitude": files, "simplify": self.route, "line": self.route}
        for name, file in needs.items():
            unset = file is not None or getattr(self, name) in (None, 0.0)
            require(unset, f"--{name}", "no --route", "the file of a route: --route FILE")
        return scenario if files is None else self._with_files(scenario)

    def _is_host_decisive(self, scenario: Scenario) -> bool:
        """Return whether the capacity of the host decides between real time and lockstep.

        The capacity does not decide if an autopilot or a simulator has its own time, or if a user
        activates the controller.
        """
        by_clock = self.use_sim_time or scenario.flight.use_sim_time
        has_own_time = by_clock or self.bridge is not None
        controller = scenario.controller
        begins = controller.autostart and controller.start_active
        return begins and not (self.real_time or self.in_process or has_own_time)

    def _require_one_length(self) -> None:
        """Check that --quiet is not given together with --verbose or --json.

        Raises ParameterError if it is.
        """
        if self.quiet:
            require_unused(self, ["verbose", "as_json"], "one of the two", "--quiet beside it")

    def _require_one_way(self, *, stepping: bool) -> None:
        """Check that the options ask for only one way to fly. Raises ParameterError if not."""
        other = self.in_process or self.use_sim_time or stepping
        contradiction = "a flight in lockstep, in one process or by /clock"
        require(not (self.real_time and other), "--real-time", contradiction, "one of the two")
        for name in ("lockstep", "composed"):
            ways = not (self.in_process and getattr(self, name))
            require(
                ways, "in_process", f"--{name} too", f"one of the two: --{name} flies over topics"
            )
        has_nodes = "a flight over topics, which has nodes"
        has_namespace = self.in_process and self.namespace
        require(not has_namespace, "--namespace", "a flight in one process", has_nodes)
        has_own_time = self.use_sim_time and (self.in_process or stepping)
        contradiction = "a flight in lockstep or in one process"
        require(
            not has_own_time, "use_sim_time", contradiction, "a flight in real time over topics"
        )

    def _autopilot(self, *, stepping: bool) -> Autopilot | None:
        """Return the autopilot that replaces the aircraft, if any.

        Raises ParameterError if the autopilot cannot fly.
        """
        if self.bridge is None:
            expected = "the channel map of an autopilot: --bridge MAP"
            require_unused(self, ["send"], expected, "no --bridge")
            return None
        autopilot = find_autopilot(self.bridge, dry_run=not self.send)
        require(not self.composed, "composed", "a flight with a bridge", "one process a node")
        require(
            not (self.in_process or stepping),
            "--bridge",
            "a flight in lockstep or in one process",
            "a flight in real time over topics: an autopilot does not wait",
        )
        return autopilot

    def _with_files(self, scenario: Scenario) -> Scenario:
        """Add the route and the fence from files to a scenario. May raise ParameterError."""
        above_sea = scenario.aircraft.is_jsbsim
        sections: dict[str, Any] = {}
        if self.fence is not None:
            origin = parse_origin(self.origin)
            sections = read_fence_file(self.fence, origin, self.altitude, above_sea=above_sea)
        can_have_route = not sections or scenario.guidance is not None
        require(can_have_route, "--fence", "a scenario without guidance", "one with guidance")
        if home := sections.get("home"):
            place = ", ".join(f"{name} {value:.7g} m" for name, value in home.items())
            ground = "" if above_sea or home.get("altitude", 1.0) > 0.0 else ": the ground"
            warn(f"note: home by the fence file: {place}{ground}")
        if self.route is None:
            return scenario.vary(guidance=sections)
        waypoints = self.read_waypoints(self.route, above_sea=above_sea, fence=self.fence)
        return with_route(scenario, waypoints, sections)

    def _fly_fleet(self) -> NoReturn:
        """Fly a fleet with the page of all aircraft, and exit with the severest status."""
        fleet = open_fleet(self.scenario, self.duration, use_sim_time=self.use_sim_time)
        has_own_time = fleet.lockstep or fleet.use_sim_time
        require(
            not (self.real_time and has_own_time),
            "--real-time",
            "a fleet in lockstep or by /clock",
            "one of the two",
        )
        if not (self.real_time or has_own_time):
            fleet = _as_host_allows(fleet)
        runs = new_runs(fleet, self.runs)
        self.context.call_on_close(partial(remove_empty, *runs))
        self._watch(*runs, fleet=True)
        raise typer.Exit(fly_fleet_file(fleet, runs, as_json=self.as_json))

    def _watch(self, *runs: Path, fleet: bool = False) -> None:
        """If --watch is given, serve the page of the runs while the command lasts."""
        if not self.watch:
            return
        from flight_cli.watch import watched  # noqa: PLC0415 - loads the server, which few flights need

        print(*self.context.with_resource(watched(*runs, fleet=fleet)), sep="\n", file=sys.stderr)
        _warn_of_browser()


def _falls_back(lack: Refusal | None, *, can_step: bool = True) -> bool:
    """Return whether to fly in lockstep because the host cannot fly in real time; tell the user.

    `lack` is what the host lacks for real time, or None. If `can_step` is False, the flight stays
    in real time, and the user gets a warning.
    """
    if lack is None:
        return False
    if can_step:
        warn(f"this host {lack}: flying in lockstep; --real-time flies in real time all the same")
    else:
        warn(f"warning: this host {lack}, and aircraft with a delay do not fly in lockstep")
    return can_step


def _as_host_allows(fleet: Fleet) -> Fleet:
    """Return the fleet as this host can fly it.

    If the host lacks something for real time, the fleet flies in lockstep and composed, which means
    that the nodes of an aircraft share a process.
    """
    scenarios = [member.scenario for member in fleet.members]
    lack = shortage(scenarios, cores_given, composed=fleet.composed)
    has_delay = any(member.delay > 0.0 for member in fleet.members)
    if _falls_back(lack, can_step=not has_delay):
        return replace(fleet, lockstep=True, composed=True)
    return fleet


def _warn_of_browser() -> None:
    """Warn that a browser takes cores from the flight, if the host has no cores to spare."""
    cores = len(os.sched_getaffinity(0))
    if cores < SPARE_CORES:
        warn(
            f"this host has {cores} cores: a browser on it takes a third of one or more from the "
            "flight. From another machine it takes none: docs/live-view.md"
        )


def _report(
    scenario: Scenario,
    run: Path,
    outcome: Outcome,
    *,
    as_json: bool,
    verbose: bool,
    quiet: bool,
) -> int:
    """Write and print the report of a flight, and return the exit status."""
    unwritten = ""
    try:
        result = write_report(run, outcome)
    except UnwrittenReportError as error:
        # The flight is over, so its outcome is printed first.
        result = error.result
        unwritten = str(error)
    except ParameterError:
        if outcome.status == 0:
            raise
        warn(f"error: {outcome}, before the first sample; see {display_path(run)}")
        try:
            write_empty_summary(run, scenario, outcome)
        except ParameterError as error:
            warn(f"error: no summary: {error}")
        return outcome.status
    outcome_record = result.flight.summary["outcome"]
    if as_json:
        print_json(result.flight.summary)
    elif quiet:
        print(outcome_record["sentence"])
    else:
        console = Console()
        if verbose:
            show_flight(console, result.flight)
        show_outcome(console, outcome_record)
        if not verbose:
            show_errors(console, result.flight)
        print(f"log:     {display_path(result.mcap)}")
        if not unwritten:
            print(f"report:  {display_path(result.report)}")
    if unwritten:
        warn(f"error: no report: {unwritten}")
    return int(outcome_record["status"])


def _require_flyable(scenario: Scenario, autopilot: Autopilot | None, *, in_process: bool) -> None:
    """Check that a flight can begin, before anything is written. Raises ParameterError if not."""
    if not in_process:
        require_package("rclpy", "; without ROS fly with --in-process")
        require_ros_environment()
    second_stage(scenario, bridge=autopilot is not None)
    if autopilot is not None:
        from flight_design.identification.sign_check import require_signs  # noqa: PLC0415 - loads SciPy, which few flights need

        require_signs(autopilot.channel_map, scenario)
        require_limits(autopilot, scenario)


def _that_learns(scenario: Scenario) -> Scenario:
    """Return the scenario with a learner, which learns a model in flight.

    Raises ParameterError if it already has a model.
    """
    from flight_design.learning.scenario_learner import that_learns  # noqa: PLC0415 - loads SciPy, which few flights need

    return that_learns(scenario)


def _learner(scenario: Scenario) -> Learn | None:
    """Return the learner of a scenario for a flight in one process, or None.

    Raises ParameterError if the scenario cannot learn.
    """
    if not scenario.has_learner():
        return None
    from flight_design.learning.scenario_learner import learner  # noqa: PLC0415 - loads SciPy, which few flights need

    return learner(scenario)
