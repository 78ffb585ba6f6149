# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write a bag in the layout of rosbag2: an MCAP file of CDR messages, and metadata.yaml.

The module needs no ROS.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, Self, cast

from mcap._chunk_builder import ChunkBuilder
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Message, MessageIndex
from mcap.writer import CompressionType, Writer

from flight_core.files import read_yaml, write_file
from flight_core.parameters import require
from flight_log.disk import ReservedFile
from flight_log.message_definitions import MessageDefinition, definition
from flight_log.rosbag2_metadata import METADATA, FileContents, TopicCount, bag_metadata_yaml
from flight_log.scan import RECORD

SCENARIO_MEDIA_TYPE = "application/yaml"  # media type of the attached scenario
FILE_MEDIA_TYPE = "text/yaml"  # media type of other attached files
# Key in the metadata of a channel: the full name of its topic before a remap of ROS 2.
BEFORE_REMAP = "rise_di_topic"
OUTCOME = "rise_di_outcome"  # name of the metadata record with the outcome of the flight
SILENCES = "rise_di_silent"  # name of the metadata record with the silences of topics, s
OUTCOME_FILE = "outcome"  # file in the folder of a run from which the recorder learns the outcome
# Name of the metadata record of a log that the stack did not fly. Its keys are "log", "kind", "map"
# and COMPARED.
IMPORTED = "rise_di_imported"
# Key in IMPORTED of the notes on how the parameters in the autopilot's log differ from the map, or
# that they could not be compared. The text is empty if there are no notes.
COMPARED = "parameters"
# Name of the metadata record with the SI units of channels, for a log without a scenario.
CHANNEL_UNITS = "rise_di_units"
# Name of the metadata record of a flight whose time was given by /clock. The record has the topic,
# and the speed of the flight as a multiple of real time.
SIMULATED_TIME = "rise_di_simulated_time"
# Name of the metadata record that counts the messages that the recorder lost, by topic.
LOST_MESSAGES = "rise_di_lost"
CHUNK_BYTES = 256 * 1024

# Bytes reserved for the end of a file: the chunk in progress with its index, and the summary
# without the chunk indexes. The chunk indexes grow with the file: 77 bytes for each chunk, and 10
# for each topic in it (MCAP specification, Chunk Index).
END_BYTES = 2 * CHUNK_BYTES
INDEX_BYTES = 77
INDEX_BYTES_BY_TOPIC = 10

# Private attributes of the Writer of mcap 1.6. Another version would have other private attributes.
CHUNK_BUILDER = "_Writer__chunk_builder"
CHUNK_INDEXES = "_Writer__chunk_indices"
MESSAGE = int(Opcode.MESSAGE)
# RECORD, then channel, sequence, log time and publish time (MCAP specification)
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
INDEX_HEAD = struct.Struct("<BQHI")  # RECORD, then channel and size


class LogAttachments(NamedTuple):
    """Files and metadata that a log stores beside the messages."""

    scenario: Path | None = None
    files: tuple[Path, ...] = ()
    # A YAML file of named sets of strings. Each set becomes a metadata record.
    metadata: Path | None = None


@dataclass
class BagChannel:
    """A topic to which a bag writer adds messages."""

    topic: str
    type: MessageDefinition
    qos: str
    identity: int
    messages: int = 0


class _MessageIndex(MessageIndex):
    """Where the messages of a channel are in a chunk: their offsets, packed in one step."""

    def write(self, stream: RecordBuilder) -> None:
        size = 16 * len(self.records)
        head = INDEX_HEAD.pack(
            Opcode.MESSAGE_INDEX, INDEX_HEAD.size - RECORD.size + size, self.channel_id, size
        )
        stream.write(head + struct.pack(f"<{size // 8}Q", *chain.from_iterable(self.records)))


class _ChunkBuilder(ChunkBuilder):
    """A chunk builder that writes the same bytes as mcap's builder in half the time.

    The builder of mcap writes a message field by field, and then goes back to write the message's
    length.
    """

    def add_message(self, message: Message) -> None:
        time_ns = message.log_time
        self.message_start_time = (
            time_ns if self.num_messages == 0 else min(self.message_start_time, time_ns)
        )
        self.message_end_time = max(self.message_end_time, time_ns)
        index = self.message_indices.get(message.channel_id)
        if index is None:
            index = self.message_indices[message.channel_id] = _MessageIndex(message.channel_id, [])
        index.records.append((time_ns, self.record_writer.count))
        self.num_messages += 1
        length = MESSAGE_HEAD.size - RECORD.size + len(message.data)
        self.record_writer.write(
            MESSAGE_HEAD.pack(
                MESSAGE, length, message.channel_id, message.sequence, time_ns, message.publish_time
            )
        )
        self.record_writer.write(message.data)


class _ChunkIndexes:
    """The chunk indexes of a file as records on disk; mcap would keep them as a list in memory.

    The list would grow by 1 kB a chunk, which is 36 MB an hour. Each chunk index also enlarges the
    space that is reserved for the end of the file, because the indexes are written there.
    """

    def __init__(self, file: ReservedFile, channels: Sequence[BagChannel]) -> None:
        self._file = file
        self._channels = channels
        self._count = 0

    def append(self, index: ChunkIndex) -> None:
        record = RecordBuilder()
        index.write(record)
        self._file.keep(record.end())
        self._count += 1
        self._file.reserve(
            END_BYTES + self._count * (INDEX_BYTES + INDEX_BYTES_BY_TOPIC * len(self._channels))
        )

    def __iter__(self) -> Iterator["_ChunkIndexes"]:
        yield self

    def write(self, stream: RecordBuilder) -> None:
        stream.write(self._file.kept_data())


def full_names(remaps: Mapping[str, str]) -> dict[str, str]:
    """Return, for each topic of a log, its full name in the flight stack before a remap.

    `remaps` maps such full names to topics of the log. The result maps the other way.
    """
    return {topic: f"/{name.lstrip('/')}" for name, topic in remaps.items()}


def stack_topic(channel: Channel, stack_names: Mapping[str, str] = {}) -> str:
    """Return the full name that a topic of a log has in the flight stack, before a remap.

    `stack_names` has such names by topic of the log. For a topic that is not in `stack_names`, the
    name is the one that the log states, or else the topic itself.
    """
    return stack_names.get(channel.topic) or channel.metadata.get(BEFORE_REMAP) or channel.topic


class BagWriter:
    """Writes a bag into a folder.

    `flush` closes the chunk in progress. If the process is killed, the closed chunks stay readable.
    Disk space for the end of the file is reserved. After a write has used this reserve, `full` is
    true and the bag must be closed. Raises OSError if a write fails for another reason, or if the
    reserve does not suffice.
    """

    def __init__(self, directory: Path) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self.directory = directory
        self.path = directory / f"{directory.name}_0.mcap"
        self.channels: list[BagChannel] = []
        self._file = ReservedFile(self.path)
        self._file.reserve(END_BYTES)
        self._writer = Writer(
            cast(Any, self._file), chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD
        )
        setattr(self._writer, CHUNK_BUILDER, _ChunkBuilder())
        setattr(self._writer, CHUNK_INDEXES, _ChunkIndexes(self._file, self.channels))
        try:
            self._writer.start(profile="ros2", library="rise-di flight_recorder")
        except OSError:
            self._file.close()
            raise
        self._first_ns: int | None = None
        self._last_ns = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_full(self) -> bool:
        """Whether the disk is full."""
        return self._file.is_full

    def add_attachments(self, attachments: LogAttachments, now_ns: int) -> None:
        """Store files as attachments, and named sets of strings as metadata records."""
        typed = [(path, FILE_MEDIA_TYPE) for path in attachments.files]
        if attachments.scenario is not None:
            typed.insert(0, (attachments.scenario, SCENARIO_MEDIA_TYPE))
        for path, media_type in typed:
            self._writer.add_attachment(now_ns, now_ns, path.name, media_type, path.read_bytes())
        if attachments.metadata is not None:
            for name, values in read_metadata_records(attachments.metadata).items():
                self.add_metadata(name, values)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Store a named set of strings as an MCAP metadata record."""
        self._writer.add_metadata(name, dict(values))

    def add_topic(self, topic: str, type_name: str, qos: str, before_remap: str = "") -> BagChannel:
        """Add a topic by its full name.

        `qos` is rosbag2's YAML list of the offered profiles of quality of service. `before_remap`
        is the full name that the topic has in the flight stack. Raises ParameterError if the
        definition of the type is not known.
        """
        type_definition = definition(type_name)
        schema = self._writer.register_schema(
            type_definition.name, "ros2msg", type_definition.text.encode()
        )
        metadata = {"offered_qos_profiles": qos, "topic_type_hash": type_definition.type_hash}
        if before_remap not in {"", topic}:
            metadata[BEFORE_REMAP] = before_remap
        channel = BagChannel(
            topic,
            type_definition,
            qos,
            self._writer.register_channel(topic, "cdr", schema, metadata),
        )
        self.channels.append(channel)
        return channel

    def write(
        self, channel: BagChannel, received_ns: int, sent_ns: int, sequence: int, message: bytes
    ) -> None:
        """Append a serialised message."""
        self._writer.add_message(channel.identity, received_ns, message, sent_ns, sequence)
        channel.messages += 1
        self._last_ns = max(self._last_ns, received_ns)
        if self._first_ns is None or received_ns < self._first_ns:
            self._first_ns = received_ns

    def flush(self) -> None:
        """Close the chunk in progress and flush the file."""
        self._writer.flush()

    def contents(self) -> FileContents:
        """Return the content of the file so far."""
        counts = (
            TopicCount(
                topic=channel.topic,
                type_name=channel.type.name,
                type_hash=channel.type.type_hash,
                qos=channel.qos,
                messages=channel.messages,
            )
            for channel in self.channels
        )
        return FileContents(self.path.name, self._first_ns or 0, self._last_ns, tuple(counts))

    def close(self) -> None:
        """Finish the file and write metadata.yaml."""
        try:
            self._file.release()
            metadata = bag_metadata_yaml([self.contents()])
            self._writer.add_metadata("rosbag2", {"serialized_metadata": metadata})
            self._writer.finish()
        finally:
            self._file.close()
        write_file(self.directory / METADATA, metadata)


def _is_mapping_of_strings(content: object) -> bool:
    return isinstance(content, dict) and all(
        isinstance(text, str) for text in (*content.keys(), *content.values())
    )


def read_metadata_records(path: Path) -> dict[str, dict[str, str]]:
    """Read named sets of strings from a YAML file. Raises ParameterError for another content."""
    expected = "a mapping of mappings of strings"
    content = read_yaml(path, str(path), expected)
    valid = isinstance(content, dict) and all(map(_is_mapping_of_strings, content.values()))
    require(valid, str(path), "something else", expected)
    return {str(name): values for name, values in content.items()}
