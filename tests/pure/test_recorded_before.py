# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Backward compatibility: logs of an earlier version in tests/recorded are read, summarised and replayed bit by bit."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from tests.conftest import REPOSITORY

from flight_analysis.closed_loop.replay import recorded_parameters, recorded_scenario, replay
from flight_analysis.report.run_folder import read_flight
from flight_core.rates import NANOSECONDS
from flight_log.repair import repair
from flight_log.tape_reader import read_run
from flight_view.flight import Flight

pytestmark = pytest.mark.package("flight_log")

TOPICS = {"y", "y_m", "u", "internals", "truth"}


RUNS = ("osprey_servo", "osprey_gust")  # in lockstep, in real time


@pytest.fixture(params=RUNS)
def run(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A copy of a recorded run: the log, metadata.yaml and summary.json."""
    shutil.unpack_archive(REPOSITORY / "tests" / "recorded" / f"{request.param}.tar.xz", tmp_path, filter="data")
    return tmp_path / str(request.param)


def test_every_sample_is_that_of_independent_reader(run: Path) -> None:
    samples: dict[str, list[tuple[int, tuple[str, ...], bytes]]] = {name: [] for name in TOPICS}
    with next(run.glob("*.mcap")).open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics=[f"/{name}" for name in TOPICS]):
            if message.name:
                stamp_ns = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
                assert message.header.frame_id.startswith("/")
                samples[channel.topic[1:]].append((stamp_ns, tuple(message.name), np.array(message.position).tobytes()))
    tape = read_run(run).tape
    assert tape.notes == ()
    assert set(tape.signals) - {"pose"} == TOPICS  # a topic that came later
    for name in TOPICS:
        signal = tape.signals[name]
        stamps = signal.stamp_ns.tolist()
        read = [(stamp, signal.names, row.tobytes()) for stamp, row in zip(stamps, signal.values, strict=True)]
        assert read == sorted(samples[name], key=lambda sample: sample[0]), name
        assert len(read) > 30  # ticks of 10 ms in the shorter flight


def test_summary_equal_to_last_digit(run: Path) -> None:
    recorded = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    assert recorded["outcome"] == "completed"
    summary = json.loads(json.dumps(read_flight(run).summary))
    account = summary.pop("account")  # four keys that came later
    assert summary == recorded | {"guidance": None, "age_of_u": None, "models": []}
    assert account["lacks"] == []


def test_every_bit_is_replayed(run: Path) -> None:
    recorded = read_run(run)
    result = replay(recorded)
    assert result.equal(), result.first()
    assert result.checked.all()
    assert len(result.number) == len(recorded.tape["internals"].stamp_ns) > 30  # ticks of 10 ms in the shorter flight
    assert result.notes == ()


def test_page_and_commands_read_scenario(run: Path) -> None:
    flight, recorded = Flight(run), read_run(run).scenario
    flight.update()
    assert recorded is not None
    assert flight.notes == []
    assert flight.scenario is not None
    assert flight.scenario.controller == recorded_scenario(recorded).controller == recorded_parameters(recorded)


def test_log_intact_and_keeps_attachments_and_metadata(run: Path) -> None:
    assert not repair(run).wrote_metadata
    recorded = read_run(run)
    assert recorded.scenario is not None
    assert recorded.scenario.name == f"{run.name}.yaml"
    assert {file.name for file in recorded.attachments} == {"parameters.yaml", "airframe.yaml"}
    assert set(recorded.metadata) >= {"rise_di_flight", "rise_di_host", "rise_di_lost", "rise_di_revision", "rise_di_versions"}
