# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a scenario on a full ROS 2: ros2 launch flight_bringup fly.launch.py scenario:=osprey_gust.

The same graph and the same scenario file as `rise-di fly`. The flight begins once recorder and controller are ready and ends
after the scenario's duration, in lockstep as soon as that is flown. It ends early, with exit status 1, when any of its nodes
does.
"""

import math
import time
from collections.abc import Sequence
from pathlib import Path

import yaml
from launch.action import Action
from launch.actions import DeclareLaunchArgument, OpaqueFunction, TimerAction

from flight_analysis.report.run_folder import new_run
from flight_bringup.graph import AIRCRAFT, FIRST, FLOWN, THEN, NodeSpec, parameters, start_lead
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
    when_said,
)
from flight_bringup.scenarios import find_scenario
from launch import LaunchContext, LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """The arguments, and the flight that they describe."""
    return LaunchDescription(
        [
            scenario_argument("osprey_gust"),
            DeclareLaunchArgument("duration", default_value="", description="seconds to fly; empty flies the scenario's"),
            DeclareLaunchArgument(
                "lockstep",
                default_value="",
                choices=["", *BOOLEAN],
                description="true: as fast as the machine allows, repeatable to the byte; empty: as the scenario says",
            ),
            runs_argument(),
            namespace_argument(),
            OpaqueFunction(function=_fly),
        ]
    )


def _fly(context: LaunchContext) -> list[Action]:
    scenario = find_scenario(text(context, "scenario"))
    if duration := text(context, "duration"):
        scenario = scenario.vary(flight={"duration": yaml.safe_load(duration)})
    asked = text(context, "lockstep")
    lockstep = asked == "true" if asked else scenario.flight.lockstep
    run = new_run(scenario, Path(text(context, "runs")))
    end_with_launch(context)

    def told(spec: NodeSpec, start_time: float = math.inf) -> dict[str, object]:
        return parameters(spec, scenario, run, start_time, lockstep=lockstep)

    def take_off(startup: float) -> Sequence[Action]:
        lead = start_lead(startup)
        start_time = round(time.time() + lead, 3)
        others = {spec: node(spec, scenario, told(spec, start_time)) for spec in THEN}
        end: Action = TimerAction(period=lead + scenario.flight.duration, actions=flown(run))
        if lockstep:
            end = when_said(others[AIRCRAFT], FLOWN, lambda: flown(run))
        return [end, *others.values()]

    return in_order({spec: node(spec, scenario, told(spec)) for spec in FIRST}, take_off)
