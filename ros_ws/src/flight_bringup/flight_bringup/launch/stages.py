# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Start the nodes of a launch in stages.

A stage starts when each node of the previous stage has published the state "ready" on the topic
`node_state`.
"""

import math
import os
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import psutil
from diagnostic_msgs.msg import KeyValue
from launch.action import Action
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.events.process import ProcessExited
from launch_ros.actions import Node
from launch_ros.ros_adapters import get_ros_node
from launch_ros.substitutions import ExecutableInPackage

from flight_analysis.closed_loop.scenario import ParameterOverrides, Scenario
from flight_analysis.closed_loop.scenario_library import scenarios
from flight_bringup.graph import AIRCRAFT, LEAD, LEARNER, NodeSpec, start_instant, start_lead
from flight_bringup.launch.flight import SIM_TIME, Flight
from flight_bringup.monitor import DISCOVERY_TIME, FREE_DOMAIN, LOOP_INPUTS
from flight_bringup.processes import (
    FIRST_U,
    LOG_TIMEOUT,
    READY_TIMEOUT,
    leave_outcome,
)
from flight_core.files import link_latest
from flight_core.outcome import (
    INTERRUPTED,
    STATUS_LANDED,
    End,
    Outcome,
    ended_early,
    log_ends_at,
    never_flew,
)
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_log.bag import BagWriter, LogAttachments
from flight_log.open_log import ROSBAG2
from flight_ros import transport
from flight_ros.endpoints import require_no_publishers
from flight_ros.messages import instant
from flight_ros.topics import (
    FLIGHT,
    LOCKSTEP,
    NEWEST_SAMPLES,
    NODE_STATE,
    RECORDED,
    START,
    STATES,
    NodeState,
    U,
    offered,
)
from launch import Event, EventHandler, LaunchContext

BOOLEAN = ["true", "false"]
SHUTDOWN_DELAY = 0.05  # s
WAITED_FOR = "the lines of the nodes say what they wait for"


class NodeStateEvent(Event):
    """Event of the launch: one of its nodes has published its state."""

    name = "flight_bringup.NodeStateEvent"

    def __init__(self, node: str, state: str) -> None:
        self.node = node  # fully qualified name
        self.state = state


class FlownEvent(Event):
    """Event of the launch: a flight has reached its end."""

    name = "flight_bringup.FlownEvent"

    def __init__(self, flight: "Flight") -> None:
        self.flight = flight


def scenario_argument(default: str, otherwise: str = "") -> DeclareLaunchArgument:
    """Declare the launch argument `scenario`.

    `otherwise` ends the description, and says what an empty value means.
    """
    description = (
        f"name of a scenario ({', '.join(scenarios())}), or path of a scenario file "
        f"(.yaml){otherwise}"
    )
    return DeclareLaunchArgument("scenario", default_value=default, description=description)


def boolean_argument(name: str, default: bool, description: str) -> DeclareLaunchArgument:
    """Declare a launch argument whose value is "true" or "false"."""
    return DeclareLaunchArgument(
        name, default_value=str(default).lower(), choices=BOOLEAN, description=description
    )


def runs_argument() -> DeclareLaunchArgument:
    """Declare the launch argument `runs`."""
    return DeclareLaunchArgument(
        "runs", default_value="runs", description="folder in which the folder of the run is created"
    )


def recorder_argument(*further: str) -> DeclareLaunchArgument:
    """Declare the launch argument `recorder`. `further` has additional values that it permits."""
    description = (
        "true: the stack's recorder; rosbag2: `ros2 bag record` into the folder rosbag2 of the run"
    )
    return DeclareLaunchArgument(
        "recorder",
        default_value="true",
        choices=["true", "rosbag2", *further],
        description=description,
    )


def watch_argument() -> DeclareLaunchArgument:
    """Declare the launch argument `watch`."""
    return boolean_argument("watch", False, "serve the live page of the flight: docs/live-view.md")


def watch_page(flight: Flight) -> list[Action]:
    """Return the process that serves the live page of a flight, if the user wants the page.

    The flight goes on if this process ends.
    """
    if flight.argument("watch") != "true":
        return []
    rise_di = ExecutableInPackage(package="flight_cli", executable="rise-di")
    words = [rise_di, "watch", str(flight.run), "--wait"]
    return flight.in_scope([ExecuteProcess(cmd=words, name="watch", output="screen")])


def namespace_argument(
    description: str = "namespace of all nodes, a different one for each aircraft",
) -> DeclareLaunchArgument:
    """Declare the launch argument `namespace`."""
    return DeclareLaunchArgument("namespace", default_value="", description=description)


def log_level_argument() -> DeclareLaunchArgument:
    """Declare the launch argument `log_level`."""
    return DeclareLaunchArgument(
        "log_level",
        default_value="info",
        choices=["debug", "info", "warn", "error", "fatal"],
        description="from which level on the nodes log",
    )


def sim_time_argument() -> DeclareLaunchArgument:
    """Declare the launch argument `use_sim_time`."""
    return boolean_argument(
        SIM_TIME, False, "run `rise-di fly` by the /clock of a simulator: docs/ros.md"
    )


def by_rise_di(flight: Flight, file: str, *, has_own_time: bool = False) -> list[Action]:
    """Run the command `rise-di fly` for a scenario or fleet file, with the launch's arguments.

    The command flies in real time, because a launch file flies beside other nodes. If
    `has_own_time` is True, the fleet file says whether the fleet flies in real time. If the command
    ends with an error, because a flight was not completed, the launch ends with exit status 1.

    Raises ParameterError if the launch file gives parameters or names to its nodes, because they
    would not reach the nodes of the command.
    """

    def end(event: ProcessExited, context: LaunchContext) -> Sequence[Action]:
        if event.returncode != 0 and not flight.is_over:
            return flight.fail(ended_early(f"rise-di fly ended with status {event.returncode}"))
        return flight.complete()

    given = flight.given_to_nodes()
    require(
        not given,
        file,
        f"{', '.join(given)} of the launch",
        "values in the file: `rise-di fly` starts these nodes, and no launch reaches them",
    )
    options = ["--runs", flight.argument("runs")]
    options += ["--use-sim-time"] * flight.is_by_clock
    options += ["--real-time"] * (not (flight.is_by_clock or has_own_time))
    for name, value in (
        ("duration", flight.argument("duration")),
        ("namespace", flight.namespace),
    ):
        options += [f"--{name}", value] if value else []
    options += ["--watch"] * (flight.argument("watch") == "true")
    rise_di = ExecutableInPackage(package="flight_cli", executable="rise-di")
    words = [rise_di, "fly", file, *options]
    process = ExecuteProcess(cmd=words, name="flight", output="screen", on_exit=end)
    return flight.in_scope([process])


def flight_node(
    spec: NodeSpec, scenario: Scenario, overrides: ParameterOverrides, flight: Flight
) -> Node:
    """Return the action that starts a node of a flight.

    The node gets its section of the scenario file, and then `overrides`.
    """
    return Node(
        package=spec.package,
        executable=spec.executable,
        # a separate name, so that the overrides go to this node after its section
        name=spec.executable,
        exec_name=spec.executable,  # otherwise the log names each process by its prefix
        namespace=flight.argument("namespace"),
        parameters=[str(scenario.path), overrides],
        ros_arguments=["--log-level", flight.argument("log_level")],
        output="screen",
        on_exit=partial(say_on_exit if spec is LEARNER else fail_on_exit, flight=flight),
    )


def rosbag2(flight: Flight, scenario: Scenario, overrides: ParameterOverrides) -> ExecuteProcess:
    """Return the process `ros2 bag record`, which takes the place of this package's recorder.

    It records the same topics. `overrides` are the parameters that the replaced recorder would get.
    The files that the replaced recorder would attach to its log are written to a separate log in
    the folder of the run.
    """
    run = Path(overrides["directory"])
    with BagWriter(run) as bag:
        files = LogAttachments(
            Path(overrides["scenario_file"]),
            tuple(map(Path, overrides["attach"])),
            Path(overrides["metadata_file"]),
        )
        bag.add_attachments(files, time.time_ns())
    further = overrides.get("topics", scenario.recorder.topics)
    topics = [*(topic.name for topic in FLIGHT), *further]
    names = dict.fromkeys(
        name if name.startswith("/") else f"{flight.namespace}/{name}" for name in topics
    )
    command = [
        "ros2",
        "bag",
        "record",
        "--storage",
        "mcap",
        "--output",
        str(run / ROSBAG2),
        "--topics",
        *names,
    ]
    return ExecuteProcess(
        cmd=command, name="recorder", output="screen", on_exit=partial(fail_on_exit, flight=flight)
    )


def fail_on_exit(
    event: ProcessExited, context: LaunchContext, flight: Flight
) -> Sequence[Action] | None:
    """End the flight if a process ends before the flight does.

    If the exit status says that the aircraft has landed, the flight is completed.
    """
    if flight.is_over:
        return None
    if event.returncode != STATUS_LANDED:
        return flight.fail(ended_early(f"{event.process_name} ended before the flight did"))
    return flight.complete("the aircraft has landed", Outcome(End.LANDED))


def say_on_exit(event: ProcessExited, context: LaunchContext, flight: Flight) -> list[Action]:
    """Say that the learner has ended, if it ends before the flight does. The flight goes on."""
    sentence = (
        f"{event.process_name} ended before the flight did: the law continues with the model "
        "that it has"
    )
    return [] if flight.is_over else [LogInfo(msg=sentence)]


def on_state(
    flight: Flight, spec: NodeSpec, state: NodeState, then: Callable[[], Sequence[Action]]
) -> Action:
    """Return an action that waits until a node has reached a state, and then runs `then` once.

    If the node has already reached the state or a later one, `then` runs immediately. This happens
    if nodes of the user publish the inputs of the node before the node starts.
    """
    node = f"{flight.namespace}/{spec.executable}"
    states = [*NodeState]
    states_from = {*states[states.index(state) :]}

    def matches(event: Event) -> bool:
        return (
            isinstance(event, NodeStateEvent) and event.node == node and event.state in states_from
        )

    def act(context: LaunchContext) -> list[Action]:
        return [] if flight.is_over else [*then()]

    run = OpaqueFunction(function=act)
    if flight.states.get(node) in states_from:
        return run
    return RegisterEventHandler(EventHandler(matcher=matches, entities=[run], handle_once=True))


def start_in_stages(
    flight: Flight,
    first: Mapping[NodeSpec, Node],
    second: Callable[[float, float], Sequence[Action]],
    *,
    beside: Sequence[Action] = (),
    publishes: Collection[str] = LOOP_INPUTS,
) -> list[Action]:
    """Start the nodes `first` of a flight and `beside`, and then run the actions of `second`.

    `second` is called when these nodes are ready. It gets the time until t = 0 and the system time
    of t = 0, s. The flight ends early if a node is not ready after READY_TIMEOUT. It also ends
    early if another flight is under way. This is seen if a topic in `publishes` has a publisher
    before any node starts. Raises ParameterError in simulated time, because the instant of t = 0 is
    unknown then.
    """
    require(
        not flight.has_sim_time,
        SIM_TIME,
        "true by SetParameter",
        "false: fly.launch.py and fleet.launch.py alone fly by /clock, and `rise-di fly --bridge`",
    )
    _subscribe_states(flight)
    leave_outcome(flight.run, INTERRUPTED)  # until another outcome replaces it
    if flight.run.name:
        link_latest(flight.run)
    begin = time.monotonic() + DISCOVERY_TIME
    waiting = dict.fromkeys(first)  # nodes in order

    def ready(spec: NodeSpec) -> Sequence[Action]:
        del waiting[spec]
        lead = start_lead(time.monotonic() - begin)
        if waiting:
            return ()
        return flight.in_scope(second(lead, start_instant(lead, time.time())))

    def require_ready(context: LaunchContext) -> Sequence[Action] | None:
        if not waiting:
            return None
        names = ", ".join(spec.executable for spec in waiting)
        return flight.fail(never_flew(f"{names} not ready after {READY_TIMEOUT:g} s"))

    def start(context: LaunchContext) -> list[Action]:
        topics = [f"{flight.namespace}/{topic}" for topic in LOOP_INPUTS if topic in publishes]
        try:
            require_no_publishers(get_ros_node(context), topics, FREE_DOMAIN)
        except ParameterError as error:
            return flight.fail(never_flew(str(error)))
        nodes = flight.in_scope([*first.values(), *beside])
        return [*nodes, flight.after(READY_TIMEOUT, require_ready)]

    handlers = [
        on_state(flight, spec, NodeState.READY, lambda spec=spec: ready(spec)) for spec in first
    ]
    return [*handlers, flight.after(DISCOVERY_TIME, start)]


def begin_when_matched(
    flight: Flight, nodes: Sequence[NodeSpec], duration: float, *, by_rosbag2: bool, flies: bool
) -> list[Action]:
    """Begin the flight when each node is ready and each input of a node has a publisher.

    t = 0 is published on the topic `start`. The flight ends when the log holds y, y_m and u up to
    `duration`, s. With rosbag2 it ends when u has the stamp of this instant. The flight ends early
    if a node is not ready, or lacks a publisher, for too long. If `flies` is True, the simulated
    aircraft is one of the nodes, and the flight also ends early if this aircraft takes no u.
    """
    begin = _Begin(flight, nodes, duration, flies=flies)
    return [
        _complete_at(flight, begin.held, by_rosbag2=by_rosbag2),
        *(
            on_state(flight, spec, NodeState.MATCHED, partial(begin.matched, spec))
            for spec in nodes
        ),
        on_state(flight, AIRCRAFT, NodeState.FLYING, begin.fly),
        flight.after(READY_TIMEOUT, begin.require_matched),
    ]


class _Begin:
    """Begins a flight on the topic `start`, and ends a flight that cannot begin."""

    def __init__(
        self, flight: Flight, nodes: Sequence[NodeSpec], duration: float, *, flies: bool
    ) -> None:
        self._flight = flight
        self._duration = duration
        self._waiting = dict.fromkeys(nodes)
        self._flies = not flies  # an aircraft of the user does not report that it has taken u
        self._start_ns = 0  # instant of t = 0; 0 before t = 0 is sent
        self._held_ns = -1  # stamp up to which the log holds y, y_m and u
        topic = f"{flight.namespace}/{START.name}"
        node = get_ros_node(flight.context)
        self._publish = node.create_publisher(START.type, topic, offered(START)).publish

    def matched(self, spec: NodeSpec) -> Sequence[Action]:
        """Note that each input of a node has a publisher. After the last node, send t = 0."""
        del self._waiting[spec]
        if self._waiting:
            return []
        self._start_ns = nanoseconds(start_instant(LEAD, time.time()))
        self._publish(instant(self._start_ns))
        return [
            self._flight.after(LEAD + FIRST_U, self._require_flight),
            self._flight.after(LEAD + self._duration + 2.0 * LOG_TIMEOUT, self._give_up),
        ]

    def fly(self) -> Sequence[Action]:
        """Note that the aircraft has taken its first u."""
        self._flies = True
        return []

    def held(self, stamp_ns: int) -> bool:
        """Note that the log is complete up to a stamp, and return whether the flight is over."""
        self._held_ns = stamp_ns
        return self._start_ns > 0 and stamp_ns >= self._start_ns + nanoseconds(self._duration)

    def require_matched(self, context: LaunchContext) -> Sequence[Action] | None:
        """End the flight if a node still waits to be ready, or for a publisher of an input."""
        if not self._waiting:
            return None
        names = ", ".join(spec.executable for spec in self._waiting)
        reason = f"not ready, or with an input without a publisher, after {READY_TIMEOUT:g} s"
        return self._flight.fail(never_flew(f"{names} {reason}; {WAITED_FOR}"))

    def _require_flight(self, context: LaunchContext) -> Sequence[Action] | None:
        if self._flies:
            return None
        reason = "y did not reach the controller, or u did not reach the aircraft"
        return self._flight.fail(never_flew(f"{reason}; {WAITED_FOR}"))

    def _give_up(self, context: LaunchContext) -> Sequence[Action]:
        held = (self._held_ns - self._start_ns) / NANOSECONDS
        return self._flight.fail(log_ends_at(held, self._duration))


def end_with_log(
    flight: Flight, lead: float, end_time: float, duration: float, *, by_rosbag2: bool
) -> list[Action]:
    """End a flight when the log holds y, y_m and u up to the system time `end_time`, s.

    If the log lacks one of these topics, for example u while a bridge is not engaged, the flight
    ends `lead` plus `duration` s from now. If the log is still growing at this time, the flight
    ends LOG_TIMEOUT later.
    """
    last = [-math.inf]  # monotonic time of the log's last change, s

    def held(stamp_ns: int) -> bool:
        last[0] = time.monotonic()
        return min(stamp_ns, time.time_ns()) >= nanoseconds(end_time)

    def end(context: LaunchContext) -> Sequence[Action]:
        if time.monotonic() < last[0] + LOG_TIMEOUT:
            return [flight.after(LOG_TIMEOUT, lambda context: flight.complete())]
        return flight.complete()

    return [
        flight.after(lead + duration, end),
        _complete_at(flight, held, by_rosbag2=by_rosbag2),
    ]


def _complete_at(
    flight: Flight, held: Callable[[int], bool], *, by_rosbag2: bool
) -> RegisterEventHandler:
    """Complete the flight when `held` is True for the stamp up to which the log is complete.

    Up to this stamp the log holds y, y_m and u. With rosbag2 the stamp of the newest u is taken.
    """
    context = flight.context

    def receive(message: Any) -> None:
        stamp = message.header.stamp if by_rosbag2 else message
        if held(stamp.sec * NANOSECONDS + stamp.nanosec) and not flight.is_over:
            context.asyncio_loop.call_soon_threadsafe(context.emit_event_sync, FlownEvent(flight))

    topic, qos = (U, NEWEST_SAMPLES) if by_rosbag2 else (RECORDED, LOCKSTEP)
    get_ros_node(context).create_subscription(
        topic.type, f"{flight.namespace}/{topic.name}", receive, qos
    )

    def end(context: LaunchContext) -> list[Action]:
        return [] if flight.is_over else flight.complete()

    on_progress = EventHandler(
        matcher=lambda event: isinstance(event, FlownEvent) and event.flight is flight,
        entities=[OpaqueFunction(function=end)],
        handle_once=True,
    )
    return RegisterEventHandler(on_progress)


def _subscribe_states(flight: Flight) -> None:
    """Emit a NodeStateEvent each time a node of this launch publishes its state.

    launch_ros.actions.LifecycleNode does the same with lifecycle states.
    """

    def receive(message: KeyValue) -> None:
        node, _, pid = message.key.rpartition("#")
        if pid.isdecimal() and _is_descendant(int(pid)) and not flight.is_over:
            context.asyncio_loop.call_soon_threadsafe(reach, node, message.value)

    def reach(node: str, state: str) -> None:
        # This runs in the thread of the launch, as `on_state` does. So a state that `on_state` does
        # not find in `flight.states` still comes as an event.
        flight.states[node] = state
        context.emit_event_sync(NodeStateEvent(node, state))

    context = flight.context
    transport.prepare()  # before the first rclpy.init of this process
    ros_node = get_ros_node(context)
    ros_node.create_subscription(
        NODE_STATE.type, f"{flight.namespace}/{NODE_STATE.name}", receive, STATES
    )
    # At shutdown, launch_ros waits for its executor before it stops the nodes. This takes up to 1 s
    # if no timer wakes the executor.
    ros_node.create_timer(SHUTDOWN_DELAY, lambda: None)


def _is_descendant(pid: int) -> bool:
    """Return whether this launch has started a process, directly or behind a launch prefix.

    The processes of another flight in the same namespace were not started by this launch.
    """
    with suppress(psutil.Error):
        return os.getpid() in {parent.pid for parent in psutil.Process(pid).parents()}
    return False
