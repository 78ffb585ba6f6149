# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A log as messages to be sent again: which, and when. Needs no ROS; `flight_ros.player` sends them."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from flight_core.parameters import require
from flight_core.rates import NANOSECONDS, nanoseconds, seconds
from flight_log.named_vectors import JOINT_STATE, STAMP, decoder, flight_start_ns
from flight_log.stored_messages import Stored, stored_messages

CLOCK = "/clock"
"""Never played: the player has a clock of its own."""

SHARED = ("/diagnostics", "/parameter_events", "/rosout")
"""Topics on which every node of a domain may publish; of a log they are played only where they are asked for."""

OTHER_CLOCK_NS = 86_400 * NANOSECONDS
"""Stamps further than a day from the clock of the machine are of another clock: flight time, as in lockstep."""

NO_FIELD = re.compile(r"\s*(#|$|\S+\s+\w+\s*=)")  # a comment, nothing, a constant
STAMPED = re.compile(r"\s*((std_msgs/)?Header|builtin_interfaces/Time)\s")


class Message(NamedTuple):
    """A message that is to be sent."""

    due_ns: int  # on the scale of the log's stamps
    topic: str
    data: bytes  # CDR, as recorded
    stamped: bool  # whether a stamp on that scale stands in front of all else


class Playback(NamedTuple):
    """What is to be sent, in the order of the instants at which it is due."""

    types: Mapping[str, str]  # type names by full topic name
    messages: Sequence[Message]
    start_ns: int  # the instant at which flight time is 0

    def t(self, due_ns: int) -> float:
        """Flight time of an instant, s."""
        return seconds(due_ns - self.start_ns)


def read_playback(run: Path, topics: Sequence[str] = (), start: float = 0.0) -> Playback:
    """The messages of a log from a flight time on; `topics` by their full or last names, none for all but the shared ones.

    A message is due when it was sent, and in a log of lockstep, where the machine's clock tells nothing, at its stamp, but
    not before those that were sent before it. Raises ParameterError where the log cannot be read or lacks a topic, or ends
    before the start.
    """
    stored = sorted((one for one in stored_messages(run) if one.topic != CLOCK), key=_sent_ns)
    known = {one.topic: one for one in stored}
    wanted = {full for name in topics for full in _matching(name, known, str(run))} if topics else set(known) - set(SHARED)
    require(bool(wanted), str(run), "no message", "a recorded flight")
    stamped = {topic: begins_with_stamp(one.definition) for topic, one in known.items()}
    votes = [_is_of_other_clock(one) for one in stored if one.type_name == JOINT_STATE]
    other_clock = 2 * sum(votes) > len(votes)
    messages, now_ns = [], 0
    for one in stored:
        # What has a stamp of the other scale, or none yet, says nothing of when it is due and keeps it.
        fits = stamped[one.topic] and _is_of_other_clock(one) is other_clock
        if not other_clock:
            now_ns = _sent_ns(one)
        elif fits:
            now_ns = max(now_ns, _stamp_ns(one.data))
        if one.topic in wanted:
            messages.append(Message(now_ns, one.topic, one.data, fits))
    start_ns = _start_ns(stored, messages[0].due_ns)
    begin_ns = start_ns + nanoseconds(start)
    end = seconds(messages[-1].due_ns - start_ns)
    require(begin_ns <= messages[-1].due_ns, "start", f"{start:g} s", f"a flight time before the end of the log, {end:g} s")
    kept = messages if start <= 0.0 else [message for message in messages if message.due_ns >= begin_ns]
    return Playback({topic: known[topic].type_name for topic in sorted(wanted)}, kept, start_ns)


def begins_with_stamp(definition: str) -> bool:
    """Whether the first field of a message type, given its definition as text, is a header or a time."""
    first = next((line for line in definition.splitlines() if not NO_FIELD.match(line)), "")
    return bool(STAMPED.match(first))


def _matching(name: str, known: Mapping[str, Stored], where: str) -> list[str]:
    found = [topic for topic in known if name in (topic, topic.rpartition("/")[2])]
    require(bool(found), where, f"no message of {name}", f"some of {', '.join(sorted(known))}")
    return found


def _stamp_ns(data: bytes) -> int:
    return int.from_bytes(data[STAMP][:4], "little", signed=True) * NANOSECONDS + int.from_bytes(data[STAMP][4:], "little")


def _sent_ns(stored: Stored) -> int:
    return stored.sent_ns or stored.received_ns


def _is_of_other_clock(stored: Stored) -> bool:
    return abs(_stamp_ns(stored.data) - _sent_ns(stored)) > OTHER_CLOCK_NS


def _start_ns(stored: Sequence[Stored], otherwise: int) -> int:
    """Stamp of flight time 0, as `truth` says, where there is one."""
    truth = next((one for one in stored if one.topic.rpartition("/")[2] == "truth"), None)
    decode = None if truth is None else decoder(truth.topic, truth.type_name)
    if truth is None or decode is None:
        return otherwise
    for names, stamp_ns, values in decode([truth.data]).samples:
        if "t" in names and (start_ns := flight_start_ns(int(stamp_ns[0]), float(values[0, names.index("t")]))) is not None:
            return start_ns
    return otherwise
