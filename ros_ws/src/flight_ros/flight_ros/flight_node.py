# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Base class of all nodes: parameters, topics, ticks, overruns, diagnostics, clean shutdown."""

import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Generic, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from flight_core.outcome import LostContact, joined
from flight_core.parameters import NodeConfig, ParameterError, flatten, require
from flight_core.publisher_lock import LockstepLock, PublisherLock
from flight_core.rates import NANOSECONDS, nanoseconds, seconds
from flight_core.text import bounded
from flight_ros.clocks import PeerClocks
from flight_ros.endpoints import EndpointMonitor
from flight_ros.liveliness import LivelinessMonitor
from flight_ros.messages import Encoder
from flight_ros.parameters import changed, read_parameters
from flight_ros.rclpy_private import refuse_foreign_parameters
from flight_ros.receiver import Receiver, Refusals, Sample
from flight_ros.simulated_time import SimulatedTime
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import HostTime, Tick, TickTimes
from flight_ros.topics import (
    DIAGNOSTICS,
    LOCKSTEP,
    NEWEST_SAMPLES,
    NODE_STATE,
    START,
    NodeState,
    Topic,
    offered,
    publisher_qos,
)

P = TypeVar("P", bound=NodeConfig)
S = TypeVar("S", bound=Sample)

# time for the processes of a flight to start, one after another
NO_PUBLISHER_WARNING_NS = 3 * NANOSECONDS

# time for the last messages of a lockstep flight to arrive
ACKNOWLEDGE_TIMEOUT = Duration(seconds=0.5)

WAITING_PERIOD_NS = 2 * NANOSECONDS  # time between two warnings about a topic without samples

# A late node catches up with its missed ticks, but it ignores a start that is older than this.
MAX_START_AGE_NS = 10 * NANOSECONDS

SIM_TIME = "use_sim_time"
AT_START = "no change: a node chooses its clock when it starts"

# slewing changes a clock by less than 0.01 s in the second between two checks
CLOCK_STEP_NS = NANOSECONDS // 20


class FlightNode(Node, Generic[P]):
    """A node with fixed ticks or in lockstep.

    A subclass defines the rate, and the work of a tick or a step.
    """

    def __init__(self, name: str, schema: type[P]) -> None:
        Node.__init__(self, name, automatically_declare_parameters_from_overrides=True)
        self.parameters = read_parameters(self, schema)
        self.add_on_set_parameters_callback(self._change_parameters)
        refuse_foreign_parameters(self)
        self.peers = LivelinessMonitor(self, name) if self.parameters.lockstep else None
        # Two equal lockstep flights must give equal bytes, so the process number is left out.
        process = "" if self.parameters.lockstep else f"#{os.getpid()}"
        self.instance = self.get_fully_qualified_name() + process
        self.refusals = Refusals(self, self.clock_of)
        self.endpoints = EndpointMonitor(self)
        is_simulated = self.get_parameter(SIM_TIME).value and not self.parameters.lockstep
        self.simulated = SimulatedTime(self, self.refusals) if is_simulated else None
        self.host: HostTime = self.simulated or time  # the source of the time of the ticks
        self.clocks = (
            None
            if is_simulated or self.parameters.lockstep
            else PeerClocks(self, self.instance, self.refusals)
        )
        self.polled_subscriptions: list[PolledSubscription] = []
        self.receivers: list[Receiver[Any]] = []
        self._flight_publishers: list[Publisher] = []
        # by topic, the instants of the last call of `warn_no_publisher` and of its next log line
        self._waiting: dict[str, tuple[int, int]] = {}
        self._diagnostics = self.create_publisher(
            DIAGNOSTICS.type, DIAGNOSTICS.name, offered(DIAGNOSTICS)
        )
        self._node_state = self.create_publisher(
            NODE_STATE.type, NODE_STATE.name, offered(NODE_STATE)
        )
        is_start_awaited = (
            getattr(self.parameters, "start_time", 0.0) < 0.0 and not self.parameters.lockstep
        )
        self._start_subscription = (
            PolledSubscription(self, START, offered(START), raw=True) if is_start_awaited else None
        )
        self._is_matched = False
        self._adopted: P | None = None
        self._tick_times = TickTimes()
        self.time_offset_ns = 0  # time of the ticks minus the monotonic clock
        self._clock_step_ns = 0  # last logged step of the system clock

    # Defined by a subclass

    def period_ns(self) -> int:
        """Return the period of the ticks."""
        raise NotImplementedError

    def inputs(self) -> Sequence[PolledSubscription]:
        """Return the subscriptions that need a publisher before a flight begins in real time."""
        return ()

    def is_waiting_for_start(self) -> bool:
        """Return whether the topic `start` gives the instant of tick 0."""
        return self._start_subscription is not None

    def has_time(self) -> bool:
        """Return whether the time of the ticks is known.

        Simulated time is known from the first message of /clock on.
        """
        return self.host is not self.simulated or self.simulated.is_known()

    def start_ns(self) -> int | None:
        """Return the system time of tick 0, ns, which depends on the parameter `start_time`.

        If `start_time` is -1, the topic `start` gives the instant, and the result is None until its
        message comes. If `start_time` is 0, tick 0 is at the next whole period of the system clock,
        so that nodes with equal rates tick together.
        """
        start_time = getattr(self.parameters, "start_time", 0.0)
        if start_time < 0.0:
            return self._received_start_ns()
        return nanoseconds(start_time) or self.next_period_ns()

    def tick(self, tick: Tick, now_ns: int) -> None:
        """Run a tick; `now_ns` is the nominal instant of tick.number by the system clock."""
        raise NotImplementedError

    def advance(self) -> bool:
        """Take all lockstep steps whose messages have come, and return whether there was one."""
        raise NotImplementedError

    def awaited_topic(self) -> str | None:
        """Return the topic whose next message the node awaits in lockstep, or None for no topic."""
        return None

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        """Return the level of the 1 Hz diagnostics, a sentence, and further values by name."""
        return DiagnosticStatus.OK, "running", {}

    def close(self) -> None:
        """Clean up when the node ends, also after an error; called once."""

    def on_parameters(self, parameters: P) -> None:
        """Take a valid new set of parameters in flight, before it becomes `self.parameters`.

        A subclass raises ParameterError to refuse the set.
        """

    # Used by a subclass

    def create_publisher(self, *args: Any, **kwargs: Any) -> Publisher:
        """Create a publisher as rclpy does, but without its callbacks for peers that do not match.

        `EndpointMonitor` reports such peers. With callbacks, an executor would ask for two events
        of each publisher whenever it looks for a request.
        """
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        return super().create_publisher(*args, event_callbacks=quiet, **kwargs)

    def next_period_ns(self) -> int:
        """Return the next instant at a whole period of the system clock, ns."""
        now_ns = self.host.time_ns()
        period_ns = self.period_ns()
        return now_ns - now_ns % period_ns + period_ns

    def advertise(self, topic: Topic) -> Callable[[bytes], None]:
        """Create a publisher of serialised messages on a topic of the flight.

        Returns the function that publishes a message.
        """
        qos = LOCKSTEP if self.parameters.lockstep else publisher_qos(self.period_ns())
        publisher = self.create_publisher(topic.type, topic.name, qos)
        self._flight_publishers.append(publisher)
        return publisher.publish

    def subscribe(self, topic: Topic, qos: QoSProfile | None = None) -> PolledSubscription:
        """Create a subscription to serialised messages that is polled at the tick.

        Its publishers are checked once a second.
        """
        default = LOCKSTEP if self.parameters.lockstep else NEWEST_SAMPLES
        subscription = PolledSubscription(self, topic, qos or default, raw=True)
        self.polled_subscriptions.append(subscription)
        return subscription

    def receive(
        self,
        topic: Topic,
        decode: Callable[[bytes], S | None],
        take: Callable[[S, int], None],
        *,
        max_age_ns: Callable[[], int] | None,
        lock: PublisherLock | None = None,
        qos: QoSProfile | None = None,
        max_size: int | None = None,
    ) -> Receiver[S]:
        """Create a subscription, and a `Receiver` that checks and takes its samples.

        If this node overruns, this time is not seen as silence of the publisher.
        """
        subscription = self.subscribe(topic, qos)
        receiver = Receiver(
            subscription,
            self.refusals,
            decode,
            take,
            lock=lock,
            max_age_ns=max_age_ns,
            max_size=max_size,
        )
        self.receivers.append(receiver)
        return receiver

    def publisher_lock(self, timeouts_ns: Callable[[], tuple[int, int]]) -> PublisherLock:
        """Create the publisher lock of a topic. A lock in lockstep has no timeouts."""
        return LockstepLock() if self.parameters.lockstep else PublisherLock(timeouts_ns)

    def encoder(self, names: Sequence[str]) -> Encoder:
        """Create an encoder for the samples of the node."""
        return Encoder(names, self.instance)

    def now_ns(self) -> int:
        """Return the time of the ticks, ns.

        It is the system clock at the start of the node plus the monotonic time since then.
        """
        return self.host.monotonic_ns() + self.time_offset_ns

    def clock_step_ns(self) -> int:
        """Return by how much the system clock has stepped ahead of the time of the ticks, ns.

        A lead of less than CLOCK_STEP_NS is no step of the clock, and the result is 0.
        """
        step_ns = self.host.time_ns() - self.now_ns()
        return step_ns if abs(step_ns) > CLOCK_STEP_NS else 0

    def adopt(self, parameters: P) -> None:
        """Replace the parameters by a set that the node itself has chosen, such as a learned model.

        A parameter event reports the new set. The set must be valid, because it is not checked.
        """
        before, after = (
            dict(flatten(values.model_dump())) for values in (self.parameters, parameters)
        )
        changes = [
            Parameter(
                name, value=list(value) if isinstance(value := after.get(name), tuple) else value
            )
            for name in before | after
            if before.get(name) != after.get(name)
        ]
        for change in changes:
            if not self.has_parameter(change.name):
                self._adopted = self.parameters  # declared without a check
                self.declare_parameter(change.name, None, ParameterDescriptor(dynamic_typing=True))
        self._adopted = parameters
        self.set_parameters_atomically(changes)

    def clock_of(self, sender: str) -> str | None:
        """Return what `PeerClocks.sentence_on` says, or None if this node compares no clocks."""
        return None if self.clocks is None else self.clocks.sentence_on(sender)

    def warn_no_publisher(
        self, subscription: PolledSubscription, lack: str = "no publisher"
    ) -> None:
        """Warn of a topic without samples. Call this at each tick without a sample.

        The warning is logged after 3 s, and then every 2 s. If the topic has no publisher, the
        warning gives `lack` as the cause. A publisher that sends nothing may be a node that waits
        for `start`. So the warning also says if a node waits for `start` and nobody publishes it.
        """
        now_ns = time.monotonic_ns()
        last_ns, log_ns = self._waiting.get(subscription.name, (0, 0))
        if now_ns - last_ns > NANOSECONDS:  # the first call after a sample
            log_ns = now_ns + NO_PUBLISHER_WARNING_NS
        self._waiting[subscription.name] = (
            now_ns,
            log_ns if now_ns < log_ns else now_ns + WAITING_PERIOD_NS,
        )
        if now_ns < log_ns:
            return
        cause = self.refusals.since(subscription, now_ns - NO_PUBLISHER_WARNING_NS)
        if cause is None and self.count_publishers(subscription.name):
            lack = "no sample of its publisher arrives"
            if self.count_subscribers(START.name) and not self.count_publishers(START.name):
                lack += f"; a node waits for the topic {START.name}, which nobody publishes"
            cause = joined(self.endpoints.mismatches(subscription))
        self.get_logger().warning(f"waiting for {subscription.name}: {cause or lack}")

    def _change_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        """Accept a change of tunable parameters as a whole, or reject it with a sentence.

        After a rejection, all parameters keep their values.
        """
        if self._adopted is not None:
            self.parameters = self._adopted
            self._adopted = None
            return SetParametersResult(successful=True)
        try:
            sim_time = self.get_parameter(SIM_TIME).value
            is_same = all(change.value == sim_time for change in changes if change.name == SIM_TIME)
            require(is_same, f"{self.get_name()}.{SIM_TIME}", not sim_time, AT_START)
            parameters = changed(self, self.parameters, changes)
            self.on_parameters(parameters)
        except ParameterError as error:
            self.get_logger().warning(f"parameters rejected: {error}")
            return SetParametersResult(successful=False, reason=str(error))
        for change in changes:
            old = self.get_parameter_or(change.name).value
            self.get_logger().info(bounded(f"{change.name}: {old} -> {change.value}"))
        self.parameters = parameters
        return SetParametersResult(successful=True)

    # Called by the event loop

    def _received_start_ns(self) -> int | None:
        """Return the instant from the topic `start`, ns, or None if no recent instant has come.

        An old instant belongs to an earlier flight.
        """
        if self._start_subscription is None:
            return None
        if messages := self._start_subscription.take():
            self.endpoints.check_publishers(self._start_subscription)
        instants = self.refusals.stamps(self._start_subscription, messages)
        oldest_ns = self.host.time_ns() - MAX_START_AGE_NS
        return next((stamp_ns for stamp_ns in instants if stamp_ns > oldest_ns), None)

    def match(self) -> None:
        """Publish once, in real time, that every input of this node has a publisher: MATCHED."""
        awaited = [
            *self.inputs(),
            *([self._start_subscription] if self._start_subscription is not None else []),
        ]
        if not self._is_matched and all(
            subscription.entity.get_publisher_count() for subscription in awaited
        ):
            self._is_matched = True
            self.publish_state(NodeState.MATCHED)

    def run_tick(self, tick: Tick, now_ns: int) -> None:
        """Run a tick, and measure the period, the compute time and the overruns."""
        self._tick_times.begin(tick)
        for receiver in self.receivers:
            if receiver.lock is not None:
                receiver.lock.overran(tick.missed * self.period_ns())
        self.tick(tick, now_ns)
        self._tick_times.end()

    def check_clock(self) -> None:
        """Log an error after a step of the system clock.

        This node keeps its time, but a node that starts later uses the new time.
        """
        step_ns = self.host.time_ns() - self.now_ns()
        if abs(step_ns - self._clock_step_ns) > CLOCK_STEP_NS:
            is_restored = abs(step_ns) <= CLOCK_STEP_NS
            advice = (
                "it is correct again"
                if is_restored
                else "this node keeps its own time; restart all nodes or none"
            )
            self.get_logger().error(
                f"the system clock was set by {seconds(step_ns - self._clock_step_ns):+.3f} s: "
                f"{advice}"
            )
            self._clock_step_ns = step_ns

    def compare_clocks(self) -> None:
        """Exchange clock differences with the other nodes.

        A warning is logged when another clock begins to differ from the clock of this node, and
        when the two agree again.
        """
        if self.clocks is not None:
            self.clocks.exchange(time.time_ns() - self.now_ns())
            for sentence in self.clocks.news():
                self.get_logger().warning(sentence)

    def warn_without_time(self) -> None:
        """Log a warning as long as no /clock comes in simulated time."""
        if self.simulated is not None and self.simulated.is_silent():
            self.warn_no_publisher(self.simulated.subscription)

    def graph_checks(self) -> list[Callable[[], None]]:
        """Return the checks of the graph, one for each topic.

        One check for all topics would take about a period of 2 ms, because it asks the middleware.
        A check logs an error for a peer with a wrong message type or an incompatible QoS, because
        such a topic would stay silent.
        """
        return [
            *(
                partial(self.endpoints.check_subscribers, publisher)
                for publisher in self._flight_publishers
            ),
            *(
                partial(self.endpoints.check_publishers, subscription)
                for subscription in self.polled_subscriptions
            ),
        ]

    def is_in_lockstep(self) -> bool:
        """Return whether the event loop calls `advance` in lockstep instead of `tick`."""
        return self.parameters.lockstep

    def require_flight(self) -> None:
        """Check that the flight can go on. Raises FlightEnded if a peer in lockstep is lost.

        The other peers get a report of the loss. In simulated time, raises ClockRestarted after a
        jump of /clock.
        """
        if self.simulated is not None:
            self.simulated.require_one_simulation()
        if self.peers is not None and (role := self.peers.lost_role()) is not None:
            self.peers.report(role)
            raise LostContact(f"lost contact with {role}")

    def finish(self) -> None:
        """End the node. In lockstep, first wait until its last messages have arrived."""
        self.close()
        if self.parameters.lockstep and not (self.peers and self.peers.lost_role()):
            for publisher in self.publishers:
                publisher.wait_for_all_acked(ACKNOWLEDGE_TIMEOUT)

    def publish_state(self, state: NodeState) -> None:
        """Publish the state of this node on `node_state`.

        The key contains the process number, in lockstep too, so that a subscriber can distinguish
        the nodes of two flights.
        """
        self._node_state.publish(
            KeyValue(key=f"{self.get_fully_qualified_name()}#{os.getpid()}", value=state)
        )

    def publish_diagnostics(self) -> None:
        """Publish the 1 Hz report.

        The report has the loop period, the compute time, missed ticks (overruns), rejected samples
        and more.
        """
        level, sentence, further = self.status()
        if conflict := self.refusals.pop_conflict():
            level = DiagnosticStatus.ERROR
            sentence = str(conflict)
        refused = {f"refused {reason}": count for reason, count in self.refusals.counts.items()}
        clocks = {} if self.clocks is None else self.clocks.report()
        report: dict[str, object] = {**self._tick_times.report(), **refused, **further, **clocks}
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self.instance
        message.status = [
            DiagnosticStatus(
                level=level,
                name=self.get_fully_qualified_name(),
                message=sentence,
                # stable, so that an aggregator sees one device also after a restart
                hardware_id=self.get_fully_qualified_name(),
                values=[KeyValue(key=key, value=str(value)) for key, value in report.items()],
            )
        ]
        self._diagnostics.publish(message)
