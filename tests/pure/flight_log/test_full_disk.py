# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a log is finished from its reserve when the disk is full.

Otherwise it stays readable up to its last complete chunk.
"""

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from tests.conftest import refusing
from tests.joint_states import JOINT_STATE, vector
from tests.small_disk import fill, small_disk

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_log.bag import END_BYTES, BagChannel, BagWriter, LogAttachments
from flight_log.disk import ReservedFile, free_bytes
from flight_log.tape_reader import read_run
from flight_log.tape_writer import write_run

SIZE = 2_000_000


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", SIZE) as folder:
        yield folder


NAMES = [f"channel.{k}" for k in range(40)]
RANDOM = np.random.default_rng(1)


def write(bag: BagWriter, channel: BagChannel, count: int) -> None:
    """Write messages of 40 noisy channels, which cannot be compressed.

    Every tenth message ends a chunk, as at 1 kHz and 0.1 s.
    """
    for _ in range(count):
        stamp_ns = 1_000_000 * (channel.messages + 1)
        bag.write(
            channel,
            stamp_ns,
            stamp_ns,
            channel.messages + 1,
            vector(stamp_ns, NAMES, RANDOM.normal(size=40).tolist()),
        )
        if channel.messages % 10 == 0:
            bag.flush()


def write_until_full(bag: BagWriter, channel: BagChannel) -> None:
    while not bag.is_full:
        write(bag, channel, 1)


def test_log_on_full_disk_finished_without_loss(disk: Path) -> None:
    bag = BagWriter(disk / "run")
    channel = bag.add_topic("/y", JOINT_STATE, "")
    write_until_full(bag, channel)
    bag.close()
    assert channel.messages > 1000
    with AnyReader([disk / "run"]) as reader:
        assert reader.message_count == channel.messages
        assert sum(1 for _ in reader.messages()) == channel.messages
    assert read_run(disk / "run").tape.notes == ()


def test_log_whose_chunks_fill_up_between_two_flushes_finished_too(
    disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Three messages a chunk: a reserve that did not grow with each of them would be too small for
    # the index of a thousand.
    monkeypatch.setattr("flight_log.bag.CHUNK_BYTES", 4000)
    monkeypatch.setattr("flight_log.bag.END_BYTES", 8000)
    monkeypatch.setattr("flight_log.disk.RESERVE_STEP", 4096)
    bag = BagWriter(disk / "run")
    channel = bag.add_topic("/y", JOINT_STATE, "")
    while not bag.is_full:
        stamp_ns = 1_000_000 * (channel.messages + 1)
        message = vector(stamp_ns, NAMES, RANDOM.normal(size=40).tolist())
        bag.write(channel, stamp_ns, stamp_ns, channel.messages + 1, message)
    bag.close()
    with AnyReader([disk / "run"]) as reader:
        assert reader.message_count == channel.messages > 1000


@pytest.mark.parametrize("chunks", range(1, 5))
def test_log_closes_where_last_chunk_would_need_larger_reserve(
    chunks: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flight_log.disk.RESERVE_STEP", 0)  # each chunk needs more
    with BagWriter(tmp_path / "run") as bag:
        channel = bag.add_topic("/y", JOINT_STATE, "")
        for k in range(chunks):
            bag.write(channel, k, k, k + 1, vector(k, NAMES, [0.0] * 40))
            if k + 1 < chunks:
                bag.flush()
    assert len(read_run(tmp_path / "run").tape["y"].stamp_ns) == chunks


def test_end_of_file_has_reserve_until_it_closed(disk: Path) -> None:
    with BagWriter(disk / "run"):
        assert SIZE - free_bytes(disk) >= END_BYTES
    # The space is freed; a file without messages and metadata.yaml remain.
    assert SIZE - free_bytes(disk) < 50_000


def test_log_finished_when_another_process_fills_disk(disk: Path) -> None:
    bag = BagWriter(disk / "run")
    channel = bag.add_topic("/y", JOINT_STATE, "")
    write(bag, channel, 300)
    fill(disk / "other")
    write_until_full(bag, channel)
    bag.close()
    with AnyReader([disk / "run"]) as reader:
        assert reader.message_count == channel.messages >= 300


def test_log_without_reserve_stays_readable_to_last_complete_chunk(disk: Path) -> None:
    bag = BagWriter(disk / "run")
    channel = bag.add_topic("/y", JOINT_STATE, "")
    write_until_full(bag, channel)
    written = channel.messages
    fill(disk / "other")  # another process takes the freed reserve
    with pytest.raises(OSError, match="No space left"):
        write(bag, channel, 10_000)
    with pytest.raises(OSError, match="No space left"):
        bag.close()
    back = read_run(disk / "run").tape
    assert len(back["y"].stamp_ns) >= written - 10
    assert back["y"].stamp_ns.tolist() == [
        1_000_000 * (k + 1) for k in range(len(back["y"].stamp_ns))
    ]
    assert "run_0.mcap is truncated: read up to its last complete chunk" in back.notes[0]


def test_input_output_error_is_not_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = ReservedFile(tmp_path / "file")

    def fails(descriptor: int, data: bytes) -> int:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "write", fails)
    with pytest.raises(OSError, match="Input/output error"):
        file.write(b"x")
    assert not file.is_full
    file.close()


def test_what_kept_for_end_survives_disk_that_fills_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = ReservedFile(tmp_path / "file")
    file.keep(b"reserve")

    def fails(descriptor: int, data: bytes, position: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", fails)
    file.keep(b", memory")
    assert file.is_full
    file.keep(b", too")
    assert file.kept_data() == b"reserve, memory, too"
    file.close()


def test_short_writes_are_completed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = ReservedFile(tmp_path / "file")
    write_all = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: write_all(descriptor, data[:3]))
    file.write(b"0123456789")
    assert file.tell() == 10
    file.close()
    assert (tmp_path / "file").read_bytes() == b"0123456789"


def test_flight_in_one_process_on_full_disk_is_one_sentence(
    disk: Path, osprey_gust: Scenario
) -> None:
    fill(disk / "other")
    with refusing(r"disk/run cannot be written \(No space left on device\)"):
        write_run(
            simulate(osprey_gust.vary(flight={"duration": 0.1})),
            disk / "run",
            LogAttachments(osprey_gust.path),
        )
