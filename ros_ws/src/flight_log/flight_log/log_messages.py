# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a log says in words: warnings, errors, parameter changes, learning and a bridge."""

from collections.abc import Iterable
from typing import Any, NamedTuple

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


class LogMessage(NamedTuple):
    """A message of a flight. `stamp_ns` is as in the samples, or by the clock of the host.

    `kind` is "warning", "error", "control", "parameter", "learning" or "bridge"; on the live page
    also "mode" or "route". For a parameter, `namespace` is that of its node.
    """

    stamp_ns: int
    kind: str
    text: str
    namespace: str | None = None


class StoredText(NamedTuple):
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
            return LogMessage(sent_ns, kind, f"{message.name}: {message.msg}")
        if message.name.rpartition(".")[2] == CONTROL:
            return LogMessage(sent_ns, CONTROL, message.msg.removeprefix(f"{CONTROL}: "))
        return None
    if type_name == PARAMETER_EVENT:
        entries = (*(message.new_parameters if has_begun else []), *message.changed_parameters)
        changes = {entry.name: parameter_value(entry.value) for entry in entries}
        text = ", ".join(f"{name} = {shown(value)}" for name, value in changes.items())
        namespace, _, node = message.node.rpartition("/")
        return LogMessage(sent_ns, PARAMETER, f"{node}: {text}", namespace) if text else None
    if type_name == DIAGNOSTIC_ARRAY:
        stamp_ns, sentence = stamped_sentence(message)
        return LogMessage(stamp_ns, LEARNING, sentence)
    return LogMessage(sent_ns, "bridge", f"{message.key} {message.value}".strip())


def log_messages(texts: Iterable[StoredText], namespace: str, first_ns: int) -> list[LogMessage]:
    """Return the messages of an aircraft in a log by stamp; `first_ns` is its first sample's."""
    messages = []
    for topic, type_name, sent_ns, data in texts:
        is_shared = topic in {ROSOUT, PARAMETER_EVENTS}
        if not is_shared and topic not in {f"{namespace}/{LEARNING}", f"{namespace}{ENGAGEMENT}"}:
            continue
        try:
            decoded = typestore().deserialize_cdr(data, type_name)
        except SerdeError:
            continue
        message = log_message(decoded, type_name, sent_ns, has_begun=sent_ns >= first_ns)
        if message is not None and message.namespace in {None, namespace}:
            messages.append(message._replace(text=bounded(message.text)))
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
