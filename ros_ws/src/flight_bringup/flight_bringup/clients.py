# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What the command line needs of ROS: a monitor of a running flight, a player of a log, the four nodes in one process."""

import os
import time
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple, Self

import rclpy
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool

from flight_core.parameters import ParameterError, require
from flight_core.rates import seconds
from flight_core.vectors import ChannelError, FloatArray
from flight_ros import transport
from flight_ros.messages import Decoder, stamp_of
from flight_ros.player import Player
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import INTERNALS, LOCKSTEP, NEWEST_SAMPLES, RECORDED, Y_M, U, Y
from rise_di_controller.guard import Mode

MODES = {float(mode): mode.name for mode in Mode}


class ControllerStatus(NamedTuple):
    """The newest of the controller's internals."""

    mode: str
    e: FloatArray


class FlightMonitor:
    """Listens to `internals`. A context manager, so that the middleware is always shut down."""

    def __init__(self, outputs: tuple[str, ...], *, lockstep: bool) -> None:
        transport.prepare()
        # Ctrl-C is for the runner to handle, not for rclpy.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node("monitor", start_parameter_services=False)
        # In lockstep every listener costs time, so it listens to the recorder alone.
        self._inbox = None if lockstep else PolledSubscription(self._node, INTERNALS, NEWEST_SAMPLES, raw=True)
        self._recorded_subscription = PolledSubscription(self._node, RECORDED, LOCKSTEP, raw=True)
        self._decoder = Decoder(("mode", *(f"e.{output}" for output in outputs)))

    def __enter__(self) -> "FlightMonitor":
        return self

    def __exit__(self, *_: object) -> None:
        self._node.destroy_node()
        rclpy.try_shutdown()

    def newest(self) -> ControllerStatus | None:
        """The newest sample since the last call, None where none has come."""
        seen = None
        for received in self._inbox.take() if self._inbox is not None else ():
            try:
                sample = self._decoder.decode(received.message)
            except ChannelError:
                continue
            if sample is not None:
                seen = ControllerStatus(MODES.get(sample.value[0], "?"), sample.value[1:])
        return seen

    def recorded(self) -> float | None:
        """The flight time up to which a lockstep flight is in its log, s; None where that has not changed."""
        recorded = None
        for received in self._recorded_subscription.take():
            recorded = seconds(stamp_of(received.message))
        return recorded

    def require_free_domain(self) -> None:
        """Raise ParameterError where an aircraft or a reference model is already there, which would fly into this flight."""
        for topic in (Y, Y_M):
            count = self._node.count_publishers(topic.name)
            domain = os.environ.get("ROS_DOMAIN_ID", "0")
            found = f"{count} publishers of {topic.name} already"
            require(count == 0, f"ROS_DOMAIN_ID {domain}", found, "a domain of its own for each flight: set ROS_DOMAIN_ID")


PATIENCE = 10.0
"""s, for a node to answer, and for u to come to rest."""

AT_REST = 20
"""Samples of u alike in a row: it no longer goes to trim."""


class EngagementClient:
    """Takes an autopilot over through a running bridge, and gives it back. A context manager, as the monitor is."""

    def __init__(self, namespace: str) -> None:
        transport.prepare()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node("engage", namespace=namespace, start_parameter_services=False)
        self._u: list[tuple[float, ...]] = []
        self._inbox = PolledSubscription(self._node, U, NEWEST_SAMPLES, raw=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._node.destroy_node()
        rclpy.try_shutdown()

    def take_over(self) -> str:
        """The controller to trim, the bridge engaged, the controller active; why the bridge refused, empty where not."""
        state = self._call(GetState, "controller/get_state", GetState.Request()).current_state.id
        if state == State.PRIMARY_STATE_ACTIVE:
            self._change(Transition.TRANSITION_DEACTIVATE)
        try:
            self._u.clear()
            self._until(self._at_rest, "u does not come to rest, expected the controller's u to go to trim")
            refusal = self._engage(on=True)
        except ParameterError:
            self._restore(state)
            raise
        if refusal:
            self._restore(state)
        else:
            self._change(Transition.TRANSITION_ACTIVATE)
        return refusal

    def give_back(self) -> str:
        """The bridge disengaged; why it refused, empty where not."""
        return self._engage(on=False)

    def _restore(self, state: int) -> None:
        if state == State.PRIMARY_STATE_ACTIVE:
            self._change(Transition.TRANSITION_ACTIVATE)

    def _engage(self, *, on: bool) -> str:
        return str(self._call(SetBool, "bridge/engage", SetBool.Request(data=on)).message)

    def _change(self, transition: int) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        done = self._call(ChangeState, "controller/change_state", request).success
        require(done, "controller", "a lifecycle transition that fails", "a controller that is configured; see its log")

    def _at_rest(self) -> bool:
        for received in self._inbox.take():
            self._u.append(tuple(deserialize_message(received.message, U.type).position))
        return len(self._u) >= AT_REST and len(set(self._u[-AT_REST:])) == 1

    def _call(self, kind: Any, name: str, request: Any) -> Any:
        client = self._node.create_client(kind, name)
        self._until(client.service_is_ready, f"nobody offers {client.srv_name}, expected a flight with a bridge in this domain")
        future = client.call_async(request)
        self._until(future.done, f"{client.srv_name} does not answer, expected it within {PATIENCE:g} s")
        return future.result()

    def _until(self, condition: Callable[[], bool], sentence: str) -> None:
        deadline = time.monotonic() + PATIENCE
        while not condition():
            if time.monotonic() > deadline:
                raise ParameterError(sentence)
            rclpy.spin_once(self._node, timeout_sec=0.02)


def player(types: Mapping[str, str], shared: Collection[str]) -> Player:
    """A player of topics, by their names with their types; see flight_ros.player. Raises ParameterError."""
    return Player(types, shared)
