# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a log says in words: warnings, errors, parameter changes, learning and a bridge."""

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
MAX_TEXT = 400  # characters of a text from the log
CUT = " ..."  # end of a longer text
LAST_NS = 3 * NANOSECONDS  # end of a log: a node that waits says so every 2 s
MAX_VALUES = 16  # most values of a parameter that are shown: one per channel, but not a matrix


@dataclass(frozen=True, kw_only=True)
class LogMessage:
    """A message of a flight. `stamp_ns` is as in the samples, or by the clock of the host.

    `kind` is "warning", "error", "control", "parameter", "learning" or "bridge"; on the live page
    also "mode" or "route". For a parameter, `namespace` is that of its node.
    """

    stamp_ns: int
    kind: str
    text: str
    namespace: str | None = None


@dataclass(frozen=True, kw_only=True)
class StoredText:
    """A message that may be a LogMessage, as stored."""

    topic: str  # in full
    type_name: str
    sent_ns: int
    data: bytes


def holds_texts(topic: str, type_name: str) -> bool:
    """Return whether the messages of a topic may be LogMessages."""
    return (
        (topic, type_name) in {(ROSOUT, LOG), (PARAMETER_EVENTS, PARAMETER_EVENT)}
        or (topic.endswith(f"/{LEARNING}") and type_name == DIAGNOSTIC_ARRAY)
        or (topic.endswith(ENGAGEMENT) and type_name == KEY_VALUE)
    )


def log_message(
    message: Any, type_name: str, sent_ns: int, *, has_begun: bool = True
) -> LogMessage | None:
    """Turn a decoded message into a LogMessage; None for information and empty messages.

    Before the first sample, with `has_begun` False, starting nodes still declare parameters.
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
    """Return the messages of an aircraft in a log by stamp; `first_ns` is its first sample's."""
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
    """Return the warnings and errors at the end of a log, each once, in order."""
    said = [each for each in messages if each.kind in {"warning", "error"}]
    end_ns = max((each.stamp_ns for each in said), default=0) - LAST_NS
    return list(dict.fromkeys(each.text for each in said if each.stamp_ns > end_ns))


def shown(value: Any) -> str:
    """Show the value of a parameter with four digits, or the size of a matrix."""
    if isinstance(value, list) and len(value) > MAX_VALUES:
        return f"{len(value)} values"
    if isinstance(value, list):
        return f"[{', '.join(map(shown, value))}]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def bounded(text: str) -> str:
    """Make a text from the log printable and of bounded length, with a mark where it is cut."""
    whole = printable(text)
    return whole if len(whole) <= MAX_TEXT else f"{whole[: MAX_TEXT - len(CUT)]}{CUT}"
