# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read the messages of a log as stored bytes, of any type, and the parameter changes among them."""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Message, Schema
from rosbags.serde.errors import SerdeError

from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS
from flight_log.named_vectors import full_name, typestore
from flight_log.open_log import A_RUN, log_files, open_scan, plain_message

PARAMETER_EVENTS = "/parameter_events"
PARAMETER_EVENT = "rcl_interfaces/msg/ParameterEvent"


class StoredMessage(NamedTuple):
    """A message as it is stored in a log. Its times are in ns by the clock of the recorder."""

    topic: str  # full name
    type_name: str
    definition: str  # definition of the type, as text
    received_ns: int
    sent_ns: int
    data: bytes
    encoding: str = "cdr"
    qos: str = ""  # the offered profiles, as rosbag2's YAML list


NO_SCHEMA = Schema(id=0, data=b"", encoding="", name="")


def stored_messages(run: Path) -> Iterator[StoredMessage]:
    """Yield the messages of a log in the order in which they were written.

    For a truncated or damaged file, the readable messages are yielded. Raises ParameterError for a
    missing or unreadable log.
    """
    for file in log_files(run):
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        try:
            with open_scan(file) as scan:
                for record in scan.records():
                    if isinstance(record, Message) and record.channel_id in channels:
                        channel = channels[record.channel_id]
                        schema = schemas.get(channel.schema_id, NO_SCHEMA)
                        yield StoredMessage(
                            topic=channel.topic,
                            type_name=full_name(schema.name),
                            definition=schema.data.decode(errors="replace"),
                            received_ns=record.log_time,
                            sent_ns=record.publish_time,
                            data=plain_message(record.data),
                            encoding=channel.message_encoding,
                            qos=channel.metadata.get("offered_qos_profiles", ""),
                        )
                    elif isinstance(record, Schema):
                        schemas[record.id] = record
                    elif isinstance(record, Channel):
                        channels[record.id] = record
        except OSError as error:
            raise ParameterError(
                f"{file}: cannot be read ({error.strerror}), expected {A_RUN}"
            ) from None


def parameter_changes(
    run: Path, node: str, parameters: Mapping[str, object]
) -> list[dict[str, Any]]:
    """Return the changes of a node's parameters on `/parameter_events`, in order of the stamps.

    `node` is the full name of a node, as in "/one/controller". A change is a mapping from dotted
    names to values in SI units. Names that are not in `parameters`, nor belong to a group in
    `parameters`, are left out. The value None means that a parameter was deleted.
    """
    store = typestore()
    events: list[tuple[int, dict[str, Any]]] = []
    for message in stored_messages(run):
        if message.topic != PARAMETER_EVENTS or message.type_name != PARAMETER_EVENT:
            continue
        try:
            event: Any = store.deserialize_cdr(message.data, PARAMETER_EVENT)
        except SerdeError:
            continue
        if event.node != node:
            continue
        changes = {
            change.name: parameter_value(change.value)
            for change in (*event.new_parameters, *event.changed_parameters)
        }
        changes |= {deleted.name: None for deleted in event.deleted_parameters}
        values = {
            name: value for name, value in changes.items() if name.split(".")[0] in parameters
        }
        if values:
            events.append((event.stamp.sec * NANOSECONDS + event.stamp.nanosec, values))
    return [values for _, values in sorted(events, key=itemgetter(0))]


def parameter_event(stamp_ns: int, node: str, changes: Mapping[str, Any]) -> bytes:
    """Return a message of PARAMETER_EVENTS with changes by dotted name.

    A value of None means that the parameter was deleted.

    This is the inverse of `parameter_changes`.
    """
    store = typestore()
    types = {
        name: store.types[f"rcl_interfaces/msg/{name}"]
        for name in ("ParameterEvent", "Parameter", "ParameterValue")
    }
    scalars = (bool, int, float, str)

    def parameter(name: str, value: Any) -> Any:
        array = isinstance(value, (list, tuple))
        kind = (
            0
            if value is None
            else 1 + scalars.index(type(value[0] if array else value)) + 5 * array
        )
        empty = [np.zeros(0, dtype=dtype) for dtype in (np.uint8, bool, np.int64, float)]
        fields: list[Any] = [False, 0, 0.0, "", *empty, []]  # fields of the types from 1 on
        if kind:
            default = fields[kind - 1]
            is_table = isinstance(default, np.ndarray)
            fields[kind - 1] = np.array(value, dtype=default.dtype) if is_table else value
        return types["Parameter"](name, types["ParameterValue"](kind, *fields))

    replacements = [parameter(name, value) for name, value in changes.items() if value is not None]
    deleted = [parameter(name, None) for name, value in changes.items() if value is None]
    stamp = store.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, NANOSECONDS))
    event = types["ParameterEvent"](stamp, node, [], replacements, deleted)
    return bytes(store.serialize_cdr(event, PARAMETER_EVENT))


def parameter_value(message: Any) -> Any:
    """Return the value in a rcl_interfaces/msg/ParameterValue, or None for an unset value."""
    # In rcl_interfaces/msg/ParameterValue, the field "type" is followed by one field for each type,
    # in the order of the types from 1 on.
    kind = message.type
    names = [field.name for field in fields(message)]
    value: Any = getattr(message, names[kind]) if 0 < kind < len(names) else None
    return value.tolist() if hasattr(value, "tolist") else value
