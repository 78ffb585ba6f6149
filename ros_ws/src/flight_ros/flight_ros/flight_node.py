# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Base class of every node: parameters, topics, ticks, overruns, diagnostics, clean shutdown."""

import math
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Generic, TypeVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.topic_endpoint_info import TopicEndpointInfo

from flight_core.outcome import LOST_CONTACT, FlightEnded
from flight_core.parameters import NodeConfig, ParameterError
from flight_core.publisher_lock import SENDER, PublisherLock
from flight_core.rates import NANOSECONDS, seconds
from flight_core.vectors import ChannelError, StampedVector
from flight_ros.endpoints import mismatch, type_name
from flight_ros.liveliness import LivelinessMonitor
from flight_ros.messages import Decoder, Encoder
from flight_ros.parameters import changed, read_parameters
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import Tick
from flight_ros.topics import DIAGNOSTICS, LOCKSTEP, NEWEST_SAMPLES, NODE_STATE, PUBLISH, STATE, NodeState, Topic, publisher_qos

P = TypeVar("P", bound=NodeConfig)

NO_PUBLISHER_WARNING_NS = 3 * NANOSECONDS  # the processes of a flight start one after another

ACKNOWLEDGE_TIMEOUT = Duration(seconds=0.5)  # at the end of a lockstep flight, for the last messages to arrive

LOG_THROTTLE_NS = 2 * NANOSECONDS  # between two equal messages of the log

MISMATCH_THROTTLE_NS = 5 * NANOSECONDS

CLOCK_STEP_NS = NANOSECONDS // 20  # slewing moves a clock by less than 0.01 s in the second between two checks


class FlightNode(Node, Generic[P]):
    """A node that runs at fixed ticks or in lockstep. A subclass defines its rate and the work of one tick or step."""

    def __init__(self, name: str, schema: type[P]) -> None:
        Node.__init__(self, name, automatically_declare_parameters_from_overrides=True)
        self.parameters = read_parameters(self, schema)
        if self.parameters.tunable():
            self.add_on_set_parameters_callback(self._change_parameters)
        self.peers = LivelinessMonitor(self, name) if self.parameters.lockstep else None
        # Two equal lockstep flights give equal bytes, so the process number is left out.
        process = "" if self.parameters.lockstep else f"#{os.getpid()}"
        self.instance = self.get_fully_qualified_name() + process
        self.rejected: Counter[str] = Counter()
        self.refusals: dict[str, tuple[int, str]] = {}  # the last one by topic: when on the monotonic clock, and why
        self._logged_ns: dict[str, int] = {}  # by message: when it was logged last
        self._conflict = ""  # the last sample of a conflicting publisher since the last report
        self.polled_subscriptions: list[PolledSubscription] = []
        self._flight_publishers: list[Publisher] = []
        self._waiting: dict[str, tuple[int, int]] = {}  # by topic: last call, and when to log it next
        self._diagnostics = self.create_publisher(DIAGNOSTICS.type, DIAGNOSTICS.name, PUBLISH)
        self._node_state = self.create_publisher(NODE_STATE.type, NODE_STATE.name, STATE)
        self._periods: list[int] = []
        self._compute: list[int] = []
        self._missed = 0
        self.publisher_locks: tuple[PublisherLock, ...] = ()  # of a node's topics
        self._last_tick_ns: int | None = None
        self.time_offset_ns = 0  # of the time of the ticks from the monotonic clock
        self._clock_step_ns = 0  # of the system clock since the start

    # Defined by a subclass

    def period_ns(self) -> int:
        """The period of the ticks."""
        raise NotImplementedError

    def start_ns(self) -> int:
        """System time of tick 0, ns: the next whole period of the system clock, so that nodes of equal rates tick together."""
        now_ns, period_ns = time.time_ns(), self.period_ns()
        return now_ns - now_ns % period_ns + period_ns

    def tick(self, tick: Tick, now_ns: int) -> None:
        """One tick; `now_ns` is the nominal instant of tick.number on the system clock's scale."""
        raise NotImplementedError

    def advance(self) -> bool:
        """Lockstep: take every step that the received messages allow. Returns whether there was one."""
        raise NotImplementedError

    def awaited_topic(self) -> str:
        """Lockstep: the topic whose next message this node waits for; empty if it waits for none."""
        return ""

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        """Level, sentence and further values of the 1 Hz diagnostics."""
        return DiagnosticStatus.OK, "running", {}

    def close(self) -> None:
        """Called once when the node ends, also after an error."""

    def on_parameters(self, parameters: P) -> None:
        """Called with a valid new set in flight, before it becomes `self.parameters`. A ParameterError refuses it."""

    # Used by a subclass

    def advertise(self, topic: Topic) -> Callable[[bytes], None]:
        """Create a publisher of serialised messages on a topic of the flight. Returns the function that publishes one."""
        qos = LOCKSTEP if self.parameters.lockstep else publisher_qos(self.period_ns())
        publisher = self.create_publisher(topic.type, topic.name, qos)
        self._flight_publishers.append(publisher)
        return publisher.publish

    def subscribe(self, topic: Topic, qos: QoSProfile | None = None) -> PolledSubscription:
        """Create a subscription that is polled at the tick, as bytes. Its publishers are checked once a second."""
        default = LOCKSTEP if self.parameters.lockstep else NEWEST_SAMPLES
        subscription = PolledSubscription(self, topic, qos or default, raw=True)
        self.polled_subscriptions.append(subscription)
        return subscription

    def encoder(self, names: Sequence[str]) -> Encoder:
        """Encoder of samples that this node publishes."""
        return Encoder(names, self.instance)

    def received(self, subscription: PolledSubscription, decoder: Decoder) -> list[StampedVector | None]:
        """The samples that were received since the last call; None for one without channels or with an error."""
        samples: list[StampedVector | None] = []
        for one in subscription.take():
            try:
                samples.append(decoder.decode(one.message))
            except ChannelError as error:
                self.reject(subscription, error.reason, str(error))
                samples.append(None)
        return samples

    def accept(
        self,
        subscription: PolledSubscription,
        take: Callable[[StampedVector, int], None],
        sample: StampedVector,
        now_ns: int,
        lock: PublisherLock | None = None,
        max_age_ns: int = 0,
        takeover_ns: int = 0,
    ) -> None:
        """Give a sample to `take`, unless its stamp is bad or it is from a conflicting publisher.

        The lock has the timeouts of `PublisherLock.check`. Without one, in lockstep, every publisher is accepted.
        """
        try:
            if lock is not None:
                lock.check(sample.sender, now_ns, max_age_ns, takeover_ns)
            take(sample, now_ns)
            if lock is not None:
                lock.refresh(sample.sender, now_ns)
        except ChannelError as error:
            self.reject(subscription, error.reason, str(error))

    def reject(self, subscription: PolledSubscription, reason: str, sentence: str) -> None:
        """Count an invalid sample, and log it at most once in 2 s for each topic and reason.

        A conflicting publisher is an ERROR, here and in the diagnostics.
        """
        what = f"{subscription.topic.name}: {reason}"
        self.rejected[what] += 1
        self.refusals[subscription.name] = time.monotonic_ns(), sentence
        if reason == SENDER:
            self._conflict = f"{subscription.name}: {sentence}"
        if not self._log_due(what, LOG_THROTTLE_NS):
            return
        if reason == SENDER:
            self.get_logger().error(f"{subscription.name}: sample refused: {sentence}")
        else:
            self.get_logger().warning(f"{subscription.name}: sample refused: {sentence}")

    def _log_due(self, message: str, throttle_ns: int) -> bool:
        """Whether a message was not logged for the throttle time; if so, it counts as logged now."""
        now_ns = time.monotonic_ns()
        due = now_ns - self._logged_ns.get(message, -throttle_ns) >= throttle_ns
        if due:
            self._logged_ns[message] = now_ns
        return due

    def now_ns(self) -> int:
        """The time of the ticks, ns: the system clock at the start plus the monotonic time since then."""
        return time.monotonic_ns() + self.time_offset_ns

    def clock_step_ns(self) -> int:
        """How far the system clock is ahead of the time of the ticks; 0 for less than CLOCK_STEP_NS, which is no step."""
        step_ns = time.time_ns() - self.now_ns()
        return step_ns if abs(step_ns) > CLOCK_STEP_NS else 0

    def warn_no_publisher(self, subscription: PolledSubscription) -> None:
        """Called at each tick without a sample of a topic: logs a warning after 3 s, then every 2 s."""
        now_ns = time.monotonic_ns()
        last_ns, log_ns = self._waiting.get(subscription.name, (0, 0))
        if now_ns - last_ns > NANOSECONDS:  # the first call after a sample
            log_ns = now_ns + NO_PUBLISHER_WARNING_NS
        self._waiting[subscription.name] = now_ns, log_ns if now_ns < log_ns else now_ns + LOG_THROTTLE_NS
        if now_ns < log_ns:
            return
        cause = "its publisher sends no samples" if self.count_publishers(subscription.name) else "no publisher"
        self.get_logger().warning(f"waiting for {subscription.name}: {cause}")

    def _change_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        """Accept a change of tunable parameters as a whole, or reject it with a sentence and change nothing."""
        try:
            parameters = changed(self, self.parameters, changes)
            self.on_parameters(parameters)
        except ParameterError as error:
            self.get_logger().warning(f"parameters rejected: {error}")
            return SetParametersResult(successful=False, reason=str(error))
        for change in changes:
            old = self.get_parameter_or(change.name).value
            self.get_logger().info(f"{change.name}: {old} -> {change.value}")
        self.parameters = parameters
        return SetParametersResult(successful=True)

    # Called by the event loop

    def run_tick(self, tick: Tick, now_ns: int) -> None:
        """Run one tick; measure its period, its compute time and its overruns."""
        begin_ns = time.monotonic_ns()
        if self._last_tick_ns is not None:
            self._periods.append(begin_ns - self._last_tick_ns)
        self._last_tick_ns = begin_ns
        self._missed += tick.missed
        for lock in self.publisher_locks:
            lock.overran(tick.missed * self.period_ns())
        self.tick(tick, now_ns)
        self._compute.append(time.monotonic_ns() - begin_ns)

    def check_clock(self) -> None:
        """Log an error after a step of the system clock. This node keeps its time; a node that starts now has another time."""
        step_ns = time.time_ns() - self.now_ns()
        if abs(step_ns - self._clock_step_ns) > CLOCK_STEP_NS:
            restored = abs(step_ns) <= CLOCK_STEP_NS
            advice = "it is correct again" if restored else "this node keeps its own time; restart all nodes or none"
            self.get_logger().error(f"the system clock was set by {seconds(step_ns - self._clock_step_ns):+.3f} s: {advice}")
            self._clock_step_ns = step_ns

    def graph_checks(self) -> list[Callable[[], None]]:
        """Checks of the graph, a topic each: to ask the middleware for all topics takes about a period of 2 ms.

        They log an error for each peer with another message type or incompatible QoS: its topic would stay silent.
        """
        subscribed = ((one.name, type_name(one.topic.type), one.qos) for one in self.polled_subscriptions)
        return [
            *(partial(self.check_subscribers, publisher) for publisher in self._flight_publishers),
            *(partial(self.check_publishers, *topic) for topic in subscribed),
        ]

    def check_publishers(self, topic: str, message_type: str, qos: QoSProfile | None = None) -> None:
        """Log an error for each publisher of a topic that does not match a subscription of this type and QoS."""
        self._log_mismatches(topic, self.get_publishers_info_by_topic(topic), message_type, qos)

    def check_subscribers(self, publisher: Publisher) -> None:
        """Log an error for each subscriber of a topic that does not match a publisher of this node."""
        topic = publisher.topic_name
        # The graph reports the QoS of both sides in the same terms. A new publisher is not in it yet.
        for own in self.get_publishers_info_by_topic(topic):
            if own.node_name == self.get_name():
                peers = self.get_subscriptions_info_by_topic(topic)
                self._log_mismatches(topic, peers, own.topic_type, own.qos_profile)
                return

    def _log_mismatches(self, topic: str, peers: Sequence[TopicEndpointInfo], type_name: str, qos: QoSProfile | None) -> None:
        for peer in peers:
            sentence = mismatch(topic, peer, type_name, qos)
            if sentence and self._log_due(sentence, MISMATCH_THROTTLE_NS):
                self.get_logger().error(sentence)

    def runs_in_lockstep(self) -> bool:
        """Whether the event loop calls `advance` in lockstep instead of `tick` in real time."""
        return self.parameters.lockstep

    def require_peers(self) -> None:
        """Raise FlightEnded after the loss of a peer of a lockstep flight."""
        if self.peers is not None and (role := self.peers.lost()):
            raise FlightEnded(f"{LOST_CONTACT} {role}")

    def finish(self) -> None:
        """End the node. In lockstep, wait until its last messages have arrived."""
        self.close()
        if self.parameters.lockstep and not (self.peers and self.peers.lost()):
            for publisher in self.publishers:
                publisher.wait_for_all_acked(ACKNOWLEDGE_TIMEOUT)

    def publish_state(self, state: NodeState) -> None:
        """Publish the state of this node on `node_state`.

        The key contains the process number, also in lockstep, so that a subscriber can distinguish the nodes of two flights.
        """
        self._node_state.publish(KeyValue(key=f"{self.get_fully_qualified_name()}#{os.getpid()}", value=state))

    def publish_diagnostics(self) -> None:
        """Publish the 1 Hz report: loop period, compute time, missed ticks (overruns), rejected samples and more."""
        level, sentence, further = self.status()
        if self._conflict:
            level, sentence, self._conflict = DiagnosticStatus.ERROR, self._conflict, ""
        report: dict[str, object] = {"missed ticks": self._missed}
        for key, sample in (("period", self._periods), ("compute time", self._compute)):
            if sample:
                values = np.sort(sample) * 1e-9
                nearest = math.ceil(0.99 * len(values)) - 1  # np.percentile would import numpy.ma inside a tick
                report |= {
                    f"{key} mean (s)": f"{values.mean():.6f}",
                    f"{key} p99 (s)": f"{values[nearest]:.6f}",
                    f"{key} max (s)": f"{values[-1]:.6f}",
                }
                sample.clear()
        report |= {f"refused {reason}": count for reason, count in self.rejected.items()} | further
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self.instance
        message.status = [
            DiagnosticStatus(
                level=level,
                name=self.get_fully_qualified_name(),
                message=sentence,
                hardware_id=self.instance,
                values=[KeyValue(key=key, value=str(value)) for key, value in report.items()],
            )
        ]
        self._diagnostics.publish(message)
