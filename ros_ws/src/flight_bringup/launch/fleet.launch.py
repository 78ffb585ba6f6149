# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a fleet on a full ROS 2: ros2 launch flight_bringup fleet.launch.py fleet:=fleet.yaml.

It runs `rise-di fly`, which starts, follows and ends every aircraft. The launch ends with it, with
exit status 1 where an aircraft did not complete its flight.
"""

from collections.abc import Sequence
from pathlib import Path

from launch.action import Action
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch_ros.substitutions import ExecutableInPackage

from flight_bringup.fleet import read_fleet
from flight_bringup.launch.stages import (
    USE_SIM_TIME,
    argument,
    end_with_launch,
    runs_argument,
    sim_time_argument,
    watch_argument,
)
from launch import LaunchContext, LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """The arguments and the fleet."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("fleet", description="file of a fleet (.yaml): docs/fleets.md"),
            DeclareLaunchArgument(
                "duration",
                default_value="",
                description="flight time of each aircraft, s; empty: that of the file",
            ),
            watch_argument(),
            runs_argument(),
            sim_time_argument(),
            OpaqueFunction(function=_fly),
        ]
    )


def _fly(context: LaunchContext) -> list[Action]:
    file = argument(context, "fleet")
    duration = argument(context, "duration")
    read_fleet(Path(file))  # a mistake in the file is one sentence, before anything starts
    end_with_launch(context)

    def end(event: ProcessExited, context: LaunchContext) -> Sequence[Action]:
        if event.returncode != 0 and not context.is_shutdown:
            raise RuntimeError(f"the fleet ended with status {event.returncode}")
        return [Shutdown(reason="fleet completed")]

    rise_di = ExecutableInPackage(package="flight_cli", executable="rise-di")
    options = [
        "--set",
        f"runs={argument(context, 'runs')}",
        *(["--duration", duration] if duration else []),
    ]
    options += ["--watch"] if argument(context, "watch") == "true" else []
    options += ["--set", USE_SIM_TIME] if argument(context, USE_SIM_TIME) == "true" else []
    return [
        ExecuteProcess(
            cmd=[rise_di, "fly", file, *options], name="fleet", output="screen", on_exit=end
        )
    ]
