# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""An MCAP file, whole or not: all records up to where it was cut, but for damaged parts."""

import os
import struct
import zlib
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import IO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC

# What reading raises where bytes were changed: between records, inside one, inside a compressed chunk.
DAMAGE = (McapError, MemoryError, OverflowError, UnicodeDecodeError, struct.error, zstandard.ZstdError)

RECORD = struct.Struct("<BQ")  # opcode and length, in front of each record (MCAP specification, Records)
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time and publish time, in front of each message
TIMES = struct.Struct("<QQ")  # log times of the first and the last message, in front of each chunk
FOOTER = struct.Struct("<BQQQI")  # opcode, length, where the index and its offsets begin, checksum
CRC = struct.Struct("<I")

LARGEST_UNPACKED = 64 << 20
"""Bytes of a chunk that is larger than it is packed: one of 1 kB may say that it holds any number of them, and may hold 20 MB.

Recorders close a chunk at about 1 MB, or behind the message that makes it larger.
"""

READ: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
}


class Scan:
    """One file, read once by `records`; afterwards the attributes say how it stands with it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.whole = False  # it has its end
        self.damaged = 0  # chunks and other parts that could not be read
        self.known_end_ns = 0  # the latest log time that it speaks of, in what is lost too

    @property
    def faults(self) -> str:
        """What is wrong with it; empty where nothing is."""
        faults = [] if self.whole else ["no end"]
        faults += [f"{self.damaged} damaged parts"] if self.damaged else []
        return " and ".join(faults)

    def records(self) -> Iterator[McapRecord]:
        """All schemas, channels, messages, attachments and metadata; schemas and channels of the index come first.

        A chunk that is damaged then takes none of those with it. Raises OSError where the file cannot be read, nothing where
        its content cannot.
        """
        with self.path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            index = self._index(stream, size)
            yield from (record for record in index if isinstance(record, Schema | Channel))
            missing = sum(record.message_count for record in index if isinstance(record, Statistics))
            for opcode, content in self._frames(stream, size, index):
                try:
                    records = list(_unpack(opcode, content))
                except DAMAGE:
                    self.damaged += 1
                    continue
                missing -= sum(isinstance(record, Message) for record in records)
                yield from records
            if missing > 0 and not self.damaged:  # a record that no longer looks like one
                self.damaged += 1

    def _index(self, stream: IO[bytes], size: int) -> list[McapRecord]:
        """The records of the index at the end of the file; none where there is no such end, or it is damaged."""
        place = size - FOOTER.size - len(MCAP0_MAGIC)
        if place < len(MCAP0_MAGIC):
            return []
        stream.seek(place)
        footer, magic = stream.read(FOOTER.size), stream.read()
        opcode, _, start, _, crc = FOOTER.unpack(footer)
        self.whole = magic == MCAP0_MAGIC and opcode == Opcode.FOOTER and start <= place
        if not self.whole or start == 0:
            return []
        stream.seek(start)
        content = stream.read(place - start)
        try:
            if crc not in (0, zlib.crc32(footer[: -CRC.size], zlib.crc32(content))):
                raise McapError("an index whose bytes were changed")
            index = list(_split(content))
        except DAMAGE:
            self.damaged += 1
            return []
        ends = [record.message_end_time for record in index if isinstance(record, Statistics | ChunkIndex)]
        self.known_end_ns = max(ends, default=0)
        return index

    def _frames(self, stream: IO[bytes], size: int, index: Sequence[McapRecord]) -> Iterator[tuple[int, bytes]]:
        """Opcode and content of each record up to the index; behind one that is damaged, of the next that the index knows."""
        starts = (
            record.chunk_start_offset if isinstance(record, ChunkIndex) else record.offset
            for record in index
            if isinstance(record, ChunkIndex | AttachmentIndex | MetadataIndex)
        )
        known = [*sorted(start for start in starts if start < size), size]
        stream.seek(0)
        place = len(MCAP0_MAGIC)
        if stream.read(place) != MCAP0_MAGIC:
            self.whole = False
            return
        while place + RECORD.size <= size:  # a file that is being written grows meanwhile
            opcode, length = RECORD.unpack(stream.read(RECORD.size))
            ahead = known[bisect_right(known, place)]
            place += RECORD.size + length
            if place <= ahead:
                if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                    return
                yield opcode, stream.read(length)
            elif ahead < size:
                self.damaged += 1
                place = ahead
                stream.seek(place)
            else:
                start = stream.read(TIMES.size)
                if opcode == Opcode.CHUNK and len(start) == TIMES.size:
                    self.known_end_ns = max(self.known_end_ns, TIMES.unpack(start)[1])
                break
        self.whole = False


def _split(data: bytes) -> Iterator[McapRecord]:
    """The records in some bytes. Raises one of DAMAGE."""
    place = 0
    while place < len(data):
        opcode, length = RECORD.unpack_from(data, place)
        place += RECORD.size
        if place + length > len(data):
            raise McapError("a record longer than what it stands in")
        yield from _unpack(opcode, data[place : place + length])
        place += length


def _unpack(opcode: int, content: bytes) -> Iterator[McapRecord]:
    """The record, or those in a chunk. Raises one of DAMAGE."""
    if opcode == Opcode.CHUNK:
        yield from _split(_unpacked(Chunk.read(ReadDataStream(BytesIO(content)))))
    elif opcode == Opcode.MESSAGE:
        channel, sequence, log_time, publish_time = MESSAGE.unpack_from(content)
        yield Message(channel, log_time, content[MESSAGE.size :], publish_time, sequence)
    elif opcode in READ:
        if opcode == Opcode.ATTACHMENT:
            (crc,) = CRC.unpack(content[-CRC.size :])
            if crc not in (0, zlib.crc32(content[: -CRC.size])):
                raise McapError("an attachment whose bytes were changed")
        yield READ[opcode](ReadDataStream(BytesIO(content)))


def _unpacked(chunk: Chunk) -> bytes:
    """The records of a chunk as bytes, no more of them than it says. Raises one of DAMAGE."""
    size = chunk.uncompressed_size
    if size > max(LARGEST_UNPACKED, len(chunk.data)):
        raise McapError(f"a chunk that says it holds {size} bytes")
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) > size:  # it would be taken at its word
            raise McapError("a chunk that holds more than it says")
        data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    elif chunk.compression == "lz4":
        try:
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size)
        except RuntimeError as error:
            raise McapError(str(error)) from None
    elif chunk.compression:
        raise McapError(f"a chunk packed by {chunk.compression}")
    else:
        data = chunk.data
    if len(data) != size or chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise McapError("a chunk whose bytes were changed")
    return data
