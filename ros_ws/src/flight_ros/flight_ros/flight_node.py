# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The skeleton of every node: parameters, topics, ticks, diagnostics, a clean end."""

import math
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible

from flight_core.authentication import MessageAuthenticator, read_key
from flight_core.outcome import FlightEnded
from flight_core.parameters import KeyedParameters, NodeParameters, ParameterError
from flight_core.rates import NANOSECONDS, seconds
from flight_ros.liveliness import LivelinessMonitor
from flight_ros.messages import Decoder, Encoder
from flight_ros.parameters import changed, read_parameters
from flight_ros.publisher_lock import SENDER
from flight_ros.rclpy_private import raw_publish
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import Tick
from flight_ros.topics import DIAGNOSTICS, LOCKSTEP, NEWEST_SAMPLES, NODE_STATE, PUBLISH, STATE, NodeState, Topic, publisher_qos

P = TypeVar("P", bound=NodeParameters)

NO_PUBLISHER_WARNING_NS = 3 * NANOSECONDS  # processes of one flight start one after the other

ACKNOWLEDGE_TIMEOUT = Duration(seconds=0.5)  # at the end of a lockstep flight, what was sent is left time to arrive

LOG_THROTTLE_NS = 2 * NANOSECONDS  # before the same is said again

CLOCK_STEP_NS = NANOSECONDS // 20  # in a second a clock is slewed by a hundredth of it


class FlightNode(Node, Generic[P]):
    """A node that works at fixed ticks, or in lockstep. A subclass says at which rate, and what one tick or step does."""

    def __init__(self, name: str, schema: type[P], tunable: frozenset[str] = frozenset()) -> None:
        Node.__init__(self, name, automatically_declare_parameters_from_overrides=True)
        self.parameters = read_parameters(self, schema, tunable)
        if tunable:
            self.add_on_set_parameters_callback(self._change_parameters)
        self.peers = LivelinessMonitor(self, name) if self.parameters.lockstep else None
        # In lockstep the same flight gives the same bytes, so the process is left out.
        process = "" if self.parameters.lockstep else f"#{os.getpid()}"
        self.instance = self.get_fully_qualified_name() + process
        key_file = self.parameters.key_file if isinstance(self.parameters, KeyedParameters) else ""
        self._key = read_key(key_file, f"{name}.key_file") if key_file else None
        # Samples of the time before this node are not flown. Lockstep has no such time: it begins at 0, with all that was sent.
        self._since_ns = None if self.parameters.lockstep else time.time_ns()
        if self._key is not None:
            self.get_logger().info(f"samples are signed, and those that are not refused, with the key in {key_file}")
        self.rejected: Counter[str] = Counter()
        self._rejected_said_ns: dict[str, int] = {}
        self._intruder = ""  # who publishes beside the one that is listened to, since the last report
        self._polled_subscriptions: list[PolledSubscription] = []
        self._flight_publishers: list[Publisher] = []
        self._waiting: dict[str, tuple[int, int]] = {}  # by topic: last call, and when to say it next
        self._diagnostics = self.create_publisher(DIAGNOSTICS.type, DIAGNOSTICS.name, PUBLISH)
        self._node_state = self.create_publisher(NODE_STATE.type, NODE_STATE.name, STATE)
        self._periods: list[int] = []
        self._compute: list[int] = []
        self._missed = 0
        self._last_tick_ns: int | None = None
        self._ahead_ns = 0  # of the time of the ticks before the monotonic clock
        self._clock_ns = 0  # how far the system clock was set since the start

    # What a subclass says

    def period_ns(self) -> int:
        """The period of the ticks."""
        raise NotImplementedError

    def start_ns(self) -> int:
        """System time of tick 0 in ns; 0 starts at once."""
        return 0

    def tick(self, tick: Tick, now_ns: int) -> None:
        """One tick; `now_ns` is the nominal instant of tick.number on the system clock's scale."""
        raise NotImplementedError

    def advance(self) -> bool:
        """In lockstep: do all that can be done with what has come. Whether that was anything."""
        raise NotImplementedError

    def awaited_topic(self) -> str:
        """In lockstep: what it waits for, for people; empty where it waits for nothing any more."""
        return ""

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        """Level, sentence and further figures for the 1 Hz diagnostics."""
        return DiagnosticStatus.OK, "running", {}

    def close(self) -> None:
        """Called once when the node ends, whatever ended it."""

    def on_parameters(self, parameters: P) -> None:
        """Called with a set that was accepted in flight, before it becomes `self.parameters`."""

    # What a subclass uses

    def advertise(self, topic: Topic) -> Callable[[bytes], None]:
        """A publisher of serialised messages on a topic of the flight, as the function that publishes one."""
        qos = LOCKSTEP if self.parameters.lockstep else publisher_qos(self.period_ns())
        publisher = self.create_publisher(topic.type, topic.name, qos)
        self._flight_publishers.append(publisher)
        return raw_publish(publisher)

    def subscribe(self, topic: Topic, qos: QoSProfile | None = None) -> PolledSubscription:
        """A subscription that is read at the tick, as bytes; its publishers are checked once a second."""
        subscription = PolledSubscription(
            self, topic, qos or (LOCKSTEP if self.parameters.lockstep else NEWEST_SAMPLES), raw=True
        )
        self._polled_subscriptions.append(subscription)
        return subscription

    def encoder(self, topic: Topic, names: Sequence[str]) -> Encoder:
        """Samples of a topic as messages of this node, signed where it has a key."""
        return Encoder(names, self.instance, self._authenticator(topic))

    def decoder(self, topic: Topic, wanted: Sequence[str]) -> Decoder:
        """Messages of a topic as samples; where the node has a key, those alone that are signed with it, each once."""
        return Decoder(wanted, self._authenticator(topic))

    def _authenticator(self, topic: Topic) -> MessageAuthenticator | None:
        return (
            None if self._key is None else MessageAuthenticator(self._key, self.resolve_topic_name(topic.name), self._since_ns)
        )

    def reject(self, subscription: PolledSubscription, reason: str, sentence: str) -> None:
        """Count a sample that cannot be used, and say so, of each topic and reason at most once in 2 s.

        A second publisher is an alarm: an ERROR here and in the diagnostics.
        """
        what, now_ns = f"{subscription.topic.name}: {reason}", time.monotonic_ns()
        self.rejected[what] += 1
        if reason == SENDER:
            self._intruder = f"{subscription.name}: {sentence}"
        if now_ns - self._rejected_said_ns.get(what, -LOG_THROTTLE_NS) < LOG_THROTTLE_NS:
            return
        self._rejected_said_ns[what] = now_ns
        if reason == SENDER:
            self.get_logger().error(f"{subscription.name}: sample refused: {sentence}")
        else:
            self.get_logger().warning(f"{subscription.name}: sample refused: {sentence}")

    def now_ns(self) -> int:
        """The time of the ticks, ns: the system clock as it was at the start, gone on with the monotonic clock."""
        return time.monotonic_ns() + self._ahead_ns

    def warn_no_publisher(self, subscription: PolledSubscription) -> None:
        """Called at each tick while nothing comes on a topic: says so after 3 s, then every 2 s, and who is there."""
        now_ns = time.monotonic_ns()
        last_ns, say_ns = self._waiting.get(subscription.name, (0, 0))
        if now_ns - last_ns > NANOSECONDS:  # the first call since it came
            say_ns = now_ns + NO_PUBLISHER_WARNING_NS
        self._waiting[subscription.name] = now_ns, say_ns if now_ns < say_ns else now_ns + 2 * NANOSECONDS
        if now_ns < say_ns:
            return
        count = self.count_publishers(subscription.name)
        who = "its publisher sends nothing" if count else "no publisher there"
        self.get_logger().warning(f"waiting for {subscription.name}: {who}")

    def _change_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        """Accept a change of tunable parameters as a whole, or refuse it with a sentence and leave everything as it was."""
        try:
            parameters = changed(self, self.parameters, changes)
        except ParameterError as error:
            self.get_logger().warning(f"parameters refused: {error}")
            return SetParametersResult(successful=False, reason=str(error))
        self.on_parameters(parameters)
        for change in changes:
            old = self.get_parameter_or(change.name).value
            self.get_logger().info(f"{change.name}: {old} -> {change.value}")
        self.parameters = parameters
        return SetParametersResult(successful=True)

    # What the loop does

    def run_tick(self, tick: Tick, now_ns: int) -> None:
        """One tick, timed."""
        begin_ns = time.monotonic_ns()
        if self._last_tick_ns is not None:
            self._periods.append(begin_ns - self._last_tick_ns)
        self._last_tick_ns = begin_ns
        self._missed += tick.missed
        self.tick(tick, now_ns)
        self._compute.append(time.monotonic_ns() - begin_ns)

    def keep_time(self, start_ns: int, monotonic_ns: int) -> None:
        """Ticks count from here: one instant on both clocks."""
        self._ahead_ns = start_ns - monotonic_ns

    def check_clock(self) -> None:
        """Say where the system clock was set: the node goes on with the time it began with, one started now does not."""
        set_ns = time.time_ns() - self.now_ns()
        if abs(set_ns - self._clock_ns) > CLOCK_STEP_NS:
            by = f"the system clock was set by {seconds(set_ns - self._clock_ns):+.3f} s"
            rest = (
                "it is right again" if abs(set_ns) <= CLOCK_STEP_NS else "this node goes on with its own; restart all or none"
            )
            self.get_logger().error(f"{by}: {rest}")
            self._clock_ns = set_ns

    def check_graph(self) -> None:
        """Say what keeps a topic silent for ever: another type, or an incompatible quality of service."""
        for publisher in self._flight_publishers:
            self._check_listeners(publisher)
        for subscription in self._polled_subscriptions:
            wanted = f"{subscription.topic.type.__module__.split('.')[0]}/msg/{subscription.topic.type.__name__}"
            for peer in self.get_publishers_info_by_topic(subscription.name):
                node = f"{peer.node_namespace.rstrip('/')}/{peer.node_name}"
                if peer.topic_type != wanted:
                    self.get_logger().error(
                        f"{subscription.name}: {node} publishes {peer.topic_type}, expected {wanted}", throttle_duration_sec=5.0
                    )
                    continue
                compatibility, reason = qos_check_compatible(peer.qos_profile, subscription.qos)
                if compatibility == QoSCompatibility.ERROR:
                    self.get_logger().error(
                        f"{subscription.name}: quality of service of {node} does not fit: {reason}", throttle_duration_sec=5.0
                    )

    def _check_listeners(self, publisher: Publisher) -> None:
        known = self.get_publishers_info_by_topic(publisher.topic_name)
        offered = next((one.qos_profile for one in known if one.node_name == self.get_name()), None)
        if offered is None:  # the graph does not know of it yet; it tells of both sides in the same terms
            return
        for peer in self.get_subscriptions_info_by_topic(publisher.topic_name):
            compatibility, reason = qos_check_compatible(offered, peer.qos_profile)
            if compatibility == QoSCompatibility.ERROR:
                node = f"{peer.node_namespace.rstrip('/')}/{peer.node_name}"
                self.get_logger().error(
                    f"{publisher.topic_name}: quality of service of {node}, which listens, does not fit: {reason}",
                    throttle_duration_sec=5.0,
                )

    def steps(self) -> bool:
        """Whether it moves by `advance` in lockstep; else by `tick` in real time."""
        return self.parameters.lockstep

    def polled_subscriptions(self) -> list[PolledSubscription]:
        """What it listens to."""
        return self._polled_subscriptions

    def require_peers(self) -> None:
        """Raise FlightEnded where a node that took part in lockstep is gone."""
        if self.peers is not None and (role := self.peers.missing()):
            raise FlightEnded(f"{role} is gone")

    def finish(self) -> None:
        """The end of the node: in lockstep what was sent is left time to arrive."""
        self.close()
        if self.parameters.lockstep and not (self.peers and self.peers.missing()):
            for publisher in self.publishers:
                publisher.wait_for_all_acked(ACKNOWLEDGE_TIMEOUT)

    def publish_state(self, state: NodeState) -> None:
        """Publish the state of this node on `node_state`.

        The key names the process too, in lockstep as well: a subscriber tells the nodes of two flights apart by it.
        """
        self._node_state.publish(KeyValue(key=f"{self.get_fully_qualified_name()}#{os.getpid()}", value=state))

    def publish_diagnostics(self) -> None:
        """The 1 Hz report: loop period, compute time, missed ticks, refused samples, and what the node adds."""
        level, sentence, figures = self.status()
        if self._intruder:
            level, sentence, self._intruder = DiagnosticStatus.ERROR, self._intruder, ""
        shown: dict[str, object] = {"missed ticks": self._missed}
        for key, sample in (("period", self._periods), ("compute time", self._compute)):
            if sample:
                values = np.sort(sample) * 1e-9
                nearest = math.ceil(0.99 * len(values)) - 1  # np.percentile would load numpy.ma in the middle of a tick
                shown |= {
                    f"{key} mean (s)": f"{values.mean():.6f}",
                    f"{key} p99 (s)": f"{values[nearest]:.6f}",
                    f"{key} max (s)": f"{values[-1]:.6f}",
                }
                sample.clear()
        shown |= {f"refused {reason}": count for reason, count in self.rejected.items()} | figures
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self.instance
        message.status = [
            DiagnosticStatus(
                level=level,
                name=self.get_fully_qualified_name(),
                message=sentence,
                hardware_id=self.instance,
                values=[KeyValue(key=key, value=str(value)) for key, value in shown.items()],
            )
        ]
        self._diagnostics.publish(message)
