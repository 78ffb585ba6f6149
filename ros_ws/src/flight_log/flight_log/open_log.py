# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Open the files of a log for every reader.

This module unpacks packed files and compressed messages, and orders the files of a bag. If a path
is no log, the error says what the path contains.
"""

import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.records import Channel, Schema

from flight_core.files import is_file, is_folder
from flight_core.parameters import ParameterError, require
from flight_log.bag import stack_topic
from flight_log.file_kinds import (
    IMPORTABLE,
    MCAP_BEGINS,
    PACKED,
    ZSTD_MAGIC,
    FileKind,
    file_kind,
)
from flight_log.named_vectors import tables
from flight_log.rosbag2_metadata import (
    METADATA,
    PACKED_SUFFIXES,
    bag_files,
    part_number,
    plain_name,
)
from flight_log.scan import MAX_CHUNK_BYTES, MessageBatch, Scan

A_RUN = "the folder of a run or an MCAP file"
ROSBAG2 = "rosbag2"
"""Folder in the folder of a run with the bag of `ros2 bag record`, if this program recorded the
flight. The log in the folder of the run then has only the attachments."""

NAMED = 5  # largest number of files, folders or topics that a sentence names
COPY_BYTES = 1 << 20
UNPACK = {".zst": "zstd -d", ".zstd": "zstd -d", ".lz4": "lz4 -d"}


def log_files(run: Path) -> list[Path]:
    """Return the files of a log in the order of recording.

    Files in the folder ROSBAG2 of a run come last. If the path has no log, raises ParameterError
    with a sentence on what it contains.
    """
    files = [*bag_files(run), *(bag_files(run / ROSBAG2) if is_folder(run / ROSBAG2) else ())]
    kinds = [file_kind(file) for file in files]
    is_log = any(kind is FileKind.MCAP or kind in PACKED for kind in kinds)
    is_begun = is_folder(run) and not MCAP_BEGINS.isdisjoint(kinds)
    if FileKind.SQLITE in kinds or not (is_log or is_begun):
        importable = is_file(run) and {*kinds} & IMPORTABLE
        mend = f"; rise-di import {run} makes one of it" if importable else ""
        found = _what_is_there(run, files, kinds)
        raise ParameterError(f"{run}: found {found}, expected {A_RUN}{mend}")
    return files


def _what_is_there(run: Path, files: Sequence[Path], kinds: Sequence[FileKind]) -> str:
    """Return the part of a sentence that says what a path without a log contains."""
    if files:
        if is_file(run):
            return kinds[0].value
        named = zip(files, kinds, strict=True)
        return _some([f"{file.name}, {kind.value}" for file, kind in named])
    if not is_folder(run):
        return "no such file or folder"
    content = sorted(run.iterdir())
    runs = [
        folder.name
        for folder in content
        if is_folder(folder) and folder.name != ROSBAG2 and _is_bag(folder)
    ]
    others = [
        f"{path.name}, {file_kind(path).value}"
        for path in content
        if is_file(path) and path.name != METADATA
    ]
    if runs:
        content_text = f"the folders of runs {_some(runs)}"
    else:
        content_text = _some(others or [path.name for path in content])
    return f"no .mcap file, but {content_text}" if content_text else "no .mcap file"


def _is_bag(folder: Path) -> bool:
    """Return whether a folder holds the files of a single bag."""
    with suppress(ParameterError):
        return bool(bag_files(folder))
    return False


def _some(names: Sequence[str]) -> str:
    """Return a text with the first names and the number of the rest."""
    surplus = len(names) - NAMED
    return "; ".join(names[:NAMED]) + (f"; and {surplus} more" if surplus > 0 else "")


def missing_parts(files: Sequence[Path], information: Mapping[str, Any]) -> list[str]:
    """Return the names of a bag's files that metadata.yaml lists but the folder lacks.

    Without metadata.yaml, the bag should have every number from 0, the first number of rosbag2, to
    the last number in the folder. Renamed files are compared by number.
    """
    paths = information.get("relative_file_paths")
    file_names = [Path(str(path)).name for path in paths] if isinstance(paths, list) else []
    present = {plain_name(file.name) for file in files}
    numbers = {number for file in files if (number := part_number(file.name)) is not None}
    if not file_names and len(numbers) == len(files) > 1 and max(numbers) < 2 * len(files) + 100:
        stem = re.sub(r"\d+$", "", Path(plain_name(files[0].name)).stem)
        suffix = files[0].name.removeprefix(Path(plain_name(files[0].name)).stem)
        file_names = [f"{stem}{number}{suffix}" for number in range(max(numbers) + 1)]
    if len(files) >= len(file_names):
        return []
    if any(plain_name(name) in present for name in file_names):
        return [name for name in file_names if plain_name(name) not in present]
    return [name for name in file_names if part_number(name) not in numbers]


@contextmanager
def open_scan(file: Path) -> Iterator[Scan]:
    """Open the reader of a log's file, which depends on the first bytes of the file.

    A packed file is unpacked into a temporary folder. Raises ParameterError if the file cannot be
    read.
    """
    kind = file_kind(file)
    if kind not in PACKED:
        yield Scan(file)
        return
    with TemporaryDirectory(prefix="rise-di-") as folder:
        plain = Path(folder) / plain_name(file.name)
        _unpack(file, plain, kind)
        is_sqlite = file_kind(plain) is FileKind.SQLITE
        require(not is_sqlite, str(file), FileKind.SQLITE.value, A_RUN)
        yield Scan(plain)


def _unpack(file: Path, plain: Path, kind: FileKind) -> None:
    """Unpack the content of a packed file into the file `plain`.

    If the file is truncated, only the beginning is written. Raises ParameterError if the file
    cannot be read, or if its content is larger than half of the free space.
    """
    limit = shutil.disk_usage(plain.parent).free // 2
    open_packed: Any = lz4.frame.open if kind is FileKind.LZ4 else zstandard.open
    size = 0
    try:
        with open_packed(file, "rb") as source, plain.open("wb") as target:
            # `read1` returns the content of a truncated file up to its end.
            while block := source.read1(COPY_BYTES):
                size += len(block)
                unpack = UNPACK.get(file.suffix, "unpack")
                require(
                    size <= limit,
                    str(file),
                    f"more than {limit} bytes unpacked",
                    f"them on a larger disk: {unpack}",
                )
                target.write(block)
    except (EOFError, RuntimeError, zstandard.ZstdError):
        return
    except OSError as error:
        raise ParameterError(
            f"{file}: cannot be unpacked ({error.strerror or error}), expected {A_RUN}"
        ) from None


def log_topics(run: Path, stack_names: Mapping[str, str] = {}) -> dict[str, str]:
    """Return the types of the topics in a log, by the full name of the topic.

    `stack_names` is a mapping from a topic of the log to its name in the flight stack. The type of
    messages that are not CDR ends with "in ENCODING". If the file has an index, only the index is
    read. Raises ParameterError for a path without a log.
    """
    topics: dict[str, str] = {}
    for file in log_files(run):
        schemas: dict[int, str] = {}
        with open_scan(file) as scan:
            for record in scan.records():
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    name = schemas.get(record.schema_id, "")
                    encoding = record.message_encoding
                    topics.setdefault(
                        stack_topic(record, stack_names),
                        name if encoding == "cdr" else f"{name} in {encoding}",
                    )
                elif topics and scan.message_counts:
                    # The index has all channels.
                    break
    return topics


def plain_message(data: bytes) -> bytes:
    """Return a message in plain form: decompressed if `ros2 bag record` compressed it.

    No message in CDR begins like a compressed message. A damaged message is returned as it is,
    because no decoder accepts it.
    """
    if data[:4] != ZSTD_MAGIC:
        return data
    try:
        if zstandard.frame_content_size(data) > MAX_CHUNK_BYTES:
            return data
        return zstandard.ZstdDecompressor().stream_reader(data).read(MAX_CHUNK_BYTES)
    except (MemoryError, zstandard.ZstdError):
        return data


def plain_batches(batch: MessageBatch) -> Iterator[MessageBatch]:
    """Decompress the messages of a batch as `plain_message` does.

    Decompressed messages may differ in length, so they come in batches of equal length.
    """
    if not len(batch.data) or batch.data[0, :4].tobytes() != ZSTD_MAGIC:
        yield batch
        return
    begin = 0
    for table in tables(plain_message(row.tobytes()) for row in batch.data):
        end = begin + len(table)
        yield MessageBatch(
            channel_id=batch.channel_id,
            data=table,
            log_ns=batch.log_ns[begin:end],
            publish_ns=batch.publish_ns[begin:end],
            sequence=batch.sequence[begin:end],
        )
        begin = end


def require_mcap(file: Path) -> None:
    """Raise ParameterError for a file that is no MCAP file, and name its kind.

    An empty file passes, and so does a file with only the first bytes of an MCAP file.
    """
    kind = file_kind(file)
    found = kind.value
    if kind in PACKED and file.name.endswith(PACKED_SUFFIXES):
        found += f", which {UNPACK[file.suffix]} unpacks"
    require(kind in MCAP_BEGINS, str(file), found, "an MCAP file")
