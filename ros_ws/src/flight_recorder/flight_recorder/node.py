# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder's node: every topic of a flight, as it came over the wire, to one MCAP bag."""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from importlib import import_module
from pathlib import Path

import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Log, ParameterEvent
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.validate_topic_name import validate_topic_name

from flight_core.files import is_file, writing
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns
from flight_log.bag import LOST, BagWriter, Channel, Enclosed
from flight_log.disk import free_bytes
from flight_log.message_definitions import definition
from flight_recorder.params import RecorderParameters
from flight_ros.flight_node import NO_PUBLISHER_WARNING_NS, FlightNode
from flight_ros.messages import instant, stamp_of
from flight_ros.subscriptions import PolledSubscription, ReceivedMessage
from flight_ros.ticker import Tick
from flight_ros.topics import FLIGHT, PUBLISH, RECORD, RECORD_FOREIGN, RECORDED, TRUTH, Topic

FLUSH_PERIOD_NS = nanoseconds(
    0.1
)  # what a killed recorder loses at most, and how often topics that are not there are looked for

DISK_PERIOD_NS = NANOSECONDS

MEGABYTE = 1e6

FOREVER_NS = 2**63 - 1  # rmw: RMW_DURATION_INFINITE

# As ROS 2 itself publishes them (rmw: rmw_qos_profile_rosout_default, rmw_qos_profile_parameter_events).
LOGS = Topic("/rosout", Log, foreign=True)
PARAMETER_EVENTS = Topic("/parameter_events", ParameterEvent, foreign=True)


@dataclass
class _Source:
    """A topic that is recorded."""

    subscription: PolledSubscription
    channel: Channel
    next: int = 0  # the sequence that comes next, 0 before anything has come
    publishers: int = 0  # how many there were when last looked


class RecorderNode(FlightNode[RecorderParameters]):
    """Takes all that has arrived at each tick and appends it to the bag."""

    def __init__(self) -> None:
        super().__init__("recorder", RecorderParameters)
        wanted = [self._full_name(name) for name in self.parameters.topics]
        self._bag = self._begin()
        self._sources = [
            *(self._record(self.subscribe(topic, RECORD), [PUBLISH]) for topic in FLIGHT if not topic.foreign),
            *(
                self._record(PolledSubscription(self, topic, RECORD_FOREIGN, raw=True), [PUBLISH])
                for topic in FLIGHT
                if topic.foreign
            ),
            self._record(PolledSubscription(self, LOGS, RECORD, raw=True), [RECORD]),
            self._record(PolledSubscription(self, PARAMETER_EVENTS, RECORD_FOREIGN, raw=True), [RECORD_FOREIGN]),
        ]
        recorded = {source.subscription.name for source in self._sources}
        self._missing = [name for name in dict.fromkeys(wanted) if name not in recorded]
        self._publish_recorded = self.advertise(RECORDED) if self.parameters.lockstep else None
        self.lost: Counter[str] = Counter()
        self._ended = ""  # why it no longer records
        self._flushed_ns = self._emptied_ns = self._disk_ns = time.monotonic_ns()
        self._patience_ns = time.monotonic_ns() + NO_PUBLISHER_WARNING_NS
        self.get_logger().info(f"recording to {self._bag.path}")

    def _full_name(self, name: str) -> str:
        try:
            validate_topic_name(name)
            return str(self.resolve_topic_name(name))
        except InvalidTopicNameException:
            raise ParameterError(f"recorder.topics: found {name!r}, expected the name of a topic") from None

    def _begin(self) -> BagWriter:
        """The bag with all that it holds beside messages. Raises ParameterError where it cannot be written."""
        parameters = self.parameters
        enclosed = Enclosed(
            _file(parameters.scenario_file, "scenario_file"),
            tuple(path for name in parameters.attach if (path := _file(name, "attach"))),
            _file(parameters.metadata_file, "metadata_file"),
        )
        default = f"runs/{datetime.now(UTC):%Y%m%dT%H%M%SZ}-recording"
        directory = Path(parameters.directory or default).absolute()
        with writing("recorder.directory", directory, "a folder that can"):
            directory.mkdir(parents=True, exist_ok=True)
            if sentence := self._short_of_space(directory):
                raise ParameterError(f"recorder.min_free: {sentence}")
            bag = BagWriter(directory)
            bag.enclose(enclosed, time.time_ns())
            bag.flush()
        return bag

    def _short_of_space(self, directory: Path) -> str:
        free, least = free_bytes(directory) / MEGABYTE, self.parameters.min_free
        return "" if free >= least else f"found {free:.1f} MB free in {directory}, expected at least {least:g} MB"

    def _record(self, subscription: PolledSubscription, offered: Sequence[QoSProfile]) -> _Source:
        return _Source(
            subscription, self._bag.add_topic(subscription.name, _type_name(subscription.topic.type), _qos_yaml(offered))
        )

    def period_ns(self) -> int:
        return period_ns(self.parameters.rate, "rate")

    def steps(self) -> bool:
        return False  # it writes at its ticks in lockstep too, many instants at a time, and says how far it has kept up

    def advance(self) -> bool:
        """Together with others in one process: at ticks between their steps. It never holds them up."""
        if time.monotonic_ns() - self._emptied_ns > self.period_ns():
            self._write()
        return False

    def tick(self, tick: Tick, now_ns: int) -> None:
        self._write()

    def _write(self) -> None:
        """Empty the polled_subscriptions, and now and then do what need not be done at each tick."""
        now_ns = self._emptied_ns = time.monotonic_ns()
        kept_up = self._drain_subscriptions()
        if self._publish_recorded is not None and kept_up is not None:
            self._publish_recorded(instant(kept_up))
        if now_ns - self._flushed_ns < FLUSH_PERIOD_NS or self._ended:
            return
        self._flushed_ns = now_ns
        self._guarded(self._bag.flush)
        if self._ended:
            return
        self._look_for_missing(now_ns)
        self._look_for_weaker()
        if now_ns - self._disk_ns > DISK_PERIOD_NS:
            self._disk_ns = now_ns
            self._guarded(self._look_at_disk)

    def _look_at_disk(self) -> None:
        if sentence := self._short_of_space(self._bag.directory):
            self._end(f"min_free: {sentence}")

    def _drain_subscriptions(self) -> int | None:
        """Write all that has come; the instant of the newest sample of `truth`, where one has, ns."""
        newest = None
        for source in self._sources:
            received = source.subscription.take()
            if received and source.subscription.topic is TRUTH:
                newest = stamp_of(received[-1].message)
            if not self._ended:
                self._guarded(partial(self._append, source, received))
        return newest

    def _append(self, source: _Source, received: Sequence[ReceivedMessage]) -> None:
        write, channel = self._bag.write, source.channel
        # Several nodes may publish on a foreign topic: their sequences interleave and tell nothing.
        counted = not source.subscription.topic.foreign
        for message, sent_ns, received_ns, sequence in received:
            write(channel, received_ns, sent_ns, sequence, message)
            if counted:
                if sequence > source.next > 0:
                    self._say_lost(source.subscription.name, sequence - source.next)
                source.next = sequence + 1

    def _say_lost(self, name: str, count: int) -> None:
        self.lost[name] += count
        self.get_logger().warning(f"{name}: {count} messages lost", throttle_duration_sec=2.0)

    def _guarded(self, write: Callable[[], None]) -> None:
        """Do what writes to the bag; once the disk is full or fails the bag is ended, once, and the flight goes on."""
        try:
            write()
        except OSError as error:
            self._end(f"{self._bag.path} cannot be written ({error.strerror})")
        else:
            if self._bag.full:
                self._end(f"no space left for {self._bag.path}")

    def _end(self, reason: str) -> None:
        if not self._ended:
            self._ended = f"recording ended: {reason}{self._close_bag()}"
            self.get_logger().error(self._ended)

    def _close_bag(self) -> str:
        """Finish the bag; what is to be said where it cannot be."""
        try:
            self._bag.note(LOST, {name: str(count) for name, count in self.lost.items()})
            self._bag.close()
        except OSError as error:
            return f"; {self._bag.path.name} has no end: it cannot be written ({error.strerror})"
        return ""

    # Topics of others: they may appear late, and with any quality of service

    def _look_for_weaker(self) -> None:
        for source in self._sources:
            if (
                source.subscription.topic.foreign
                and (count := self.count_publishers(source.subscription.name)) != source.publishers
            ):
                source.publishers = count
                self._fit(source)

    def _look_for_missing(self, now_ns: int) -> None:
        for name in list(self._missing):
            if offered := self.get_publishers_info_by_topic(name):
                self._missing.remove(name)
                self._subscribe(name, offered[0].topic_type)
        if self._missing and now_ns > self._patience_ns:
            self._patience_ns = now_ns + 10 * NO_PUBLISHER_WARNING_NS
            self.get_logger().warning(f"nobody publishes {', '.join(self._missing)}; recorded as soon as somebody does")

    def _subscribe(self, name: str, type_name: str) -> None:
        package, _, kind = type_name.partition("/msg/")
        try:
            message = getattr(import_module(f"{package}.msg"), kind)
            definition(type_name)
        except (ImportError, AttributeError, ParameterError):
            self.get_logger().warning(f"{name} is not recorded: its type {type_name} is not installed")
            return
        offered = self._offered(name, type_name)
        self._sources.append(
            self._record(PolledSubscription(self, Topic(name, message, foreign=True), _fitting(offered), raw=True), offered)
        )

    def check_graph(self) -> None:
        super().check_graph()
        for source in self._sources:
            name, type_name = source.subscription.name, source.channel.type.name
            for peer in self.get_publishers_info_by_topic(name) if source.subscription.topic.foreign else ():
                if peer.topic_type != type_name:
                    node = f"{peer.node_namespace.rstrip('/')}/{peer.node_name}"
                    sentence = f"{name}: {node} publishes {peer.topic_type}, expected {type_name}"
                    self.get_logger().error(sentence, throttle_duration_sec=5.0)

    def _offered(self, name: str, type_name: str) -> list[QoSProfile]:
        return [peer.qos_profile for peer in self.get_publishers_info_by_topic(name) if peer.topic_type == type_name]

    def _fit(self, source: _Source) -> None:
        """Ask for less where somebody has come who offers less."""
        subscription, name = source.subscription, source.subscription.name
        offered = self._offered(name, source.channel.type.name)
        if all(qos_check_compatible(one, subscription.qos)[0] != QoSCompatibility.ERROR for one in offered):
            return
        # Volatile: what was kept for those who come late has been recorded already.
        weaker = QoSProfile(depth=subscription.qos.depth, reliability=_fitting(offered).reliability)
        self._drain_subscriptions()
        self.destroy_subscription(subscription.entity)
        source.subscription = PolledSubscription(self, subscription.topic, weaker, raw=True)
        self.get_logger().info(
            f"{name}: now recorded with {weaker.reliability.short_key}, as not all of its publishers offer more"
        )

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        figures: dict[str, object] = {f"messages {channel.topic}": channel.messages for channel in self._bag.channels}
        figures |= {f"lost {name}": count for name, count in self.lost.items()}
        figures |= {f"missing {name}": "nobody publishes it" for name in self._missing}
        if self._ended:
            return DiagnosticStatus.ERROR, self._ended, figures
        level = DiagnosticStatus.WARN if self.lost or self._missing else DiagnosticStatus.OK
        return level, f"recording to {self._bag.path}", figures

    def close(self) -> None:
        self._drain_subscriptions()
        if not self._ended:
            self._ended = "recording ended"
            if sentence := self._close_bag():
                self.get_logger().error(f"{self._ended}{sentence}")
        for name in self._missing:
            self.get_logger().warning(f"{name} is not in the log: nobody published it")
        self.get_logger().info(f"{self._bag.contents().messages} messages in {self._bag.path}")


def _file(name: str, key: str) -> Path | None:
    require(not name or is_file(Path(name)), f"recorder.{key}", f"{name!r}", "the path of a file")
    return Path(name) if name else None


def _fitting(offered: Sequence[QoSProfile]) -> QoSProfile:
    """The strongest quality of service that fits all that is offered."""
    reliable = all(one.reliability == ReliabilityPolicy.RELIABLE for one in offered)
    durable = reliable and all(one.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in offered)
    return QoSProfile(
        depth=RECORD.depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if durable else DurabilityPolicy.VOLATILE,
    )


def _type_name(kind: type) -> str:
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


def _qos_yaml(offered: Sequence[QoSProfile]) -> str:
    return yaml.safe_dump([_qos(one) for one in offered], sort_keys=False)


def _qos(qos: QoSProfile) -> dict[str, object]:
    return {
        "history": qos.history.short_key,
        "depth": qos.depth,
        "reliability": qos.reliability.short_key,
        "durability": qos.durability.short_key,
        "deadline": _duration(qos.deadline),
        "lifespan": _duration(qos.lifespan),
        "liveliness": "automatic",
        "liveliness_lease_duration": _duration(qos.liveliness_lease_duration),
        "avoid_ros_namespace_conventions": False,
    }


def _duration(duration: Duration) -> dict[str, int]:
    sec, nsec = divmod(duration.nanoseconds or FOREVER_NS, NANOSECONDS)  # 0 stands for none
    return {"sec": sec, "nsec": nsec}
