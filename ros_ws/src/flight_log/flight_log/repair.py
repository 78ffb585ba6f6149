# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A bag whose recorder was killed, or whose files are damaged, made one that every reader of rosbag2 takes. Needs no ROS."""

import os
import shutil
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from flight_core.files import is_file
from flight_core.parameters import ParameterError, require
from flight_log.bag import CHUNK_BYTES, METADATA, Contents, Count, bag_files, information_of, read_information
from flight_log.disk import lock, replace_text
from flight_log.scan import Scan


class Repaired(NamedTuple):
    """What was done to one file."""

    path: Path
    kept: int  # messages in it now
    last_ns: int  # log time of the last one
    known_end_ns: int  # the latest log time that anything speaks of, 0 where nothing does
    faults: str  # what was wrong with it, empty where nothing was
    damaged: Path | None  # where the file as it was is kept; None where it was not touched


class Repair(NamedTuple):
    """What was done to a bag."""

    files: tuple[Repaired, ...]
    wrote_metadata: bool


def repair(run: Path) -> Repair:
    """Rebuild what is damaged in the folder of a bag: files without an end or with damaged parts, and metadata.yaml.

    A rebuilt file holds all that could be read and has an index; it takes the place of the damaged one at once, which is kept
    beside it as *.damaged. An intact bag is left alone. Raises ParameterError where there is no bag, it is still being
    recorded, nothing in it can be read, or the folder cannot be written.
    """
    directory = run.parent if is_file(run) else run
    files = bag_files(directory)
    require(bool(files), str(run), "no .mcap file", "the folder of a run")
    try:
        before, end_ns = read_information(directory)
        whole = before.get("relative_file_paths") == [file.name for file in files]
    except ParameterError:
        before, end_ns, whole = {}, 0, False
    try:
        surveys = [_Survey(file) for file in files]
        repaired = [survey.rebuild() if survey.faults else survey.unchanged() for survey in surveys]
        write = not whole or any(one.damaged for one in repaired)
        if write:
            replace_text(directory / METADATA, information_of([survey.contents() for survey in surveys], before))
    except OSError as error:
        raise ParameterError(f"{run}: cannot be repaired ({error.strerror}), expected a folder that can be written") from None
    *others, last = repaired
    return Repair((*others, last._replace(known_end_ns=max(last.known_end_ns, end_ns))), write)


class _Survey:
    """One file, read through."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as stream:
            require(lock(stream), str(path), "a recorder that is writing it", "one that has ended")
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.messages: Counter[int] = Counter()
        self.first_ns: int | None = None
        self.last_ns = 0
        scan = Scan(path)
        for record in scan.records():
            self._take(record)
        self.known_end_ns = scan.known_end_ns
        self.faults = scan.faults

    def _take(self, record: McapRecord) -> None:
        if isinstance(record, Message):
            self.messages[record.channel_id] += 1
            self.first_ns = record.log_time if self.first_ns is None else min(self.first_ns, record.log_time)
            self.last_ns = max(self.last_ns, record.log_time)
        elif isinstance(record, Channel):
            self.channels[record.id] = record
        elif isinstance(record, Schema):
            self.schemas[record.id] = record

    def contents(self) -> Contents:
        counts = []
        for identity, channel in self.channels.items():
            schema = self.schemas.get(channel.schema_id)
            type_hash, qos = (channel.metadata.get(key, "") for key in ("topic_type_hash", "offered_qos_profiles"))
            counts.append(Count(channel.topic, schema.name if schema else "", type_hash, qos, self.messages[identity]))
        return Contents(self.path.name, self.first_ns or 0, self.last_ns, tuple(counts))

    def unchanged(self) -> Repaired:
        return Repaired(self.path, self.messages.total(), self.last_ns, self.known_end_ns, "", None)

    def rebuild(self) -> Repaired:
        """Write a file of all that can be read, then put it in the place of the damaged one."""
        known = {identity: count for identity, count in self.messages.items() if identity in self.channels}
        require(bool(known), str(self.path), "no message that could be read", "any")
        fresh = self.path.with_name(f"{self.path.name}.new")
        try:
            with fresh.open("wb") as stream:
                writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
                self._copy(writer)
                stream.flush()
                os.fsync(stream.fileno())
            damaged = _keep(self.path)
            fresh.replace(self.path)
        except OSError:
            fresh.unlink(missing_ok=True)
            raise
        return Repaired(self.path, sum(known.values()), self.last_ns, self.known_end_ns, self.faults, damaged)

    def _copy(self, writer: Writer) -> None:
        """All records, schemas and channels first: those of a damaged chunk stand in the index too."""
        writer.start(profile="ros2", library="rise-di repair")
        schemas = {identity: writer.register_schema(one.name, one.encoding, one.data) for identity, one in self.schemas.items()}
        channels = {
            identity: writer.register_channel(one.topic, one.message_encoding, schemas.get(one.schema_id, 0), one.metadata)
            for identity, one in self.channels.items()
        }
        for record in Scan(self.path).records():
            if isinstance(record, Message):
                if record.channel_id in channels:
                    channel = channels[record.channel_id]
                    writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
            elif isinstance(record, Attachment):
                writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
            elif isinstance(record, Metadata) and record.name != "rosbag2":
                writer.add_metadata(record.name, record.metadata)
        writer.add_metadata("rosbag2", {"serialized_metadata": information_of([self.contents()])})
        writer.finish()


def _keep(path: Path) -> Path:
    """A second name for a file, so that the first can be given to another; a copy where the file system has no links."""
    number = 1
    while (damaged := path.with_name(f"{path.name}.damaged{f'-{number}' if number > 1 else ''}")).exists():
        number += 1
    try:
        damaged.hardlink_to(path)
    except OSError:
        shutil.copy2(path, damaged)
    return damaged
