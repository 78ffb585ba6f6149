# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: D101, D102 - launch documents its classes and methods
"""Stand in for the parts of `launch` and `launch_ros` that the launch files use.

It runs nothing. Names and arguments are those of launch 3.4.3 and launch_ros 0.26.6 (branch jazzy),
and any other argument is a TypeError. .ci/ros launches a flight with the official packages.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any

from flight_core.environment import PROFILE_VARIABLE


class Event: ...


class LaunchContext:
    """The values of the arguments, the events, and the ROS node of the launch.

    It is its own asyncio loop.
    """

    def __init__(self, **arguments: str) -> None:
        self.launch_configurations = dict(arguments)
        self.is_shutdown = False
        self.events: list[Event] = []
        self.handled: list[Any] = []  # handlers that handle one event
        self.ros_node = RosNode()
        self.asyncio_loop = self

    def call_soon_threadsafe(self, callback: Callable[..., None], *arguments: Any) -> None:
        callback(*arguments)

    def emit_event_sync(self, event: Event) -> None:
        """Keep the event for `handle`."""
        self.events.append(event)

    def handle(self, actions: Sequence[Any]) -> list[Any]:
        """Return the actions that follow from the kept events, given all actions so far.

        Handlers that handle once are unregistered.
        """
        follow: list[Any] = []
        events = self.events
        self.events = []
        for event in events:
            for action in actions:
                handler = action.event_handler if isinstance(action, RegisterEventHandler) else None
                if handler is not None and handler not in self.handled and handler.matcher(event):
                    self.handled += [handler] * handler.handle_once
                    for function in handler.entities:
                        follow += function.function(self) or []
        return follow


class RosNode:
    """The rclpy node of the launch process."""

    def __init__(self) -> None:
        self.subscriptions: dict[str, Callable[[Any], None]] = {}
        self.published: list[tuple[str, bytes]] = []
        self.publishers: dict[str, int] = {}  # of other processes, by topic

    def create_subscription(
        self, kind: type, topic: str, callback: Callable[[Any], None], qos: Any
    ) -> None:
        """Keep the callback with its topic."""
        self.subscriptions[topic] = callback

    def create_publisher(self, kind: type, topic: str, qos: Any) -> Any:
        """Return a publisher that keeps the messages with the topic."""
        return SimpleNamespace(publish=lambda message: self.published.append((topic, message)))

    def resolve_topic_name(self, topic: str) -> str:
        """Return a full name as it is."""
        assert topic.startswith("/")
        return topic

    def count_publishers(self, topic: str) -> int:
        """Return the number of publishers of other processes."""
        return self.publishers.get(topic, 0)

    def create_timer(self, period: float, callback: Callable[[], None]) -> None:
        """Accept a timer, which never fires here."""


def get_ros_node(context: LaunchContext) -> RosNode:
    """Return the node. The environment must have the transport profile."""
    assert PROFILE_VARIABLE in os.environ
    return context.ros_node


def prefix_namespace(base_ns: str | None, ns: str | None) -> str | None:
    """Return `ns` below `base_ns`, unless `ns` is absolute."""
    if ns is None or not base_ns:
        return base_ns if ns is None else ns
    return ns if ns.startswith("/") else f"{base_ns.rstrip('/')}/{ns}".rstrip("/")


def make_namespace_absolute(ns: str | None) -> str | None:
    """Return `ns` with a slash in front."""
    return ns if ns is None or ns.startswith("/") else f"/{ns}"


@dataclass(eq=False)
class LaunchDescription:
    """The entities of a launch file."""

    entities: Sequence[Any]


@dataclass(frozen=True)
class LaunchConfiguration:
    variable_name: str

    def perform(self, context: LaunchContext) -> str:
        """Return the value."""
        return context.launch_configurations[self.variable_name]


@dataclass(frozen=True)
class ExecutableInPackage:
    executable: str
    package: str


class Action: ...


@dataclass(eq=False)
class DeclareLaunchArgument(Action):
    name: str
    default_value: str | None = None
    description: str | None = None
    choices: list[str] | None = None


@dataclass(eq=False, kw_only=True)
class OpaqueFunction(Action):
    function: Callable[[LaunchContext], list[Action] | None]


@dataclass(kw_only=True)
class LogInfo(Action):
    msg: str


class PushLaunchConfigurations(Action): ...


class PopLaunchConfigurations(Action): ...


@dataclass(eq=False, kw_only=True)
class EmitEvent(Action):
    event: Event


@dataclass(eq=False, kw_only=True)
class TimerAction(Action):
    period: float  # s
    actions: Sequence[Action]
    is_canceled: bool = False

    def cancel(self) -> None:
        """Do not call any more."""
        self.is_canceled = True


@dataclass(eq=False, kw_only=True)
class EventHandler:
    matcher: Callable[[Event], bool]
    entities: Sequence[Any]
    handle_once: bool = False


@dataclass(eq=False)
class RegisterEventHandler(Action):
    event_handler: EventHandler


@dataclass(eq=False, kw_only=True)
class ExecuteProcess(Action):
    cmd: Sequence[Any]
    name: str | None = None
    output: str = "log"
    on_exit: Callable[[Any, LaunchContext], Any] | None = None


@dataclass(eq=False, kw_only=True)
class Node(Action):
    executable: str
    package: str
    name: str | None = None
    namespace: Any = None
    exec_name: str | None = None
    parameters: Sequence[Any] = field(default_factory=list)
    ros_arguments: Sequence[str] = ()
    output: str = "log"
    on_exit: Callable[[Any, LaunchContext], Any] | None = None


@dataclass(kw_only=True)
class ShutdownProcess(Event):
    process_matcher: Callable[[Any], bool]


@dataclass
class ProcessExited(Event):
    process_name: str
    returncode: int


MODULES: dict[str, tuple[Any, ...]] = {
    "launch": (Event, EventHandler, LaunchContext, LaunchDescription),
    "launch.action": (Action,),
    "launch.actions": (
        DeclareLaunchArgument,
        EmitEvent,
        ExecuteProcess,
        LogInfo,
        OpaqueFunction,
        PopLaunchConfigurations,
        PushLaunchConfigurations,
        RegisterEventHandler,
        TimerAction,
    ),
    "launch.events": (),
    "launch.events.process": (ProcessExited, ShutdownProcess),
    "launch.substitutions": (LaunchConfiguration,),
    "launch_ros": (),
    "launch_ros.actions": (Node,),
    "launch_ros.ros_adapters": (get_ros_node,),
    "launch_ros.substitutions": (ExecutableInPackage,),
    "launch_ros.utilities": (make_namespace_absolute, prefix_namespace),
}


def modules() -> dict[str, ModuleType]:
    """Return the modules by name."""
    stand_ins = {name: ModuleType(name) for name in MODULES}
    for name, members in MODULES.items():
        for member in members:
            setattr(stand_ins[name], member.__name__, globals()[member.__name__])
    return stand_ins
