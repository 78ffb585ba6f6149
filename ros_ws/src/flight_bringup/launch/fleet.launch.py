# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a fleet on a full ROS 2: ros2 launch flight_bringup fleet.launch.py fleet:=fleet.yaml.

The launch runs the command `rise-di fly`, which starts, follows and ends the flight of every
aircraft. The launch ends when this command does. The exit status is 1 if an aircraft did not
complete its flight.
"""

from pathlib import Path

from launch.action import Action
from launch.actions import DeclareLaunchArgument, OpaqueFunction

from flight_bringup.fleet import read_fleet
from flight_bringup.launch.flight import Flight, argument
from flight_bringup.launch.stages import (
    by_rise_di,
    runs_argument,
    sim_time_argument,
    watch_argument,
)
from launch import LaunchContext, LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, and fly the fleet."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("fleet", description="file of a fleet (.yaml): docs/fleets.md"),
            DeclareLaunchArgument(
                "duration",
                default_value="",
                description="flight time of each aircraft, s; empty: as in the file",
            ),
            watch_argument(),
            runs_argument(),
            sim_time_argument(),
            OpaqueFunction(function=_fly),
        ]
    )


def _fly(context: LaunchContext) -> list[Action]:
    file = argument(context, "fleet")
    # A mistake in the file is refused in one sentence, before anything starts.
    fleet = read_fleet(Path(file))
    has_own_time = fleet.lockstep or fleet.use_sim_time
    return by_rise_di(Flight(context), file, has_own_time=has_own_time)
