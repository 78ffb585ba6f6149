# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Publish the messages of a log again, with their timing."""

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from importlib import import_module
from typing import Any

from rclpy.exceptions import InvalidTopicNameException
from rclpy.validate_full_topic_name import validate_full_topic_name

from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS
from flight_core.vectors import ChannelError
from flight_log.playback import ScheduledMessage
from flight_ros.client import Client
from flight_ros.endpoints import require_no_publishers
from flight_ros.event_loop import IDLE_POLL_PERIOD
from flight_ros.flight_node import ACKNOWLEDGE_TIMEOUT
from flight_ros.messages import STAMP, STAMP_PLACE, instant, stamp_of
from flight_ros.topics import CLOCK, LOCKSTEP

DISCOVERY_TIME = 1.0  # s, time to discover other publishers
EXPECTED = "no publisher: set ROS_DOMAIN_ID to an unused domain, or choose other --topics"
MATCHING_TIME = 0.5  # s, time to discover the subscribers
CLOCK_PERIOD_NS = 10_000_000  # ns of the log between two samples of `/clock`
CLOCK_NAME = f"/{CLOCK.name}"  # the name that ROS uses for simulated time
PROGRESS_PERIOD_NS = 100_000_000


class Player(Client):
    """Publishes the messages of a log on its topics, and the time of the log on `/clock`.

    Raises ParameterError if a topic already has a publisher, unless it is one of `shared`, or if a
    message type is not installed.
    """

    def __init__(self, types: Mapping[str, str], shared: Collection[str]) -> None:
        kinds = {topic: _message_type(topic, name) for topic, name in types.items()}
        super().__init__("player", rosout=False)
        try:
            topics = [topic for topic in (*types, CLOCK_NAME) if topic not in shared]
            require_no_publishers(self._node, topics, EXPECTED, DISCOVERY_TIME)
            self._publishers = {
                topic: self._node.create_publisher(kind, topic, LOCKSTEP)
                for topic, kind in kinds.items()
            }
            self._clock = self._node.create_publisher(CLOCK.type, CLOCK_NAME, LOCKSTEP)
            time.sleep(MATCHING_TIME)
        except BaseException:
            self.__exit__()
            raise

    def play(
        self,
        messages: Iterable[ScheduledMessage],
        rate: float,
        *,
        stamps_now: bool,
        progress: Callable[[int], None] | None = None,
    ) -> None:
        """Publish all messages with the timing of the log, divided by `rate`.

        The first message is sent immediately. Each further message is sent when its time since the
        first, divided by `rate`, has passed. Deadlines are absolute on the monotonic clock, so
        delays do not add up. If `stamps_now` is True, the stamps are moved to the present. The age
        of a message by the system clock is then its age in the log, divided by `rate`. `progress`
        is called ten times a second with the instant of the log, ns.
        """
        begin_ns = begin_system_ns = first_ns = clock_ns = progress_ns = 0
        for message in messages:
            due_ns = message.due_ns
            if begin_ns == 0:
                begin_ns = time.monotonic_ns()
                begin_system_ns = time.time_ns()
                first_ns = clock_ns = due_ns
            while clock_ns <= due_ns:
                _sleep_until(begin_ns + round((clock_ns - first_ns) / rate))
                self._clock.publish(instant(clock_ns))
                clock_ns += CLOCK_PERIOD_NS
                if progress is not None and time.monotonic_ns() >= progress_ns:
                    progress_ns = time.monotonic_ns() + PROGRESS_PERIOD_NS
                    progress(due_ns)
            _sleep_until(begin_ns + round((due_ns - first_ns) / rate))
            data = message.data
            if stamps_now and message.is_stamped:
                data = _restamped(data, begin_system_ns, first_ns, rate)
            self._publishers[message.topic].publish(data)
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(ACKNOWLEDGE_TIMEOUT)


def _restamped(data: bytes, begin_ns: int, first_ns: int, rate: float) -> bytes:
    try:
        since_ns = stamp_of(data) - first_ns
    except ChannelError:
        # The message is too short for a stamp, so it is sent as it is in the log.
        return data
    stamp_ns = begin_ns + (since_ns if rate == 1.0 else round(since_ns / rate))
    message = bytearray(data)
    STAMP.pack_into(message, STAMP_PLACE, *divmod(stamp_ns, NANOSECONDS))
    return bytes(message)


def _sleep_until(deadline_ns: int) -> None:
    while (pause_ns := deadline_ns - time.monotonic_ns()) > 0:
        time.sleep(min(pause_ns / NANOSECONDS, IDLE_POLL_PERIOD))


def unsendable(types: Mapping[str, str]) -> dict[str, str]:
    """Return the topics that cannot be published, each with its type.

    Either the message type of such a topic is not installed, or ROS does not permit its name.
    """
    lacking = {}
    for topic, name in types.items():
        try:
            validate_full_topic_name(topic)
            _message_type(topic, name)
        except (InvalidTopicNameException, ParameterError):
            lacking[topic] = name
    return lacking


def _message_type(topic: str, name: str) -> Any:
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError, ValueError):
        # This also catches a log whose type name is no name of a type.
        raise ParameterError(
            f"{topic}: its type {name} is not installed, expected the package {package}"
        ) from None
