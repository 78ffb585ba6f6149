# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the repair of truncated and damaged logs: kept messages, printed result, intact logs."""

import fcntl
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.conftest import refusing
from tests.recordings import messages, summary_of, truncate

from flight_core.parameters import ParameterError
from flight_log.repair import repair
from flight_log.scan import Faults
from flight_log.tape_reader import read_run

pytestmark = pytest.mark.slow

DURATION = 2.0  # s, of the log


@contextmanager
def unchanged(folder: Path) -> Iterator[None]:
    """Check that every file keeps its content and its modification time."""

    def state() -> dict[str, tuple[bytes, int]]:
        return {
            path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.iterdir()
        }

    before = state()
    yield
    assert state() == before


def last(run: Path) -> float:
    """Return the flight time of the last sample on any topic."""
    tape = read_run(run).tape
    return float(max(tape.time(name)[-1] for name in tape.signals))


@pytest.mark.parametrize("fraction", [0.35, 0.999])
def test_repaired_truncated_log_read_in_full_by_rosbags(
    fraction: float, recorded: Path, run: Path
) -> None:
    before = truncate(run, fraction)
    readable = read_run(run)
    done = repair(run)
    assert done.files[0].damaged == run / "run_0.mcap.damaged"
    assert done.files[0].damaged.read_bytes() == before
    contents = messages(run)
    assert len(contents) == done.files[0].messages > 0
    assert contents == messages(recorded)[: len(contents)]
    after = read_run(run)
    assert after.tape.notes == ()
    assert after.tape.time("truth")[-1] == readable.tape.time("truth")[-1]
    assert (after.scenario, after.attachments) == (readable.scenario, readable.attachments)
    assert after.metadata["rise_di_host"] == readable.metadata["rise_di_host"]
    statistics = summary_of(run / "run_0.mcap").statistics
    assert statistics is not None
    assert statistics.message_count == len(contents)
    assert not list(run.glob("*.new"))


@pytest.mark.parametrize("repaired", [False, True])
def test_an_intact_or_repaired_log_is_unchanged(repaired: bool, run: Path) -> None:
    if repaired:
        truncate(run, 0.5)
        repair(run)
    with unchanged(run):
        assert not repair(run).has_new_metadata


@pytest.mark.parametrize("content", [None, "{"])
def test_missing_or_damaged_metadata_yaml_restored(
    content: str | None, recorded: Path, run: Path
) -> None:
    (run / "metadata.yaml").unlink()
    if content is not None:
        (run / "metadata.yaml").write_text(content)
    before = (run / "run_0.mcap").stat().st_mtime_ns
    done = repair(run)
    assert done.has_new_metadata
    assert done.files[0].damaged is None
    assert (run / "run_0.mcap").stat().st_mtime_ns == before
    assert (run / "metadata.yaml").read_text("utf-8") == (recorded / "metadata.yaml").read_text(
        "utf-8"
    )


def test_damage_inside_loses_only_its_chunk(recorded: Path, run: Path) -> None:
    file = run / "run_0.mcap"
    chunk = summary_of(file).chunk_indexes[1]
    content = bytearray(file.read_bytes())
    content[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
    file.write_bytes(content)
    assert repair(run).files[0].faults == Faults(is_cut=False, damaged=1)
    kept = set(messages(run))
    every = set(messages(recorded))
    assert kept < every
    assert all(
        chunk.message_start_time <= stamp_ns <= chunk.message_end_time
        for _, stamp_ns, _ in every - kept
    )


def test_log_that_is_being_recorded_unchanged(run: Path) -> None:
    truncate(run, 0.5)
    with unchanged(run), (run / "run_0.mcap").open("ab") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        with refusing("found a recorder that still writes it, expected a recorder that has ended"):
            repair(run)


def test_a_failed_repair_changes_nothing(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    truncate(run, 0.5)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with (
        unchanged(run),
        refusing(r"cannot be repaired \(No space left on device\)"),
    ):
        repair(run)


@pytest.mark.parametrize(
    "size",
    [
        30,
    ],
)
def test_log_without_message_rejected_and_unchanged(size: int, run: Path) -> None:
    file = run / "run_0.mcap"
    file.write_bytes(file.read_bytes()[:size])
    with unchanged(run), refusing("found no message that could be read"):
        repair(run)


def test_changed_bytes_never_cause_traceback_or_false_messages(recorded: Path, run: Path) -> None:
    file = run / "run_0.mcap"
    generator = np.random.default_rng(2)
    content = file.read_bytes()
    repaired = 0
    data = {(topic, bytes_) for topic, _, bytes_ in messages(recorded)}
    for _ in range(20):
        damaged = bytearray(content)
        for position in generator.integers(0, len(content), 3):
            damaged[position] ^= 1 << generator.integers(0, 8)
        file.write_bytes(damaged)
        try:
            done = repair(run)
        except ParameterError:
            continue
        if done.files[0].damaged is not None:
            repaired += 1
            assert {(topic, bytes_) for topic, _, bytes_ in messages(run)} <= data
    assert repaired > 5


def test_link_in_folder_is_not_followed(run: Path, tmp_path: Path) -> None:
    """A folder from elsewhere may contain links, some of them to nothing.

    Such a link may have the name of the copy of the damaged file.
    """
    target = tmp_path / "target"
    precious = tmp_path / "precious"
    precious.write_bytes(b"mine")
    first = truncate(run, 0.9)
    (run / "run_0.mcap.damaged").symlink_to(target)
    (run / "run_0.mcap.damaged-2").symlink_to(precious)
    (run / "metadata.yaml").symlink_to(precious)
    with refusing("a file of another program"):
        repair(run)
    (run / "metadata.yaml").unlink()
    (run / "metadata.yaml").symlink_to(target)
    repair(run)
    assert (run / "run_0.mcap.damaged-3").read_bytes() == first
    assert (precious.read_bytes(), target.exists()) == (b"mine", False)
    assert not (run / "metadata.yaml").is_symlink()


def test_command_prints_kept_messages_and_missing_time(run: Path) -> None:
    def command() -> str:
        words = [sys.executable, "-m", "flight_cli.cli", "report", "--repair", "run"]
        return subprocess.run(
            words, cwd=run.parent, capture_output=True, text=True, check=True
        ).stdout

    assert command() == "run is intact: nothing to repair\n"
    metadata = (run / "metadata.yaml").read_bytes()
    truncate(run, 0.42)  # between two chunks: a chunk that is cut states its end
    end = last(run)
    kept = (
        r"run_0.mcap had a truncated end: (\d+) messages kept; the damaged file is "
        r"run_0.mcap.damaged\n"
    )
    written = (
        rf"metadata.yaml written; the log ends at t = {end:.3f} s of the {DURATION:g} s "
        r"of the scenario\n"
    )
    assert re.fullmatch(kept + written, command())
    truncate(run, 0.5)
    (run / "metadata.yaml").write_bytes(metadata)  # it holds the time of the last message
    end = last(run)
    assert f"{DURATION - end:.3f} s are missing at its end" in command()
    information = yaml.safe_load((run / "metadata.yaml").read_text("utf-8"))[
        "rosbag2_bagfile_information"
    ]
    assert information["message_count"] == len(messages(run))
