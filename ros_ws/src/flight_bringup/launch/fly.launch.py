# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a scenario on a full ROS 2: ros2 launch flight_bringup fly.launch.py scenario:=osprey_servo.

The same graph and the same scenario file as `rise-di fly`. The flight begins once each node is
ready and matched. It ends once the log holds the scenario's duration, in lockstep when the aircraft
completes it. It ends early with exit status 1 when a node ends, is not ready, or when no u reaches
the aircraft.
"""

from collections.abc import Sequence
from pathlib import Path

import yaml
from launch.action import Action
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node

from flight_analysis.closed_loop.scenario_library import as_flown, find_scenario
from flight_analysis.report.run_folder import new_run
from flight_bringup.graph import (
    AIRCRAFT,
    CONTROLLER,
    FIRST_STAGE,
    ON_START,
    RECORDER,
    NodeSpec,
    parameter_overrides,
    second_stage,
)
from flight_bringup.launch.stages import (
    BOOLEAN,
    argument,
    begin_when_matched,
    by_rise_di,
    complete,
    end_with_launch,
    end_with_log,
    flight_node,
    namespace_argument,
    on_state,
    recorder_argument,
    rosbag2,
    runs_argument,
    scenario_argument,
    sim_time_argument,
    start_in_stages,
    watch_argument,
    watch_page,
)
from flight_core.parameters import require
from flight_ros.topics import NodeState
from launch import LaunchContext, LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """The arguments and the flight."""
    return LaunchDescription(
        [
            scenario_argument("osprey_servo"),
            DeclareLaunchArgument(
                "duration",
                default_value="",
                description="seconds to fly; empty flies the scenario's",
            ),
            DeclareLaunchArgument(
                "lockstep",
                default_value="",
                choices=["", *BOOLEAN],
                description="true: as fast as the machine allows, repeatable to the byte; "
                "empty: the value in the scenario",
            ),
            recorder_argument(),
            runs_argument(),
            watch_argument(),
            namespace_argument(),
            sim_time_argument(),
            OpaqueFunction(function=_fly),
        ]
    )


def _fly(context: LaunchContext) -> list[Action]:
    scenario = find_scenario(
        argument(context, "scenario"), yaml.safe_load(argument(context, "duration"))
    )
    value = argument(context, "lockstep")
    lockstep = value == "true" or (value == "" and scenario.flight.lockstep)
    by_rosbag2 = argument(context, "recorder") == "rosbag2"
    require(
        not (by_rosbag2 and lockstep),
        "recorder",
        "rosbag2 in lockstep",
        "true: the aircraft waits for the stack's recorder",
    )
    if argument(context, "use_sim_time") == "true":
        require(
            not (lockstep or by_rosbag2),
            "use_sim_time",
            f"true {'in lockstep' if lockstep else 'with rosbag2'}",
            "a flight in real time, recorded by the stack",
        )
        return by_rise_di(context, argument(context, "scenario"))
    run = new_run(scenario, Path(argument(context, "runs")))
    scenario = as_flown(scenario, run)
    end_with_launch(context)
    first = (CONTROLLER,) if by_rosbag2 else FIRST_STAGE

    def node(spec: NodeSpec, start_time: float = ON_START) -> Node:
        overrides = parameter_overrides(spec, scenario, run, start_time, lockstep=lockstep)
        return flight_node(spec, scenario, overrides, run)

    def follow(lead: float, start_time: float) -> Sequence[Action]:
        nodes = second_stage(scenario)
        duration = scenario.flight.duration
        begins = not lockstep and scenario.controller.autostart and scenario.controller.start_active
        if lockstep:
            end: list[Action] = [
                on_state(context, AIRCRAFT, NodeState.COMPLETED, lambda: complete(run))
            ]
        elif begins:
            end = begin_when_matched(
                context, run, (*first, *nodes), duration, by_rosbag2=by_rosbag2
            )
        else:
            # A user activates the controller, or no user does.
            end = end_with_log(
                context, run, lead, start_time + duration, duration, by_rosbag2=by_rosbag2
            )
        return [*end, *(node(spec, ON_START if begins else start_time) for spec in nodes)]

    recorders: list[Action] = []
    if by_rosbag2:
        overrides = parameter_overrides(RECORDER, scenario, run, ON_START, lockstep=False)
        recorders.append(rosbag2(context, scenario, overrides))
    stages = start_in_stages(
        context, run, {spec: node(spec) for spec in first}, follow, beside=recorders
    )
    return watch_page(context, run) + stages
