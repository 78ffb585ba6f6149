# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The messages of a log as stored bytes, of any type; and the parameter changes among them."""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from mcap.records import Channel, Message, Schema
from rosbags.serde.errors import SerdeError

from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS
from flight_log.named_vectors import typestore
from flight_log.rosbag2_metadata import bag_files
from flight_log.scan import Scan
from flight_log.tape_reader import A_RUN, ROSBAG2

PARAMETER_EVENTS = "/parameter_events"
PARAMETER_EVENT = "rcl_interfaces/msg/ParameterEvent"


class StoredMessage(NamedTuple):
    """A message. Times in ns of the recorder's clock."""

    topic: str  # in full
    type_name: str
    definition: str  # of the type, as text
    received_ns: int
    sent_ns: int
    data: bytes  # CDR


def stored_messages(run: Path) -> Iterator[StoredMessage]:
    """The messages of a bag of MCAP files in the order of writing; of a truncated file the readable messages.

    Raises ParameterError for a missing or unreadable bag.
    """
    files = bag_files(run)
    require(bool(files), str(run), "no .mcap file", A_RUN)
    for file in files:
        schemas: dict[int, Schema] = {}
        channels: dict[int, tuple[str, str, str]] = {}
        try:
            for record in Scan(file).records():
                if isinstance(record, Message) and record.channel_id in channels:
                    yield StoredMessage(*channels[record.channel_id], record.log_time, record.publish_time, record.data)
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel) and (schema := schemas.get(record.schema_id)) is not None:
                    channels[record.id] = record.topic, schema.name, schema.data.decode(errors="replace")
        except OSError as error:
            raise ParameterError(f"{file}: cannot be read ({error.strerror}), expected an MCAP file") from None


def parameter_changes(run: Path, node: str, known: Mapping[str, object]) -> list[dict[str, Any]]:
    """The changes of a node's parameters on `/parameter_events`, in the order of the stamps.

    `node` is the full name of a node, as in "/one/controller". A change maps dotted names to values, for `known` parameters
    or groups of parameters. None stands for a deleted parameter. SI units. The bag in the folder ROSBAG2 of a run is read, too.
    """
    store = typestore()
    events: list[tuple[int, dict[str, Any]]] = []
    beside = run / ROSBAG2
    for stored in chain(stored_messages(run), stored_messages(beside) if bag_files(beside) else ()):
        if stored.topic != PARAMETER_EVENTS or stored.type_name != PARAMETER_EVENT:
            continue
        try:
            event: Any = store.deserialize_cdr(stored.data, PARAMETER_EVENT)
        except SerdeError:
            continue
        if event.node != node:
            continue
        changes = {new.name: parameter_value(new.value) for new in (*event.new_parameters, *event.changed_parameters)}
        changes |= {deleted.name: None for deleted in event.deleted_parameters}
        values = {name: value for name, value in changes.items() if name.split(".")[0] in known}
        if values:
            events.append((event.stamp.sec * NANOSECONDS + event.stamp.nanosec, values))
    return [values for _, values in sorted(events, key=itemgetter(0))]


def parameter_value(message: Any) -> Any:
    """The value in a rcl_interfaces/msg/ParameterValue; None for an unset value."""
    # After the field "type" of rcl_interfaces/msg/ParameterValue there is one field for each type, in their order from 1 on.
    kind, names = message.type, [field.name for field in fields(message)]
    value: Any = getattr(message, names[kind]) if 0 < kind < len(names) else None
    return value.tolist() if hasattr(value, "tolist") else value
