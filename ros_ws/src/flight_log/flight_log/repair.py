# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Repair a truncated or damaged bag, which a killed recorder leaves behind.

Every rosbag2 reader accepts the repaired bag. The module needs no ROS.
"""

import os
import shutil
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from flight_core.files import is_file, parse_yaml, read_file, replacing, write_file
from flight_core.parameters import ParameterError, require
from flight_log.bag import CHUNK_BYTES
from flight_log.disk import try_lock
from flight_log.open_log import log_files, missing_parts, require_mcap
from flight_log.rosbag2_metadata import (
    EXPECTED,
    INFORMATION,
    METADATA,
    FileContents,
    TopicCount,
    bag_files,
    bag_metadata_yaml,
    read_bag_metadata,
)
from flight_log.scan import Faults, Scan


class FileRepair(NamedTuple):
    """What the repair of a file has found and done."""

    path: Path
    messages: int  # number of messages in the file after the repair
    last_ns: int  # log time of the last message
    known_end_ns: int  # the latest log time in any index or metadata; 0 if there is none
    faults: Faults | None  # None for an intact file
    damaged: Path | None  # copy of the damaged file; None for an intact file


class Repair(NamedTuple):
    """What the repair of a bag has found and done."""

    files: tuple[FileRepair, ...]
    has_new_metadata: bool
    # Names of files that metadata.yaml lists but the folder lacks.
    missing: tuple[str, ...] = ()


def repair(run: Path) -> Repair:
    """Rebuild the damaged files in the folder of a bag, and metadata.yaml.

    A damaged file is truncated or has damaged parts. A rebuilt file holds every readable record and
    has an index. The rebuilt file replaces the damaged file atomically, and the damaged file stays
    as *.damaged. An intact bag does not change. metadata.yaml keeps the names of missing files. If
    `run` is a single file of a bag, only this file is repaired, and metadata.yaml stays. Raises
    ParameterError if there is no bag, if a recorder still writes the bag, if no message can be
    read, if metadata.yaml comes from another program, or if the folder cannot be written.
    """
    # `log_files` raises, and says what the path contains.
    files = bag_files(run) or log_files(run)
    for file in files:
        require_mcap(file)
    previous: Mapping[str, Any] = {}
    end_ns = 0
    missing = list[str]()
    if not is_file(run):
        previous, end_ns = _previous_metadata(run / METADATA)
        missing = missing_parts(files, previous)
    paths = previous.get("relative_file_paths")
    try:
        scans = [_FileScan(file) for file in files]
        repairs = [scan.rebuild() if scan.faults else scan.unchanged() for scan in scans]
        lists_all_files = isinstance(paths, list) and {file.name for file in files} == {
            *map(str, paths)
        } - {*missing}
        write = not is_file(run) and (not lists_all_files or any(file.damaged for file in repairs))
        if write:
            if not previous and is_file(run / METADATA):
                _keep_damaged(run / METADATA)
            write_file(
                run / METADATA,
                bag_metadata_yaml([scan.contents() for scan in scans], previous, missing),
            )
    except OSError as error:
        raise ParameterError(
            f"{run}: cannot be repaired ({error.strerror}), expected a folder that can be written"
        ) from None
    *others, last = repairs
    return Repair(
        (*others, last._replace(known_end_ns=max(last.known_end_ns, end_ns))), write, tuple(missing)
    )


def _previous_metadata(path: Path) -> tuple[Mapping[str, Any], int]:
    """Return the content of metadata.yaml and the log time of the last message, ns.

    If the file is missing or damaged, the results are an empty mapping and 0. Raises ParameterError
    for a file of another program, because it must not be replaced.
    """
    try:
        return read_bag_metadata(path.parent)
    except ParameterError:
        if not is_file(path):
            return {}, 0
    try:
        tree = parse_yaml(read_file(path, METADATA, EXPECTED), METADATA, EXPECTED)
    except ParameterError:
        return {}, 0
    foreign = bool(tree) and not (isinstance(tree, Mapping) and INFORMATION in tree)
    require(
        not foreign,
        str(path),
        "a file of another program",
        f"{EXPECTED}, or no such file: move it elsewhere",
    )
    return {}, 0


class _FileScan:
    """The content of a file of a bag, except the data of the messages."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as stream:
            require(
                try_lock(stream),
                str(path),
                "a recorder that still writes it",
                "a recorder that has ended",
            )
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.messages: Counter[int] = Counter()
        self.first_ns = 2**63
        self.last_ns = 0
        scan = Scan(path)
        for record in scan.records():
            if isinstance(record, Message):
                self.messages[record.channel_id] += 1
                self.first_ns = min(self.first_ns, record.log_time)
                self.last_ns = max(self.last_ns, record.log_time)
            elif isinstance(record, Channel):
                self.channels[record.id] = record
            elif isinstance(record, Schema):
                self.schemas[record.id] = record
        self.known_end_ns = scan.known_end_ns
        self.faults = scan.faults

    def contents(self) -> FileContents:
        counts = []
        for identity, channel in self.channels.items():
            schema = self.schemas.get(channel.schema_id)
            type_hash, qos = (
                channel.metadata.get(key, "") for key in ("topic_type_hash", "offered_qos_profiles")
            )
            counts.append(
                TopicCount(
                    topic=channel.topic,
                    type_name=schema.name if schema else "",
                    type_hash=type_hash,
                    qos=qos,
                    messages=self.messages[identity],
                )
            )
        return FileContents(
            self.path.name, self.first_ns if self.messages else 0, self.last_ns, tuple(counts)
        )

    def unchanged(self) -> FileRepair:
        return FileRepair(
            path=self.path,
            messages=self.messages.total(),
            last_ns=self.last_ns,
            known_end_ns=self.known_end_ns,
            faults=None,
            damaged=None,
        )

    def rebuild(self) -> FileRepair:
        """Write a file with the readable records, then replace the damaged file."""
        counts = {
            identity: count
            for identity, count in self.messages.items()
            if identity in self.channels
        }
        require(bool(counts), str(self.path), "no message that could be read", "at least one")
        with replacing(self.path) as stream:
            self._copy(Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD))
            stream.flush()
            # A full disk is noticed here at the latest, before the damaged file gets a second name.
            os.fsync(stream.fileno())
            damaged = _keep_damaged(self.path)
        return FileRepair(
            path=self.path,
            messages=sum(counts.values()),
            last_ns=self.last_ns,
            known_end_ns=self.known_end_ns,
            faults=self.faults,
            damaged=damaged,
        )

    def _copy(self, writer: Writer) -> None:
        """Copy the readable records, with the schemas and channels first.

        All channels are copied, because the index also has the channels of a damaged chunk.
        """
        writer.start(profile="ros2", library="rise-di repair")
        schemas = {
            identity: writer.register_schema(schema.name, schema.encoding, schema.data)
            for identity, schema in self.schemas.items()
        }
        channels = {
            identity: writer.register_channel(
                channel.topic,
                channel.message_encoding,
                schemas.get(channel.schema_id, 0),
                channel.metadata,
            )
            for identity, channel in self.channels.items()
        }
        for record in Scan(self.path).records():
            if isinstance(record, Message):
                if record.channel_id in channels:
                    channel = channels[record.channel_id]
                    writer.add_message(
                        channel, record.log_time, record.data, record.publish_time, record.sequence
                    )
            elif isinstance(record, Attachment):
                writer.add_attachment(
                    record.create_time, record.log_time, record.name, record.media_type, record.data
                )
            elif isinstance(record, Metadata) and record.name != "rosbag2":
                writer.add_metadata(record.name, record.metadata)
        writer.add_metadata(
            "rosbag2", {"serialized_metadata": bag_metadata_yaml([self.contents()])}
        )
        writer.finish()


def _keep_damaged(path: Path) -> Path:
    """Give the damaged file a second name, under which it stays after the replacement.

    On a file system without hard links, a copy gets this name.
    """
    number = 1
    # `lexists` is also true for a broken link, whose name is taken as well.
    while os.path.lexists(
        damaged := path.with_name(f"{path.name}.damaged{f'-{number}' if number > 1 else ''}")
    ):
        number += 1
    try:
        damaged.hardlink_to(path)
    except OSError:
        shutil.copy2(path, damaged)
    return damaged
