# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A rosbag2-layout bag: one MCAP file of CDR messages and, at the end, metadata.yaml beside it. Needs no ROS."""

from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import yaml
from mcap.writer import CompressionType, Writer

from flight_recorder.definitions import Definition, definition

ROSBAG2_VERSION = 9
SCENARIO, OTHER = "application/yaml", "text/yaml"  # media types of attachments: the scenario, and what goes with it
CHUNK_BYTES = 256 * 1024


@dataclass
class _Channel:
    name: str
    type: Definition
    qos: str
    identity: int
    count: int = 0


@dataclass
class BagWriter:
    """Writes one bag into a folder. Every `flush` closes the chunk, so that a killed process leaves all before it readable."""

    directory: Path
    channels: dict[str, _Channel] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        self.path = self.directory / f"{self.directory.name}_0.mcap"
        self._stream = self.path.open("xb")
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="rise-di flight_recorder")
        self._first_ns: int | None = None
        self._last_ns = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def attach(self, name: str, media_type: str, content: bytes, now_ns: int) -> None:
        """Store a file inside the log, e.g. the scenario."""
        self._writer.add_attachment(now_ns, now_ns, name, media_type, content)

    def note(self, name: str, values: dict[str, str]) -> None:
        """Store a named set of strings inside the log."""
        self._writer.add_metadata(name, values)

    def add_topic(self, topic: str, type_name: str, qos: str) -> None:
        """Declare a topic by its full name. `qos` is rosbag2's YAML list of offered profiles."""
        known = definition(type_name)
        schema = self._writer.register_schema(known.name, "ros2msg", known.text.encode())
        metadata = {"offered_qos_profiles": qos, "topic_type_hash": known.type_hash}
        identity = self._writer.register_channel(topic, "cdr", schema, metadata)
        self.channels[topic] = _Channel(topic, known, qos, identity)

    def write(self, topic: str, received_ns: int, sent_ns: int, sequence: int, message: bytes) -> None:
        """Append one serialised message."""
        channel = self.channels[topic]
        self._writer.add_message(channel.identity, received_ns, message, sent_ns, sequence)
        channel.count += 1
        self._first_ns = received_ns if self._first_ns is None else min(self._first_ns, received_ns)
        self._last_ns = max(self._last_ns, received_ns)

    def flush(self) -> None:
        """Close the chunk in progress and hand all of it to the operating system."""
        self._writer.flush()
        self._stream.flush()

    def close(self) -> None:
        """Finish the file and write metadata.yaml."""
        information = yaml.safe_dump({"rosbag2_bagfile_information": self._information()}, sort_keys=False)
        self._writer.add_metadata("rosbag2", {"serialized_metadata": information})
        self._writer.finish()
        self._stream.close()
        (self.directory / "metadata.yaml").write_text(information, encoding="utf-8")

    def _information(self) -> dict[str, Any]:
        first_ns = self._first_ns or 0
        extent = {
            "duration": {"nanoseconds": max(self._last_ns - first_ns, 0)},
            "starting_time": {"nanoseconds_since_epoch": first_ns},
            "message_count": sum(channel.count for channel in self.channels.values()),
        }
        topics = [
            {
                "topic_metadata": {
                    "name": channel.name,
                    "type": channel.type.name,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": yaml.safe_load(channel.qos) or [],
                    "type_description_hash": channel.type.type_hash,
                },
                "message_count": channel.count,
            }
            for channel in self.channels.values()
        ]
        return {
            "version": ROSBAG2_VERSION,
            "storage_identifier": "mcap",
            **extent,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self.path.name],
            "files": [{"path": self.path.name, **extent}],
            "custom_data": None,
            "ros_distro": "jazzy",
        }
