# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Hold the arguments and the processes of one flight of a launch, and end the flight."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

from launch.action import Action
from launch.actions import (
    EmitEvent,
    ExecuteProcess,
    LogInfo,
    OpaqueFunction,
    PopLaunchConfigurations,
    PushLaunchConfigurations,
    TimerAction,
)
from launch.events.process import ShutdownProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.utilities import make_namespace_absolute, prefix_namespace

from flight_bringup.processes import end_with_parent, leave_outcome
from flight_core.outcome import COMPLETED, Outcome
from launch import LaunchContext

SIM_TIME = "use_sim_time"


class Flight:
    """One flight of a launch, with its processes and the arguments that are valid for it.

    A launch file may include several flights, each in a group. When a node of the flight starts,
    the scope of its group may have ended. So the flight copies the launch configurations of the
    group once, and uses the copy for all that it starts later. The copy has the arguments of the
    flight, and the effects of PushRosNamespace, SetParameter and SetRemap in the group. At its end
    a flight stops only its own processes. If the launch then has nothing else to do, it also ends.
    """

    _of_launch: ClassVar[WeakKeyDictionary[LaunchContext, list["Flight"]]] = WeakKeyDictionary()

    def __init__(self, context: LaunchContext) -> None:
        self.context = context
        self.run = Path()  # folder of the run; Path() without a recorder
        self.states: dict[str, str] = {}  # the last state of each node by its full name
        # A copy of each list, because a later SetParameter or SetRemap of the launch extends it.
        self.configurations: dict[str, Any] = {
            name: [*value] if isinstance(value, list) else value
            for name, value in context.launch_configurations.items()
        }
        # If any other signal than SIGINT ends launch, it leaves its processes running.
        self.configurations.setdefault("launch-prefix", shlex.join(end_with_parent()))
        self.namespace = _namespace(context)
        self._processes: list[Action] = []
        self._timers: list[TimerAction] = []
        self._is_stopped = False
        self._failure = ""
        self._of_launch.setdefault(context, []).append(self)

    @property
    def has_sim_time(self) -> bool:
        """Whether a SetParameter in the launch file makes all nodes fly by /clock."""
        values = dict(each for each in self._given_parameters() if isinstance(each, tuple))
        return values.get(SIM_TIME) is True

    @property
    def is_by_clock(self) -> bool:
        """Whether the flight is by /clock, by the argument `use_sim_time` or by a SetParameter."""
        return self.argument(SIM_TIME) == "true" or self.has_sim_time

    def given_to_nodes(self) -> list[str]:
        """List what the launch file gives to all nodes of the flight, such as "SetRemap y".

        `use_sim_time` is left out. SetParameter, SetParametersFromFile and SetRemap reach only the
        nodes that the launch starts itself. They reach no node of a command that the launch runs.
        """
        names = []
        for each in self._given_parameters():
            if not isinstance(each, tuple):
                names.append(f"SetParametersFromFile {each}")
            elif each[0] != SIM_TIME:
                names.append(f"SetParameter {each[0]}")
        return names + [f"SetRemap {name}" for name, _ in self.configurations.get("ros_remaps", ())]

    def _given_parameters(self) -> Sequence[tuple[str, Any] | str]:
        """Return the parameters that the launch file gives to all nodes: values, or paths."""
        given: Sequence[tuple[str, Any] | str] = self.configurations.get("global_params", ())
        return given

    @property
    def is_over(self) -> bool:
        """Whether the flight or the launch has ended."""
        return self._is_stopped or bool(self.context.is_shutdown)

    def argument(self, name: str) -> str:
        """Return the value of a launch argument of this flight."""
        return str(self.configurations[name])

    def in_scope(self, actions: Sequence[Action]) -> list[Action]:
        """Return actions that run others with the launch configurations of this flight.

        The processes among `actions` are stopped when the flight ends.
        """
        self._processes += [each for each in actions if isinstance(each, (ExecuteProcess, Node))]
        restore = _Restore(self.configurations)
        return [PushLaunchConfigurations(), restore, *actions, PopLaunchConfigurations()]

    def after(
        self, period: float, function: Callable[[LaunchContext], Sequence[Action] | None]
    ) -> TimerAction:
        """Return an action that calls a function after a period, s.

        If the flight has ended by then, the function is not called.
        """

        def call(context: LaunchContext) -> list[Action] | None:
            return None if self.is_over else [*(function(context) or ())]

        timer = TimerAction(period=period, actions=[OpaqueFunction(function=call)])
        self._timers.append(timer)
        return timer

    def complete(
        self, reason: str = "flight completed", outcome: Outcome = COMPLETED
    ) -> list[Action]:
        """Return the actions that end a flight that was completed.

        The recorder writes the outcome into the log and closes it.
        """
        leave_outcome(self.run, outcome)
        report = f"; now: ros2 run flight_cli rise-di report {shlex.quote(str(self.run))}"
        return [LogInfo(msg=reason + (report if self.run.name else "")), *self._stop()]

    def fail(self, outcome: Outcome) -> list[Action]:
        """Return the actions that end the flight early, and write its outcome to the run's folder.

        Other flights of the launch go on undisturbed. If this was the last flight, raises
        RuntimeError, so that the launch ends with exit status 1.
        """
        leave_outcome(self.run, outcome)
        self._failure = str(outcome)
        return [LogInfo(msg=str(outcome)), *self._stop()]

    def _stop(self) -> list[Action]:
        """Return the actions that stop all that the flight has started.

        If this was the last flight of the launch, and any flight has failed, raises RuntimeError.
        """
        self._is_stopped = True
        for timer in self._timers:
            timer.cancel()
        flights = self._of_launch[self.context]
        failures = [flight._failure for flight in flights if flight._failure]
        if failures and all(flight._is_stopped for flight in flights):
            raise RuntimeError("; ".join(failures))
        return [EmitEvent(event=ShutdownProcess(process_matcher=self._has_process))]

    def _has_process(self, process: Action) -> bool:
        return any(process is each for each in self._processes)


class _Restore(Action):
    """An action that brings back the launch configurations of a scope that has ended."""

    def __init__(self, configurations: Mapping[str, Any]) -> None:
        super().__init__()
        self.configurations = configurations

    def execute(self, context: LaunchContext) -> None:
        """Replace the launch configurations by the stored ones.

        `Flight.in_scope` saves the present configurations before, and brings them back afterwards.
        """
        context.launch_configurations.clear()
        context.launch_configurations.update(self.configurations)


def argument(context: LaunchContext, name: str) -> str:
    """Return the value of a launch argument."""
    return str(LaunchConfiguration(name).perform(context))


def _namespace(context: LaunchContext) -> str:
    """Return the absolute namespace of the nodes, as launch_ros computes it. The root is ""."""
    base = context.launch_configurations.get("ros_namespace")
    own = context.launch_configurations.get("namespace", "")
    return str(make_namespace_absolute(prefix_namespace(base, own))).rstrip("/")
