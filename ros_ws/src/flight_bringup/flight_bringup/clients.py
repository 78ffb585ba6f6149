# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS clients of the command line: a monitor of a flight, clients of controller, bridge and guidance, a player of a log."""

import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Self

import numpy as np
import rclpy
from geometry_msgs.msg import Point, Pose, PoseStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Path
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger

from flight_core.modes import Mode
from flight_core.parameters import ParameterError, require
from flight_core.rates import seconds
from flight_core.vectors import ChannelError, FloatArray
from flight_guidance.modes import TARGETS
from flight_guidance.odometry import MAP
from flight_ros import transport
from flight_ros.messages import Decoder, Encoder, NamedDecoder, stamp_of
from flight_ros.player import Player
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import (
    ENGAGEMENT,
    GUIDANCE,
    INTERNALS,
    LOCKSTEP,
    NEWEST_SAMPLES,
    NODE_STATE,
    PUBLISH,
    RECORDED,
    ROUTE,
    STATES,
    TARGET,
    Y_M,
    NodeState,
    U,
    Y,
)

__all__ = ["ControlClient", "EngagementClient", "FlightMonitor", "Player", "TargetClient"]

MODES = {float(mode): mode.name for mode in Mode}

ENGAGE, ENGAGE_BLIND = "bridge/engage", "bridge/engage_blind"  # the services of a bridge
SERVICE_TIMEOUT, WITHDRAW_TIMEOUT = 10.0, 1.0  # s
TARGET_TIMEOUT = 3.0  # s, in which guidance takes a target at its ticks
ROUTE_TIMEOUT = 3.0  # s, in which the middleware of guidance confirms a route
ROUTE_POLL_PERIOD = Duration(seconds=0.05)
TARGET_PERIOD = 0.2  # s, between two equal targets
FIRST_U = 30.0  # s: the nodes of a flight start, and the autopilot may send its first messages late
AT_REST = 20  # so many equal samples of u in a row: it has reached trim


class _Client:
    """A node in the default context, or that of a `parent`, whose cancellation ends the waits of both.

    A context manager: the middleware always shuts down.
    """

    def __init__(self, name: str, namespace: str = "", parent: "_Client | None" = None) -> None:
        if parent is None:
            transport.prepare()
            # The command handles SIGINT, not rclpy.
            rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
            try:
                node = rclpy.create_node(name, namespace=namespace, start_parameter_services=False)
            except NameValidationException as error:
                rclpy.try_shutdown()
                raise ParameterError(f"--namespace: {' '.join(str(error).split())}") from None
            self._node, self._cancelled = node, threading.Event()
        else:
            self._node, self._cancelled = parent._node, parent._cancelled

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._node.destroy_node()
        rclpy.try_shutdown()

    def _spin_until(self, condition: Callable[[], bool], message: str, timeout: float = SERVICE_TIMEOUT) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            if self._cancelled.is_set():
                raise ParameterError("cancelled by a later request")
            if time.monotonic() > deadline:
                raise ParameterError(message)
            rclpy.spin_once(self._node, timeout_sec=0.02)

    def _call(self, kind: Any, name: str, request: Any, expected: str = "a flight") -> Any:
        client = self._node.create_client(kind, name)
        try:
            service = f"service {client.srv_name}"
            self._spin_until(client.service_is_ready, f"{service} not available, expected {expected} in this domain")
            future = client.call_async(request)
            self._spin_until(future.done, f"{service}: no response, expected one within {SERVICE_TIMEOUT:g} s")
            return future.result()
        finally:
            self._node.destroy_client(client)

    def _set_engaged(self, *, engaged: bool) -> str:
        return str(self._call(SetBool, ENGAGE, SetBool.Request(data=engaged), "a flight with a bridge").message)


class FlightMonitor(_Client):
    """Monitors a flight: the states of its nodes, the controller's internals, in lockstep the progress of the log."""

    def __init__(self, outputs: tuple[str, ...], *, lockstep: bool) -> None:
        super().__init__("monitor")
        # Each subscription slows a lockstep flight down.
        self._internals = None if lockstep else PolledSubscription(self._node, INTERNALS, NEWEST_SAMPLES, raw=True)
        self._recorded = PolledSubscription(self._node, RECORDED, LOCKSTEP, raw=True)
        self._node_state = PolledSubscription(self._node, NODE_STATE, STATES)
        self._states: dict[str, str] = {}  # by process
        self._engagement = None if lockstep else PolledSubscription(self._node, ENGAGEMENT, PUBLISH)
        self._decoder = Decoder(("mode", *(f"e.{output}" for output in outputs)))

    def is_ready(self, node: str, pid: int) -> bool:
        """Whether the loop of a node runs. The process id tells it from a node of that name in another flight."""
        for received in self._node_state.take():
            self._states[received.message.key] = received.message.value
        return self._states.get(f"/{node}#{pid}") in {NodeState.READY, NodeState.COMPLETED}

    def newest(self) -> tuple[str, FloatArray] | None:
        """Mode and e of the controller's newest sample since the last call, None without one."""
        status = None
        for received in self._internals.take() if self._internals is not None else ():
            try:
                sample = self._decoder.decode(received.message)
            except ChannelError:
                continue
            if sample is not None:
                status = MODES.get(sample.value[0], "?"), sample.value[1:]
        return status

    def engagement(self) -> list[tuple[str, str]]:
        """Phases of a bridge with their reasons, in order, since the last call."""
        messages = () if self._engagement is None else self._engagement.take()
        return [(received.message.key, received.message.value) for received in messages]

    def recorded(self) -> float | None:
        """The flight time up to which the log of a lockstep flight is complete, s; None without a change."""
        messages = self._recorded.take()
        return seconds(stamp_of(messages[-1].message)) if messages else None

    def require_free_domain(self) -> None:
        """Raise ParameterError where the domain already has an aircraft or a reference model."""
        for topic in (Y, Y_M):
            count = self._node.count_publishers(topic.name)
            domain = os.environ.get("ROS_DOMAIN_ID", "0")
            publishers = f"{count} publishers of {topic.name} already"
            require(count == 0, f"ROS_DOMAIN_ID {domain}", publishers, "a domain of its own for each flight: set ROS_DOMAIN_ID")


class EngagementClient(_Client):
    """Engages and disengages a running bridge without a jump of u (bumpless transfer)."""

    def __init__(self, namespace: str = "", parent: _Client | None = None) -> None:
        super().__init__("engage", namespace, parent)
        self._u: list[tuple[float, ...]] = []
        self._phases: list[tuple[str, str]] = []
        self._waits_for = ""  # the last reason that was reported
        self._engagement_subscription = PolledSubscription(self._node, ENGAGEMENT, PUBLISH)
        self._u_subscription = PolledSubscription(self._node, U, NEWEST_SAMPLES, raw=True)

    def engage(self, progress: Callable[[str], None], *, blind: bool = False) -> str:
        """Wait for u at trim and engage the bridge, which activates the controller. Returns the reason of a refusal, or "".

        An engaged bridge takes the request at once: the time of `max_engaged` starts again. `blind`: without regard to the loss
        of the transmitter. `progress` is called with what the bridge waits for, and with what it lacks once it is engaged. An
        engagement that is not waited for any more, as after Ctrl-C, is withdrawn: the autopilot must not change its mode later.
        """
        self._spin_until(lambda: bool(self._received_phases()), "bridge/engagement: not received, expected a running bridge")
        if self._phases[-1][0] != "ENGAGED":
            self._spin_until(lambda: bool(self._received_u()), "u: not received, expected a controller with y and y_m", FIRST_U)
            self._spin_until(self._at_rest, f"u: not at trim after {SERVICE_TIMEOUT:g} s, expected a ramp to trim")
        self._received_phases().clear()
        try:
            if refusal := self._engage_blind() if blind else self._set_engaged(engaged=True):
                return refusal
            silent = "bridge/engagement: no change, expected ENGAGED or a reason"
            self._spin_until(lambda: self._settled(progress), silent, FIRST_U)
        except BaseException:
            self._withdraw()
            raise
        phase, reason = self._phases[-1]
        if phase != "ENGAGED":
            return reason
        if reason:
            progress(f"warning: {reason}")
        return ""

    def _engage_blind(self) -> str:
        return str(self._call(Trigger, ENGAGE_BLIND, Trigger.Request(), "a flight with a bridge").message)

    def disengage(self) -> str:
        """Disengage the bridge. Returns its reason to refuse, or ""."""
        return self._set_engaged(engaged=False)

    def _withdraw(self) -> None:
        """Request to disengage, and wait for an answer at most WITHDRAW_TIMEOUT: a bridge that is stopped answers later."""
        client = self._node.create_client(SetBool, ENGAGE)
        if client.wait_for_service(WITHDRAW_TIMEOUT):
            future = client.call_async(SetBool.Request(data=False))
            rclpy.spin_until_future_complete(self._node, future, timeout_sec=WITHDRAW_TIMEOUT)
        self._node.destroy_client(client)

    def _received_u(self) -> list[tuple[float, ...]]:
        for received in self._u_subscription.take():
            self._u.append(tuple(deserialize_message(received.message, U.type).position))
        return self._u

    def _received_phases(self) -> list[tuple[str, str]]:
        """Phases of the bridge with their reasons, since the request."""
        self._phases += [(received.message.key, received.message.value) for received in self._engagement_subscription.take()]
        return self._phases

    def _settled(self, progress: Callable[[str], None]) -> bool:
        """Whether the bridge has engaged, or has given up after it began to. Reports from before the request do not count."""
        phases = [phase for phase, _ in self._received_phases()]
        while phases and phases[0] not in {"ENGAGING", "ENGAGED"}:
            del phases[0], self._phases[0]
        if phases and phases[-1] == "ENGAGING" and self._phases[-1][1] != self._waits_for:
            self._waits_for = self._phases[-1][1]
            progress(f"waiting: {self._waits_for}")
        return bool(phases) and phases[-1] != "ENGAGING"

    def _at_rest(self) -> bool:
        self._received_u()
        return len(self._u) >= AT_REST and len(set(self._u[-AT_REST:])) == 1


class TargetClient(_Client):
    """Commands the guidance of a running flight."""

    def __init__(self, namespace: str = "", parent: _Client | None = None) -> None:
        super().__init__("operator", namespace, parent)
        self._guidance, self._decoder = PolledSubscription(self._node, GUIDANCE, NEWEST_SAMPLES, raw=True), NamedDecoder()
        self._publisher = self._node.create_publisher(TARGET.type, TARGET.name, PUBLISH)
        self._sent = -TARGET_PERIOD  # monotonic time of the last target, s

    def send(self, values: Mapping[str, float]) -> str:
        """Publish commands by channel until guidance has them in force. Returns why they are not, or ""."""
        silent = f"{self._guidance.name}: not received, expected a flight with guidance in this domain"
        self._spin_until(lambda: bool(self._received()), silent)
        try:
            self._spin_until(lambda: self._published(values), "", TARGET_TIMEOUT)
        except ParameterError:
            if self._cancelled.is_set():
                raise
            return f"guidance did not take them in {TARGET_TIMEOUT:g} s; its log says why"
        return ""

    def _published(self, values: Mapping[str, float]) -> bool:
        if time.monotonic() - self._sent > TARGET_PERIOD:
            self._sent = time.monotonic()
            encoder = Encoder([*values], self._node.get_fully_qualified_name())
            self._publisher.publish(encoder.encode(time.time_ns(), np.array([*values.values()])))
        taken = sum(1 << TARGETS.index(name) for name in values)
        return any(
            int(sample.get("given", 0.0)) & taken == taken
            and all(sample.get(f"target.{name}") == value for name, value in values.items())
            for sample in self._received()
        )

    def _received(self) -> list[dict[str, float]]:
        """The channels of the samples of `guidance` since the last call."""
        samples = []
        for received in self._guidance.take():
            with suppress(ChannelError):
                samples.append(self._decoder.decode(received.message).channels)
        return samples


class ControlClient(_Client):
    """Changes a running flight for `rise-di watch --control`. Each method but `cancel` may wait, and is called by one thread.

    Methods return why something is refused, or "". They raise ParameterError where a node or its answer is missing.
    """

    NODES = ("aircraft", "bridge", "controller", "guidance")

    def __init__(self, namespace: str) -> None:
        super().__init__("control", namespace)
        self._targets: TargetClient | None = None
        self._engagement: EngagementClient | None = None

    def nodes(self) -> list[str]:
        """The nodes of the flight that can be commanded and are in the graph."""
        namespace = self._node.get_namespace()
        found = {name for name, where in self._node.get_node_names_and_namespaces() if where == namespace}
        return [name for name in self.NODES if name in found]

    def parameters(self, node: str, names: Sequence[str]) -> dict[str, Any]:
        """Values of a node's parameters; one that is not set is left out."""
        values = self._call(GetParameters, f"{node}/get_parameters", GetParameters.Request(names=list(names))).values
        found = {name: parameter_value_to_python(value) for name, value in zip(names, values, strict=False)}
        lists = {name: value.tolist() if hasattr(value, "tolist") else value for name, value in found.items()}
        return {name: value for name, value in lists.items() if value is not None}

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> str:
        """Set parameters of a node together, or none of them."""
        request = SetParametersAtomically.Request()
        request.parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        result = self._call(SetParametersAtomically, f"{node}/set_parameters_atomically", request).result
        return "" if result.successful else str(result.reason)

    def activate(self, *, active: bool) -> str:
        """Activate or deactivate the controller."""
        number = Transition.TRANSITION_ACTIVATE if active else Transition.TRANSITION_DEACTIVATE
        request = ChangeState.Request(transition=Transition(id=number))
        response = self._call(ChangeState, "controller/change_state", request)
        return "" if response.success else f"the controller is {'active' if active else 'inactive'} already"

    def send_target(self, values: Mapping[str, float]) -> str:
        """Command guidance, as `rise-di target`."""
        self._targets = self._targets or TargetClient(parent=self)
        return self._targets.send(values)

    def send_route(self, points: Sequence[Sequence[float]]) -> str:
        """Publish a route of waypoints, each north, east and altitude in m."""
        places = [Point(x=float(east), y=float(north), z=float(altitude)) for north, east, altitude in points]
        route = Path(poses=[PoseStamped(pose=Pose(position=place)) for place in places])
        route.header.frame_id = MAP
        publisher = self._node.create_publisher(ROUTE.type, ROUTE.name, PUBLISH)
        try:
            subscribed = f"{publisher.topic_name}: no subscriber, expected a flight with guidance in this domain"
            self._spin_until(lambda: self._reaches_guidance(publisher), subscribed)
            publisher.publish(route)
            unconfirmed = f"guidance did not confirm its reception in {ROUTE_TIMEOUT:g} s"
            self._spin_until(lambda: publisher.wait_for_all_acked(ROUTE_POLL_PERIOD), unconfirmed, ROUTE_TIMEOUT)
        finally:
            self._node.destroy_publisher(publisher)  # else guidance that starts later would receive the route, and fly it
        return ""

    def _reaches_guidance(self, publisher: Publisher) -> bool:
        """Whether guidance is among the subscribers in the graph, and each of them has been matched."""
        known = [endpoint.node_name for endpoint in self._node.get_subscriptions_info_by_topic(publisher.topic_name)]
        return "guidance" in known and len(known) <= publisher.get_subscription_count()

    def hold(self) -> str:
        """Hold heading, altitude and airspeed of now."""
        return str(self._call(Trigger, "guidance/hold", Trigger.Request(), "a flight with guidance").message)

    def skip(self) -> str:
        """Fly the next leg."""
        return str(self._call(Trigger, "guidance/skip", Trigger.Request(), "a flight with guidance").message)

    def engage(self) -> str:
        """Engage the bridge, as `rise-di engage`."""
        self._engagement = self._engagement or EngagementClient(parent=self)
        return self._engagement.engage(lambda reason: None)

    def disengage(self) -> str:
        """Disengage the bridge."""
        return self._set_engaged(engaged=False)

    def cancel(self) -> None:
        """End the wait of the method that runs, from another thread."""
        self._cancelled.set()

    def resume(self) -> None:
        """Wait again, after `cancel`."""
        self._cancelled.clear()

    def note(self, text: str) -> None:
        """Write a line to the log of the flight."""
        self._node.get_logger().info(text)
