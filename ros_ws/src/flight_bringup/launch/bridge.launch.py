# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly an autopilot through a channel map on a full ROS 2.

ros2 launch flight_bringup bridge.launch.py map:=ardupilot

The launch starts the nodes of fly.launch.py, with the bridge in place of the aircraft. The bridge
sends to the autopilot only if dry_run:=false is given, and only while it is engaged
(docs/autopilots.md). A map whose signs contradict the controller's signs is refused. The flight
ends with Ctrl-C or after `duration`. If a node ends earlier, the exit status is 1.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import yaml
from launch.action import Action
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node

from autopilot_bridge.params import maps
from flight_analysis.closed_loop.scenario_library import as_flown, find_scenario
from flight_analysis.report.run_folder import new_run
from flight_bringup.graph import (
    CONTROLLER,
    FIRST_STAGE,
    RECORDER,
    NodeSpec,
    find_autopilot,
    parameter_overrides,
    require_limits,
    second_stage,
)
from flight_bringup.launch.flight import Flight, argument
from flight_bringup.launch.stages import (
    boolean_argument,
    end_with_log,
    flight_node,
    log_level_argument,
    namespace_argument,
    recorder_argument,
    rosbag2,
    runs_argument,
    scenario_argument,
    start_in_stages,
    watch_argument,
    watch_page,
)
from flight_core.parameters import require
from flight_design.identification.sign_check import require_signs
from launch import LaunchContext, LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, and fly."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "map",
                description=f"name of a channel map ({', '.join(maps())}), or path of a file "
                "(.yaml)",
            ),
            scenario_argument("osprey_servo"),
            boolean_argument(
                "dry_run",
                True,
                "true: publish on bridge/would_send, send nothing; false: send once the bridge "
                "is engaged",
            ),
            recorder_argument("false"),
            DeclareLaunchArgument(
                "duration", default_value="", description="seconds to fly; empty flies until Ctrl-C"
            ),
            runs_argument(),
            watch_argument(),
            namespace_argument(
                "namespace of all nodes, a different one for each aircraft; topics that a map "
                "names in full are not in it"
            ),
            log_level_argument(),
            OpaqueFunction(function=_fly),
        ]
    )


def _fly(context: LaunchContext) -> list[Action]:
    duration = yaml.safe_load(argument(context, "duration"))
    scenario = find_scenario(argument(context, "scenario"), duration)
    autopilot = find_autopilot(
        argument(context, "map"), dry_run=argument(context, "dry_run") == "true"
    )
    require_signs(autopilot.channel_map, scenario)
    require_limits(autopilot, scenario)
    recorder = argument(context, "recorder")
    recorded = recorder != "false"
    stores = recorded or not scenario.reference_model.recorded
    require(stores, "recorder", "false", "true: a run stores the values of recorded commands")
    flight = Flight(context)
    if recorded:
        flight.run = new_run(scenario, Path(argument(context, "runs")))
        scenario = as_flown(scenario, flight.run, flight.namespace)
    run = flight.run

    def node(spec: NodeSpec, start_time: float = math.inf) -> Node:
        overrides = parameter_overrides(
            spec, scenario, run, start_time, lockstep=False, autopilot=autopilot
        )
        return flight_node(spec, scenario, overrides, flight)

    def follow(lead: float, start_time: float) -> Sequence[Action]:
        span = scenario.flight.duration
        if duration:
            end = end_with_log(
                flight, lead, start_time + span, span, by_rosbag2=recorder == "rosbag2"
            )
        else:
            end = []
        return [*end, *(node(spec, start_time) for spec in second_stage(scenario, bridge=True))]

    page = watch_page(flight) if recorded else []
    first = FIRST_STAGE if recorder == "true" else (CONTROLLER,)
    beside: list[Action] = []
    if recorder == "rosbag2":
        overrides = parameter_overrides(
            RECORDER, scenario, run, math.inf, lockstep=False, autopilot=autopilot
        )
        beside.append(rosbag2(flight, scenario, overrides))
    stages = start_in_stages(flight, {spec: node(spec) for spec in first}, follow, beside=beside)
    return page + stages
