# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read the records of an MCAP file that may be truncated, damaged or growing.

The file is read to its end, and damaged parts are left out.
"""

import os
import struct
import threading
import zlib
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from itertools import chain, pairwise
from pathlib import Path
from typing import IO, NamedTuple, TypeVar

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

# Exceptions that reading raises if bytes were changed between records, inside a record, or inside a
# compressed chunk.
DECODE_ERRORS = (
    McapError,
    MemoryError,
    OverflowError,
    UnicodeDecodeError,
    struct.error,
    zstandard.ZstdError,
)

RECORD = struct.Struct("<BQ")  # opcode and length, before each record (MCAP specification, Records)
# Channel, sequence, log time and publish time, which come before each message.
MESSAGE = struct.Struct("<HIQQ")
# Fields of RECORD and MESSAGE.
HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<i8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_ns", "<i8"),
        ("publish_ns", "<i8"),
    ]
)
# Channel and size, which come before the entries of a message index (MCAP specification, Message
# Index).
MESSAGE_INDEX = struct.Struct("<HI")
INDEX_ENTRY = np.dtype([("log_ns", "<i8"), ("place", "<i8")])
NO_PLACES = np.zeros(0, dtype=np.int64)
TIMES = struct.Struct("<QQ")  # log times of the first and the last message, before each chunk
# TIMES, size and checksum of the records, and the length of the compression's name, which come
# before this name.
CHUNK = struct.Struct("<QQQII")
LENGTH = struct.Struct("<Q")  # before the records of a chunk
# Opcode, length, offsets of the summary and of its offsets, checksum.
FOOTER = struct.Struct("<BQQQI")
CRC = struct.Struct("<I")

ENDS = (int(Opcode.DATA_END), int(Opcode.FOOTER))
DAMAGED = 0  # in place of an opcode; all opcodes are larger

JOINED_BYTES = 1 << 20
"""Bytes of the records in chunks that are decoded together: about a second of a flight."""

AHEAD = 2  # number of groups of chunks that are decoded ahead

MAX_CHUNK_BYTES = 64 << 20
"""Largest size of the records in a compressed chunk, bytes.

Without a limit, a damaged chunk of 1 kB could claim any size.

Recorders close a chunk at about 1 MB, or after the message that exceeds it.
"""

RECORD_READERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
}


class _Decompressor(threading.local):
    """A decompressor for each thread, because making one for each chunk would double the time."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdDecompressor()


_OF_THREAD = _Decompressor()


class FilePart(NamedTuple):
    """A whole record of a file, or a damaged one."""

    opcode: int
    content: bytes
    message_indexes: list[bytes]  # contents of the message indexes that follow a chunk
    end: int  # place after the record and its message indexes


@dataclass(frozen=True, kw_only=True)
class MessageBatch:
    """N successive messages with the same channel and length, from one or several chunks."""

    channel_id: int
    data: NDArray[np.uint8]  # (N, length) bytes of the messages
    log_ns: NDArray[np.int64]  # (N,)
    publish_ns: NDArray[np.int64]  # (N,), 0 if the log has no times of sending
    # (N,), number that the publisher gave to the message, 0 if the log has no numbers
    sequence: NDArray[np.int64]

    @property
    def sent_ns(self) -> NDArray[np.int64]:
        """Times of sending, (N,); times of receipt if the log has no times of sending."""
        return np.where(self.publish_ns == 0, self.log_ns, self.publish_ns)


R = TypeVar("R")
T = TypeVar("T")


class Faults(NamedTuple):
    """What a file lacks that is not intact."""

    is_cut: bool  # whether the file has no footer
    damaged: int  # number of chunks and other parts that could not be read


class Scan:
    """Reads a file, and continues where the last reading ended, because the file may grow.

    `records`, `batches` and `groups` read the file. The attributes are valid after a reading.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.position = 0  # number of bytes that have been read
        self.ended = False  # whether the end of the data has been read
        self.complete = False  # whether the file has its footer
        self.damaged = 0  # number of chunks and other parts that could not be read
        self.endless = 0  # size that a record at `position` claims and no file can have, bytes
        # The latest log time in the index and the chunk headers, including lost messages.
        self.known_end_ns = 0
        # Number of messages by channel, from the index; known from the first record on.
        self.message_counts: dict[int, int] = {}
        self._messages = 0  # number of messages that have been read

    @property
    def faults(self) -> Faults | None:
        """Faults of the file, or None for an intact file."""
        is_intact = self.complete and not self.damaged
        return None if is_intact else Faults(not self.complete, self.damaged)

    def records(self) -> Iterator[McapRecord]:
        """Yield the schemas, channels, messages, attachments and metadata.

        Schemas and channels of the index come first, so that a damaged chunk loses none of them.
        Raises OSError if the file cannot be read. Damaged content raises no error.
        """
        return chain.from_iterable(self._read(decode_parts, 0, map))

    def batches(self) -> Iterator[McapRecord | MessageBatch]:
        """Yield the content of `records` faster, with the messages of a channel together."""
        return chain.from_iterable(self._read(decode_batches, JOINED_BYTES, map_ahead))

    def groups(self) -> Iterator[Sequence[McapRecord | MessageBatch]]:
        """Yield the content of `batches` chunk by chunk, so that a caller may stop in between."""
        return self._read(decode_batches, 0, map)

    def _read(
        self,
        decode_record: Callable[[Sequence[FilePart]], Iterator[R]],
        joined: int,
        apply: Callable[..., Iterator[tuple[FilePart, list[R], int]]],
    ) -> Iterator[Sequence[R | Schema | Channel]]:
        with self.path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            index = self._index(stream, size)
            yield [record for record in index if isinstance(record, Schema | Channel)]
            count = sum(record.message_count for record in index if isinstance(record, Statistics))
            parts = _joined(self._parts(stream, size, index), joined)
            for last, records, damaged in apply(partial(_decoded, decode_record), parts):
                self.position = last.end
                self.ended = last.opcode in ENDS
                self.damaged += damaged
                self._messages += sum(map(_messages_in, records))
                yield records
            if count > self._messages and not self.damaged:
                self.damaged += 1  # a changed opcode makes a record unrecognisable

    def _index(self, stream: IO[bytes], size: int) -> list[McapRecord]:
        """Read the records of the index, the MCAP summary.

        The list is empty if the file is truncated or the index is damaged.
        """
        position = size - FOOTER.size - len(MCAP0_MAGIC)
        if position < len(MCAP0_MAGIC):
            return []
        stream.seek(position)
        footer = stream.read(FOOTER.size)
        magic = stream.read()
        opcode, _, start, _, crc = FOOTER.unpack(footer)
        self.complete = magic == MCAP0_MAGIC and opcode == Opcode.FOOTER and start <= position
        if not self.complete or start == 0:
            return []
        stream.seek(start)
        content = stream.read(position - start)
        try:
            if crc not in (0, zlib.crc32(footer[: -CRC.size], zlib.crc32(content))):
                raise McapError("an index whose bytes were changed")
            index = list(split(content))
        except DECODE_ERRORS:
            self.damaged += 1
            return []
        ends = [
            record.message_end_time
            for record in index
            if isinstance(record, Statistics | ChunkIndex)
        ]
        self.known_end_ns = max(ends, default=0)
        # a larger count is damaged, because its message indexes would not fit into the file
        most = size // INDEX_ENTRY.itemsize
        self.message_counts = {
            channel: min(count, most)
            for record in index
            if isinstance(record, Statistics)
            for channel, count in record.channel_message_counts.items()
        }
        return index

    def _parts(
        self, stream: IO[bytes], size: int, index: Sequence[McapRecord]
    ) -> Iterator[FilePart]:
        """Yield the parts from `position` on, up to the end of what is written so far."""
        stream.seek(0)
        if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            self.complete = False
            return
        position = self.position = max(self.position, len(MCAP0_MAGIC))
        for part in whole_parts(stream, position, _known_places(index, size)):
            position = part.end
            yield part
            if part.opcode in ENDS:
                return
        # A record begins here that is not whole yet.
        stream.seek(position)
        head = stream.read(RECORD.size + TIMES.size)
        if len(head) == RECORD.size + TIMES.size:
            opcode, length = RECORD.unpack_from(head)
            self.endless = length if length > 2 * MAX_CHUNK_BYTES else 0
            if opcode == Opcode.CHUNK:
                self.known_end_ns = max(self.known_end_ns, TIMES.unpack_from(head, RECORD.size)[1])
        self.complete = False


def _known_places(index: Sequence[McapRecord], size: int) -> list[int]:
    """Return the places of the records in the index, in order, and then the size of the file."""
    starts = (
        record.chunk_start_offset if isinstance(record, ChunkIndex) else record.offset
        for record in index
        if isinstance(record, ChunkIndex | AttachmentIndex | MetadataIndex)
    )
    return [*sorted(start for start in starts if start < size), size]


def whole_parts(stream: IO[bytes], position: int, places: Sequence[int]) -> Iterator[FilePart]:
    """Yield every whole record from a position to the end of the data, with its message indexes.

    A damaged record gets the opcode DAMAGED, and the reading continues at the next record of the
    index. If the last record is not one of ENDS, the file is truncated or still growing.
    """
    stream.seek(position)
    size = places[-1]
    before: FilePart | None = None
    is_end = False
    while position + RECORD.size <= size and not is_end:
        opcode, length = RECORD.unpack(stream.read(RECORD.size))
        next_known = places[bisect_right(places, position)]
        end = position + RECORD.size + length
        is_end = opcode in ENDS and next_known == size
        if end > next_known or is_end != (opcode in ENDS):
            if next_known == size:
                break
            opcode = DAMAGED
            end = next_known
        position = end
        content = b"" if opcode == DAMAGED else stream.read(length)
        stream.seek(position)
        if before is not None and opcode == Opcode.MESSAGE_INDEX:
            before.message_indexes.append(content)
            before = before._replace(end=end)
            continue
        if before is not None:
            yield before
        before = FilePart(opcode, content, [], end)
    if before is not None:
        yield before


def _joined(parts: Iterator[FilePart], most: int) -> Iterator[Sequence[FilePart]]:
    """Join successive chunks up to `most` bytes of records; other records stay alone.

    A chunk with more than `most` bytes stays alone too.
    """
    chunks: list[FilePart] = []
    size = 0
    for part in parts:
        # A value that is no number is damaged.
        is_chunk = part.opcode == Opcode.CHUNK and len(part.content) >= CHUNK.size
        more = CHUNK.unpack_from(part.content)[2] if is_chunk else 0
        if chunks and (not is_chunk or size + more > most):
            yield chunks
            chunks = []
            size = 0
        if is_chunk:
            chunks.append(part)
            size += more
        else:
            yield [part]
    if chunks:
        yield chunks


def _decoded(
    decode_record: Callable[[Sequence[FilePart]], Iterator[R]], parts: Sequence[FilePart]
) -> tuple[FilePart, list[R], int]:
    """Decode parts of a file, and return the last part, the records, and how many were damaged."""
    try:
        return parts[-1], list(decode_record(parts)), 0
    except DECODE_ERRORS:
        if len(parts) == 1:
            return parts[0], [], 1
    records = []
    damaged = 0
    for part in parts:
        _, part_records, part_damaged = _decoded(decode_record, [part])
        records += part_records
        damaged += part_damaged
    return parts[-1], records, damaged


def map_ahead(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Apply a function to items like `map`, while a thread computes the next results in advance.

    The caller runs at the same time, because decompression and NumPy release Python's global lock.
    """
    with ThreadPoolExecutor(1) as pool:
        queue: deque[Future[R]] = deque()
        for item in items:
            queue.append(pool.submit(function, item))
            if len(queue) > AHEAD:
                yield queue.popleft().result()
        yield from (future.result() for future in queue)


def split(data: bytes) -> Iterator[McapRecord]:
    """Yield the records in a sequence of bytes. Raises DECODE_ERRORS."""
    position = 0
    while position < len(data):
        opcode, length = RECORD.unpack_from(data, position)
        position += RECORD.size
        end = position + length
        if end > len(data):
            raise McapError("a record longer than its container")
        # Nearly all records are messages, so they come first.
        if opcode == Opcode.MESSAGE and length >= MESSAGE.size:
            channel, sequence, log_time, publish_time = MESSAGE.unpack_from(data, position)
            yield Message(
                channel, log_time, data[position + MESSAGE.size : end], publish_time, sequence
            )
        else:
            yield from decode_record(opcode, data[position:end])
        position = end


def _messages_in(record: object) -> int:
    return len(record.data) if isinstance(record, MessageBatch) else isinstance(record, Message)


def decode_batches(parts: Sequence[FilePart]) -> Iterator[McapRecord | MessageBatch]:
    """Decode as `decode_record` does, with the messages of a channel together.

    The parts are chunks or a single record. The message indexes of a chunk save most of the time.
    The result does not depend on them, so they may be wrong. Raises DECODE_ERRORS.
    """
    yield from _split_batches([(_plain(part), _places(part.message_indexes)) for part in parts])


def _plain(part: FilePart) -> bytes:
    """Return the records of a part; a chunk is decompressed. Raises DECODE_ERRORS."""
    if part.opcode == Opcode.CHUNK:
        return decompress(part.content)
    return RECORD.pack(part.opcode, len(part.content)) + part.content


def _places(message_indexes: Sequence[bytes]) -> NDArray[np.int64]:
    """Read the sorted places of messages in a chunk from its indexes, which may be damaged."""
    ends = (
        len(content) - (len(content) - MESSAGE_INDEX.size) % INDEX_ENTRY.itemsize
        for content in message_indexes
    )
    entries = b"".join(
        content[MESSAGE_INDEX.size : end]
        for content, end in zip(message_indexes, ends, strict=True)
    )
    return np.sort(np.frombuffer(entries, INDEX_ENTRY)["place"])


def _split_batches(
    chunks: Sequence[tuple[bytes, NDArray[np.int64]]],
) -> Iterator[McapRecord | MessageBatch]:
    """Yield the records in chunks, and then the messages by channel. Raises DECODE_ERRORS.

    Each chunk comes with the sorted places of its messages from the message indexes.
    """
    joined_places: list[NDArray[np.int64]] = []
    size = 0
    for data, indexed in chunks:
        try:
            others, places = _walk(data, indexed)
        except DECODE_ERRORS:
            # An index may be wrong, or may belong to another chunk.
            others, places = _walk(data, NO_PLACES)
        yield from others
        joined_places.append(places + size)
        size += len(data)
    data, places = b"".join(data for data, _ in chunks), np.concatenate(joined_places)
    places = places[np.argsort(_heads(data)["channel"][places], kind="stable")]
    heads = _heads(data)[places]
    sizes = heads["length"] - MESSAGE.size
    cuts = np.flatnonzero((np.diff(heads["channel"]) != 0) | (np.diff(sizes) != 0)) + 1
    for first, end in pairwise([0, *cuts.tolist(), len(places)] if len(places) else []):
        size = int(sizes[first])
        windows = np.ndarray((len(data) - size + 1, size), np.uint8, data, strides=(1, 1))
        log_ns, publish_ns = (heads[name][first:end].copy() for name in ("log_ns", "publish_ns"))
        rows = windows[places[first:end] + HEAD.itemsize]
        yield MessageBatch(
            channel_id=int(heads["channel"][first]),
            data=rows,
            log_ns=log_ns,
            publish_ns=publish_ns,
            sequence=heads["sequence"][first:end].astype(np.int64),
        )


def _heads(data: bytes) -> NDArray[np.void]:
    """Read, at every byte of a chunk, the head that a message would have if it began there."""
    return np.ndarray((max(len(data) - HEAD.itemsize + 1, 0),), HEAD, data, strides=(1,))


def _walk(data: bytes, places: NDArray[np.int64]) -> tuple[list[McapRecord], NDArray[np.int64]]:
    """Find the records of a chunk that are no messages, and the sorted places of the messages.

    The search skips the messages at `places`, and goes from record to record between them. Raises
    DECODE_ERRORS.
    """
    heads = _heads(data)
    if len(places) and not 0 <= places[0] <= places[-1] < len(heads):
        raise McapError("a message index beyond its chunk")
    lengths = heads["length"][places]
    if np.any(heads["opcode"][places] != Opcode.MESSAGE) or np.any(
        (lengths < MESSAGE.size) | (lengths > len(data))
    ):
        raise McapError("a message index without its message")
    starts = np.append(places, len(data))
    ends = np.append(0, places + RECORD.size + lengths)
    others: list[McapRecord] = []
    further: list[int] = []
    for gap in np.flatnonzero(starts != ends):
        position = int(ends[gap])
        stop = int(starts[gap])
        while position != stop:
            opcode, length = RECORD.unpack_from(data, position)
            begin = position + RECORD.size
            if begin + length > stop:
                raise McapError("a record longer than its container")
            if opcode == Opcode.MESSAGE and length >= MESSAGE.size:
                further.append(position)
            else:
                others += decode_record(opcode, data[begin : begin + length])
            position = begin + length
    return others, np.sort(np.append(places, further)) if further else places


def decode_parts(parts: Iterable[FilePart]) -> Iterator[McapRecord]:
    """Yield the records of parts of a file, in order. Raises DECODE_ERRORS."""
    for part in parts:
        yield from split(_plain(part))


def decode_record(opcode: int, content: bytes) -> Iterator[McapRecord]:
    """Decode a record that is no message. Raises DECODE_ERRORS."""
    # A chunk does not contain another chunk.
    if opcode in {DAMAGED, Opcode.CHUNK, Opcode.MESSAGE}:
        raise McapError("a record that is damaged")
    if opcode in RECORD_READERS:
        if opcode == Opcode.ATTACHMENT:
            (crc,) = CRC.unpack(content[-CRC.size :])
            if crc not in (0, zlib.crc32(content[: -CRC.size])):
                raise McapError("an attachment whose bytes were changed")
        yield RECORD_READERS[opcode](ReadDataStream(BytesIO(content)))


def decompress(chunk: bytes) -> bytes:
    """Decompress the records in a chunk, up to the size that the chunk states.

    Raises DECODE_ERRORS.
    """
    _, _, size, crc, name_length = CHUNK.unpack_from(chunk)
    (length,), start = (
        LENGTH.unpack_from(chunk, CHUNK.size + name_length),
        CHUNK.size + name_length + LENGTH.size,
    )
    compression = chunk[CHUNK.size : CHUNK.size + name_length]
    compressed = memoryview(chunk)[start : start + length]
    if len(compressed) != length:
        raise McapError("a chunk longer than its record")
    if size > max(MAX_CHUNK_BYTES, len(compressed)):
        raise McapError(f"a chunk with a size of {size} bytes")
    if compression == b"zstd":
        # The decompressor would allocate the stated size.
        if zstandard.frame_content_size(compressed) > size:
            raise McapError("a chunk that holds more than its size")
        data = _OF_THREAD.zstd.decompress(compressed, max_output_size=size)
    elif compression == b"lz4":
        try:
            data = lz4.frame.LZ4FrameDecompressor().decompress(compressed, max_length=size)
        except RuntimeError as error:
            raise McapError(str(error)) from None
    elif compression:
        raise McapError(f"a chunk with the unknown compression {compression!r}")
    else:
        data = bytes(compressed)
    if len(data) != size or crc not in (0, zlib.crc32(data)):
        raise McapError("a chunk whose bytes were changed")
    return data
