# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Record the topics of a flight to a single MCAP bag, as a ROS 2 node.

The messages are stored as received, without deserialisation.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.validate_topic_name import validate_topic_name

from flight_core.files import dump_yaml
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns
from flight_core.text import bounded
from flight_log.bag import LOST_MESSAGES, SILENCES, SIMULATED_TIME
from flight_log.message_definitions import definition
from flight_recorder.flight_bag import FlightBag, Records
from flight_recorder.params import RecorderConfig
from flight_recorder.recorded_topic import RecordedTopic
from flight_recorder.silences import Silences
from flight_ros.endpoints import type_name
from flight_ros.flight_node import NO_PUBLISHER_WARNING_NS, FlightNode
from flight_ros.messages import instant, sender_of
from flight_ros.qos import rosbag2_profiles, strongest_compatible
from flight_ros.subscriptions import PolledSubscription, ReceivedMessage
from flight_ros.throttle import Throttle
from flight_ros.ticker import HostTime, Tick
from flight_ros.topics import (
    EXTERNAL,
    FLIGHT,
    INTERNALS,
    POSE,
    PUBLISH,
    RECORD,
    RECORD_FOREIGN,
    RECORDED,
    ROSOUT,
    TRUTH,
    Y_M,
    Topic,
    U,
    Y,
)

# The longest span that is lost when the recorder is killed. It is also the period of the graph
# checks.
FLUSH_PERIOD_NS = nanoseconds(0.1)
DISK_PERIOD_NS = NANOSECONDS
LOSS_PERIOD_NS = 2 * NANOSECONDS  # time between two lines on lost messages of a topic

LOOP = (Y, Y_M, U)  # every flight has these topics
# Topics that go on in every mode of a flight while their publisher runs.
STEADY = (Y, Y_M, U, INTERNALS, TRUTH, POSE)

# longest wait at the end of a flight for messages that were sent before the end
DRAIN_NS = 10 * NANOSECONDS
QUIET_NS = NANOSECONDS // 5  # after this time without a message, no message is left


@dataclass(kw_only=True)
class _Subscribed(RecordedTopic):
    """A recorded topic with its subscription."""

    subscription: PolledSubscription


class _RecordedTopics:
    """The topics that are recorded.

    They are the topics of a flight, and the topics in `names`. Each is recorded from the time of
    its first publisher on.
    """

    def __init__(self, node: Node, bag: FlightBag, names: Sequence[str]) -> None:
        self._node = node
        self._bag = bag
        self._topics: list[_Subscribed] = []
        for topic in FLIGHT:
            # ROS 2 keeps lines of the log for late subscribers, so ROSOUT is recorded like a topic
            # of the stack.
            qos = RECORD_FOREIGN if topic.is_foreign and topic is not ROSOUT else RECORD
            self._record(topic, qos, [PUBLISH])
        recorded_names = {topic.name for topic in self._topics}
        self.missing = [name for name in dict.fromkeys(names) if name not in recorded_names]
        self._warn_missing_ns = time.monotonic_ns() + NO_PUBLISHER_WARNING_NS

    def __iter__(self) -> Iterator[_Subscribed]:
        return iter(self._topics)

    def among(self, topics: Sequence[Topic], *, heard: bool = False) -> list[_Subscribed]:
        """Return which of the given `topics` are recorded.

        If `heard`, a topic without a message so far is left out.
        """
        selection = (topic for topic in self._topics if topic.subscription.topic in topics)
        return [topic for topic in selection if topic.channel.messages or not heard]

    def _record(self, topic: Topic, qos: QoSProfile, offered: list[QoSProfile]) -> None:
        subscription = PolledSubscription(self._node, topic, qos, raw=True)
        before_remap = self._node.resolve_topic_name(topic.name, only_expand=True)
        channel = self._bag.add_topic(
            subscription.name,
            type_name(topic.type),
            dump_yaml(rosbag2_profiles(offered), flow=False),
            before_remap,
        )
        subscribed = _Subscribed(
            name=subscription.name,
            is_foreign=topic.is_foreign,
            channel=channel,
            subscription=subscription,
        )
        self._topics.append(subscribed)

    def subscribe_missing(self, now_ns: int) -> None:
        """Subscribe to the missing topics that now have a publisher, and warn of the others."""
        for name in list(self.missing):
            if offered := self._node.get_publishers_info_by_topic(name):
                self.missing.remove(name)
                self._subscribe(name, offered[0].topic_type)
        if self.missing and now_ns > self._warn_missing_ns:
            self._warn_missing_ns = now_ns + 10 * NO_PUBLISHER_WARNING_NS
            self._node.get_logger().warning(
                f"no publisher of {', '.join(self.missing)}; recording starts with the first "
                "publisher"
            )

    def _subscribe(self, name: str, message_type: str) -> None:
        topic = Topic(name, message_type, EXTERNAL)
        try:
            definition(type_name(topic.type))
        except (ImportError, AttributeError, ParameterError):
            self._node.get_logger().warning(
                bounded(f"{name} is not recorded: its type {message_type} is not installed")
            )
            return
        offered = self._offered(name, message_type)
        self._record(topic, strongest_compatible(offered), offered)

    def _offered(self, name: str, message_type: str) -> list[QoSProfile]:
        return [
            peer.qos_profile
            for peer in self._node.get_publishers_info_by_topic(name)
            if peer.topic_type == message_type
        ]

    def with_new_publishers(self) -> Iterator[_Subscribed]:
        """Yield the topics whose number of publishers has changed since the last call."""
        for topic in self._topics:
            if (count := self._node.count_publishers(topic.name)) != topic.publishers:
                topic.publishers = count
                yield topic

    def weaken_qos(self, topic: _Subscribed, drain: Callable[[], None]) -> None:
        """Subscribe again with a weaker QoS if publishers offer less than is requested.

        A topic that this flight stack publishes keeps its QoS if at least one publisher offers it.
        EndpointMonitor then logs the mismatch of the other publishers. `drain` writes the received
        messages before the subscription is removed.
        """
        subscription = topic.subscription
        offered = self._offered(topic.name, topic.channel.type.name)
        lacking = [
            qos_check_compatible(profile, subscription.qos)[0] == QoSCompatibility.ERROR
            for profile in offered
        ]
        if not any(lacking) or not (topic.is_foreign or all(lacking)):
            return
        # The QoS is volatile, because the transient-local samples have been recorded already.
        weaker = QoSProfile(
            depth=subscription.qos.depth, reliability=strongest_compatible(offered).reliability
        )
        drain()
        self._node.destroy_subscription(subscription.entity)
        topic.subscription = PolledSubscription(self._node, subscription.topic, weaker, raw=True)
        self._node.get_logger().info(
            f"{topic.name}: now recorded as {weaker.reliability.short_key} and volatile: its "
            "publishers offer no more"
        )


class RecorderNode(FlightNode[RecorderConfig]):
    """Appends the received messages to the bag at every tick."""

    def __init__(self) -> None:
        super().__init__("recorder", RecorderConfig)
        self.host = time  # host time, so that the log is also flushed in a pause of /clock
        # time by which silences count; it stands still in a pause of /clock
        self._flight_time: HostTime = self.simulated or time
        names = [_full_name(self, name) for name in self.parameters.topics]
        logger = self.get_logger()
        self._bag = FlightBag(
            self.parameters,
            clock=None if self.simulated is None else self.simulated.subscription.name,
            last_records=self._last_records,
            report=logger.error,
        )
        self._topics = _RecordedTopics(self, self._bag, names)
        self._publish_recorded = self.advertise(RECORDED)
        self.lost: Counter[str] = Counter()
        self._losses = Throttle(LOSS_PERIOD_NS)
        self._silences = Silences(
            inform=logger.info,
            warn=logger.warning,
            count_publishers=self.count_publishers,
            now_ns=self._flight_time.monotonic_ns(),
        )
        self._flushed_ns = self._drained_ns = self._disk_checked_ns = time.monotonic_ns()
        logger.info(bounded(f"recording to {self._bag.path}"))

    def period_ns(self) -> int:
        return period_ns(self.parameters.rate, "rate")

    def inputs(self) -> Sequence[PolledSubscription]:
        return [topic.subscription for topic in self._topics.among(LOOP)]

    def is_in_lockstep(self) -> bool:
        # Even in a lockstep flight the recorder ticks by the clock of the host. Each tick writes
        # many instants of the flight, and publishes up to where the log is complete.
        return False

    def advance(self) -> bool:
        """Write the received messages if a period has passed since the last time.

        In a lockstep flight in one process, this is called between the steps of the other nodes.
        Returns False, because writing is no step of the flight.
        """
        if time.monotonic_ns() - self._drained_ns > self.period_ns():
            self._write()
        return False

    def tick(self, tick: Tick, now_ns: int) -> None:
        self._write()

    def _write(self) -> None:
        """Write all received messages.

        At intervals of FLUSH_PERIOD_NS, also flush the bag, and check the graph and the disk.
        """
        now_ns = self._drained_ns = time.monotonic_ns()
        self._drain_subscriptions()
        if now_ns - self._flushed_ns < FLUSH_PERIOD_NS:
            return
        self._flushed_ns = now_ns
        self._publish_span()
        self._bag.flush()
        if self._bag.end_reason:
            return
        self._topics.subscribe_missing(now_ns)
        self._warn_of_a_part()
        flight_ns = self._flight_time.monotonic_ns()
        self._silences.warn_of_loop(self._topics.among(LOOP), flight_ns)
        self._silences.warn_of_topics(self._topics.among(STEADY, heard=True), flight_ns)
        for topic in self._topics.with_new_publishers():
            self._topics.weaken_qos(topic, self._drain_subscriptions)
        if now_ns - self._disk_checked_ns > DISK_PERIOD_NS:
            self._disk_checked_ns = now_ns
            self._bag.check_disk()

    def _drain_subscriptions(self) -> None:
        """Write the received messages.

        In lockstep, also publish the stamp of the newest sample of `truth` in the bag.
        """
        if self.simulated is not None and (
            self.simulated.has_restarted or not self.simulated.is_known()
        ):
            return
        stamps: list[int] = []
        for topic in self._topics:
            arrivals = topic.subscription.take()
            self._bag.write_or_end(partial(self._append, topic, arrivals))
            if arrivals:
                self._hear(topic, arrivals)
            if topic.subscription.topic is TRUTH and self.parameters.lockstep:
                stamps += self.refusals.stamps(topic.subscription, arrivals)
        if stamps:
            self._publish_recorded(instant(stamps[-1]))

    def _hear(self, topic: _Subscribed, arrivals: Sequence[ReceivedMessage]) -> None:
        """Note the newest message of a topic: when it was sent and received, and its stamp."""
        now_ns = self._flight_time.monotonic_ns()
        topic.hear(arrivals[-1].sent_ns, now_ns)
        if topic.subscription.topic in LOOP and not self.parameters.lockstep:
            for stamp_ns in self.refusals.stamps(topic.subscription, arrivals):
                topic.stamp_ns = stamp_ns
        self._silences.end(topic, now_ns)

    def _publish_span(self) -> None:
        """Publish, in real time, up to which stamp y, y_m and u are in the log.

        A flight ends as soon as the log has these topics up to its end.
        """
        stamps = [topic.stamp_ns for topic in self._topics.among(LOOP)]
        if not self.parameters.lockstep and min(stamps) >= 0:
            self._publish_recorded(instant(min(stamps)))

    def _append(self, topic: _Subscribed, arrivals: Sequence[ReceivedMessage]) -> None:
        for message, sent_ns, received_ns, sequence in arrivals:
            if self.simulated is not None:
                sent_ns, received_ns = map(self.simulated.at, (sent_ns, received_ns))  # noqa: PLW2901 - the log has one time
            self._bag.write(topic.channel, received_ns, sent_ns, sequence, message)
            if topic.is_next(sequence):
                continue
            if count := topic.lost_before(sequence, sender_of(message)):
                self.lost[topic.name] += count
                if self._losses.is_due(topic.name):
                    self.get_logger().warning(f"{topic.name}: {count} messages lost")

    def _last_records(self) -> Records:
        """Return the last records of the bag: losses, silences and the speed of the simulator."""
        records = {LOST_MESSAGES: {name: str(count) for name, count in self.lost.items()}}
        if silent := self._silences.record([*self._topics], self._flight_time.monotonic_ns()):
            records[SILENCES] = silent
        if self.simulated is not None and self.simulated.is_known():
            records[SIMULATED_TIME] = {
                "topic": self.simulated.subscription.name,
                "speed": f"{self.simulated.speed():.3g}",
            }
        return records

    def _warn_of_a_part(self) -> None:
        """Warn if a log has only some of y, y_m and u.

        A flight has all three topics, but discovery can fail on a busy domain.
        """
        silent = [topic for topic in self._topics.among(LOOP) if not topic.channel.messages]
        for topic in silent if len(silent) < len(LOOP) else ():
            self.warn_no_publisher(topic.subscription)

    def graph_checks(self) -> list[Callable[[], None]]:
        return [
            *super().graph_checks(),
            *(partial(self._check_publishers, topic) for topic in self._topics),
        ]

    def _check_publishers(self, topic: _Subscribed) -> None:
        self._topics.weaken_qos(topic, self._drain_subscriptions)
        self.endpoints.check_publishers(topic.subscription)

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        figures: dict[str, object] = {
            f"messages {channel.topic}": channel.messages for channel in self._bag.channels
        }
        figures |= {f"lost {name}": count for name, count in self.lost.items()}
        figures |= {f"missing {name}": "no publisher" for name in self._topics.missing}
        if self._bag.end_reason:
            return DiagnosticStatus.ERROR, str(self._bag.end_reason), figures
        silent = [topic.name for topic in self._topics if topic.silent_ns]
        figures |= {f"silent {name}": "no message" for name in silent}
        lacks = self.lost or self._topics.missing or silent
        level = DiagnosticStatus.WARN if lacks else DiagnosticStatus.OK
        return level, f"recording to {self._bag.path}", figures

    def _drain(self) -> None:
        """Write the messages that were sent before the end of the flight.

        On a busy host, this process can be seconds behind.
        """
        end_ns = time.monotonic_ns()
        sent_ns = time.time_ns()
        heard_ns = end_ns
        self._drain_subscriptions()
        while (now_ns := time.monotonic_ns()) - end_ns < DRAIN_NS and now_ns - heard_ns < QUIET_NS:
            if all(topic.sent_ns >= sent_ns for topic in self._topics.among(STEADY, heard=True)):
                return
            time.sleep(QUIET_NS / 20 / NANOSECONDS)
            # A publisher that goes on sending, such as an aircraft of the user, does not delay the
            # end.
            behind = [topic for topic in self._topics if topic.sent_ns < sent_ns]
            before = [topic.sent_ns for topic in behind]
            self._drain_subscriptions()
            if [topic.sent_ns for topic in behind] != before:
                heard_ns = time.monotonic_ns()

    def close(self) -> None:
        self._drain()
        self._bag.close()
        for name in self._topics.missing:
            self.get_logger().warning(f"{name} is not in the log: it had no publisher")
        self.get_logger().info(bounded(f"{self._bag.message_count()} messages in {self._bag.path}"))


def _full_name(node: Node, name: str) -> str:
    """Return the full name of a topic that a node records. Raises ParameterError if invalid."""
    try:
        validate_topic_name(name)
        return str(node.resolve_topic_name(name))
    except InvalidTopicNameException:
        raise ParameterError(
            f"recorder.topics: found {name!r}, expected the name of a topic"
        ) from None
