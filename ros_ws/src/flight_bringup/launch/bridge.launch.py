# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly an autopilot through a channel map on a full ROS 2: ros2 launch flight_bringup bridge.launch.py map:=ardupilot.

The graph of fly.launch.py with the bridge in the aircraft's place. Nothing is sent to the autopilot unless dry_run is false and
the bridge is then told to engage; docs/autopilots.md says how. Refuses a map whose signs contradict the controller's. Ends with
Ctrl-C, after `duration`, or, with exit status 1, when any of its nodes does.
"""

import math
import time
from collections.abc import Sequence
from pathlib import Path

import yaml
from launch.action import Action
from launch.actions import DeclareLaunchArgument, OpaqueFunction, TimerAction

from autopilot_bridge.params import maps
from flight_analysis.design.sign_check import require_signs
from flight_analysis.report.run_folder import new_run
from flight_bringup.graph import BRIDGED, CONTROLLER, FIRST, NodeSpec, find_autopilot, parameters, start_lead
from flight_bringup.launch.stages import (
    BOOLEAN,
    end_with_launch,
    flown,
    in_order,
    namespace_argument,
    node,
    runs_argument,
    scenario_argument,
    text,
)
from flight_bringup.scenarios import find_scenario
from launch import LaunchContext, LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """The arguments, and the flight that they describe."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("map", description=f"name of a channel map ({', '.join(maps())}), or path of a file (.yaml)"),
            scenario_argument("osprey_gust"),
            DeclareLaunchArgument(
                "dry_run",
                default_value="true",
                choices=BOOLEAN,
                description="true: say what would be sent, and send nothing; false: send once the bridge is told to engage",
            ),
            DeclareLaunchArgument("recorder", default_value="true", choices=BOOLEAN, description="record the flight"),
            DeclareLaunchArgument("duration", default_value="", description="seconds to fly; empty flies until Ctrl-C"),
            runs_argument(),
            namespace_argument("namespace of all nodes, one an aircraft; topics that a map names in full are not in it"),
            OpaqueFunction(function=_fly),
        ]
    )


def _fly(context: LaunchContext) -> list[Action]:
    scenario = find_scenario(text(context, "scenario"))
    if duration := text(context, "duration"):
        scenario = scenario.vary(flight={"duration": yaml.safe_load(duration)})
    autopilot = find_autopilot(text(context, "map"), dry_run=text(context, "dry_run") == "true")
    require_signs(autopilot.channel_map, scenario)
    recorded = text(context, "recorder") == "true"
    run = new_run(scenario, Path(text(context, "runs"))) if recorded else Path()
    end_with_launch(context)

    def told(spec: NodeSpec, start_time: float = math.inf) -> dict[str, object]:
        return parameters(spec, scenario, run, start_time, lockstep=False, autopilot=autopilot)

    def take_off(startup: float) -> Sequence[Action]:
        lead = start_lead(startup)
        start_time = round(time.time() + lead, 3)
        end = [TimerAction(period=lead + scenario.flight.duration, actions=flown(run))] if duration else []
        return [*end, *(node(spec, scenario, told(spec, start_time)) for spec in BRIDGED)]

    first = FIRST if recorded else (CONTROLLER,)
    return in_order({spec: node(spec, scenario, told(spec)) for spec in first}, take_off)
