# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Play a recorded flight on a full ROS 2, with nodes against it: ros2 launch flight_bringup replay.launch.py run:=runs/latest.

As `rise-di play` does: the topics of the log with their timing, and /clock with its time. Of the topics those are played that
none of the nodes says itself, so that a controller answers the recorded y and y_m with a u of its own. Playing begins once all
nodes are ready, and ends with the log; early, with exit status 1, when any of the nodes does.
"""

from collections.abc import Sequence
from pathlib import Path

from launch.action import Action
from launch.actions import DeclareLaunchArgument, ExecuteProcess, LogInfo, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch_ros.substitutions import ExecutableInPackage

from autopilot_bridge.params import maps
from flight_analysis.report.run_folder import new_run, recorded_scenario
from flight_bringup.graph import (
    AIRCRAFT,
    BRIDGE,
    CONTROLLER,
    RECORDER,
    REFERENCE_MODEL,
    NodeSpec,
    find_autopilot,
    parameters,
    to_play,
)
from flight_bringup.launch.stages import (
    BOOLEAN,
    end_with_launch,
    flown,
    in_order,
    namespace_argument,
    node,
    require_flown,
    runs_argument,
    scenario_argument,
    text,
)
from flight_bringup.scenarios import find_scenario
from flight_core.parameters import require
from flight_log.playback import read_playback
from launch import LaunchContext, LaunchDescription

CHOSEN = (RECORDER, CONTROLLER, REFERENCE_MODEL, AIRCRAFT)
"""Nodes that run against the log where the argument of their name says so."""


def generate_launch_description() -> LaunchDescription:
    """The arguments, and what is played to whom."""
    chosen = [
        DeclareLaunchArgument(
            spec.executable,
            default_value=str(spec is CONTROLLER).lower(),
            choices=BOOLEAN,
            description=f"run the {spec.executable} with it",
        )
        for spec in CHOSEN
    ]
    return LaunchDescription(
        [
            DeclareLaunchArgument("run", description="folder of a run, or an MCAP file"),
            *chosen,
            DeclareLaunchArgument(
                "map",
                default_value="",
                description="run the bridge against the log, as a dry run: name of a channel map"
                f" ({', '.join(maps())}), or path of a file (.yaml); empty runs none",
            ),
            DeclareLaunchArgument(
                "topics",
                default_value="",
                description="which topics of the log, as in y,y_m; empty plays all that none of the nodes says itself",
            ),
            DeclareLaunchArgument("rate", default_value="1.0", description="how many times as fast"),
            DeclareLaunchArgument("start", default_value="0.0", description="flight time of the log to begin at, s"),
            DeclareLaunchArgument(
                "loop", default_value="false", choices=BOOLEAN, description="begin again at the end, until Ctrl-C"
            ),
            DeclareLaunchArgument(
                "lockstep",
                default_value="false",
                choices=BOOLEAN,
                description="of a log of lockstep: keep its stamps, and have the controller answer each y with the same bytes",
            ),
            scenario_argument("", "; empty takes the one inside the log"),
            runs_argument(),
            namespace_argument(
                "namespace of all nodes: that of the flight in the log, whose topics are played by their full names"
            ),
            OpaqueFunction(function=_play),
        ]
    )


def _play(context: LaunchContext) -> list[Action]:
    log, namespace = Path(text(context, "run")), text(context, "namespace")
    lockstep = text(context, "lockstep") == "true"
    autopilot = find_autopilot(text(context, "map"), dry_run=True) if text(context, "map") else None
    nodes = [spec for spec in CHOSEN if text(context, spec.executable) == "true"] + [BRIDGE] * (autopilot is not None)
    alone = {RECORDER, CONTROLLER}
    others = [spec.executable for spec in nodes if spec not in alone]
    require(not (lockstep and others), "lockstep", f"true with {', '.join(others)}", "controller and recorder alone")
    named = text(context, "scenario")
    known = read_playback(log).types
    asked = text(context, "topics") or ",".join(to_play(known, nodes, namespace, autopilot))
    end_with_launch(context)

    def end(event: ProcessExited, context: LaunchContext) -> Sequence[Action] | None:
        if event.returncode != 0:
            require_flown(event, context)
        return flown(run, "played to its end") if RECORDER in nodes else [Shutdown(reason="played to its end")]

    rise_di = ExecutableInPackage(package="flight_bringup", executable="rise-di")
    loop = ["--loop"] if text(context, "loop") == "true" else []
    stamps = ["--stamps", "recorded" if lockstep else "now"]
    options = ["--topics", asked, "--rate", text(context, "rate"), "--start", text(context, "start"), *stamps, *loop]
    player = ExecuteProcess(cmd=[rise_di, "play", str(log), *options], name="play", output="screen", on_exit=end)
    if not nodes:
        return [player]
    scenario = find_scenario(named) if named else recorded_scenario(log, namespace or None)
    run = new_run(scenario, Path(text(context, "runs"))) if RECORDER in nodes else Path()

    def told(spec: NodeSpec) -> dict[str, object]:
        return parameters(spec, scenario, run, 0.0, lockstep=lockstep, autopilot=autopilot)

    playing = [LogInfo(msg=f"playing {asked}"), player]
    return in_order({spec: node(spec, scenario, told(spec)) for spec in nodes}, lambda startup: playing)
