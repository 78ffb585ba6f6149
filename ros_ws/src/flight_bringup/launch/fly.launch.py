# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a scenario on a full ROS 2: ros2 launch flight_bringup fly.launch.py scenario:=osprey_gust.

The same graph and the same scenario file as `rise-di fly`. The flight begins once recorder and controller are ready and ends
after the scenario's duration, in lockstep as soon as that is flown. It ends early, with exit status 1, when any of its nodes
does.
"""

import math
import shlex
import time
from collections.abc import Callable
from pathlib import Path

import yaml
from launch.action import Action
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, RegisterEventHandler, Shutdown, TimerAction
from launch.event_handlers import OnProcessIO
from launch.events.process import ProcessExited, ProcessIO
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from flight_bringup.fly import new_run
from flight_bringup.graph import AIRCRAFT, FIRST, FLOWN, READY, THEN, NodeSpec, parameters, start_lead
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
            DeclareLaunchArgument(
                "lockstep",
                default_value="",
                choices=["", "true", "false"],
                description="true: as fast as the machine allows, repeatable to the byte; empty: as the scenario says",
            ),
            DeclareLaunchArgument("runs", default_value="runs", description="folder that the run's folder is made in"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of all nodes, one an aircraft"),
            OpaqueFunction(function=_fly),
        ]
    )


def _fly(context: LaunchContext) -> list[Action]:
    scenario = find_scenario(LaunchConfiguration("scenario").perform(context))
    if duration := LaunchConfiguration("duration").perform(context):
        scenario = scenario.vary(flight={"duration": yaml.safe_load(duration)})
    asked = LaunchConfiguration("lockstep").perform(context)
    lockstep = asked == "true" if asked else scenario.flight.lockstep
    run = new_run(scenario, Path(LaunchConfiguration("runs").perform(context)))
    begin = time.monotonic()
    # launch leaves its processes running when it is itself ended by anything but SIGINT.
    context.launch_configurations.setdefault("launch-prefix", shlex.join(end_with_parent()))

    def process(node: NodeSpec, start_time: float = math.inf) -> Node:
        return Node(
            package=node.package,
            executable=node.executable,
            exec_name=node.executable,  # else the log names each process by its prefix
            namespace=LaunchConfiguration("namespace"),
            parameters=[str(scenario.path), parameters(node, scenario, run, start_time, lockstep=lockstep)],
            output="screen",
            on_exit=_require_flown,
        )

    flown = [
        LogInfo(msg=f"flown; now: ros2 run flight_bringup rise-di report {shlex.quote(str(run))}"),
        Shutdown(reason="flown to its end"),
    ]
    first = {node: process(node) for node in FIRST}
    waiting = set(FIRST)

    def when_flown(event: ProcessIO) -> list[Action] | None:
        return flown if FLOWN in event.text.decode(errors="replace") else None

    def when_ready(node: NodeSpec) -> Callable[[ProcessIO], list[Action] | None]:
        def handle(event: ProcessIO) -> list[Action] | None:
            if node not in waiting or READY not in event.text.decode(errors="replace"):
                return None
            waiting.remove(node)
            if waiting:
                return None
            lead = start_lead(time.monotonic() - begin)
            start_time = round(time.time() + lead, 3)
            others = {other: process(other, start_time) for other in THEN}
            if lockstep:
                end: Action = RegisterEventHandler(
                    OnProcessIO(target_action=others[AIRCRAFT], on_stdout=when_flown, on_stderr=when_flown)
                )
            else:
                end = TimerAction(period=lead + scenario.flight.duration, actions=flown)
            return [end, *others.values()]

        return handle

    handlers = [
        RegisterEventHandler(OnProcessIO(target_action=action, on_stdout=when_ready(node), on_stderr=when_ready(node)))
        for node, action in first.items()
    ]
    return [*handlers, *first.values()]


def _require_flown(event: ProcessExited, context: LaunchContext) -> None:
    if not context.is_shutdown:
        raise RuntimeError(f"{event.process_name} ended before the flight did")  # launch then ends the others, with status 1
