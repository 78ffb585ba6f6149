# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The log: what independent readers find in it, and what ours reads from a file without an end."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from flight_analysis.bag_reader import read_run
from flight_analysis.bag_writer import write_run
from flight_analysis.scenario import Scenario
from flight_analysis.simulate import simulate
from flight_core.parameters import ParameterError
from flight_core.tape import Tape
from flight_recorder.definitions import definition


@pytest.fixture(scope="module")
def tape(osprey_gust: Scenario) -> Tape:
    return simulate(osprey_gust.vary(flight={"duration": 2.0}))


@pytest.fixture
def run(tape: Tape, osprey_gust: Scenario, tmp_path: Path) -> Path:
    write_run(tape, tmp_path / "run", osprey_gust.path)
    return tmp_path / "run"


def test_a_tape_comes_back_to_the_last_bit(tape: Tape, run: Path) -> None:
    back = read_run(run).tape
    assert set(back.signals) == set(tape.signals)
    for name, signal in tape.signals.items():
        assert back[name].names == signal.names
        assert (back[name].stamp_ns == signal.stamp_ns).all()
        assert back[name].values.tobytes() == signal.values.tobytes()


def test_the_scenario_comes_back_as_it_was(run: Path, osprey_gust: Scenario) -> None:
    assert read_run(run).scenario == ("osprey_gust.yaml", osprey_gust.path.read_bytes())


def test_rosbags_reads_every_topic(tape: Tape, run: Path) -> None:
    with AnyReader([run]) as reader:
        assert {c.topic.lstrip("/"): c.msgcount for c in reader.connections} == {
            n: len(s.stamp_ns) for n, s in tape.signals.items()
        }
        connection, _, raw = next(reader.messages([c for c in reader.connections if c.topic == "/y"]))
        message: Any = reader.deserialize(raw, connection.msgtype)
        assert message.name == ["q", "V", "p", "r"]
        assert message.position.tolist() == tape["y"].values[0].tolist()


def test_mcap_ros2_support_reads_every_message(tape: Tape, run: Path) -> None:
    with (run / "run_0.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        messages = [message for _, _, _, message in reader.iter_decoded_messages(topics=["/u"])]
    assert len(messages) == len(tape["u"].stamp_ns)
    last = messages[-1]
    assert last.header.stamp.sec * 10**9 + last.header.stamp.nanosec == tape["u"].stamp_ns[-1]
    assert list(last.position) == tape["u"].values[-1].tolist()


def test_the_file_is_a_ros2_profile_with_installed_definitions_and_hashes(run: Path) -> None:
    with (run / "run_0.mcap").open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert reader.get_header().profile == "ros2"
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        assert {channel.metadata["topic_type_hash"] for channel in summary.channels.values()} == {
            definition("sensor_msgs/msg/JointState").type_hash
        }
        assert any(record.name == "rosbag2" for record in reader.iter_metadata())


@pytest.mark.parametrize("share", [0.4, 0.55, 0.6, 0.75, 0.9])
def test_a_file_without_an_end_is_read_up_to_its_last_whole_chunk(share: float, tape: Tape, run: Path) -> None:
    file = run / "run_0.mcap"
    whole = file.read_bytes()
    file.write_bytes(whole[: int(len(whole) * share)])
    (run / "metadata.yaml").unlink()
    back = read_run(run).tape
    assert 0 < len(back["y"].stamp_ns) <= len(tape["y"].stamp_ns)
    assert (back["y"].values == tape["y"].values[: len(back["y"].stamp_ns)]).all()
    assert "is damaged or has no end" in back.notes[0]


def test_a_file_with_changed_bytes_is_read_as_far_as_it_goes_or_refused(tape: Tape, run: Path) -> None:
    file, generator = run / "run_0.mcap", np.random.default_rng(1)
    whole, read = file.read_bytes(), 0
    for _ in range(60):
        damaged = bytearray(whole)
        for place in generator.integers(0, len(whole), 10):
            damaged[place] ^= 1 << generator.integers(0, 8)
        file.write_bytes(damaged)
        try:
            back = read_run(run).tape
        except ParameterError:
            continue
        read += "y" in back and "is damaged or has no end" in "".join(back.notes)
    assert read > 0


def test_two_logs_in_a_folder_are_refused(run: Path) -> None:
    (run / "copy.mcap").write_bytes((run / "run_0.mcap").read_bytes())
    with pytest.raises(ParameterError, match=r"run: found 2 \.mcap files, expected exactly one"):
        read_run(run)


def test_a_tape_whose_first_signal_has_no_sample_is_written(tape: Tape, osprey_gust: Scenario, tmp_path: Path) -> None:
    empty = {"y": tape["y"].until(-1), "u": tape["u"]}
    write_run(Tape(empty), tmp_path / "run", osprey_gust.path)
    assert list(read_run(tmp_path / "run").tape.signals) == ["u"]


def test_a_folder_without_a_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"found no \.mcap file"):
        read_run(tmp_path)


def test_definitions_hold_all_that_they_refer_to() -> None:
    text = definition("sensor_msgs/msg/JointState").text
    assert [line.removeprefix("MSG: ") for line in text.splitlines() if line.startswith("MSG: ")] == [
        "builtin_interfaces/Time",
        "std_msgs/Header",
    ]
    with pytest.raises(ParameterError, match="install the package no_such_msgs"):
        definition("no_such_msgs/msg/Thing")


def test_stamps_of_signals_may_differ_in_number(run: Path) -> None:
    back = read_run(run).tape
    assert len(back["y"].stamp_ns) == 1001
    assert len(back["u"].stamp_ns) == 201
    assert np.diff(back["u"].stamp_ns).tolist() == [10_000_000] * 200
