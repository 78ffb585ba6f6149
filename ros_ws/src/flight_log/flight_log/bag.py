# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A rosbag2-layout bag: one MCAP file of CDR messages and, at the end, metadata.yaml beside it. Needs no ROS."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self, cast

import yaml
from mcap.writer import CompressionType, Writer

from flight_core.files import is_file, is_folder, parse_yaml, read_yaml
from flight_core.parameters import ParameterError, require
from flight_log.disk import ReservedFile, replace_text
from flight_log.message_definitions import Definition, definition

ROSBAG2_VERSION = 9
METADATA = "metadata.yaml"
INFORMATION = "rosbag2_bagfile_information"  # the one key in it
SCENARIO, OTHER = "application/yaml", "text/yaml"  # media types of attachments: the scenario, and what goes with it
LOST = "rise_di_lost"  # metadata: messages lost on the way to the recorder, by topic
CHUNK_BYTES = 256 * 1024

# Room to hold for the end of a file: the chunk in progress with its index, and the rest but for the index of chunks, which
# grows with the file: 77 bytes a chunk and 10 for each topic in it (MCAP specification, Chunk Index).
END_BYTES = 2 * CHUNK_BYTES
INDEX_BYTES, INDEX_BYTES_BY_TOPIC = 77, 10


class Count(NamedTuple):
    """What a file holds of one topic."""

    topic: str
    type_name: str
    type_hash: str
    qos: str  # rosbag2's YAML list of offered profiles
    messages: int


class Contents(NamedTuple):
    """What one file of a bag holds; log times in ns, 0 where there is no message."""

    file: str
    first_ns: int
    last_ns: int
    counts: tuple[Count, ...]

    @property
    def messages(self) -> int:
        """How many messages on all topics."""
        return sum(count.messages for count in self.counts)


@dataclass
class Channel:
    """A topic of a bag that is being written."""

    topic: str
    type: Definition
    qos: str
    identity: int
    messages: int = 0


class BagWriter:
    """Writes one bag into a folder. Every `flush` closes the chunk, so that a killed process leaves all before it readable.

    Room for the end of the file is held on the disk. Once a write had to use it, `full` says so, and it is time to close.
    Raises OSError where a write fails for any other reason, or finds no space even so.
    """

    def __init__(self, directory: Path) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self.directory = directory
        self.path = directory / f"{directory.name}_0.mcap"
        self.channels: list[Channel] = []
        self._file = ReservedFile(self.path)
        self._file.hold(END_BYTES)
        self._writer = Writer(cast(Any, self._file), chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        try:
            self._writer.start(profile="ros2", library="rise-di flight_recorder")
        except OSError:
            self._file.close()
            raise
        self._chunks = 0
        self._first_ns: int | None = None
        self._last_ns = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def full(self) -> bool:
        """Whether the disk is full."""
        return self._file.full

    def attach(self, name: str, media_type: str, content: bytes, now_ns: int) -> None:
        """Store a file inside the log, e.g. the scenario."""
        self._writer.add_attachment(now_ns, now_ns, name, media_type, content)

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Store a named set of strings inside the log, as an MCAP metadata record."""
        self._writer.add_metadata(name, dict(values))

    def enclose(self, enclosed: "Enclosed", now_ns: int) -> None:
        """Store all that a log holds beside its messages."""
        if enclosed.scenario is not None:
            self.attach(enclosed.scenario.name, SCENARIO, enclosed.scenario.read_bytes(), now_ns)
        for path in enclosed.attached:
            self.attach(path.name, OTHER, path.read_bytes(), now_ns)
        for name, values in (read_metadata(enclosed.metadata) if enclosed.metadata is not None else {}).items():
            self.note(name, values)

    def add_topic(self, topic: str, type_name: str, qos: str) -> Channel:
        """Declare a topic by its full name. `qos` is rosbag2's YAML list of offered profiles.

        Raises ParameterError where the package of its type is not installed.
        """
        known = definition(type_name)
        schema = self._writer.register_schema(known.name, "ros2msg", known.text.encode())
        said = {"offered_qos_profiles": qos, "topic_type_hash": known.type_hash}
        channel = Channel(topic, known, qos, self._writer.register_channel(topic, "cdr", schema, said))
        self.channels.append(channel)
        return channel

    def write(self, channel: Channel, received_ns: int, sent_ns: int, sequence: int, message: bytes) -> None:
        """Append one serialised message."""
        self._writer.add_message(channel.identity, received_ns, message, sent_ns, sequence)
        channel.messages += 1
        self._last_ns = max(self._last_ns, received_ns)
        if self._first_ns is None or received_ns < self._first_ns:
            self._first_ns = received_ns

    def flush(self) -> None:
        """Close the chunk in progress and hand all of it to the operating system."""
        self._writer.flush()
        self._chunks += 1
        self._file.hold(END_BYTES + self._chunks * (INDEX_BYTES + INDEX_BYTES_BY_TOPIC * len(self.channels)))

    def contents(self) -> Contents:
        """What it holds so far."""
        counts = (
            Count(channel.topic, channel.type.name, channel.type.type_hash, channel.qos, channel.messages)
            for channel in self.channels
        )
        return Contents(self.path.name, self._first_ns or 0, self._last_ns, tuple(counts))

    def close(self) -> None:
        """Finish the file and write metadata.yaml."""
        try:
            self._file.release()
            information = information_of([self.contents()])
            self._writer.add_metadata("rosbag2", {"serialized_metadata": information})
            self._writer.finish()
        finally:
            self._file.close()
        replace_text(self.directory / METADATA, information)


class Enclosed(NamedTuple):
    """What a log holds beside its messages: files, and a YAML file of named sets of strings for its metadata records."""

    scenario: Path | None = None
    attached: tuple[Path, ...] = ()
    metadata: Path | None = None


def read_metadata(path: Path) -> dict[str, dict[str, str]]:
    """Named sets of strings from a YAML file. Raises ParameterError where it holds anything else."""
    expected = "a mapping of mappings of strings"
    content = read_yaml(path, str(path), expected)
    fits = isinstance(content, dict) and all(
        isinstance(values, dict) and all(isinstance(text, str) for item in values.items() for text in item)
        for values in content.values()
    )
    require(fits, str(path), "something else", expected)
    return {str(name): values for name, values in content.items()}


def bag_files(run: Path) -> list[Path]:
    """The MCAP files of a bag in the order of their numbers, or the one that is named; none where it has another storage.

    Raises ParameterError where the files in the folder are not parts of one bag.
    """
    if is_file(run):
        return [run]
    files = [file for file in run.glob("*.mcap") if is_file(file)] if is_folder(run) else []
    stems = {re.sub(r"_\d+$", "", file.stem) for file in files}
    found = f"{len(files)} .mcap files that are no parts of one bag"
    require(len(stems) < 2, str(run), found, "one bag in the folder of a run")
    return sorted(files, key=lambda file: (len(file.stem), file.stem))  # _2 before _10


def read_information(run: Path) -> tuple[dict[str, Any], int]:
    """What metadata.yaml of a bag says, and the log time of its last message in ns.

    Raises ParameterError where it is missing or not that of a bag.
    """
    tree = read_yaml(run / METADATA, METADATA, "that of rosbag2")
    try:
        information: dict[str, Any] = dict(tree[INFORMATION])
        first, last = information["starting_time"]["nanoseconds_since_epoch"], information["duration"]["nanoseconds"]
        end_ns = int(first) + int(last)
    except (KeyError, OverflowError, TypeError, ValueError):
        raise ParameterError(f"{METADATA}: found something else, expected that of rosbag2") from None
    require(abs(end_ns) < 2**63, METADATA, "an end at no instant", "that of rosbag2")
    return information, end_ns


def information_of(files: Sequence[Contents], before: Mapping[str, Any] | None = None) -> str:
    """The text of metadata.yaml (rosbag2 metadata, version 9); `before` is what an older one said of things not known here."""
    counts: dict[str, Count] = {}
    for count in (count for file in files for count in file.counts):
        messages = count.messages + (counts[count.topic].messages if count.topic in counts else 0)
        counts[count.topic] = count._replace(messages=messages)
    topics = [
        {
            "topic_metadata": {
                "name": count.topic,
                "type": count.type_name,
                "serialization_format": "cdr",
                "offered_qos_profiles": _profiles(count.qos),
                "type_description_hash": count.type_hash,
            },
            "message_count": count.messages,
        }
        for count in counts.values()
    ]
    kept = before or {}
    information = {
        "version": ROSBAG2_VERSION,
        "storage_identifier": "mcap",
        **_extent(files),
        "topics_with_message_count": topics,
        "compression_format": kept.get("compression_format", ""),
        "compression_mode": kept.get("compression_mode", ""),
        "relative_file_paths": [file.file for file in files],
        "files": [{"path": file.file, **_extent([file])} for file in files],
        "custom_data": kept.get("custom_data"),
        "ros_distro": kept.get("ros_distro", "jazzy"),
    }
    return yaml.safe_dump({INFORMATION: information}, sort_keys=False)


def _profiles(qos: str) -> list[Any]:
    """The offered profiles as a channel says them; none where that is no list."""
    try:
        found = parse_yaml(qos, "qos", "a list")
    except ParameterError:
        return []
    return found if isinstance(found, list) else []


def _extent(files: Sequence[Contents]) -> dict[str, Any]:
    filled = [file for file in files if file.messages]
    first_ns = min((file.first_ns for file in filled), default=0)
    last_ns = max((file.last_ns for file in filled), default=0)
    return {
        "duration": {"nanoseconds": last_ns - first_ns},
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "message_count": sum(file.messages for file in files),
    }
