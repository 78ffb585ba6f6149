# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Reads a file of rosbag2's storage sqlite3 with the interface of `Scan`."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from urllib.parse import quote

import numpy as np
from mcap.records import Channel, McapRecord, Message, Schema
from numpy.typing import NDArray

from flight_core.parameters import ParameterError
from flight_log.named_vectors import tables
from flight_log.scan import MessageBatch

BATCH = 4096  # messages of SQLite that are grouped by channel


def message_tables(
    channel_id: int, messages: Iterable[bytes], *columns: NDArray[np.int64]
) -> Iterator[MessageBatch]:
    """Messages of a channel with the columns of a MessageBatch, those of equal length together."""
    begin = 0
    for table in tables(messages):
        end = begin + len(table)
        yield MessageBatch(channel_id, table, *(column[begin:end] for column in columns))
        begin = end


class SqliteScan:
    """A file of rosbag2's storage sqlite3, with the interface of `Scan`. The storage has no time of
    sending: it is 0.
    """

    def __init__(self, path: Path, shown: Path | None = None) -> None:
        self.path = path
        self.complete = True
        self.damaged = 0
        self.known_end_ns = 0
        self.message_counts: dict[int, int] = {}
        self._shown = shown or path  # the packed file

    def records(self) -> Iterator[McapRecord]:
        """The schemas, channels and messages. Raises ParameterError for a database that is no
        bag.
        """
        for row in self._rows():
            if isinstance(row, tuple):
                channel, log_ns, data = row
                yield Message(channel, log_ns, data, 0, 0)
            else:
                yield row

    def batches(self) -> Iterator[McapRecord | MessageBatch]:
        """As `records`, the messages of a channel in a table. Raises ParameterError."""
        rows = self._rows()
        while block := list(islice(rows, BATCH)):
            by_channel: dict[int, list[tuple[int, bytes]]] = defaultdict(list)
            for row in block:
                if isinstance(row, tuple):
                    by_channel[row[0]].append(row[1:])
                else:
                    yield row
            for channel, messages in by_channel.items():
                log_ns = np.array([time_ns for time_ns, _ in messages], dtype=np.int64)
                unknown = np.zeros(len(messages), dtype=np.int64)
                contents = (data for _, data in messages)
                yield from message_tables(channel, contents, log_ns, unknown, unknown)

    def _rows(self) -> Iterator[Schema | Channel | tuple[int, int, bytes]]:
        # Takes 70 ms, which no bag of ours needs.
        from rosbags.interfaces import MessageDefinitionFormat  # noqa: PLC0415
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader  # noqa: PLC0415

        reader = Sqlite3Reader(Path(quote(str(self.path.absolute()))))  # it makes a URI of the path
        encodings = {MessageDefinitionFormat.IDL: "ros2idl", MessageDefinitionFormat.MSG: "ros2msg"}
        try:
            reader.open()
            connections = reader.connections
            self.message_counts = {connection.id: connection.msgcount for connection in connections}
            self.known_end_ns = max(reader.metadata.end_time - 1, 0)
        except Exception as error:  # of SQLite or of rosbags: the content may be damaged anywhere
            reason = str(error) or type(error).__name__
            raise ParameterError(
                f"{self._shown}: cannot be read ({reason}), expected a bag of rosbag2"
            ) from None
        try:
            for connection in connections:
                definition = connection.msgdef
                ext = connection.ext
                encoding = encodings.get(definition.format, "ros2msg")
                yield Schema(
                    id=connection.id,
                    data=definition.data.encode(),
                    encoding=encoding,
                    name=connection.msgtype,
                )
                serialised = str(getattr(ext, "serialization_format", "cdr"))
                yield Channel(connection.id, connection.topic, serialised, {}, connection.id)
            for connection, log_ns, data in reader.messages(connections):
                yield connection.id, log_ns, bytes(data)
        except Exception:  # as above: what was read so far stays
            self.damaged = self.damaged + 1
            self.complete = False
        finally:
            reader.close()
