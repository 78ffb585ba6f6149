# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""As much of `launch` and `launch_ros` as the launch files use, for machines without them: it notes what it is given.

Names and arguments are those of launch 3.4.3 and launch_ros 0.26.6 (branch jazzy); an argument that they do not have is a
TypeError here too. It runs nothing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any


class LaunchContext:
    """The values of the arguments."""

    def __init__(self, **arguments: str) -> None:
        self.launch_configurations = dict(arguments)
        self.is_shutdown = False


@dataclass(eq=False)
class LaunchDescription:
    """What a launch file describes."""

    entities: Sequence[Any]


@dataclass(frozen=True)
class LaunchConfiguration:
    """The value of an argument, by its name."""

    variable_name: str

    def perform(self, context: LaunchContext) -> str:
        """The value."""
        return context.launch_configurations[self.variable_name]


@dataclass(frozen=True)
class ExecutableInPackage:
    """The path of an executable."""

    executable: str
    package: str


class Action:
    """Base of actions."""


@dataclass(eq=False)
class DeclareLaunchArgument(Action):
    """An argument of a launch file."""

    name: str
    default_value: str | None = None
    description: str | None = None
    choices: list[str] | None = None


@dataclass(eq=False)
class OpaqueFunction(Action):
    """A function that makes actions once the arguments are known."""

    function: Callable[[LaunchContext], list[Action]]


@dataclass(eq=False)
class LogInfo(Action):
    """Something to be said."""

    msg: str


@dataclass(eq=False)
class Shutdown(Action):
    """The end of all."""

    reason: str


@dataclass(eq=False)
class TimerAction(Action):
    """Actions after a while, s."""

    period: float
    actions: Sequence[Action]


@dataclass(eq=False)
class RegisterEventHandler(Action):
    """A handler from now on."""

    event_handler: "OnProcessIO"


@dataclass(eq=False, kw_only=True)
class ExecuteProcess(Action):
    """Any process."""

    cmd: Sequence[Any]
    name: str | None = None
    output: str = "log"
    on_exit: Callable[[Any, LaunchContext], Any] | None = None


@dataclass(eq=False, kw_only=True)
class Node(Action):
    """A node as a process."""

    executable: str
    package: str
    namespace: Any = None
    exec_name: str | None = None
    parameters: Sequence[Any] = field(default_factory=list)
    output: str = "log"
    on_exit: Callable[[Any, LaunchContext], Any] | None = None


@dataclass(eq=False, kw_only=True)
class OnProcessIO:
    """What follows what a process says."""

    target_action: Action
    on_stdout: Callable[[Any], Any]
    on_stderr: Callable[[Any], Any]


@dataclass
class ProcessIO:
    """A process has said something."""

    text: bytes


@dataclass
class ProcessExited:
    """A process has ended."""

    process_name: str
    returncode: int


WHERE: dict[str, tuple[type, ...]] = {
    "launch": (LaunchContext, LaunchDescription),
    "launch.action": (Action,),
    "launch.actions": (
        DeclareLaunchArgument,
        ExecuteProcess,
        LogInfo,
        OpaqueFunction,
        RegisterEventHandler,
        Shutdown,
        TimerAction,
    ),
    "launch.event_handlers": (OnProcessIO,),
    "launch.events": (),
    "launch.events.process": (ProcessExited, ProcessIO),
    "launch.substitutions": (LaunchConfiguration,),
    "launch_ros": (),
    "launch_ros.actions": (Node,),
    "launch_ros.substitutions": (ExecutableInPackage,),
}


def modules() -> dict[str, ModuleType]:
    """The modules by their names."""
    made = {name: ModuleType(name) for name in WHERE}
    for name, kinds in WHERE.items():
        for kind in kinds:
            setattr(made[name], kind.__name__, kind)
    return made
