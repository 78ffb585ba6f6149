# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read a growing log by `Scan`; each call continues where the last call ended.

A finished log is read in the same way. A packed log is always finished, so `open_log` reads it. A
record is read once it is whole, so a chunk in progress is not read yet.
"""

import math
from collections import deque
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap.records import Attachment, Channel, Metadata, Schema

from flight_core.rates import NANOSECONDS
from flight_log.bag import stack_topic
from flight_log.file_kinds import MCAP_BEGINS, PACKED, FileKind, file_kind
from flight_log.named_vectors import STAMP, full_name, stamps_of
from flight_log.open_log import ROSBAG2, open_scan, plain_batches
from flight_log.rosbag2_metadata import bag_files
from flight_log.scan import MessageBatch, Scan


class Messages(NamedTuple):
    """Messages of a topic in the order of the log."""

    topic: str  # full name
    type_name: str
    sent_ns: list[int]
    data: list[bytes]  # messages in CDR


@dataclass
class _Channel:
    topic: str
    type_name: str
    # highest rate of messages to read, Hz; 0 for no messages, infinite for all messages
    rate: float
    step: int = 0  # every step-th message is read; 0 until two messages show their period
    skip: int = 0  # number of messages that are skipped before the next one is read

    def chosen(self, batch: MessageBatch) -> slice:
        """Return the slice of the messages in a batch that are to be read."""
        if self.rate == math.inf:
            return slice(None)
        if self.step == 0 and len(batch.data) > 1 and batch.data.shape[1] >= STAMP.stop:
            first_ns, last_ns = stamps_of(batch.data[[0, -1]]).tolist()
            if (span_ns := last_ns - first_ns) > 0:
                period_ns = span_ns / (len(batch.data) - 1)
                self.step = max(1, math.floor(NANOSECONDS / self.rate / period_ns + 0.01))
        step = max(self.step, 1)
        first = self.skip
        self.skip = (self.skip - len(batch.data)) % step
        return slice(first, None, step)


class Follower:
    """Reads the log of a run while it grows.

    The run is the folder of a bag, or an MCAP file. The folder need not have a file yet.
    `rate_of(topic, type_name)` returns the highest rate at which to read messages of a topic, Hz:
    infinite to read all messages, and 0 to read none. `stack_names` is a mapping from a topic of
    the log to the name that the topic has in the flight stack before a remap.
    """

    def __init__(
        self,
        run: Path,
        rate_of: Callable[[str, str], float],
        stack_names: Mapping[str, str] = {},
    ) -> None:
        self.run = run
        self.complete = False  # whether the end of the data has been read
        self.fault = ""  # why the rest of the log cannot be read
        # Definitions (ros2msg) of the message types that have occurred, by name.
        self.definitions: dict[str, str] = {}
        self._rate_of = rate_of
        self._stack_names = stack_names
        self._read_files: list[Path] = []
        self._damaged = 0  # number of damaged records in the files that were read before
        self._pending: deque[Messages | Attachment | Metadata] = deque()
        self._begin_file()

    def _begin_file(self) -> None:
        self._path: Path | None = None
        self._scan: Scan | None = None
        self._size = 0  # size of the file at the last check, bytes
        self._identity = (0, 0)  # device and inode of the file; (0, 0) before its scan begins
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, _Channel] = {}
        # records of a packed file that have still to be read
        self._finished: Iterator[object] | None = None

    @property
    def path(self) -> Path | None:
        """The file that is being read, or None if there is no file yet.

        Raises ParameterError for a folder with several bags.
        """
        if self._path is None:
            files = bag_files(self.run)
            if files and not self.run.is_file():
                files += bag_files(self.run / ROSBAG2)
            self._path = next((file for file in files if file not in self._read_files), None)
        return self._path

    @property
    def damaged(self) -> int:
        """Number of records that could not be read."""
        return self._damaged + (0 if self._scan is None else self._scan.damaged)

    @property
    def backlog(self) -> int:
        """Number of unread bytes of the file. Raises OSError, and ParameterError as `path` does."""
        position = 0 if self._scan is None else self._scan.position
        return 0 if self.path is None else self.path.stat().st_size - position

    def skip(self, topics: Container[str]) -> None:
        """Stop reading the messages of some topics, given by full names, from this file."""
        for channel in self._channels.values():
            if channel.topic in topics:
                channel.rate = 0.0

    def read(self) -> Iterator[Messages | Attachment | Metadata]:
        """Yield the records since the last call.

        If you stop the iteration, the next call continues at this record. Raises OSError if the
        file cannot be read, and ParameterError for a folder with several bags.
        """
        yield from self._pending_records()
        while not self.fault and (path := self.path) is not None:
            status = path.stat()
            if status.st_size == self._size:
                return
            identity = (status.st_dev, status.st_ino)
            if self._scan is None or self._scan.position == 0:
                if (kind := file_kind(path)) in PACKED:
                    yield from self._read_finished(path)
                    continue
                if kind not in MCAP_BEGINS:
                    self.fault = f"{path} is {kind.value}: it does not begin as an MCAP file"
                    return
                self._scan = Scan(path)
                self._identity = identity
                self.complete = self.complete and kind is not FileKind.MCAP
            if identity != self._identity or status.st_size < self._scan.position:
                self.fault = f"{path} was replaced by another file, as rise-di report --repair does"
                return
            for records in () if self._scan.ended else self._scan.groups():
                self._take(records)
                yield from self._pending_records()
            if self._scan.endless:
                self.fault = f"a record of {self._scan.endless} bytes at byte {self._scan.position}"
            if not self._scan.ended:
                self._size = status.st_size
                return
            self._end_file(path)

    def _end_file(self, path: Path) -> None:
        self.complete = True
        self._damaged = self.damaged
        self._read_files.append(path)
        self._begin_file()

    def _read_finished(self, path: Path) -> Iterator[Messages | Attachment | Metadata]:
        """Yield the records of a packed file."""
        if self._finished is None:
            self._finished = self._records_of(path)
        for record in self._finished:
            self._take([record])
            yield from self._pending_records()
        self._end_file(path)

    def _records_of(self, path: Path) -> Iterator[object]:
        with open_scan(path) as self._scan:
            yield from self._scan.batches()
        self._damaged += not self._scan.complete

    def _pending_records(self) -> Iterator[Messages | Attachment | Metadata]:
        """Yield the pending records. If the caller stops, the next call yields the rest."""
        while self._pending:
            yield self._pending.popleft()

    def _take(self, records: Iterable[object]) -> None:
        """Add the content of records to the pending records."""
        for record in records:
            if isinstance(record, MessageBatch):
                if (channel := self._channels.get(record.channel_id)) and channel.rate > 0.0:
                    for batch in plain_batches(record):
                        self._take_messages(channel, batch)
            elif isinstance(record, Attachment | Metadata):
                self._pending.append(record)
            elif isinstance(record, Schema):
                self._schemas[record.id] = record.name
                self.definitions[record.name] = record.data.decode(errors="replace")
            elif isinstance(record, Channel) and record.id not in self._channels:
                is_cdr = record.message_encoding == "cdr"
                type_name = full_name(self._schemas.get(record.schema_id, "")) if is_cdr else ""
                topic = stack_topic(record, self._stack_names)
                rate = self._rate_of(topic, type_name)
                self._channels[record.id] = _Channel(topic, type_name, rate)

    def _take_messages(self, channel: _Channel, batch: MessageBatch) -> None:
        selection = channel.chosen(batch)
        if data := [row.tobytes() for row in batch.data[selection]]:
            sent_ns = batch.sent_ns[selection].tolist()
            self._pending.append(Messages(channel.topic, channel.type_name, sent_ns, data))
