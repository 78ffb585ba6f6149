# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The messages of a log as they are stored, one by one, of whatever type; and the changes of parameters among them."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from mcap.records import Channel, Message, Schema
from rosbags.serde.errors import SerdeError

from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS
from flight_log.bag import bag_files
from flight_log.named_vectors import typestore
from flight_log.scan import Scan

PARAMETER_EVENTS = "/parameter_events"
PARAMETER_EVENT = "rcl_interfaces/msg/ParameterEvent"

# Field of rcl_interfaces/msg/ParameterValue that holds the value, by its type.
FIELDS = (
    "",
    "bool_value",
    "integer_value",
    "double_value",
    "string_value",
    "byte_array_value",
    "bool_array_value",
    "integer_array_value",
    "double_array_value",
    "string_array_value",
)


class Stored(NamedTuple):
    """One message; times in ns of the recorder's clock."""

    topic: str  # in full
    type_name: str
    definition: str  # of the type, as text
    received_ns: int
    sent_ns: int
    data: bytes  # CDR


def stored_messages(run: Path) -> Iterator[Stored]:
    """All messages of a bag of MCAP files, in the order in which they were written; of files without an end those there are.

    Raises ParameterError where there is no such bag, or it cannot be read.
    """
    files = bag_files(run)
    require(bool(files), str(run), "no .mcap file", "the folder of a run or an MCAP file")
    for file in files:
        schemas: dict[int, Schema] = {}
        channels: dict[int, tuple[str, str, str]] = {}
        try:
            for record in Scan(file).records():
                if isinstance(record, Message) and record.channel_id in channels:
                    yield Stored(*channels[record.channel_id], record.log_time, record.publish_time, record.data)
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel) and (schema := schemas.get(record.schema_id)) is not None:
                    channels[record.id] = record.topic, schema.name, schema.data.decode(errors="replace")
        except OSError as error:
            raise ParameterError(f"{file}: cannot be read ({error.strerror}), expected an MCAP file") from None


def parameter_changes(run: Path, node: str, known: Mapping[str, object]) -> list[dict[str, Any]]:
    """What `/parameter_events` says of a node, by its name in any namespace, in the order of the stamps.

    Each a mapping from the dotted names of `known` parameters, or groups of them, to their values, None where one was taken
    away; SI as everywhere.
    """
    store = typestore()
    events: list[tuple[int, dict[str, Any]]] = []
    for stored in stored_messages(run):
        if stored.topic != PARAMETER_EVENTS or stored.type_name != PARAMETER_EVENT:
            continue
        try:
            event: Any = store.deserialize_cdr(stored.data, PARAMETER_EVENT)
        except SerdeError:
            continue
        if event.node.rpartition("/")[2] != node:
            continue
        found = {one.name: _value(one.value) for one in (*event.new_parameters, *event.changed_parameters)}
        found |= {one.name: None for one in event.deleted_parameters}
        values = {name: value for name, value in found.items() if name.split(".")[0] in known}
        if values:
            events.append((event.stamp.sec * NANOSECONDS + event.stamp.nanosec, values))
    return [values for _, values in sorted(events, key=lambda one: one[0])]


def _value(value: Any) -> Any:
    field = FIELDS[value.type] if value.type < len(FIELDS) else ""
    found: Any = getattr(value, field) if field else None
    return found.tolist() if hasattr(found, "tolist") else found
