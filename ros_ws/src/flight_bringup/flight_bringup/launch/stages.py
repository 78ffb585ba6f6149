# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Processes of a launch: started in stages, each beginning when those before it are ready; none ends before the flight does."""

import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from launch.action import Action
from launch.actions import DeclareLaunchArgument, LogInfo, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessIO
from launch.events.process import ProcessExited, ProcessIO
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup.graph import READY, NodeSpec, ParameterOverrides
from flight_bringup.processes import end_with_parent
from flight_bringup.scenarios import scenarios
from launch import LaunchContext

BOOLEAN = ["true", "false"]


def scenario_argument(default: str, otherwise: str = "") -> DeclareLaunchArgument:
    """The argument `scenario`; `otherwise` says what an empty one means."""
    description = f"name of a scenario ({', '.join(scenarios())}), or path of a scenario file (.yaml){otherwise}"
    return DeclareLaunchArgument("scenario", default_value=default, description=description)


def runs_argument() -> DeclareLaunchArgument:
    """The argument `runs`."""
    return DeclareLaunchArgument("runs", default_value="runs", description="folder that the run's folder is made in")


def namespace_argument(description: str = "namespace of all nodes, one an aircraft") -> DeclareLaunchArgument:
    """The argument `namespace`."""
    return DeclareLaunchArgument("namespace", default_value="", description=description)


def text(context: LaunchContext, name: str) -> str:
    """The value of an argument."""
    return str(LaunchConfiguration(name).perform(context))


def end_with_launch(context: LaunchContext) -> None:
    """All processes end with this one: launch leaves them running when it is itself ended by anything but SIGINT."""
    context.launch_configurations.setdefault("launch-prefix", shlex.join(end_with_parent()))


def node(spec: NodeSpec, scenario: Scenario, told: ParameterOverrides) -> Node:
    """A node of a flight, with its section of the scenario and what it is told beside it."""
    return Node(
        package=spec.package,
        executable=spec.executable,
        exec_name=spec.executable,  # else the log names each process by its prefix
        namespace=LaunchConfiguration("namespace"),
        parameters=[str(scenario.path), told],
        output="screen",
        on_exit=require_flown,
    )


def require_flown(event: ProcessExited, context: LaunchContext) -> None:
    """The end of any process before that of the flight ends all others, with exit status 1."""
    if not context.is_shutdown:
        raise RuntimeError(f"{event.process_name} ended before the flight did")


def when_said(process: Node, sentence: str, then: Callable[[], Sequence[Action] | None]) -> RegisterEventHandler:
    """What follows each line of a process that holds a sentence."""

    def handle(event: ProcessIO) -> Sequence[Action] | None:
        return then() if sentence in event.text.decode(errors="replace") else None

    return RegisterEventHandler(OnProcessIO(target_action=process, on_stdout=handle, on_stderr=handle))


def in_order(first: Mapping[NodeSpec, Node], then: Callable[[float], Sequence[Action]]) -> list[Action]:
    """The first processes, and what follows once all of them have said that they are ready, given how long that took in s."""
    begin = time.monotonic()
    waiting = set(first)

    def when_ready(spec: NodeSpec) -> Sequence[Action] | None:
        if spec not in waiting:
            return None
        waiting.remove(spec)
        return None if waiting else then(time.monotonic() - begin)

    handlers = [when_said(process, READY, lambda spec=spec: when_ready(spec)) for spec, process in first.items()]
    return [*handlers, *first.values()]


def flown(run: Path, sentence: str = "flown to its end") -> list[Action]:
    """The end of a flight that has flown as long as it was to."""
    return [
        LogInfo(msg=f"flown; now: ros2 run flight_bringup rise-di report {shlex.quote(str(run))}"),
        Shutdown(reason=sentence),
    ]
