# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Reads a growing log: a call continues at the end of the last call. A finished log is read in the
same way.

A log of another storage, or a packed log, is finished: `open_log` reads it.

A record is read once the record is whole: a chunk in progress is never read. The message index
behind a chunk gives the places of the messages: messages of unwanted topics cost nothing.
"""

import math
import os
import struct
from collections import deque
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from flight_core.rates import NANOSECONDS
from flight_log.bag import stack_topic
from flight_log.file_kinds import BEGUN, EMPTY, MCAP, PACKED, SQLITE, file_kind
from flight_log.named_vectors import full_name, stamp_of
from flight_log.open_log import ROSBAG2, open_scan, plain_message
from flight_log.rosbag2_metadata import bag_files
from flight_log.scan import (
    DAMAGED,
    DECODE_ERRORS,
    ENDS,
    MAX_CHUNK_BYTES,
    MESSAGE_INDEX,
    RECORD,
    decode,
    decompress,
    frames,
    known_places,
    split,
)

HEAD = struct.Struct("<BQ6xQQ")  # of RECORD and MESSAGE: opcode, length, log time, publish time
# As plain numbers: of a log of one hour 400,000 records are compared.
CHUNK = int(Opcode.CHUNK)
MESSAGE = int(Opcode.MESSAGE)
INDEX = int(Opcode.MESSAGE_INDEX)
SCHEMA = int(Opcode.SCHEMA)
CHANNEL = int(Opcode.CHANNEL)
READ_BYTES = 1 << 20  # read from the file at once


class Messages(NamedTuple):
    """Messages of a topic in the order of the log."""

    topic: str  # in full
    type_name: str
    sent_ns: list[int]
    data: list[bytes]  # CDR


@dataclass
class _Channel:
    topic: str
    type_name: str
    rate: float  # highest rate that is wanted, Hz; 0 for none, infinite for all messages
    step: int = 0  # every step-th message is read; 0 until two messages gave their distance
    skip: int = 0  # messages before the next one that is read


class Follower:
    """Follows the log of a run: the folder of a bag, with or without a file yet, or an MCAP file.

    `rate_of(topic, type_name)` is the highest wanted rate of the messages of a topic, Hz: infinite
    without a limit, 0 for none.
    """

    def __init__(self, run: Path, rate_of: Callable[[str, str], float]) -> None:
        self.run = run
        self.damaged = 0  # records that could not be read
        self.complete = False  # the end of the data has been read
        self.fault = ""  # why nothing more of the log can be read
        self.definitions: dict[
            str, str
        ] = {}  # of the message types that have occurred, ros2msg, by name
        self._rate_of = rate_of
        self._read_files: list[Path] = []
        self._pending: deque[Messages | Attachment | Metadata] = deque()
        self._begin_file()

    def _begin_file(self) -> None:
        self._path: Path | None = None
        self._position = self._size = 0  # bytes: read, and there at the last look
        self._identity = (0, 0)  # device and inode of the file, once something of it has been read
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, _Channel] = {}
        self._chunk = b""  # the last chunk
        self._indexed = True  # at least one message index of it has been read
        self._unread: list[
            tuple[int, int]
        ] = []  # place and length of the chunks whose schemas and channels were not read
        self._finished: Iterator[object] | None = (
            None  # records of a file of another storage, or of a packed file
        )

    @property
    def path(self) -> Path | None:
        """The present file; None before the first file. Raises ParameterError for a folder with
        several bags.
        """
        if self._path is None:
            files = bag_files(self.run)
            if files and not self.run.is_file():
                files += bag_files(self.run / ROSBAG2)
            self._path = next((file for file in files if file not in self._read_files), None)
        return self._path

    @property
    def backlog(self) -> int:
        """Unread bytes of the file. Raises as `path` and OSError."""
        return 0 if self.path is None else self.path.stat().st_size - self._position

    def skip(self, topics: Container[str]) -> None:
        """Read no more messages of these topics, by their full names, in this file."""
        for channel in self._channels.values():
            if channel.topic in topics:
                channel.rate = 0.0

    def read(self) -> Iterator[Messages | Attachment | Metadata]:
        """The records since the last call. A caller may stop the iteration: the next call
        continues.

        Raises OSError when the file cannot be read, ParameterError for a folder with several bags.
        """
        yield from self._pending_records()
        while not self.fault and (path := self.path) is not None:
            if path.stat().st_size == self._size:
                return
            if self._position == 0 and (kind := file_kind(path)) not in {MCAP, EMPTY, BEGUN}:
                if kind not in {*PACKED, SQLITE}:
                    self.fault = f"{path} is {kind}: it does not begin as an MCAP file"
                    return
                yield from self._read_finished(path)
                continue
            with path.open("rb", buffering=READ_BYTES) as stream:
                status = os.fstat(stream.fileno())
                size = status.st_size
                identity = (status.st_dev, status.st_ino)
                if self._position > 0 and (identity != self._identity or size < self._position):
                    self.fault = (
                        f"{path} was replaced by another file, as rise-di report --repair does"
                    )
                    return
                self._identity = identity
                for opcode, content in self._records(stream, size):
                    self._take(opcode, content)
                    if opcode in ENDS:
                        break
                    yield from self._pending_records()
                else:
                    self._size = size
                    return
            self.complete = True
            self._read_files.append(path)
            self._begin_file()
            yield from self._pending_records()

    def _read_finished(self, path: Path) -> Iterator[Messages | Attachment | Metadata]:
        """The records of a file of another storage, or of a packed file."""
        if self._finished is None:
            self._finished = self._records_of(path)
        for record in self._finished:
            self._take_whole(record)
            yield from self._pending_records()
        self._read_files.append(path)
        self._begin_file()

    def _records_of(self, path: Path) -> Iterator[object]:
        with open_scan(path) as scan:
            yield from scan.records()
        self.damaged += scan.damaged + (not scan.complete)
        self.complete = True

    def _pending_records(self) -> Iterator[Messages | Attachment | Metadata]:
        """The decoded records; a caller that stops gets the rest with the next call."""
        while self._pending:
            yield self._pending.popleft()

    def _records(self, stream: IO[bytes], size: int) -> Iterator[tuple[int, bytes]]:
        """Opcode and content of every whole record behind the position. The position moves on
        before a record is given.
        """
        if self._position == 0 and size >= len(MCAP0_MAGIC):
            self.complete = False
            self._position = len(MCAP0_MAGIC)
        if self._position == 0:
            return
        for opcode, end, content in frames(stream, self._position, known_places(stream, size)):
            self._position = end
            if opcode == DAMAGED:
                self._leave_chunk()
            else:
                yield opcode, content
            if opcode in ENDS:
                return
        stream.seek(self._position)
        head = stream.read(RECORD.size)
        if len(head) == RECORD.size and (length := RECORD.unpack(head)[1]) > 2 * MAX_CHUNK_BYTES:
            self.fault = f"a record of {length} bytes at byte {self._position}"

    def _take(self, opcode: int, content: bytes) -> None:
        """Add what a record holds to the pending records."""
        try:
            if opcode == INDEX:
                self._take_indexed(content)
                return
            self._take_unindexed()
            self._chunk = b""  # an index behind a record that is no chunk is of a damaged chunk
            if opcode == CHUNK:
                self._unread.append((self._position - len(content), len(content)))
                self._chunk = decompress(content)
                self._indexed = False
                return
            for record in decode(opcode, content):
                self._take_whole(record)
        except DECODE_ERRORS:
            self._leave_chunk()

    def _leave_chunk(self) -> None:
        """Count a damaged part, and leave the last chunk out."""
        self.damaged += 1
        self._chunk = b""
        self._indexed = True

    def _take_indexed(self, content: bytes) -> None:
        """The messages of a channel in the last chunk. Raises DECODE_ERRORS."""
        identity, size = MESSAGE_INDEX.unpack_from(content)
        if len(content) != MESSAGE_INDEX.size + size or size % 16:
            raise McapError("a message index of a wrong size")
        if not self._chunk:
            return
        if size // 16 > len(self._chunk) // HEAD.size:
            raise McapError("a message index longer than its chunk")
        self._indexed = True
        if identity not in self._channels:
            self._learn_from_chunks()
        if (channel := self._channels.get(identity)) is None:
            raise McapError("messages without their channel")
        if size == 0 or channel.rate <= 0.0:
            return
        places: Sequence[int] = struct.unpack_from(f"<{size // 8}Q", content, MESSAGE_INDEX.size)[
            1::2
        ]
        if channel.rate < math.inf:
            if channel.step == 0:
                channel.step = _step(
                    channel.rate, len(places), self._messages_at((places[0], places[-1]))[1]
                )
            step = max(channel.step, 1)
            skipped = channel.skip
            channel.skip = (channel.skip - len(places)) % step
            places = places[skipped::step]
        if places:
            self._pending.append(
                Messages(channel.topic, channel.type_name, *self._messages_at(places))
            )

    def _learn_from_chunks(self) -> None:
        """Schemas and channels of the chunks so far: that of a topic may be in a chunk without a
        message of it.
        """
        places = self._unread
        self._unread = []
        if self.path is None:
            return
        with self.path.open("rb") as stream:
            for place, length in places:
                stream.seek(place)
                with suppress(*DECODE_ERRORS):  # counted when the chunk itself was read
                    for record in split(decompress(stream.read(length)), (SCHEMA, CHANNEL)):
                        self._learn(record)

    def _messages_at(self, places: Sequence[int]) -> tuple[list[int], list[bytes]]:
        """Times of sending, else of receipt, in ns and data of messages of the last chunk. Raises
        DECODE_ERRORS.
        """
        chunk = self._chunk
        sent_ns = []
        data = []
        for place in places:
            opcode, length, received, sent = HEAD.unpack_from(chunk, place)
            end = place + RECORD.size + length
            if opcode != MESSAGE or end > len(chunk):
                raise McapError("a message index without its message")
            sent_ns.append(sent or received)
            data.append(plain_message(chunk[place + HEAD.size : end]))
        return sent_ns, data

    def _take_unindexed(self) -> None:
        """The messages of a chunk without a message index. Raises DECODE_ERRORS."""
        if not self._indexed:
            self._indexed = True
            for record in split(self._chunk):
                self._take_whole(record)

    def _take_whole(self, record: object) -> None:
        """A record outside a chunk, or of a chunk without an index."""
        if isinstance(record, Message):
            channel = self._channels.get(record.channel_id)
            if channel is not None and channel.rate > 0.0:
                sent_ns = record.publish_time or record.log_time
                data = plain_message(record.data)
                self._pending.append(Messages(channel.topic, channel.type_name, [sent_ns], [data]))
        elif isinstance(record, Attachment | Metadata):
            self._pending.append(record)
        else:
            self._learn(record)

    def _learn(self, record: object) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record.name
            self.definitions[record.name] = record.data.decode(errors="replace")
        elif isinstance(record, Channel):
            type_name = (
                full_name(self._schemas.get(record.schema_id, ""))
                if record.message_encoding == "cdr"
                else ""
            )
            if record.id not in self._channels:
                topic = stack_topic(record)
                self._channels[record.id] = _Channel(
                    topic, type_name, self._rate_of(topic, type_name)
                )


def _step(rate: float, count: int, ends: Sequence[bytes]) -> int:
    """Every how many-th of `count` messages is read, from the stamps of the first and the last; 0
    where they do not tell.
    """
    span_ns = stamp_of(ends[1]) - stamp_of(ends[0])
    return (
        max(1, math.floor(NANOSECONDS / rate * (count - 1) / span_ns + 0.01))
        if count > 1 and span_ns > 0
        else 0
    )
