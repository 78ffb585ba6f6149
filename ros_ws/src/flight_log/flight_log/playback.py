# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Schedule the playback of a log: the messages, and the times at which to send them.

The module needs no ROS. `flight_bringup.player` sends the messages.
"""

import re
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import yaml

from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS, nanoseconds, seconds
from flight_log.message_definitions import definition
from flight_log.named_vectors import JOINT_STATE, decoder, flight_start_ns, stamp_in, tables
from flight_log.stored_messages import StoredMessage, stored_messages
from flight_log.tape_reader import A_FLIGHT, chosen_namespace, names_within, topics_text

CLOCK = "/clock"  # never played, because the player publishes a clock

SHARED = ("/diagnostics", "/parameter_events", "/rosout")
"""Topics on which every node of a domain can publish. They are played only if they are named."""

# largest depth of a latched topic. The 20,000 messages that a lockstep flight keeps are no latch.
MAX_LATCHED = 100
# A stamp that differs by more than a day from the host's clock is flight time, as in lockstep.
MAX_CLOCK_OFFSET_NS = 86_400 * NANOSECONDS
# a line that declares no field: a comment, an empty line or a constant
NO_FIELD = re.compile(r"\s*(#|$|\S+\s+\w+\s*=)")
STAMPED = re.compile(r"\s*((std_msgs(/|::)(msg::)?)?Header|builtin_interfaces(/|::)(msg::)?Time)\s")
IDL_STRUCT = re.compile(r"\bstruct\s+\w+\s*\{")  # the first match is the type itself


class ScheduledMessage(NamedTuple):
    """A message to send, with the time at which it is due."""

    due_ns: int  # on the time scale of the stamps in the log
    topic: str
    data: bytes  # CDR, as recorded
    is_stamped: bool  # whether the data begin with a stamp on this time scale


class Playback(NamedTuple):
    """The messages to send, in the order of their due times."""

    types: Mapping[str, str]  # type names by full topic name
    messages: Sequence[ScheduledMessage]
    start_ns: int  # the instant of flight time 0
    # kind of the messages that no ROS topic can carry, by full topic name
    skipped: Mapping[str, str]

    def t(self, due_ns: int) -> float:
        """Return the flight time of an instant, s."""
        return seconds(due_ns - self.start_ns)


def read_playback(
    run: Path, topics: Sequence[str] = (), start: float = 0.0, namespace: str | None = None
) -> Playback:
    """Read the messages of a log from the flight time `start`, s.

    `topics` are full names, or the last parts of names. If `topics` is empty, every topic except
    SHARED is played. `namespace` selects an aircraft; None selects every aircraft. Topics in an
    encoding other than CDR, such as JSON, are skipped.

    A message is due at its time of sending. In the log of a lockstep flight, however, the host's
    clock has no meaning. A message is then due at its stamp, but not earlier than messages that
    were sent before it. Raises ParameterError if the log cannot be read, lacks a topic or the
    namespace, or ends before the start.
    """
    stored = sorted(
        (message for message in stored_messages(run) if message.topic != CLOCK), key=_sent_ns
    )
    skipped = {
        message.topic: kind for message in stored if (kind := _unsendable_kind(message)) is not None
    }
    stored = [message for message in stored if message.topic not in skipped]
    if namespace is not None:
        stored = _within(stored, namespace, str(run))
    last_messages = {message.topic: message for message in stored}
    selection = set[str]() if topics else set(last_messages) - set(SHARED)
    for name in topics:
        selection.update(_matching(name, last_messages, str(run)))
    among = f" to play among {topics_text(skipped)}" if skipped else ""
    require(bool(selection), str(run), f"no message{among}", A_FLIGHT)
    lockstep = _is_lockstep(stored)
    messages = [*_scheduled(stored, last_messages, selection, lockstep=lockstep)]
    starts = (message for message in stored if _is_flight_time(message) is lockstep)
    start_ns = _start_ns(starts, messages[0].due_ns)
    begin_ns = start_ns + nanoseconds(start)
    end = seconds(messages[-1].due_ns - start_ns)
    require(
        begin_ns <= messages[-1].due_ns,
        "start",
        f"{start:g} s",
        f"a flight time before the end of the log, {end:g} s",
    )
    if start > 0.0:
        later = (message for message in messages if message.due_ns >= begin_ns)
        messages = [*_latched(messages, last_messages, begin_ns), *later]
    types = {topic: last_messages[topic].type_name for topic in sorted(selection)}
    return Playback(types, messages, start_ns, skipped)


def _within(messages: Sequence[StoredMessage], namespace: str, where: str) -> list[StoredMessage]:
    """Return the messages of an aircraft, and of SHARED topics.

    Raises ParameterError if no aircraft has the namespace.
    """
    topics = {message.topic for message in messages}
    names = names_within(chosen_namespace(topics, namespace, where), topics)
    inside = {*names, *SHARED}
    return [message for message in messages if message.topic in inside]


def _is_lockstep(messages: Iterable[StoredMessage]) -> bool:
    """Return whether most stamps of named vectors are flight times, as in lockstep."""
    votes = [
        _is_flight_time(message)
        for message in messages
        if message.type_name == JOINT_STATE and stamp_in(message.data)
    ]
    return 2 * sum(votes) > len(votes)


def _scheduled(
    messages: Iterable[StoredMessage],
    last_messages: Mapping[str, StoredMessage],
    selection: Collection[str],
    *,
    lockstep: bool,
) -> Iterator[ScheduledMessage]:
    """Yield the messages of the selected topics with their due times."""
    stamped_topics = {
        topic for topic, message in last_messages.items() if is_stamped(_definition(message))
    }
    now_ns = 0
    for message in messages:
        # A stamp on the other time scale, or a stamp that was not set, gives no due time. Such a
        # message is sent unchanged.
        has_stamp = message.topic in stamped_topics and _is_flight_time(message) is lockstep
        if not lockstep:
            now_ns = _sent_ns(message)
        elif has_stamp:
            now_ns = max(now_ns, stamp_in(message.data))
        if message.topic in selection:
            yield ScheduledMessage(now_ns, message.topic, message.data, has_stamp)


def _latched(
    messages: Sequence[ScheduledMessage], last_messages: Mapping[str, StoredMessage], begin_ns: int
) -> Iterator[ScheduledMessage]:
    """Yield the latched messages from before the beginning, which late subscribers still get.

    /robot_description is such a topic.
    """
    depths = {
        topic: deque[ScheduledMessage](maxlen=latched_depth(message.qos))
        for topic, message in last_messages.items()
    }
    for message in messages:
        if message.due_ns < begin_ns:
            depths[message.topic].append(message._replace(due_ns=begin_ns))
    yield from chain.from_iterable(depths.values())


def latched_depth(qos: str) -> int:
    """Return the number of messages that a topic keeps for a late subscriber, or 0 if volatile.

    `qos` is rosbag2's YAML list of the offered profiles.
    """
    try:
        profiles = yaml.safe_load(qos)
        depths = [
            int(each["depth"])
            for each in profiles or ()
            if each["durability"] in {1, "transient_local"}
        ]
    except (yaml.YAMLError, KeyError, TypeError, ValueError):
        return 0
    depth = max(depths, default=0)
    return depth if depth <= MAX_LATCHED else 0


def _unsendable_kind(message: StoredMessage) -> str | None:
    """Return the kind of a message that no ROS topic can carry, or None for any other message."""
    if message.encoding != "cdr":
        return f"{message.type_name} in {message.encoding}".strip()
    return None if message.type_name else "no type"


def _definition(message: StoredMessage) -> str:
    """Return the definition of a message's type, from the installed package or from the log."""
    try:
        return definition(message.type_name).text
    except ParameterError:
        return message.definition


def is_stamped(text: str) -> bool:
    """Return whether the first field of a message type is a header or a time.

    `text` is the definition of the type, in ros2msg or ros2idl.
    """
    if struct := IDL_STRUCT.search(text):
        text = text[struct.end() :]
    first = next((line for line in text.splitlines() if not NO_FIELD.match(line)), "")
    return bool(STAMPED.match(first))


def _matching(name: str, last_messages: Mapping[str, StoredMessage], where: str) -> list[str]:
    topics = [topic for topic in last_messages if name in (topic, topic.rpartition("/")[2])]
    require(
        bool(topics), where, f"no message of {name}", f"some of {', '.join(sorted(last_messages))}"
    )
    return topics


def _sent_ns(message: StoredMessage) -> int:
    return message.sent_ns or message.received_ns


def _is_flight_time(message: StoredMessage) -> bool:
    return abs(stamp_in(message.data) - _sent_ns(message)) > MAX_CLOCK_OFFSET_NS


def _start_ns(messages: Iterable[StoredMessage], otherwise: int) -> int:
    """Return the stamp of flight time 0, from the first `truth` or from the first `y_m`.

    Returns `otherwise` if the messages contain neither `truth` nor `y_m`.
    """
    first: dict[str, StoredMessage] = {}
    for message in messages:
        first.setdefault(message.topic.rpartition("/")[2], message)
    truth = first.get("truth")
    y_m = first.get("y_m")
    otherwise = otherwise if y_m is None else stamp_in(y_m.data)
    decode = None if truth is None else decoder(truth.type_name)
    if truth is None or decode is None:
        return otherwise
    for samples in decode(next(tables([truth.data]))).samples:
        if "t" not in samples.names:
            continue
        t = float(samples.values[0, samples.names.index("t")])
        start_ns = flight_start_ns(int(samples.stamp_ns[0]), t)
        if start_ns is not None:
            return start_ns
    return otherwise
