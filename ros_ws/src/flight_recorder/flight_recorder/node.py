# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder's node: every topic of a flight, as it came over the wire, to one MCAP bag."""

import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import QoSProfile

from flight_core.files import is_file
from flight_core.parameters import ParameterError, require
from flight_core.rates import nanoseconds, period_ns
from flight_recorder.bag import OTHER, SCENARIO, BagWriter
from flight_recorder.params import RecorderParameters
from flight_ros.inbox import Inbox
from flight_ros.messages import instant, stamp_of
from flight_ros.runtime import FlightNode, run
from flight_ros.ticker import Tick
from flight_ros.topics import FLIGHT, PUBLISH, RECORD, RECORD_FOREIGN, RECORDED, TRUTH, Topic

FLUSH_PERIOD = 0.1  # s, what a killed recorder loses at most


class RecorderNode(FlightNode[RecorderParameters]):
    """Takes all that has arrived at each tick and appends it to the bag."""

    def __init__(self) -> None:
        super().__init__("recorder", RecorderParameters)
        default = f"runs/{datetime.now(UTC):%Y%m%dT%H%M%SZ}-recording"
        directory = Path(self.parameters.directory or default).absolute()
        scenario = [_file(path, "scenario_file") for path in (self.parameters.scenario_file,) if path]
        attached = [_file(path, "attach") for path in self.parameters.attach]
        try:
            self._bag = BagWriter(directory)
        except OSError as error:
            raise ParameterError(f"recorder.directory: {directory} cannot be written ({error.strerror})") from None
        for media_type, paths in ((SCENARIO, scenario), (OTHER, attached)):
            for path in paths:
                self._bag.attach(path.name, media_type, path.read_bytes(), time.time_ns())
        self._recorded = [self._record(topic) for topic in FLIGHT]
        self._recorded_publisher = self.publisher(RECORDED) if self.parameters.lockstep else None
        self._last_sequence: dict[str, int] = {}
        self.lost: Counter[str] = Counter()
        self._failed = ""
        self._flushed_ns = self._emptied_ns = time.monotonic_ns()
        self.get_logger().info(f"recording to {self._bag.path}")

    def _record(self, topic: Topic) -> Inbox:
        inbox = self.inbox(topic, RECORD_FOREIGN if topic.foreign else RECORD)
        type_name = f"{topic.type.__module__.split('.')[0]}/msg/{topic.type.__name__}"
        self._bag.add_topic(inbox.name, type_name, _qos_yaml(PUBLISH))
        return inbox

    def period_ns(self) -> int:
        return period_ns(self.parameters.rate, "rate")

    def steps(self) -> bool:
        return False  # it writes at its ticks in lockstep too, many instants at a time, and says how far it has kept up

    def advance(self) -> bool:
        """Together with others in one process: at ticks between their steps. It never holds them up."""
        if time.monotonic_ns() - self._emptied_ns > self.period_ns():
            self._emptied_ns = time.monotonic_ns()
            self._write()
        return False

    def tick(self, tick: Tick, now_ns: int) -> None:
        self._write()

    def _write(self) -> None:
        kept_up = None
        try:
            kept_up = self._empty_inboxes()
            if not self._failed and time.monotonic_ns() - self._flushed_ns > nanoseconds(FLUSH_PERIOD):
                self._flushed_ns = time.monotonic_ns()
                self._bag.flush()
        except OSError as error:  # the flight goes on, and what was written stays readable
            self._failed = f"recording ended: {self._bag.path} cannot be written ({error.strerror})"
            self.get_logger().error(self._failed)
        if self._recorded_publisher is not None and kept_up is not None:
            self._recorded_publisher.publish(instant(kept_up))

    def _empty_inboxes(self) -> int | None:
        """Write all that has come; the instant of the newest sample of `truth`, where one has, ns."""
        newest = None
        for inbox in self._recorded:
            for received in inbox.take():
                if inbox.topic is TRUTH:
                    newest = stamp_of(received.message)
                if not self._failed:
                    self._bag.write(inbox.name, received.received_ns, received.sent_ns, received.sequence, received.message)
                    self._count_gap(inbox, received.sequence)
        return newest

    def _count_gap(self, inbox: Inbox, sequence: int) -> None:
        # Several nodes may publish on a foreign topic: their sequences interleave and tell nothing.
        if inbox.topic.foreign:
            return
        gap = sequence - self._last_sequence.get(inbox.name, sequence - 1) - 1
        self._last_sequence[inbox.name] = sequence
        if gap > 0:
            self.lost[inbox.name] += gap
            self.get_logger().warning(f"{inbox.name}: {gap} messages lost", throttle_duration_sec=2.0)

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        counts: dict[str, object] = {f"messages {name}": channel.count for name, channel in self._bag.channels.items()}
        lost: dict[str, object] = {f"lost {name}": count for name, count in self.lost.items()}
        if self._failed:
            return DiagnosticStatus.ERROR, self._failed, counts | lost
        level = DiagnosticStatus.WARN if lost else DiagnosticStatus.OK
        return level, f"recording to {self._bag.path}", counts | lost

    def close(self) -> None:
        try:
            self._empty_inboxes()
            self._bag.note("rise_di_lost", {name: str(count) for name, count in self.lost.items()})
            self._bag.close()
        except OSError as error:
            self.get_logger().error(f"{self._bag.path} has no end: it cannot be written ({error.strerror})")
        total = sum(channel.count for channel in self._bag.channels.values())
        self.get_logger().info(f"{total} messages in {self._bag.path}")


def _file(name: str, key: str) -> Path:
    require(is_file(Path(name)), f"recorder.{key}", f"{name!r}", "the path of a file")
    return Path(name)


def _qos_yaml(qos: QoSProfile) -> str:
    forever = {"sec": 9223372036, "nsec": 854775807}
    profile = {
        "history": "keep_last",
        "depth": qos.depth,
        "reliability": qos.reliability.short_key,
        "durability": qos.durability.short_key,
        "deadline": forever,
        "lifespan": forever,
        "liveliness": "automatic",
        "liveliness_lease_duration": forever,
        "avoid_ros_namespace_conventions": False,
    }
    return yaml.safe_dump([profile], sort_keys=False)


def main() -> None:
    """Entry point of the executable `recorder`."""
    run(RecorderNode)


if __name__ == "__main__":
    main()
