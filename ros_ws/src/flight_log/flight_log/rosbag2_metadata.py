# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""metadata.yaml of a bag, version 9 of rosbag2: reading, writing as text, finding the MCAP files of a bag. Needs no ROS."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from flight_core.files import dump_yaml, is_file, is_folder, parse_yaml, read_yaml
from flight_core.parameters import ParameterError, require

ROSBAG2_VERSION = 9
METADATA = "metadata.yaml"
INFORMATION = "rosbag2_bagfile_information"  # the one key in it


class TopicCount(NamedTuple):
    """A topic in a file and the number of messages."""

    topic: str
    type_name: str
    type_hash: str
    qos: str  # rosbag2's YAML list of offered profiles
    messages: int


class FileContents(NamedTuple):
    """The content of a file of a bag. Log times in ns, 0 without messages."""

    file: str
    first_ns: int
    last_ns: int
    counts: tuple[TopicCount, ...]

    @property
    def messages(self) -> int:
        """Number of messages on every topic."""
        return sum(count.messages for count in self.counts)


def bag_files(run: Path) -> list[Path]:
    """The MCAP files of a bag in the order of their numbers; the file itself when a file is given; empty for further storages.

    Raises ParameterError when the files in the folder are not parts of a single bag.
    """
    if is_file(run):
        return [run]
    files = [file for file in run.glob("*.mcap") if is_file(file)] if is_folder(run) else []
    stems = {re.sub(r"_\d+$", "", file.stem) for file in files}
    require(
        len(stems) < 2, str(run), f"{len(files)} .mcap files that are not parts of one bag", "one bag in the folder of a run"
    )
    return sorted(files, key=lambda file: (len(file.stem), file.stem))  # _2 before _10


def read_bag_metadata(run: Path) -> tuple[dict[str, Any], int]:
    """The content of metadata.yaml, and the log time of the last message in ns.

    Raises ParameterError when the file is missing or is not rosbag2's.
    """
    tree = read_yaml(run / METADATA, METADATA, "that of rosbag2")
    try:
        information: dict[str, Any] = dict(tree[INFORMATION])
        start, duration = information["starting_time"]["nanoseconds_since_epoch"], information["duration"]["nanoseconds"]
        end_ns = int(start) + int(duration)
    except (KeyError, OverflowError, TypeError, ValueError):
        raise ParameterError(f"{METADATA}: found something else, expected that of rosbag2") from None
    require(abs(end_ns) < 2**63, METADATA, "an end time beyond 64 bits", "that of rosbag2")
    return information, end_ns


def is_compressed(information: Mapping[str, Any]) -> bool:
    """Whether `ros2 bag record` compressed the files or the messages of a bag, by the content of metadata.yaml."""
    return str(information.get("compression_mode") or "none").lower() != "none"


def bag_metadata_yaml(files: Sequence[FileContents], previous: Mapping[str, Any] | None = None) -> str:
    """The text of metadata.yaml. Compression, custom data and distribution come from the `previous` content."""
    counts: dict[str, TopicCount] = {}
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
    kept = previous or {}
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
    return dump_yaml({INFORMATION: information}, flow=False)


def _profiles(qos: str) -> list[Any]:
    """The offered profiles in the metadata of a channel; empty when they are not a YAML list."""
    try:
        profiles = parse_yaml(qos, "qos", "a list")
    except ParameterError:
        return []
    return profiles if isinstance(profiles, list) else []


def _extent(files: Sequence[FileContents]) -> dict[str, Any]:
    filled = [file for file in files if file.messages]
    first_ns = min((file.first_ns for file in filled), default=0)
    last_ns = max((file.last_ns for file in filled), default=0)
    return {
        "duration": {"nanoseconds": last_ns - first_ns},
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "message_count": sum(file.messages for file in files),
    }
