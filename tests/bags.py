# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write bags of one flight as the recorders of ROS 2 and other programs do.

Files that are no logs are beside them. The writers are the libraries mcap and rosbags, and not the
stack.
"""

import gzip
import io
import struct
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import yaml
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter
from tests.joint_states import JOINT_STATE, STORE
from tests.recordings import EPOCH

from flight_core.rates import NANOSECONDS

IDL = """================================================================================
IDL: sensor_msgs/msg/JointState
#include "std_msgs/msg/Header.idl"
module sensor_msgs { module msg {
  struct JointState {
    std_msgs::msg::Header header;
    sequence<string> name;
    sequence<double> position;
    sequence<double> velocity;
    sequence<double> effort;
  };
}; };
================================================================================
IDL: std_msgs/msg/Header
module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; string frame_id; }; }; };
"""  # noqa: E501 - a text as it is written
CLOCK = struct.Struct("<iI")


class Recorded(NamedTuple):
    """A message as a recorder stores it, with times in ns."""

    topic: str
    log_ns: int
    publish_ns: int
    data: bytes


def restamped(data: bytes, stamp_ns: int) -> bytes:
    """Return a message with another stamp in its header."""
    return data[:4] + CLOCK.pack(*divmod(stamp_ns, NANOSECONDS)) + data[12:]


def flight_messages(file: Path) -> list[Recorded]:
    """Return the messages of a log in the order of recording, with stamps of today.

    They are sent 0.5 ms and received 1 ms after their stamps.
    """
    with file.open("rb") as stream:
        stored = [
            (channel.topic, message.data)
            for _, channel, message in make_reader(stream).iter_messages()
        ]
    messages = []
    for topic, data in stored:
        seconds, nanoseconds = CLOCK.unpack_from(data, 4)
        stamp_ns = EPOCH + seconds * NANOSECONDS + nanoseconds
        messages.append(
            Recorded(topic, stamp_ns + 1_000_000, stamp_ns + 500_000, restamped(data, stamp_ns))
        )
    return sorted(messages, key=lambda message: message.log_ns)


def write_metadata(
    folder: Path, names: Sequence[str], messages: Sequence[Recorded], **information: object
) -> None:
    """Write metadata.yaml of rosbag2 with these files."""
    first, last = (choose((m.log_ns for m in messages), default=0) for choose in (min, max))
    topics = dict.fromkeys(message.topic for message in messages)
    content = {
        "version": 9,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": last - first},
        "starting_time": {"nanoseconds_since_epoch": first},
        "message_count": len(messages),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": JOINT_STATE,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [],
                    "type_description_hash": "",
                },
                "message_count": sum(message.topic == topic for message in messages),
            }
            for topic in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": list(names),
        "files": [{"path": name, "message_count": len(messages)} for name in names],
    }
    text = yaml.safe_dump({"rosbag2_bagfile_information": content | information})
    (folder / "metadata.yaml").write_text(text)


def write_mcap(
    folder: Path,
    messages: Sequence[Recorded],
    name: str = "bag_0.mcap",
    schema: tuple[str, str, bytes] | None = None,
    encoding: str = "cdr",
    beside: Callable[[Any], None] | None = None,
    profile: str = "ros2",
    **options: Any,
) -> Path:
    """Write the messages as an MCAP file with the library mcap and its options."""
    folder.mkdir(parents=True, exist_ok=True)
    text = STORE.generate_msgdef(JOINT_STATE, ros_version=2)[0].encode()
    with (folder / name).open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile=profile, library="another recorder")
        schema_id = writer.register_schema(*(schema or (JOINT_STATE, "ros2msg", text)))
        channels = {
            topic: writer.register_channel(topic, encoding, schema_id)
            for topic in dict.fromkeys(message.topic for message in messages)
        }
        if beside is not None:
            beside(writer)
        for number, message in enumerate(messages):
            writer.add_message(
                channels[message.topic], message.log_ns, message.data, message.publish_ns, number
            )
        writer.finish()  # type: ignore[no-untyped-call]
    return folder / name


def write_rosbags(
    folder: Path,
    messages: Sequence[Recorded],
    mode: CompressionMode | None,
    storage: StoragePlugin = StoragePlugin.MCAP,
) -> None:
    """Write the messages with the library rosbags."""
    writer = RosbagWriter(folder, version=9, storage_plugin=storage)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topics = dict.fromkeys(message.topic for message in messages)
        connections = {
            topic: writer.add_connection(topic, JOINT_STATE, typestore=STORE) for topic in topics
        }
        for message in messages:
            writer.write(connections[message.topic], message.log_ns, message.data)


def parts(messages: Sequence[Recorded]) -> list[Sequence[Recorded]]:
    """Return the messages in three parts."""
    third = len(messages) // 3
    return [messages[:third], messages[third : 2 * third], messages[2 * third :]]


def in_namespace(namespace: str, messages: Sequence[Recorded]) -> list[Recorded]:
    """Return the messages of a flight in a namespace."""
    return [message._replace(topic=f"{namespace}{message.topic}") for message in messages]


def foreign_topics(writer: Any) -> None:
    """Add a type that is not installed, a channel with JSON, and a channel without a schema."""
    unknown = writer.register_schema(
        "my_msgs/msg/Secret", "ros2msg", b"float64 a\nmy_msgs/Part b\n"
    )
    log = writer.register_schema("foxglove.Log", "jsonschema", b"{}")
    channels = [
        (writer.register_channel("/secret", "cdr", unknown), bytes(28)),
        (writer.register_channel("/log", "json", log), b'{"m": 1}'),
        (writer.register_channel("/bare", "cdr", 0), b"\0\1\0\0xx"),
    ]
    for channel, data in channels:
        for k in range(10):
            writer.add_message(channel, EPOCH + k * 10_000_000, data, EPOCH + k * 10_000_000, k)


def packed(
    folder: Path,
    messages: Sequence[Recorded],
    suffix: str,
    pack: Callable[[bytes], bytes],
    part: float = 1.0,
) -> None:
    """Write an MCAP file and pack it.

    `part` is the fraction of the packed file that is kept.
    """
    plain = write_mcap(folder, messages, chunk_size=1 << 14)
    content = pack(plain.read_bytes())
    plain.with_name(plain.name + suffix).write_bytes(content[: int(len(content) * part)])
    plain.unlink()


def split(
    folder: Path, messages: Sequence[Recorded], names: Sequence[str], *, metadata: bool = True
) -> None:
    """Write the messages in three files, without those whose name is "".

    metadata.yaml names bag_0 to bag_2.
    """
    for k, (name, part) in enumerate(zip(names, parts(messages), strict=True)):
        file = write_mcap(folder, part, name or f"bag_{k}.mcap")
        if not name:
            file.unlink()
    if metadata:
        write_metadata(folder, [f"bag_{k}.mcap" for k in range(3)], messages)


def whole_bags() -> dict[str, Callable[[Path, list[Recorded]], object]]:
    """Return writers of bags with the whole flight, by name."""
    text = STORE.generate_msgdef(JOINT_STATE, ros_version=2)[0].encode()
    nothing: dict[str, Any] = {
        "use_chunking": False,
        "index_types": IndexType.NONE,
        "use_statistics": False,
    }
    nothing |= {"repeat_channels": False, "repeat_schemas": False, "use_summary_offsets": False}
    rosbags = {
        f"rosbags_{'plain' if mode is None else mode.name}".lower(): partial(
            write_rosbags, mode=mode
        )
        for mode in (
            None,
            CompressionMode.FILE,
            CompressionMode.MESSAGE,
            CompressionMode.STORAGE,
        )
    }
    return rosbags | {
        "chunks_zstd": lambda f, m: write_mcap(f, m, compression=CompressionType.ZSTD),
        "chunks_lz4": lambda f, m: write_mcap(f, m, compression=CompressionType.LZ4),
        "chunks_plain": lambda f, m: write_mcap(f, m, compression=CompressionType.NONE),
        "unchunked": lambda f, m: write_mcap(f, m, use_chunking=False),
        "unindexed": lambda f, m: write_mcap(f, m, **nothing),
        "zstd_file": lambda f, m: packed(f, m, ".zstd", zstandard.compress),
        "zst_file": lambda f, m: packed(f, m, ".zst", zstandard.compress),
        "lz4_file": lambda f, m: packed(f, m, ".lz4", lz4.frame.compress),
        "split": lambda f, m: split(f, m, ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"]),
        "split_renamed": lambda f, m: split(
            f, m, ["flight_0.mcap", "flight_1.mcap", "flight_2.mcap"]
        ),
        "split_without_metadata": lambda f, m: split(
            f, m, [f"bag_{k}.mcap" for k in range(3)], metadata=False
        ),
        "foreign_topics": lambda f, m: write_mcap(f, m, beside=foreign_topics),
        "namespace": lambda f, m: write_mcap(f, in_namespace("/uav1", m)),
        "deep_namespace": lambda f, m: write_mcap(f, in_namespace("/fleet/a/uav1", m)),
        "publish_time_0": lambda f, m: write_mcap(
            f, [message._replace(publish_ns=0) for message in m]
        ),
        "idl": lambda f, m: write_mcap(f, m, schema=(JOINT_STATE, "ros2idl", IDL.encode())),
        "blank_schema": lambda f, m: write_mcap(f, m, schema=(JOINT_STATE, "ros2msg", b" ")),
        "short_type": lambda f, m: write_mcap(
            f, m, schema=("sensor_msgs/JointState", "ros2msg", text)
        ),
        "no_profile": lambda f, m: write_mcap(f, m, profile=""),
        "other_suffix": lambda f, m: write_mcap(f, m, name="bag_0.mcap").rename(f / "flight.log"),
    }


def _zip() -> bytes:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as opened:
        opened.writestr("a.mcap", b"x")
    return archive.getvalue()


FOREIGN_FILES = {
    "ULog": (b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1) + bytes(200), "a ULog of PX4"),
    "DataFlash": (bytes([0xA3, 0x95, 0x80, 0x80, 89]) + bytes(84), "a DataFlash log of ArduPilot"),
    "tlog": (
        struct.pack(">Q", EPOCH // 1000) + b"\xfd\x09\x00\x00" + bytes(30),
        "a tlog of MAVLink",
    ),
    "CSV": (b"time,q,p,r,V\n0,0,0,0,25\n0.1,0,0,0,25\n", "a CSV file"),
    "text": (b"hello\n", "a text file"),
    "empty": (b"", "an empty file"),
    "zeros": (bytes(5000), "a file of zeros"),
    "gzip": (gzip.compress(b"x"), "a gzip file"),
    "zip": (_zip(), "a ZIP archive"),
    "ROS 1": (b"#ROSBAG V2.0\n" + bytes(100), "a bag of ROS 1"),
    "JSON": (b'{"a": 1}', "a JSON file"),
}
"""Files that are no logs, with the words that name each."""
