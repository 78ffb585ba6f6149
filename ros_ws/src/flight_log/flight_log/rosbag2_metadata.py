# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read the metadata.yaml of a bag, make one in version 9 of its format, and find a bag's files.

The module needs no ROS.
"""

import re
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from flight_core.files import dump_yaml, is_file, is_folder, parse_yaml, read_yaml
from flight_core.parameters import ParameterError, require

ROSBAG2_VERSION = 9
METADATA = "metadata.yaml"
INFORMATION = "rosbag2_bagfile_information"  # the only key at the top of metadata.yaml


class TopicCount(NamedTuple):
    """A topic in a file, and the number of its messages."""

    topic: str
    type_name: str
    type_hash: str
    qos: str  # rosbag2's YAML list of offered profiles
    messages: int


class FileContents(NamedTuple):
    """The content of a file of a bag.

    The log times are in ns, and 0 if the file has no message.
    """

    file: str
    first_ns: int
    last_ns: int
    counts: tuple[TopicCount, ...]

    @property
    def messages(self) -> int:
        """Number of messages on all topics."""
        return sum(count.messages for count in self.counts)


SUFFIXES = (".mcap", ".db3")  # of the files of a bag
PACKED_SUFFIXES = (".zstd", ".zst", ".lz4")  # that a packed file has in addition


EXPECTED = "the metadata.yaml that rosbag2 writes"


def plain_name(name: str) -> str:
    """Return the name of a bag's file, less the suffix that compression has added."""
    suffix = next((suffix for suffix in PACKED_SUFFIXES if name.endswith(suffix)), "")
    return name.removesuffix(suffix)


def part_number(name: str) -> int | None:
    """Return the number of a file in a bag, or None if its name has no number."""
    number = re.search(r"_(\d{1,9})$", Path(plain_name(name)).stem)
    return None if number is None else int(number[1])


def bag_files(run: Path) -> list[Path]:
    """Return the files of a bag in the order of their numbers.

    If the path is a file, the list has only this file. If a file exists both packed and unpacked,
    the list has the unpacked file. Raises ParameterError if the files in the folder are not parts
    of a single bag.
    """
    if is_file(run):
        return [run]
    by_name: dict[str, Path] = {}
    try:
        content = sorted(run.iterdir()) if is_folder(run) else []
    except OSError as error:
        raise ParameterError(
            f"{run}: cannot be read ({error.strerror}), expected the folder of a run"
        ) from None
    # A plain file sorts before the packed file.
    for file in content:
        name = plain_name(file.name)
        if name.endswith(SUFFIXES) and is_file(file):
            by_name.setdefault(name, file)
    files = list(by_name.values())
    kinds = {re.sub(r"(_\d+)?(?=\.\w+$)", "", name) for name in by_name}
    require(len(kinds) < 2, str(run), _files_found(files), "one bag in the folder of a run")
    return sorted(files, key=lambda file: _order(file.name))


def _files_found(files: Sequence[Path]) -> str:
    """Describe files of several bags, for an error."""
    present = {*chain.from_iterable(file.suffixes for file in files)}
    suffixes = " and ".join(suffix for suffix in SUFFIXES if suffix in present)
    return f"{len(files)} {suffixes} files that are not parts of one bag"


def read_bag_metadata(run: Path) -> tuple[dict[str, Any], int]:
    """Return the content of metadata.yaml below INFORMATION, and the end of the bag, ns.

    The end is the starting time plus the duration. Raises ParameterError if the file is missing, or
    if it lacks one of these two times.
    """
    tree = read_yaml(run / METADATA, METADATA, EXPECTED)
    try:
        information: dict[str, Any] = dict(tree[INFORMATION])
        start = information["starting_time"]["nanoseconds_since_epoch"]
        duration = information["duration"]["nanoseconds"]
        end_ns = int(start) + int(duration)
    except (KeyError, OverflowError, TypeError, ValueError):
        raise ParameterError(
            f"{METADATA}: found no description of a bag, expected {EXPECTED}"
        ) from None
    require(abs(end_ns) < 2**63, METADATA, "an end time beyond 64 bits", EXPECTED)
    return information, end_ns


def bag_metadata_yaml(
    files: Sequence[FileContents],
    previous: Mapping[str, Any] | None = None,
    missing: Sequence[str] = (),
) -> str:
    """Return the text of a metadata.yaml.

    The compression, the custom data and the ROS distribution come from `previous`, the content that
    `read_bag_metadata` returned for an earlier metadata.yaml. Without it they are none, none and
    jazzy. The files that are `missing` from the folder stay in `relative_file_paths`, and in
    `files` if `previous` describes them.
    """
    counts: dict[str, TopicCount] = {}
    for count in chain.from_iterable(file.counts for file in files):
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
    previous_content = previous or {}
    descriptions = {file.file: {"path": file.file, **_extent([file])} for file in files}
    information = {
        "version": ROSBAG2_VERSION,
        "storage_identifier": "mcap",
        **_extent(files),
        "topics_with_message_count": topics,
        "compression_format": previous_content.get("compression_format", ""),
        "compression_mode": previous_content.get("compression_mode", ""),
        "relative_file_paths": sorted([*descriptions, *missing], key=_order),
        "files": sorted(
            [*descriptions.values(), *_entries(previous_content, missing)],
            key=lambda entry: _order(entry["path"]),
        ),
        "custom_data": previous_content.get("custom_data"),
        "ros_distro": previous_content.get("ros_distro", "jazzy"),
    }
    return dump_yaml({INFORMATION: information}, flow=False)


def _order(name: str) -> tuple[int, str]:
    """Return a sort key for the files of a bag: a shorter name comes first, so _2 before _10."""
    return len(plain_name(name)), name


def _entries(information: Mapping[str, Any], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return the entries in `files` of metadata.yaml whose path is among `names`."""
    entries = information.get("files")
    entries_of_files = entries if isinstance(entries, list) else []
    return [
        entry
        for entry in entries_of_files
        if isinstance(entry, dict) and entry.get("path") in names
    ]


def _profiles(qos: str) -> list[Any]:
    """Return the quality-of-service profiles of a channel; [] if they are no YAML list."""
    try:
        profiles = parse_yaml(qos, "qos", "a list")
    except ParameterError:
        return []
    return profiles if isinstance(profiles, list) else []


def _extent(files: Sequence[FileContents]) -> dict[str, Any]:
    with_messages = [file for file in files if file.messages]
    first_ns = min((file.first_ns for file in with_messages), default=0)
    last_ns = max((file.last_ns for file in with_messages), default=0)
    return {
        "duration": {"nanoseconds": last_ns - first_ns},
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "message_count": sum(file.messages for file in files),
    }
