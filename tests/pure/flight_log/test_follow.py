# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that following a log that grows gives the same values as reading it whole.

The pieces have any size, and the log may be hostile.
"""

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Message, Metadata
from mcap.writer import MCAP0_MAGIC, IndexType, Writer
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from tests.conftest import REPOSITORY
from tests.joint_states import JOINT_STATE, STORE, vector

from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from flight_log.bag import BagChannel, BagWriter
from flight_log.disk import is_locked, try_lock
from flight_log.follow import Follower, Messages
from flight_log.named_vectors import decoder, tables
from flight_log.scan import RECORD, Scan

CORPUS = sorted((REPOSITORY / "tests" / "corpus" / "mcap").iterdir())


def all_of(topic: str, type_name: str) -> float:
    return math.inf


def vectors(found: list[Messages], topic: str) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the stamps and values of a topic."""
    decode = decoder(JOINT_STATE)
    assert decode is not None
    parts = [
        part
        for messages in found
        if messages.topic == topic
        for table in tables(messages.data)
        for part in decode(table).samples
    ]
    return np.concatenate([part.stamp_ns for part in parts]), np.concatenate(
        [part.values for part in parts]
    )


@pytest.mark.parametrize("piece", [997, 65_536, 10_000_000])
def test_log_that_grows_in_pieces_gives_what_whole_log_holds(
    piece: int, recorded: Path, tape: Tape, tmp_path: Path
) -> None:
    content = (recorded / "run_0.mcap").read_bytes()
    follower = Follower(tmp_path, all_of)
    assert list(follower.read()) == []  # the recorder has not begun
    result: list[Messages | Attachment | Metadata] = []
    path = tmp_path / "run_0.mcap"
    for start in range(0, len(content), piece):
        with path.open("ab") as stream:
            stream.write(content[start : start + piece])
        result += follower.read()
    assert (follower.complete, follower.damaged, follower.fault) == (True, 0, "")
    messages = [record for record in result if isinstance(record, Messages)]
    for name, signal in tape.signals.items():
        stamps, values = vectors(messages, f"/{name}")
        assert stamps.tolist() == signal.stamp_ns.tolist()
        assert values.tobytes() == signal.values.tobytes()
    assert (
        next(record.name for record in result if isinstance(record, Attachment))
        == "osprey_gust.yaml"
    )
    assert "rise_di_host" in [record.name for record in result if isinstance(record, Metadata)]


def test_topic_thinned_to_rate_at_even_distances(recorded: Path, tape: Tape) -> None:
    # y is sent at 500 Hz.
    follower = Follower(recorded, lambda topic, _: 100.0 if topic == "/y" else 0.0)
    stamps, _ = vectors(
        [record for record in follower.read() if isinstance(record, Messages)], "/y"
    )
    assert stamps.tolist() == tape["y"].stamp_ns[::5].tolist()
    assert set(np.diff(stamps).tolist()) == {10_000_000}


@pytest.mark.parametrize("options", [{"index_types": IndexType.NONE}, {"use_chunking": False}])
def test_logs_without_message_indexes_or_chunks_read(
    options: dict[str, object], tmp_path: Path
) -> None:
    path = tmp_path / "foreign.mcap"
    messages = [vector(k, ["q"], [k / 7.0]) for k in range(50)]
    writer = Writer(str(path), chunk_size=2000, **options)  # type: ignore[arg-type]
    writer.start(profile="ros2", library="test")
    channel = writer.register_channel(
        "/y", "cdr", writer.register_schema(JOINT_STATE, "ros2msg", b"")
    )
    for k, data in enumerate(messages):
        writer.add_message(channel, k, data, k)
    writer.finish()  # type: ignore[no-untyped-call]
    whole = list(Follower(path, all_of).read())
    follower = Follower(path, all_of)
    assert [
        data for record in whole if isinstance(record, Messages) for data in record.data
    ] == messages
    assert [
        next(iter(follower.read())) for _ in whole
    ] == whole  # an iteration that is left is continued here, too


def write_chunk(bag: BagWriter, channel: BagChannel, number: int) -> None:
    bag.write(channel, number, number, number, vector(number, ["q"], [float(number)]))
    bag.flush()


def test_topic_whose_first_message_comes_after_the_chunk_with_its_channel_is_read(
    tmp_path: Path,
) -> None:
    with BagWriter(tmp_path) as bag:
        write_chunk(bag, early := bag.add_topic("/y", JOINT_STATE, ""), 1)
        late = bag.add_topic("/late", JOINT_STATE, "")
        write_chunk(bag, early, 2)
        write_chunk(bag, late, 3)
    follower = Follower(tmp_path, all_of)
    result = [record for record in follower.read() if isinstance(record, Messages)]
    assert follower.damaged == 0
    assert [stamp for topic in ("/y", "/late") for stamp in vectors(result, topic)[0].tolist()] == [
        1,
        2,
        3,
    ]


def test_all_files_of_split_bag_read_in_order(tmp_path: Path) -> None:
    run = tmp_path / "split"
    with RosbagsWriter(run, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/y", JOINT_STATE, typestore=STORE)
        writer.write(connection, 1, vector(1, ["q"], [1.0]))
    first = run / "split.mcap"
    content = first.read_bytes()
    for number in (10, 2):
        (run / f"split_{number}.mcap").write_bytes(content)
    first.unlink()
    follower = Follower(run, all_of)
    assert len([record for record in follower.read() if isinstance(record, Messages)]) == 2
    assert follower.complete
    assert follower.path is None


@pytest.mark.parametrize("case", CORPUS, ids=lambda path: path.name)
def test_hostile_log_ends_without_exception_and_without_much_memory(case: Path) -> None:
    follower = Follower(case, all_of)
    for record in follower.read():
        assert not isinstance(record, Messages) or sum(map(len, record.data)) < 1 << 25
    assert list(follower.read()) == []


def test_endless_record_is_fault_and_chunk_in_progress_awaited(
    recorded: Path, tmp_path: Path
) -> None:
    path = tmp_path / "endless.mcap"
    path.write_bytes(MCAP0_MAGIC + RECORD.pack(Opcode.CHUNK, 1 << 60) + bytes(100))
    follower = Follower(path, all_of)
    assert list(follower.read()) == []
    assert follower.fault == f"a record of {1 << 60} bytes at byte 8"
    path.write_bytes(MCAP0_MAGIC + RECORD.pack(Opcode.CHUNK, 1 << 20) + bytes(100))
    follower = Follower(path, all_of)
    assert list(follower.read()) == []
    assert (follower.fault, follower.damaged, follower.complete) == ("", 0, False)
    path.write_bytes(b"PK\x03\x04 is no log")
    follower = Follower(path, all_of)
    assert list(follower.read()) == []
    assert follower.fault.endswith("does not begin as an MCAP file")


def counts(path: Path) -> tuple[int, int, bool]:
    """Return the number of messages and damaged parts, and whether the file has an end.

    A scan of the file and a follower must agree.
    """
    scan = Scan(path)
    messages = sum(isinstance(record, Message) for record in scan.records())
    follower = Follower(path, all_of)
    sent = sum(len(record.data) for record in follower.read() if isinstance(record, Messages))
    assert (sent, follower.damaged, follower.complete) == (messages, scan.damaged, scan.ended)
    return messages, scan.damaged, scan.ended


def test_index_that_points_outside_messages_changes_nothing(recorded: Path, tmp_path: Path) -> None:
    content = bytearray((recorded / "run_0.mcap").read_bytes())
    place, changed = 8, 0
    while content[place] != Opcode.DATA_END:
        opcode, length = RECORD.unpack_from(content, place)
        if opcode == Opcode.MESSAGE_INDEX and changed < 2:
            struct.pack_into("<Q", content, place + RECORD.size + 6 + 8, (7, 1 << 50)[changed])
            changed += 1
        place += RECORD.size + length
    path = tmp_path / "run_0.mcap"
    path.write_bytes(content)
    assert counts(path) == counts(recorded / "run_0.mcap")


@pytest.mark.parametrize("size", [1, 200, 20_000])
@pytest.mark.parametrize("offset", [0, 100])
def test_follower_reads_past_damage_what_a_scan_of_the_file_reads(
    offset: int, size: int, run: Path
) -> None:
    """Bytes are inverted in the head and in the content of a chunk, while the index is intact.

    Then these bytes are removed, and after that the file is cut there.
    """
    path = run / "run_0.mcap"
    content = path.read_bytes()
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunks = [index.chunk_start_offset for index in summary.chunk_indexes]
    first = chunks[len(chunks) // 2] + offset
    damaged = bytes(byte ^ 0x55 for byte in content[first : first + size])
    path.write_bytes(content[:first] + damaged + content[first + size :])
    messages, damages, ended = counts(path)
    assert (messages > 0, damages > 0, ended) == (True, True, True)
    path.write_bytes(content[:first] + content[first + size :])
    counts(path)
    path.write_bytes(content[:first])
    assert counts(path)[1:] == (0, False)


@pytest.mark.parametrize("part", [0.4, 1.0])
def test_replaced_file_is_not_read_on(part: float, run: Path) -> None:
    path = run / "run_0.mcap"
    content = (run / "run_0.mcap").read_bytes()
    path.write_bytes(content[: len(content) // 2])
    follower = Follower(run, all_of)
    assert list(follower.read())
    fresh = run / "fresh"
    fresh.write_bytes(content[: int(part * len(content))])
    fresh.replace(path)
    assert list(follower.read()) == []
    assert follower.fault == f"{path} was replaced by another file, as rise-di report --repair does"


def test_lock_ends_with_the_stream_that_holds_it(tmp_path: Path) -> None:
    path = tmp_path / "run_0.mcap"
    path.write_bytes(b"")
    assert not is_locked(path)
    with path.open("rb") as stream:
        assert try_lock(stream)
        assert is_locked(path)
    assert not is_locked(path)
