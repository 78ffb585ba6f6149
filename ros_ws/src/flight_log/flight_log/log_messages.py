# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Collect from a log the messages for the user: warnings, errors, parameters, learning, bridge."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from rosbags.serde.errors import SerdeError

from flight_core.rates import NANOSECONDS
from flight_core.text import printable
from flight_log.engagements import ENGAGEMENT, KEY_VALUE
from flight_log.flight_processes import LOG, ROSOUT
from flight_log.learning_messages import DIAGNOSTIC_ARRAY, LEARNING, stamped_sentence
from flight_log.named_vectors import typestore
from flight_log.stored_messages import PARAMETER_EVENT, PARAMETER_EVENTS, parameter_value

WARN = 30  # level of rcl_interfaces/msg/Log
CONTROL = "control"  # name of the node that carries out the requests of a page
PARAMETER = "parameter"
MAX_TEXT = 400  # largest number of characters of a text from the log
CUT = " ..."  # mark at the end of a longer text
# The last words are those up to this time before the very last one. A node that waits says so
# every 2 s.
LAST_NS = 3 * NANOSECONDS
# largest number of values of a parameter that are shown: enough for one per channel, but not for a
# matrix
MAX_VALUES = 16


@dataclass(frozen=True, kw_only=True)
class LogMessage:
    """A message of a flight, for the user.

    `stamp_ns` is by the clock of the samples, or by the clock of the host. `kind` is "warning",
    "error", "control", "parameter", "learning" or "bridge", and on the live page also "mode" or
    "route". If the message is about a parameter, `namespace` is the namespace of its node.
    """

    stamp_ns: int
    kind: str
    text: str
    namespace: str | None = None


@dataclass(frozen=True, kw_only=True)
class StoredText:
    """A stored message that can become a LogMessage."""

    topic: str  # full name
    type_name: str
    sent_ns: int
    data: bytes


def has_texts(topic: str, type_name: str) -> bool:
    """Return whether the messages of a topic can become LogMessages."""
    return (
        (topic, type_name) in {(ROSOUT, LOG), (PARAMETER_EVENTS, PARAMETER_EVENT)}
        or (topic.endswith(f"/{LEARNING}") and type_name == DIAGNOSTIC_ARRAY)
        or (topic.endswith(ENGAGEMENT) and type_name == KEY_VALUE)
    )


def log_message(
    message: Any, type_name: str, sent_ns: int, *, has_begun: bool = True
) -> LogMessage | None:
    """Return a decoded message as a LogMessage, or None if it is mere information, or empty.

    Set `has_begun` to False before the first sample. New parameters are then not taken as changes,
    because the nodes still declare their parameters at that time.
    """
    if type_name == LOG:
        if message.level >= WARN:
            kind = "warning" if message.level == WARN else "error"
            return LogMessage(stamp_ns=sent_ns, kind=kind, text=f"{message.name}: {message.msg}")
        if message.name.rpartition(".")[2] == CONTROL:
            return LogMessage(
                stamp_ns=sent_ns, kind=CONTROL, text=message.msg.removeprefix(f"{CONTROL}: ")
            )
        return None
    if type_name == PARAMETER_EVENT:
        entries = (*(message.new_parameters if has_begun else []), *message.changed_parameters)
        changes = {entry.name: parameter_value(entry.value) for entry in entries}
        text = ", ".join(f"{name} = {shown(value)}" for name, value in changes.items())
        namespace, _, node = message.node.rpartition("/")
        told = f"{node}: {text}"
        change = LogMessage(stamp_ns=sent_ns, kind=PARAMETER, text=told, namespace=namespace)
        return change if text else None
    if type_name == DIAGNOSTIC_ARRAY:
        stamp_ns, sentence = stamped_sentence(message)
        return LogMessage(stamp_ns=stamp_ns, kind=LEARNING, text=sentence)
    return LogMessage(
        stamp_ns=sent_ns, kind="bridge", text=f"{message.key} {message.value}".strip()
    )


def log_messages(texts: Iterable[StoredText], namespace: str, first_ns: int) -> list[LogMessage]:
    """Return the messages of an aircraft in a log, in the order of their stamps.

    `first_ns` is the stamp of the first sample of the aircraft.
    """
    messages = []
    for stored in texts:
        is_shared = stored.topic in {ROSOUT, PARAMETER_EVENTS}
        if not is_shared and stored.topic not in {
            f"{namespace}/{LEARNING}",
            f"{namespace}{ENGAGEMENT}",
        }:
            continue
        try:
            decoded = typestore().deserialize_cdr(stored.data, stored.type_name)
        except SerdeError:
            continue
        has_begun = stored.sent_ns >= first_ns
        message = log_message(decoded, stored.type_name, stored.sent_ns, has_begun=has_begun)
        if message is not None and message.namespace in {None, namespace}:
            messages.append(replace(message, text=bounded(message.text)))
    return sorted(messages, key=lambda message: message.stamp_ns)


def last_words(messages: Iterable[LogMessage]) -> list[str]:
    """Return the last warning or error, and the messages up to LAST_NS before, each only once.

    The result has the order of `messages`.
    """
    said = [each for each in messages if each.kind in {"warning", "error"}]
    end_ns = max((each.stamp_ns for each in said), default=0) - LAST_NS
    return list(dict.fromkeys(each.text for each in said if each.stamp_ns > end_ns))


def shown(value: Any) -> str:
    """Write the value of a parameter with four digits; for a matrix, write its size."""
    if isinstance(value, list) and len(value) > MAX_VALUES:
        return f"{len(value)} values"
    if isinstance(value, list):
        return f"[{', '.join(map(shown, value))}]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def bounded(text: str) -> str:
    """Return a text from the log in printable form, cut with a mark if it is too long."""
    whole = printable(text)
    return whole if len(whole) <= MAX_TEXT else f"{whole[: MAX_TEXT - len(CUT)]}{CUT}"
