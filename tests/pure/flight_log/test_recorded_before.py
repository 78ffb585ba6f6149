# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test a log of an earlier revision in tests/recorded.

Every sample is read, and every bit of u is computed again.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from tests.conftest import REPOSITORY

from flight_analysis.closed_loop.replay import replay
from flight_core.rates import NANOSECONDS
from flight_log.tape_reader import read_run

TOPICS = {"y", "y_m", "u", "internals", "truth"}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Return a copy of a run of osprey_servo in lockstep."""
    shutil.unpack_archive(
        REPOSITORY / "tests" / "recorded" / "osprey_servo.tar.xz", tmp_path, filter="data"
    )
    return tmp_path / "osprey_servo"


def test_every_sample_is_that_of_independent_reader(run: Path) -> None:
    samples: dict[str, list[tuple[int, tuple[str, ...], bytes]]] = {name: [] for name in TOPICS}
    with next(run.glob("*.mcap")).open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(
            topics=[f"/{name}" for name in TOPICS]
        ):
            if message.name:
                stamp_ns = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
                samples[channel.topic[1:]].append(
                    (stamp_ns, tuple(message.name), np.array(message.position).tobytes())
                )
    tape = read_run(run).tape
    assert tape.notes == ()
    for name in TOPICS:
        signal = tape.signals[name]
        stamps = signal.stamp_ns.tolist()
        contents = [
            (stamp, signal.names, row.tobytes())
            for stamp, row in zip(stamps, signal.values, strict=True)
        ]
        assert contents == sorted(samples[name], key=lambda sample: sample[0]), name
        assert len(contents) > 30  # ticks of 10 ms


def test_every_bit_is_replayed(run: Path) -> None:
    recorded = read_run(run)
    result = replay(recorded)
    assert result.is_equal(), result.first()
    assert result.checked.all()
    assert len(result.number) == len(recorded.tape["internals"].stamp_ns) > 30
