# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Play a recorded flight on a full ROS 2, while some nodes compute again.

ros2 launch flight_bringup replay.launch.py run:=runs/latest

Like `rise-di play`, the launch publishes the topics of the log with their timing, and /clock with
the time of the log. Topics that one of the nodes publishes are not played, so that a controller
answers the recorded y and y_m with a new u. The playback begins when all nodes are ready, and ends
with the log. If a node ends earlier, the exit status is 1.
"""

from collections.abc import Sequence
from pathlib import Path

from launch.action import Action
from launch.actions import DeclareLaunchArgument, ExecuteProcess, LogInfo, OpaqueFunction
from launch.events.process import ProcessExited
from launch_ros.substitutions import ExecutableInPackage

from autopilot_bridge.params import maps
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.run_folder import new_run
from flight_analysis.report.run_report import extract_scenario
from flight_bringup.graph import (
    AIRCRAFT,
    BRIDGE,
    CONTROLLER,
    RECORDER,
    REFERENCE_MODEL,
    find_autopilot,
    parameter_overrides,
    replayed_topics,
)
from flight_bringup.launch.flight import Flight, argument
from flight_bringup.launch.stages import (
    boolean_argument,
    fail_on_exit,
    flight_node,
    log_level_argument,
    namespace_argument,
    runs_argument,
    scenario_argument,
    start_in_stages,
)
from flight_bringup.player import unsendable
from flight_core.parameters import require
from flight_core.topics import published_by
from flight_log.playback import read_playback
from launch import LaunchContext, LaunchDescription

# Nodes that run if the argument with their name is true.
OPTIONAL = (RECORDER, CONTROLLER, REFERENCE_MODEL, AIRCRAFT)


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, and start the player and the nodes."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("run", description="folder of a run, or an MCAP file"),
            *(
                boolean_argument(spec.executable, spec is CONTROLLER, f"run the {spec.executable}")
                for spec in OPTIONAL
            ),
            DeclareLaunchArgument(
                "map",
                default_value="",
                description="run the bridge against the log, as a dry run: name of a channel map"
                f" ({', '.join(maps())}), or path of a file (.yaml); empty runs none",
            ),
            DeclareLaunchArgument(
                "topics",
                default_value="",
                description="which topics of the log, as in y,y_m; empty plays all that none of "
                "the nodes publishes",
            ),
            DeclareLaunchArgument(
                "rate", default_value="1.0", description="speed, as a multiple of real time"
            ),
            DeclareLaunchArgument(
                "start", default_value="0.0", description="flight time of the log to begin at, s"
            ),
            boolean_argument("loop", False, "start again at the end, until Ctrl-C"),
            boolean_argument(
                "lockstep",
                False,
                "for a lockstep log: keep its stamps; the controller answers each y with the "
                "same bytes",
            ),
            scenario_argument("", "; empty: the one in the log"),
            runs_argument(),
            namespace_argument(
                "namespace of all nodes; it must be that of the flight in the log, whose topics "
                "keep their full names"
            ),
            log_level_argument(),
            OpaqueFunction(function=_play),
        ]
    )


def _play(context: LaunchContext) -> list[Action]:
    log = Path(argument(context, "run"))
    namespace = argument(context, "namespace")
    lockstep = argument(context, "lockstep") == "true"
    autopilot = (
        find_autopilot(argument(context, "map"), dry_run=True) if argument(context, "map") else None
    )
    nodes = [spec for spec in OPTIONAL if argument(context, spec.executable) == "true"]
    nodes += [] if autopilot is None else [BRIDGE]
    others = [spec.executable for spec in nodes if spec not in (RECORDER, CONTROLLER)]
    require(
        not (lockstep and others),
        "lockstep",
        f"true with {', '.join(others)}",
        "controller and recorder alone",
    )
    # Play the topics of the log that none of the nodes publishes.
    types = read_playback(log).types
    recorded = types.keys() - unsendable(types)
    topics = argument(context, "topics") or ",".join(
        replayed_topics(recorded, nodes, namespace, autopilot)
    )
    flight = Flight(context)
    scenario = None
    if nodes:
        name = argument(context, "scenario")
        scenario = find_scenario(name) if name else extract_scenario(log, namespace or None)
        if RECORDER in nodes:
            flight.run = new_run(scenario, Path(argument(context, "runs")))
    player = _player(flight, topics)
    if scenario is None:
        return flight.in_scope([player])
    # If there are nodes, the player is the second stage, which begins once all nodes are ready.
    first_stage = {}
    for spec in nodes:
        overrides = parameter_overrides(
            spec, scenario, flight.run, 0.0, lockstep=lockstep, autopilot=autopilot
        )
        first_stage[spec] = flight_node(spec, scenario, overrides, flight)
    second_stage = [LogInfo(msg=f"playing {topics}"), player]
    played = {topic.rpartition("/")[2] for topic in topics.split(",")}
    for spec in nodes:
        played.update(published_by(spec.executable))
    return start_in_stages(
        flight, first_stage, lambda lead, start_time: second_stage, publishes=played
    )


def _player(flight: Flight, topics: str) -> ExecuteProcess:
    """Return the process `rise-di play` with the launch's arguments. The launch ends with it."""

    def end(event: ProcessExited, context: LaunchContext) -> Sequence[Action] | None:
        if event.returncode != 0:
            return fail_on_exit(event, context, flight)
        return flight.complete("playback completed")

    lockstep = flight.argument("lockstep") == "true"
    options = ["--topics", topics, "--stamps", "recorded" if lockstep else "now"]
    for name in ("rate", "start"):
        options += [f"--{name}", flight.argument(name)]
    if flight.argument("loop") == "true":
        options.append("--loop")
    rise_di = ExecutableInPackage(package="flight_cli", executable="rise-di")
    command = [rise_di, "play", flight.argument("run"), *options]
    return ExecuteProcess(cmd=command, name="play", output="screen", on_exit=end)
