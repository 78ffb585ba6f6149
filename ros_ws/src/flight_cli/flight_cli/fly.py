# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di fly`: fly a scenario over topics or in one process, then show its figures."""

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from flight_analysis.closed_loop.learning_loop import Learn
from flight_analysis.closed_loop.scenario import Scenario, limits_beyond_stops
from flight_analysis.closed_loop.scenario_library import find_scenario, with_route, written
from flight_analysis.report.run_folder import (
    new_run,
    remove_empty,
    write_empty_summary,
    write_report,
)
from flight_bringup.fleet import is_fleet
from flight_bringup.fly import fly_in_process, fly_over_topics
from flight_bringup.graph import (
    Autopilot,
    absolute_namespace,
    find_autopilot,
    require_limits,
    second_stage,
)
from flight_cli.fleet import fly_fleet_file
from flight_cli.output import flight_progress, print_json, show_flight
from flight_cli.route_options import (
    Altitude,
    Line,
    OriginOfRoute,
    Simplify,
    parse_origin,
    read_waypoints,
)
from flight_cli.settings import Settings, with_settings
from flight_cli.words import AsJson, argument, option, setting, warn
from flight_core.environment import require_ros_environment
from flight_core.files import display_path
from flight_core.installation import require_package
from flight_core.outcome import exit_status
from flight_core.parameters import ParameterError, require
from flight_guidance.route_file import ENDINGS, read_fence_file
from flight_guidance.route_formats import FENCES


def fly(
    context: typer.Context,
    scenario: Annotated[
        str,
        argument(
            "Name of a scenario, or path of a scenario file (.yaml) or of the file of a fleet."
        ),
    ] = "osprey_servo",
    duration: Annotated[
        float | None, option("Duration in s; by default that of the scenario.")
    ] = None,
    settings: Settings = None,
    in_process: Annotated[
        bool, option("Fly in one process without ROS, as fast as it goes.", "--in-process")
    ] = False,
    lockstep: Annotated[
        bool,
        option(
            "Fly in lockstep over topics, as fast as possible, repeatable to the byte.",
            "--lockstep",
        ),
    ] = False,
    composed: Annotated[
        bool,
        setting("composed", "Fly with all nodes in one process: a third of the processor time."),
    ] = False,
    use_sim_time: Annotated[
        bool,
        typer.Option(
            "--set use_sim_time",
            help="Fly by the /clock of a simulator, at any speed of it, in place of real time.",
        ),
    ] = False,
    bridge: Annotated[
        str | None,
        option(
            "Fly an autopilot in place of the aircraft, by a channel map; a dry run "
            "without --send.",
            metavar="MAP",
        ),
    ] = None,
    route: Annotated[
        Path | None,
        option(f"Fly a route: {', '.join(ENDINGS)}. Guidance starts with it.", metavar="FILE"),
    ] = None,
    origin: OriginOfRoute = None,
    fence: Annotated[
        Path | None,
        setting(
            "route.fence",
            f"Keep the fence of a file: {', '.join(FENCES)}. Rally points are home.",
            metavar="FILE",
        ),
    ] = None,
    altitude: Altitude = None,
    simplify: Simplify = 0.0,
    line: Line = None,
    send: Annotated[
        bool, option("Send commands to the autopilot once the bridge is engaged.", "--send")
    ] = False,
    watch: Annotated[
        bool, option("Serve the live page of the flight while it lasts.", "--watch")
    ] = False,
    namespace: Annotated[
        str,
        option("Namespace of all nodes, as uav1: one for each aircraft that flies in this domain."),
    ] = "",
    runs: Annotated[Path, setting("runs", "Folder that the run's folder is made in.")] = Path(
        "runs"
    ),
    as_json: AsJson = False,
) -> None:
    """Fly a scenario or a fleet: the nodes of each aircraft as processes over ROS 2 topics, in real
    time.

    Exit status: 0 completed or landed, 2 bad input, 3 ended early or never flew, 4 completed with
    an incomplete log or a leg missed or not flown, 130 interrupted; of a fleet the severest of its
    aircraft.
    """
    if is_fleet(scenario):
        rest: dict[str, object] = {
            "settings": settings,
            "in_process": in_process,
            "lockstep": lockstep,
            "composed": composed,
            "bridge": bridge,
        }
        rest |= {"send": send, "route": route, "fence": fence, "namespace": namespace}
        for key, chosen_value in rest.items():
            require(
                not chosen_value,
                key,
                "it beside a fleet",
                "a scenario, or the key in the file of the fleet",
            )
        fly_fleet_file(
            context,
            scenario,
            duration,
            runs,
            watch=watch,
            use_sim_time=use_sim_time,
            as_json=as_json,
        )
    chosen = with_settings(find_scenario(scenario, duration, with_route=route is None), settings)
    require(
        not (in_process and (lockstep or composed)),
        "in_process",
        "a flight over topics, in lockstep",
        "one of the two",
    )
    require(
        not (in_process and namespace),
        "--namespace",
        "a flight in one process",
        "a flight over topics, which has nodes",
    )
    namespace = absolute_namespace(namespace)
    stepping = lockstep or chosen.flight.lockstep
    require(
        not (use_sim_time and (in_process or stepping)),
        "use_sim_time",
        "a flight in lockstep or in one process",
        "a flight in real time over topics",
    )
    autopilot = None if bridge is None else find_autopilot(bridge, dry_run=not send)
    require(
        not (send and bridge is None),
        "--send",
        "no --bridge",
        "the channel map of an autopilot: --bridge MAP",
    )
    real_time = "a flight in real time over topics: an autopilot does not wait"
    require(
        autopilot is None or not composed,
        "composed",
        "a flight with a bridge",
        "one process a node",
    )
    require(
        autopilot is None or not (in_process or stepping),
        "--bridge",
        "a flight in lockstep or in one process",
        real_time,
    )
    files = route or fence
    for_route = (("route.simplify", simplify or None, route), ("route.line", line, route))
    for key, value, file in (
        ("route.origin", origin, files),
        ("route.altitude", altitude, files),
        *for_route,
    ):
        require(
            value is None or file is not None,
            key,
            "no --route",
            "the file of a route: --route FILE",
        )
    if files is not None:
        chosen = _with_files(chosen, route, fence, origin, altitude, simplify, line)
    _require_flyable(chosen, autopilot, in_process=in_process)
    for sentence in limits_beyond_stops(chosen) if autopilot is None else ():
        warn(f"warning: {sentence}")
    learn = _learner(chosen)
    run = new_run(chosen, runs)
    context.call_on_close(partial(remove_empty, run))
    if files is not None or settings:
        chosen = written(chosen, run / f"{chosen.name}.yaml")
    if watch:
        from flight_cli.watch import watched  # noqa: PLC0415 - loads the server, which few flights need

        print(*context.with_resource(watched(run)), sep="\n", file=sys.stderr)
    with flight_progress(chosen.flight.duration, quiet=as_json) as (progress, announce):
        if in_process:
            outcome = fly_in_process(chosen, run, progress, learn, announce)
        else:
            outcome = fly_over_topics(
                chosen,
                run,
                progress,
                lockstep=stepping,
                one_process=composed,
                use_sim_time=use_sim_time,
                autopilot=autopilot,
                namespace=namespace,
                announce=announce,
            )
        if outcome == "completed":
            progress(chosen.flight.duration, outcome)
    raise typer.Exit(_report(chosen, run, outcome, as_json=as_json))


def _report(scenario: Scenario, run: Path, outcome: str, *, as_json: bool) -> int:
    """Write and print the report of a flight. Returns the exit status."""
    status = exit_status(outcome)
    try:
        result = write_report(run, outcome)
    except ParameterError:
        if status == 0:
            raise
        write_empty_summary(run, scenario, outcome)
        warn(f"error: {outcome}, before the first sample; see {display_path(run)}")
        return status
    outcome = result.flight.summary["outcome"]
    if as_json:
        print_json(result.flight.summary)
    else:
        show_flight(Console(), result.flight)
        print(
            f"outcome: {outcome}\nlog:     {display_path(result.mcap)}\nreport:  "
            f"{display_path(result.report)}"
        )
    return exit_status(outcome)


def _with_files(
    scenario: Scenario,
    route: Path | None,
    fence: Path | None,
    origin: str | None,
    altitude: float | None,
    simplify: float,
    line: str | None,
) -> Scenario:
    """The scenario with the route and the fence of files. Raises ParameterError."""
    above_sea = scenario.aircraft.is_jsbsim
    sections = (
        {}
        if fence is None
        else read_fence_file(fence, parse_origin(origin), altitude, above_sea=above_sea)
    )
    require(
        not sections or scenario.guidance is not None,
        "route.fence",
        "a scenario without guidance",
        "one with guidance",
    )
    if home := sections.get("home"):
        ground = "" if above_sea or home.get("altitude", 1.0) > 0.0 else ": the ground"
        print(f"note: home by the fence file: {home}{ground}", file=sys.stderr)
    if route is not None:
        return with_route(
            scenario,
            read_waypoints(route, origin, altitude, simplify, line, above_sea=above_sea),
            sections,
        )
    return scenario.vary(guidance=sections)


def _require_flyable(scenario: Scenario, autopilot: Autopilot | None, *, in_process: bool) -> None:
    """Raise ParameterError where the flight would fail, before anything is written."""
    if not in_process:
        require_package("rclpy", "; without ROS fly with --in-process")
        require_ros_environment()
    second_stage(scenario, bridge=autopilot is not None)
    if autopilot is not None:
        from flight_design.identification.sign_check import require_signs  # noqa: PLC0415 - loads SciPy, which few flights need

        require_signs(autopilot.channel_map, scenario)
        require_limits(autopilot, scenario)


def _learner(scenario: Scenario) -> Learn | None:
    """The learner of a scenario, for a flight in one process. Raises ParameterError for one that
    cannot learn.
    """
    if not scenario.learns():
        return None
    from flight_design.learning.scenario_learner import learner  # noqa: PLC0415 - loads SciPy, which few flights need

    return learner(scenario)
