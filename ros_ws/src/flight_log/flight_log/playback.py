# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Playback schedule of a log: the messages and the times to send. Needs no ROS; `flight_bringup.player` sends."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS, nanoseconds, seconds
from flight_log.named_vectors import JOINT_STATE, decoder, flight_start_ns, stamp_of, tables
from flight_log.rosbag2_metadata import is_compressed, read_bag_metadata
from flight_log.stored_messages import StoredMessage, stored_messages

CLOCK = "/clock"  # never played: the player publishes its own clock

SHARED = ("/diagnostics", "/parameter_events", "/rosout")
"""Topics on which every node of a domain may publish. They are played only by name."""

MAX_CLOCK_OFFSET_NS = 86_400 * NANOSECONDS  # a stamp further than a day from the host's clock is flight time, as in lockstep
NO_FIELD = re.compile(r"\s*(#|$|\S+\s+\w+\s*=)")  # a comment, an empty line, a constant
STAMPED = re.compile(r"\s*((std_msgs/)?Header|builtin_interfaces/Time)\s")


class ScheduledMessage(NamedTuple):
    """A message to send."""

    due_ns: int  # on the time scale of the log's stamps
    topic: str
    data: bytes  # CDR, as recorded
    stamped: bool  # whether it begins with a stamp on that time scale


class Playback(NamedTuple):
    """The messages to send, in the order of their due times."""

    types: Mapping[str, str]  # type names by full topic name
    messages: Sequence[ScheduledMessage]
    start_ns: int  # the instant of flight time 0

    def t(self, due_ns: int) -> float:
        """Flight time of an instant, s."""
        return seconds(due_ns - self.start_ns)


def read_playback(run: Path, topics: Sequence[str] = (), start: float = 0.0) -> Playback:
    """The messages of a log from flight time `start` in s. `topics`: full or last names; empty for every topic except SHARED.

    A message is due at the time of sending. In a log of a lockstep flight the host's clock has no meaning: there a message is
    due at the stamp, but not before the messages sent earlier. Raises ParameterError when the log cannot be read, lacks a
    topic, ends before the start, or holds compressed messages.
    """
    require(not is_compressed(_information(run)), str(run), "compressed messages", "plain ones: see ros2 bag convert")
    stored = sorted((message for message in stored_messages(run) if message.topic != CLOCK), key=_sent_ns)
    known = {message.topic: message for message in stored}
    wanted = {full for name in topics for full in _matching(name, known, str(run))} if topics else set(known) - set(SHARED)
    require(bool(wanted), str(run), "no message", "a recorded flight")
    begins_stamped = {topic: begins_with_stamp(message.definition) for topic, message in known.items()}
    votes = [_is_flight_time(message) for message in stored if message.type_name == JOINT_STATE]
    lockstep = 2 * sum(votes) > len(votes)
    messages, now_ns = [], 0
    for message in stored:
        # A stamp on the second time scale, or an unset stamp, gives no due time. The message is sent unchanged.
        stamped = begins_stamped[message.topic] and _is_flight_time(message) is lockstep
        if not lockstep:
            now_ns = _sent_ns(message)
        elif stamped:
            now_ns = max(now_ns, stamp_of(message.data))
        if message.topic in wanted:
            messages.append(ScheduledMessage(now_ns, message.topic, message.data, stamped))
    start_ns = _start_ns(stored, messages[0].due_ns)
    begin_ns = start_ns + nanoseconds(start)
    end = seconds(messages[-1].due_ns - start_ns)
    require(begin_ns <= messages[-1].due_ns, "start", f"{start:g} s", f"a flight time before the end of the log, {end:g} s")
    kept = messages if start <= 0.0 else [message for message in messages if message.due_ns >= begin_ns]
    return Playback({topic: known[topic].type_name for topic in sorted(wanted)}, kept, start_ns)


def begins_with_stamp(definition: str) -> bool:
    """Whether the first field of a message type is a header or a time, by the definition as text."""
    first = next((line for line in definition.splitlines() if not NO_FIELD.match(line)), "")
    return bool(STAMPED.match(first))


def _information(run: Path) -> Mapping[str, Any]:
    """The content of metadata.yaml; empty for an unreadable file."""
    try:
        return read_bag_metadata(run)[0]
    except ParameterError:
        return {}


def _matching(name: str, known: Mapping[str, StoredMessage], where: str) -> list[str]:
    topics = [topic for topic in known if name in (topic, topic.rpartition("/")[2])]
    require(bool(topics), where, f"no message of {name}", f"some of {', '.join(sorted(known))}")
    return topics


def _sent_ns(stored: StoredMessage) -> int:
    return stored.sent_ns or stored.received_ns


def _is_flight_time(stored: StoredMessage) -> bool:
    return abs(stamp_of(stored.data) - _sent_ns(stored)) > MAX_CLOCK_OFFSET_NS


def _start_ns(stored: Sequence[StoredMessage], otherwise: int) -> int:
    """Stamp of flight time 0, by the first `truth` or else the first `y_m`; `otherwise` without both."""
    first: dict[str, StoredMessage] = {}
    for message in stored:
        first.setdefault(message.topic.rpartition("/")[2], message)
    truth, y_m = first.get("truth"), first.get("y_m")
    otherwise = otherwise if y_m is None else stamp_of(y_m.data)
    decode = None if truth is None else decoder(truth.type_name)
    if truth is None or decode is None:
        return otherwise
    for names, stamp_ns, values, _ in decode(next(tables([truth.data]))).samples:
        if "t" in names and (start_ns := flight_start_ns(int(stamp_ns[0]), float(values[0, names.index("t")]))) is not None:
            return start_ns
    return otherwise
