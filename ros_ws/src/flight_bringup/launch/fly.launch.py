# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a scenario on a full ROS 2: ros2 launch flight_bringup fly.launch.py scenario:=osprey_gust.

The same graph and the same scenario file as `rise-di fly`. The flight begins once the recorder is ready, ends after the
scenario's duration, and ends early when any of its nodes does.
"""

import time
from pathlib import Path

from launch.action import Action
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, RegisterEventHandler, Shutdown, TimerAction
from launch.event_handlers import OnProcessIO
from launch.events.process import ProcessIO
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from flight_bringup.fly import new_run
from flight_bringup.graph import NODES, READY, RECORDER, START_LEAD, parameters
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
        scenario = scenario.vary(flight={"duration": float(duration)})
    run = new_run(scenario, Path(LaunchConfiguration("runs").perform(context)))
    start_time = round(time.time() + START_LEAD, 3)
    nodes = {
        node: Node(
            package=node.package,
            executable=node.executable,
            namespace=LaunchConfiguration("namespace"),
            parameters=[str(scenario.path), parameters(node, scenario.path, run, start_time)],
            output="screen",
            on_exit=Shutdown(reason=f"{node.executable} ended"),
        )
        for node in NODES
    }
    rest = [action for node, action in nodes.items() if node is not RECORDER]
    end = TimerAction(
        period=START_LEAD + scenario.flight.duration,
        actions=[LogInfo(msg=f"flown; now: rise-di report {run}"), Shutdown(reason="flown to its end")],
    )
    started = False

    def when_ready(event: ProcessIO) -> list[Action] | None:
        nonlocal started
        if started or READY not in event.text.decode(errors="replace"):
            return None
        started = True
        return [*rest, end]

    ready = OnProcessIO(target_action=nodes[RECORDER], on_stdout=when_ready, on_stderr=when_ready)
    return [RegisterEventHandler(ready), nodes[RECORDER]]
