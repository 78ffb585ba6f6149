# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder's node: records the topics of a flight to a single MCAP bag.

The messages stay serialised.
"""

import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from itertools import count
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.exceptions import InvalidTopicNameException
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.validate_topic_name import validate_topic_name

from flight_core.files import dump_yaml, is_file, link_latest, read_file, writing
from flight_core.outcome import UNKNOWN, Outcome, Refusal, joined, parsed_outcome
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns
from flight_core.text import bounded
from flight_log.bag import (
    LOST_MESSAGES,
    OUTCOME,
    OUTCOME_FILE,
    SILENCES,
    SIMULATED_TIME,
    BagChannel,
    BagWriter,
    LogAttachments,
)
from flight_log.disk import free_bytes
from flight_log.message_definitions import definition
from flight_recorder.params import RecorderConfig
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

# The longest loss when the recorder is killed; also the period of the graph checks.
FLUSH_PERIOD_NS = nanoseconds(0.1)
DISK_PERIOD_NS = NANOSECONDS
LOSS_PERIOD_NS = 2 * NANOSECONDS  # between two lines on lost messages of a topic
MEGABYTE = 1e6

LOOP = (Y, Y_M, U)  # every flight has these topics
SILENCE_NS = 3 * NANOSECONDS  # a killed controller is back within 1 s

# Topics that no mode of a flight stops while the publisher runs.
STEADY = (Y, Y_M, U, INTERNALS, TRUTH, POSE)
# A topic is steady after so many messages at such intervals.
STEADY_MESSAGES = 20
STEADY_INTERVAL_NS = NANOSECONDS // 5
TOPIC_SILENCE_NS = NANOSECONDS

DRAIN_NS = 10 * NANOSECONDS  # at most, at the end, for the messages that were sent before
QUIET_NS = NANOSECONDS // 5  # without a message: none is left


@dataclass
class _RecordedTopic:
    """A topic with the subscription and the channel in the bag."""

    subscription: PolledSubscription
    channel: BagChannel
    next_sequence: int = 0  # 0 before the first message
    publisher: str | None = None  # of the last message
    # The sequence of a name went back: a second publisher has that name, or a new one.
    shared: bool = False
    publishers: int = 0  # number of publishers at the last check
    first_ns: int = 0  # monotonic time of the first and the last message
    heard_ns: int = 0
    stamp_ns: int = -1  # of the last message
    sent_ns: int = 0  # time of sending of the last message
    silent_ns: int = 0  # begin of a silence; 0 without a silence

    @property
    def name(self) -> str:
        return self.subscription.name

    @property
    def foreign(self) -> bool:
        return self.subscription.topic.foreign


class RecorderNode(FlightNode[RecorderConfig]):
    """Appends the received messages to the bag at every tick."""

    def __init__(self) -> None:
        super().__init__("recorder", RecorderConfig)
        self.host = time  # in a pause of /clock the log is flushed too
        self._flight_time: HostTime = self.simulated or time  # of silences: a pause is none
        topic_names = [self._full_name(name) for name in self.parameters.topics]
        self._bag = self._open_bag()
        self._topics: list[_RecordedTopic] = []
        for topic in FLIGHT:
            # ROS 2 keeps the lines of the log
            qos = RECORD_FOREIGN if topic.foreign and topic is not ROSOUT else RECORD
            self._topics.append(self._record(self._poll(topic, qos), [PUBLISH]))
        recorded_names = {topic.name for topic in self._topics}
        self._missing = [name for name in dict.fromkeys(topic_names) if name not in recorded_names]
        self._publish_recorded = self.advertise(RECORDED)
        self.lost: Counter[str] = Counter()
        self._losses = Throttle(LOSS_PERIOD_NS)
        self.silent: Counter[str] = Counter()  # ns, by topic
        self._end_reason: Refusal | None = None  # why recording ended
        self._flushed_ns = self._drained_ns = self._disk_checked_ns = time.monotonic_ns()
        self._warn_missing_ns = time.monotonic_ns() + NO_PUBLISHER_WARNING_NS
        self._heard = 0  # messages of LOOP
        self._heard_ns = self._flight_time.monotonic_ns()  # and when the last message arrived
        self.get_logger().info(bounded(f"recording to {self._bag.path}"))

    def _full_name(self, name: str) -> str:
        try:
            validate_topic_name(name)
            return str(self.resolve_topic_name(name))
        except InvalidTopicNameException:
            raise ParameterError(
                f"recorder.topics: found {name!r}, expected the name of a topic"
            ) from None

    def _open_bag(self) -> BagWriter:
        """Open the bag with its attachments. Raises ParameterError if it cannot be written."""
        parameters = self.parameters
        attachments = LogAttachments(
            _file(parameters.scenario_file, "scenario_file"),
            tuple(path for name in parameters.attach if (path := _file(name, "attach"))),
            _file(parameters.metadata_file, "metadata_file"),
        )
        default = f"runs/{datetime.now(UTC):%Y%m%dT%H%M%SZ}-recording"
        directory = Path(parameters.directory or default).absolute()
        with writing("recorder.directory", directory, "a folder that can"):
            directory.mkdir(parents=True, exist_ok=True)
            if shortage := self._space_shortage(directory):
                raise ParameterError(f"recorder.min_free: {shortage}")
            bag = BagWriter(self._free_folder(directory))
            bag.add_attachments(attachments, time.time_ns())
            if self.simulated is not None:
                bag.add_metadata(SIMULATED_TIME, {"topic": self.simulated.subscription.name})
            bag.flush()
            if not parameters.directory:
                link_latest(directory)
        return bag

    def _free_folder(self, directory: Path) -> Path:
        """Return the folder, or another one beside it.

        It is a new folder if this one already holds the log of a simulation that has ended.
        """
        folders = (directory.with_name(f"{directory.name}-{number}") for number in count(2))
        has_log = self.simulated is not None and any(directory.glob("*.mcap"))
        return next(folder for folder in folders if not folder.exists()) if has_log else directory

    def _space_shortage(self, directory: Path) -> Refusal | None:
        """Refuse a folder with too little free space."""
        free = free_bytes(directory) / MEGABYTE
        least = self.parameters.min_free
        if free >= least:
            return None
        return Refusal(f"found {free:.1f} MB free in {directory}, expected at least {least:g} MB")

    def _among(self, topics: Sequence[Topic], *, heard: bool = False) -> list[_RecordedTopic]:
        """Return the recorded topics among `topics`; with `heard`, only those with messages."""
        selection = (topic for topic in self._topics if topic.subscription.topic in topics)
        return [topic for topic in selection if topic.channel.messages or not heard]

    def _poll(self, topic: Topic, qos: QoSProfile) -> PolledSubscription:
        return PolledSubscription(self, topic, qos, raw=True)

    def _record(
        self, subscription: PolledSubscription, offered: Sequence[QoSProfile]
    ) -> _RecordedTopic:
        qos = dump_yaml(rosbag2_profiles(offered), flow=False)
        before_remap = self.resolve_topic_name(subscription.topic.name, only_expand=True)
        channel = self._bag.add_topic(
            subscription.name, type_name(subscription.topic.type), qos, before_remap
        )
        return _RecordedTopic(subscription, channel)

    def period_ns(self) -> int:
        return period_ns(self.parameters.rate, "rate")

    def inputs(self) -> Sequence[PolledSubscription]:
        return [topic.subscription for topic in self._among(LOOP)]

    def runs_in_lockstep(self) -> bool:
        # In lockstep the recorder also writes at ticks, many instants at a time, and publishes the
        # progress.
        return False

    def advance(self) -> bool:
        """Write at ticks between the steps of the other nodes, if they share this process.

        No node is delayed by this.
        """
        if time.monotonic_ns() - self._drained_ns > self.period_ns():
            self._write()
        return False

    def tick(self, tick: Tick, now_ns: int) -> None:
        self._write()

    def _write(self) -> None:
        """Drain the subscriptions.

        Every FLUSH_PERIOD_NS also flush, and check the graph and the disk.
        """
        now_ns = self._drained_ns = time.monotonic_ns()
        self._drain_subscriptions()
        if now_ns - self._flushed_ns < FLUSH_PERIOD_NS:
            return
        self._flushed_ns = now_ns
        self._publish_span()
        if self._end_reason:
            return
        self._write_or_end(self._bag.flush)
        if self._end_reason:
            return
        self._subscribe_missing(now_ns)
        self._warn_of_a_part()
        self._warn_of_silence(self._flight_time.monotonic_ns())
        self._warn_of_topic_silence(self._flight_time.monotonic_ns())
        self._check_publisher_counts()
        if now_ns - self._disk_checked_ns > DISK_PERIOD_NS:
            self._disk_checked_ns = now_ns
            self._write_or_end(self._check_disk)

    def _check_disk(self) -> None:
        if shortage := self._space_shortage(self._bag.directory):
            self._end(f"min_free: {shortage}")

    def _drain_subscriptions(self) -> None:
        """Write the received messages.

        In lockstep publish the stamp of the newest sample of `truth` in the bag.
        """
        if self.simulated is not None and (self.simulated.restarted or not self.simulated.known()):
            return
        stamps: list[int] = []
        for topic in self._topics:
            arrivals = topic.subscription.take()
            if not self._end_reason:
                self._write_or_end(partial(self._append, topic, arrivals))
            if arrivals:
                self._hear(topic, arrivals)
            if topic.subscription.topic is TRUTH and self.parameters.lockstep:
                stamps += self.refusals.stamps(topic.subscription, arrivals)
        if stamps:
            self._publish_recorded(instant(stamps[-1]))

    def _hear(self, topic: _RecordedTopic, arrivals: Sequence[ReceivedMessage]) -> None:
        """Note the time of the newest message of a topic."""
        now_ns = self._flight_time.monotonic_ns()
        last = arrivals[-1]
        topic.first_ns = topic.first_ns or now_ns
        topic.heard_ns = now_ns
        topic.sent_ns = last.sent_ns
        if topic.subscription.topic in LOOP and not self.parameters.lockstep:
            for stamp_ns in self.refusals.stamps(topic.subscription, arrivals):
                topic.stamp_ns = stamp_ns
        if topic.silent_ns:
            silent_ns = now_ns - topic.silent_ns
            topic.silent_ns = 0
            self.silent[topic.name] += silent_ns
            self.get_logger().info(
                f"{topic.name}: received again after {silent_ns / NANOSECONDS:.1f} s"
            )

    def _publish_span(self) -> None:
        """In real time, publish the stamp up to which y, y_m and u are in the log.

        A flight ends once these cover it.
        """
        stamps = [topic.stamp_ns for topic in self._among(LOOP)]
        if not self.parameters.lockstep and min(stamps) >= 0:
            self._publish_recorded(instant(min(stamps)))

    def _append(self, topic: _RecordedTopic, arrivals: Sequence[ReceivedMessage]) -> None:
        write = self._bag.write
        channel = topic.channel
        # The sequences of several publishers interleave: a gap between publishers is no loss.
        # Foreign topics name no publisher.
        has_sequence = not topic.foreign and not topic.shared
        for message, sent_ns, received_ns, sequence in arrivals:
            if self.simulated is not None:
                sent_ns, received_ns = map(self.simulated.at, (sent_ns, received_ns))  # noqa: PLW2901 - the log has one time
            write(channel, received_ns, sent_ns, sequence, message)
            if has_sequence and sequence != topic.next_sequence:
                publisher = sender_of(message)
                topic.shared = publisher == topic.publisher and sequence < topic.next_sequence
                has_sequence = not topic.shared
                if publisher == topic.publisher and sequence > topic.next_sequence:
                    count = sequence - topic.next_sequence
                    self.lost[topic.name] += count
                    if self._losses.due(topic.name):
                        self.get_logger().warning(f"{topic.name}: {count} messages lost")
                topic.publisher = publisher
            topic.next_sequence = sequence + 1

    def _write_or_end(self, write: Callable[[], None]) -> None:
        """Write to the bag, and on an error or a full disk end it.

        The node goes on, because a flight waits for it.
        """
        try:
            write()
        except OSError as error:
            self._end(f"{self._bag.path} cannot be written ({error.strerror})")
        else:
            if self._bag.full:
                self._end(f"no space left for {self._bag.path}")

    def _end(self, reason: str) -> None:
        if self._end_reason is None:
            end_reason = Refusal(f"recording ended: {reason}")
            self._end_reason = joined((end_reason, self._close_bag()))
            self.get_logger().error(str(self._end_reason))

    def _close_bag(self) -> Refusal | None:
        """Finish the bag, or return why it cannot be finished."""
        try:
            self._bag.add_metadata(
                LOST_MESSAGES, {name: str(count) for name, count in self.lost.items()}
            )
            self._add_silences()
            if self.simulated is not None and self.simulated.known():
                values = {
                    "topic": self.simulated.subscription.name,
                    "speed": f"{self.simulated.speed():.3g}",
                }
                self._bag.add_metadata(SIMULATED_TIME, values)
            if (outcome := self._told_outcome()) is not UNKNOWN:
                self._bag.add_metadata(OUTCOME, outcome.record())
            self._bag.close()
        except OSError as error:
            name = self._bag.path.name
            return Refusal(f"{name} is truncated: it cannot be written ({error.strerror})")
        return None

    def _add_silences(self) -> None:
        """Store the silences of topics, including those that still last."""
        now_ns = self._flight_time.monotonic_ns()
        lasting = {
            topic.name: now_ns - topic.silent_ns for topic in self._topics if topic.silent_ns
        }
        silent = Counter(self.silent)
        silent.update(lasting)
        if silent:
            texts = {
                name: f"for {length_ns / NANOSECONDS:.1f} "
                f"s{', to the end' if name in lasting else ''}"
                for name, length_ns in silent.items()
            }
            self._bag.add_metadata(SILENCES, texts)

    def _told_outcome(self) -> Outcome:
        """Return the outcome that the flight left for the log; UNKNOWN if there is none."""
        file = self._bag.directory / OUTCOME_FILE
        if not is_file(file):
            return UNKNOWN
        try:
            text = read_file(file, OUTCOME_FILE, "an outcome").decode(errors="replace")
            file.unlink()
        except (OSError, ParameterError):
            return UNKNOWN
        return parsed_outcome(text)

    # A topic may appear late, and with any QoS

    def _check_publisher_counts(self) -> None:
        for topic in self._topics:
            if (count := self.count_publishers(topic.name)) != topic.publishers:
                topic.publishers = count
                self._weaken_qos(topic)

    def _subscribe_missing(self, now_ns: int) -> None:
        for name in list(self._missing):
            if offered := self.get_publishers_info_by_topic(name):
                self._missing.remove(name)
                self._subscribe(name, offered[0].topic_type)
        if self._missing and now_ns > self._warn_missing_ns:
            self._warn_missing_ns = now_ns + 10 * NO_PUBLISHER_WARNING_NS
            self.get_logger().warning(
                f"no publisher of {', '.join(self._missing)}; recording starts with the first "
                "publisher"
            )

    def _warn_of_a_part(self) -> None:
        """Warn if a log has only some of y, y_m and u.

        A flight has all three, but discovery may fail on a busy domain.
        """
        silent = [topic for topic in self._among(LOOP) if not topic.channel.messages]
        for topic in silent if len(silent) < len(LOOP) else ():
            self.warn_no_publisher(topic.subscription)

    def _warn_of_silence(self, now_ns: int) -> None:
        """Warn, once, when y, y_m and u have stopped.

        The publishers have ended, or this process receives nothing: Fast DDS can block the
        receiving threads during the removal of a leaving participant (eProsima/Fast-DDS, issue
        6502).
        """
        heard = sum(topic.channel.messages for topic in self._among(LOOP))
        if heard != self._heard:
            self._heard = heard
            self._heard_ns = now_ns
        elif heard and now_ns - self._heard_ns > SILENCE_NS:
            self._heard_ns = sys.maxsize
            self.get_logger().warning(
                f"no y, y_m or u for {SILENCE_NS / NANOSECONDS:g} s: if their nodes still "
                "publish, the middleware of this process is blocked: start the recorder again"
            )

    def _warn_of_topic_silence(self, now_ns: int) -> None:
        """Warn of a steady topic that is silent although its publisher is there.

        The other topics go on. A reader may miss all of a topic because of a full queue, or of a
        forged message of the middleware.
        """
        steady = self._among(STEADY, heard=True)
        newest_ns = max((topic.heard_ns for topic in steady), default=0)
        for topic in steady:
            count = topic.channel.messages
            rested = (
                count < STEADY_MESSAGES
                or topic.heard_ns - topic.first_ns > count * STEADY_INTERVAL_NS
            )
            if rested or topic.silent_ns or newest_ns - topic.heard_ns < TOPIC_SILENCE_NS:
                continue
            if now_ns - newest_ns < TOPIC_SILENCE_NS and self.count_publishers(topic.name):
                topic.silent_ns = topic.heard_ns
                why = "the publisher has stopped, or this process receives nothing more of it"
                self.get_logger().warning(
                    f"{topic.name}: no message for 1 s while others go on: {why}"
                )

    def _subscribe(self, name: str, message_type: str) -> None:
        topic = Topic(name, message_type, EXTERNAL)
        try:
            definition(type_name(topic.type))
        except (ImportError, AttributeError, ParameterError):
            self.get_logger().warning(
                bounded(f"{name} is not recorded: its type {message_type} is not installed")
            )
            return
        offered = self._offered(name, message_type)
        self._topics.append(self._record(self._poll(topic, strongest_compatible(offered)), offered))

    def graph_checks(self) -> list[Callable[[], None]]:
        return [
            *super().graph_checks(),
            *(partial(self._check_publishers, topic) for topic in self._topics),
        ]

    def _check_publishers(self, topic: _RecordedTopic) -> None:
        self._weaken_qos(topic)
        self.endpoints.check_publishers(topic.subscription)

    def _offered(self, name: str, message_type: str) -> list[QoSProfile]:
        return [
            peer.qos_profile
            for peer in self.get_publishers_info_by_topic(name)
            if peer.topic_type == message_type
        ]

    def _weaken_qos(self, topic: _RecordedTopic) -> None:
        """Subscribe again with a weaker QoS if publishers offer less than is requested.

        A weaker publisher beside one of the stack does not lower the QoS; EndpointMonitor logs the
        mismatch.
        """
        subscription = topic.subscription
        offered = self._offered(topic.name, topic.channel.type.name)
        lacking = [
            qos_check_compatible(profile, subscription.qos)[0] == QoSCompatibility.ERROR
            for profile in offered
        ]
        if not any(lacking) or not (topic.foreign or all(lacking)):
            return
        # Volatile, because the transient-local samples have been recorded already.
        weaker = QoSProfile(
            depth=subscription.qos.depth, reliability=strongest_compatible(offered).reliability
        )
        self._drain_subscriptions()
        self.destroy_subscription(subscription.entity)
        topic.subscription = self._poll(subscription.topic, weaker)
        self.get_logger().info(
            f"{topic.name}: now recorded as {weaker.reliability.short_key} and volatile: its "
            "publishers offer no more"
        )

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        figures: dict[str, object] = {
            f"messages {channel.topic}": channel.messages for channel in self._bag.channels
        }
        figures |= {f"lost {name}": count for name, count in self.lost.items()}
        figures |= {f"missing {name}": "no publisher" for name in self._missing}
        if self._end_reason:
            return DiagnosticStatus.ERROR, str(self._end_reason), figures
        figures |= {
            f"silent {topic.name}": "no message" for topic in self._topics if topic.silent_ns
        }
        if self.lost or self._missing or any(topic.silent_ns for topic in self._topics):
            level = DiagnosticStatus.WARN
        else:
            level = DiagnosticStatus.OK
        return level, f"recording to {self._bag.path}", figures

    def _drain(self) -> None:
        """Write the messages that were sent before the end.

        This process may be seconds behind on a busy host.
        """
        end_ns = time.monotonic_ns()
        sent_ns = time.time_ns()
        heard_ns = end_ns
        self._drain_subscriptions()
        while (now_ns := time.monotonic_ns()) - end_ns < DRAIN_NS and now_ns - heard_ns < QUIET_NS:
            if all(topic.sent_ns >= sent_ns for topic in self._among(STEADY, heard=True)):
                return
            time.sleep(QUIET_NS / 20 / NANOSECONDS)
            # a publisher that goes on, such as an aircraft of your own, does not delay the end
            behind = [topic for topic in self._topics if topic.sent_ns < sent_ns]
            before = [topic.sent_ns for topic in behind]
            self._drain_subscriptions()
            if [topic.sent_ns for topic in behind] != before:
                heard_ns = time.monotonic_ns()

    def close(self) -> None:
        self._drain()
        if self._end_reason is None:
            self._end_reason = Refusal("recording ended")
            if fault := self._close_bag():
                self.get_logger().error(f"{self._end_reason}; {fault}")
        for name in self._missing:
            self.get_logger().warning(f"{name} is not in the log: it had no publisher")
        self.get_logger().info(
            bounded(f"{self._bag.contents().messages} messages in {self._bag.path}")
        )


def _file(name: str, key: str) -> Path | None:
    require(not name or is_file(Path(name)), f"recorder.{key}", f"{name!r}", "the path of a file")
    return Path(name) if name else None
