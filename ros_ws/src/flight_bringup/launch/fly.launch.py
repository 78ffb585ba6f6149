# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a scenario on a full ROS 2: ros2 launch flight_bringup fly.launch.py scenario:=osprey_gust.

The same graph and the same scenario file as `rise-di fly`. The flight begins once the recorder is ready and ends after the
scenario's duration. It ends early, with exit status 1, when any of its nodes does.
"""

import shlex
import time
from pathlib import Path

import yaml
from launch.action import Action
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, RegisterEventHandler, Shutdown, TimerAction
from launch.event_handlers import OnProcessIO
from launch.events.process import ProcessExited, ProcessIO
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from flight_bringup.fly import new_run
from flight_bringup.graph import NODES, READY, RECORDER, NodeSpec, parameters, recorder_parameters, start_lead
from flight_bringup.processes import end_with_parent
from flight_bringup.scenarios import find_scenario, scenarios
from launch import LaunchContext, LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """The arguments, and the flight that they describe."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "scenario",
                default_value="osprey_gust",
                description=f"name of a scenario ({', '.join(scenarios())}), or path of a scenario file (.yaml)",
            ),
            DeclareLaunchArgument("duration", default_value="", description="seconds to fly; empty flies the scenario's"),
            DeclareLaunchArgument("runs", default_value="runs", description="folder that the run's folder is made in"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of all nodes, one an aircraft"),
            OpaqueFunction(function=_fly),
        ]
    )


def _fly(context: LaunchContext) -> list[Action]:
    scenario = find_scenario(LaunchConfiguration("scenario").perform(context))
    if duration := LaunchConfiguration("duration").perform(context):
        scenario = scenario.vary(flight={"duration": yaml.safe_load(duration)})
    run = new_run(scenario, Path(LaunchConfiguration("runs").perform(context)))
    begin = time.monotonic()
    # launch leaves its processes running when it is itself ended by anything but SIGINT.
    context.launch_configurations.setdefault("launch-prefix", shlex.join(end_with_parent()))

    def process(node: NodeSpec, told: dict[str, str | float]) -> Node:
        return Node(
            package=node.package,
            executable=node.executable,
            exec_name=node.executable,  # else the log names each process by its prefix
            namespace=LaunchConfiguration("namespace"),
            parameters=[str(scenario.path), told],
            output="screen",
            on_exit=_require_flown,
        )

    recorder = process(RECORDER, recorder_parameters(scenario.path, run))
    flown = [
        LogInfo(msg=f"flown; now: ros2 run flight_bringup rise-di report {shlex.quote(str(run))}"),
        Shutdown(reason="flown to its end"),
    ]
    started = False

    def when_ready(event: ProcessIO) -> list[Action] | None:
        nonlocal started
        if started or READY not in event.text.decode(errors="replace"):
            return None
        started = True
        lead = start_lead(time.monotonic() - begin)
        start_time = round(time.time() + lead, 3)
        rest = [process(node, parameters(node, start_time)) for node in NODES if node is not RECORDER]
        return [*rest, TimerAction(period=lead + scenario.flight.duration, actions=flown)]

    ready = OnProcessIO(target_action=recorder, on_stdout=when_ready, on_stderr=when_ready)
    return [RegisterEventHandler(ready), recorder]


def _require_flown(event: ProcessExited, context: LaunchContext) -> None:
    if not context.is_shutdown:
        raise RuntimeError(f"{event.process_name} ended before the flight did")  # launch then ends the others, with status 1
