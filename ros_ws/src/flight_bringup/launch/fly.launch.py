# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a scenario on a full ROS 2: ros2 launch flight_bringup fly.launch.py scenario:=osprey_servo.

The launch uses the same nodes and scenario file as `rise-di fly`. The flight begins when each node
is ready and each of its inputs has a publisher. It ends when the log holds the duration of the
scenario, or in lockstep when the aircraft has completed this duration. It ends early with exit
status 1 if a node ends or is not ready, or if no u reaches the aircraft. If another launch file
includes this one, the end of the flight ends only the nodes of this flight.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import yaml
from launch.action import Action
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario, with_parameters
from flight_analysis.report.run_folder import new_run
from flight_bringup.fly import with_file
from flight_bringup.graph import (
    AIRCRAFT,
    CONTROLLER,
    FIRST_STAGE,
    ON_START,
    RECORDER,
    REFERENCE_MODEL,
    NodeSpec,
    parameter_overrides,
    second_stage,
)
from flight_bringup.launch.flight import SIM_TIME, Flight, argument
from flight_bringup.launch.stages import (
    BOOLEAN,
    begin_when_matched,
    boolean_argument,
    by_rise_di,
    end_with_log,
    flight_node,
    log_level_argument,
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
from flight_core.topics import published_by
from flight_ros.topics import NodeState
from launch import LaunchContext, LaunchDescription

# Nodes that users may replace, and the topics that these nodes publish.
OPTIONAL = {AIRCRAFT: "y", REFERENCE_MODEL: "y_m"}


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, and fly."""
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
            *(
                boolean_argument(
                    spec.executable, True, f"false: a node of your own publishes {topic}"
                )
                for spec, topic in OPTIONAL.items()
            ),
            DeclareLaunchArgument(
                "params_file",
                default_value="",
                description="parameter file whose values replace the scenario's",
            ),
            log_level_argument(),
            sim_time_argument(),
            OpaqueFunction(function=_fly),
        ]
    )


def _fly(context: LaunchContext) -> list[Action]:
    flight = Flight(context)
    scenario = _scenario(context, flight.namespace)
    further = argument(context, "params_file")
    others = [spec for spec in OPTIONAL if argument(context, spec.executable) == "false"]
    value = argument(context, "lockstep")
    lockstep = value == "true" or (value == "" and scenario.flight.lockstep)
    by_rosbag2 = argument(context, "recorder") == "rosbag2"
    is_simulated = flight.is_by_clock or scenario.flight.use_sim_time
    own = [*(spec.executable for spec in others), *(["params_file"] * bool(further))]
    _require_possible(own, lockstep=lockstep, by_rosbag2=by_rosbag2, is_simulated=is_simulated)
    if is_simulated:
        return by_rise_di(flight, argument(context, "scenario"))
    flight.run = run = new_run(scenario, Path(argument(context, "runs")))
    scenario = with_file(scenario, run, flight.namespace)
    first = (CONTROLLER,) if by_rosbag2 else FIRST_STAGE
    then = tuple(spec for spec in second_stage(scenario) if spec not in others)

    overrides = partial(
        parameter_overrides, scenario=scenario, run=run, lockstep=lockstep, replaced=others
    )

    def node(spec: NodeSpec, start_time: float = ON_START) -> Node:
        return flight_node(spec, scenario, overrides(spec, start_time=start_time), flight)

    def follow(lead: float, start_time: float) -> Sequence[Action]:
        duration = scenario.flight.duration
        begins = not lockstep and scenario.controller.autostart and scenario.controller.start_active
        if lockstep:
            end: list[Action] = [on_state(flight, AIRCRAFT, NodeState.COMPLETED, flight.complete)]
        elif begins:
            end = begin_when_matched(
                flight,
                (*first, *then),
                duration,
                by_rosbag2=by_rosbag2,
                flies=AIRCRAFT not in others,
            )
        else:
            # A user activates the controller, or nobody activates it.
            end = end_with_log(flight, lead, start_time + duration, duration, by_rosbag2=by_rosbag2)
        return [*end, *(node(spec, ON_START if begins else start_time) for spec in then)]

    recorders: list[Action] = []
    if by_rosbag2:
        recorders.append(rosbag2(flight, scenario, overrides(RECORDER, start_time=ON_START)))
    published = {topic for spec in (*first, *then) for topic in published_by(spec.executable)}
    stages = start_in_stages(
        flight,
        {spec: node(spec) for spec in first},
        follow,
        beside=recorders,
        publishes=published,
    )
    return watch_page(flight) + stages


def _scenario(context: LaunchContext, namespace: str) -> Scenario:
    """Return the scenario that the arguments name, with the values of a `params_file`."""
    duration = yaml.safe_load(argument(context, "duration"))
    scenario = find_scenario(argument(context, "scenario"), duration)
    further = argument(context, "params_file")
    return with_parameters(scenario, Path(further), namespace) if further else scenario


def _require_possible(
    own: Sequence[str], *, lockstep: bool, by_rosbag2: bool, is_simulated: bool
) -> None:
    """Check that no two arguments exclude each other. Raises ParameterError if they do.

    `own` are the arguments by which users add other nodes or values to a flight.
    """
    require(
        not (by_rosbag2 and lockstep),
        "recorder",
        "rosbag2 in lockstep",
        "true: the aircraft waits for the stack's recorder",
    )
    for name in set(own) - {"params_file"}:
        require(not lockstep, name, "false in lockstep", "true: the nodes of the stack")
    if is_simulated:
        beside = f"true beside {' and '.join(own)} of your own"
        require(not own, SIM_TIME, beside, "nodes by `ros2 run`")
        require(
            not (lockstep or by_rosbag2),
            SIM_TIME,
            f"true {'in lockstep' if lockstep else 'with rosbag2'}",
            "a flight in real time, recorded by the stack",
        )
