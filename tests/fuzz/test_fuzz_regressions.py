# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test what fuzzing has found: tracebacks, hangs and excessive memory."""

import json
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from mcap.opcode import Opcode
from mcap.records import Message
from mcap.writer import MCAP0_MAGIC, CompressionType
from tests.conftest import REPOSITORY, refusing
from tests.fuzz.targets import log, write_run
from tests.joint_states import JOINT_STATE, vector

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.page import script_json
from flight_analysis.report.recorded_flight import read_flight
from flight_analysis.report.run_report import extract_scenario
from flight_core.files import parse_yaml
from flight_core.parameters import ParameterError
from flight_core.text import MAX_LENGTH
from flight_log.playback import read_playback
from flight_log.repair import repair
from flight_log.rosbag2_metadata import METADATA, read_bag_metadata
from flight_log.scan import CHUNK, LENGTH, RECORD, Scan
from flight_log.tape_reader import read_run

CORPUS = REPOSITORY / "tests" / "corpus"
Y = [("/y", JOINT_STATE, vector(10_000_000 * k, ("q", "V"), (0.1 * k, k))) for k in range(20)]
BOMBS = [
    *sorted(path.name for path in (CORPUS / "mcap").glob("*bomb*")),
    "zstd_header_says_a_terabyte",
]


def constant_flight(
    scenario: Scenario, value: float = 0.0, name: str = "osprey_gust.yaml"
) -> bytes:
    """Return the log of three samples of y, y_m and u with one value, and of its scenario."""
    outputs = scenario.controller.outputs
    inputs = scenario.controller.inputs
    messages = [
        (topic, JOINT_STATE, vector(k * 10_000_000, names, (value,) * 4))
        for k in range(3)
        for topic, names in {"/y": outputs, "/y_m": outputs, "/u": inputs}.items()
    ]
    return log(messages, attached={name: scenario.path.read_bytes()})


@pytest.mark.parametrize("name", BOMBS)
def test_chunk_decompressed_to_declared_size_and_64_mb_at_most(name: str) -> None:
    scan = Scan(CORPUS / "mcap" / name)
    tracemalloc.start()
    try:
        list(scan.records())
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert scan.damaged == 1
    assert peak < 10e6  # instead of half a gigabyte or a terabyte; the file has 33 kB


@pytest.mark.parametrize("read", [Scan.records, Scan.batches])
def test_a_chunk_inside_a_chunk_is_damaged(
    read: Callable[[Scan], Iterator[object]], tmp_path: Path
) -> None:
    content = b""
    for _ in range(2000):  # a reader that follows them exceeds the interpreter's depth
        chunk = CHUNK.pack(0, 0, len(content), 0, 0) + LENGTH.pack(len(content)) + content
        content = RECORD.pack(Opcode.CHUNK, len(chunk)) + chunk
    file = tmp_path / "run_0.mcap"
    file.write_bytes(MCAP0_MAGIC + content)
    scan = Scan(file)
    assert list(read(scan)) == []
    assert scan.damaged == 1


def test_lz4_chunk_with_changed_bytes_skipped(tmp_path: Path) -> None:
    message = bytearray(log(Y, CompressionType.LZ4))
    frame = message.index(b"\x04\x22\x4d\x18")  # the magic number of LZ4 frames
    message[frame + 4] ^= 0xFF  # the flags of the first of several chunks
    scan = Scan(write_run(tmp_path, bytes(message)) / "run_0.mcap")
    assert any(isinstance(record, Message) for record in scan.records())
    assert scan.damaged == 1


def test_channel_with_invalid_quality_of_service_repaired(tmp_path: Path) -> None:
    run = write_run(tmp_path, log(Y).replace(b"- depth: 1\n", b"[: \x01 depth:"))
    assert repair(run).has_new_metadata
    information = yaml.safe_load((run / METADATA).read_text())["rosbag2_bagfile_information"]
    assert (
        information["topics_with_message_count"][0]["topic_metadata"]["offered_qos_profiles"] == []
    )


@pytest.mark.parametrize(
    "name",
    ["run_0.mcap", "metadata.yaml", "", "..", "../../x.yaml", "a\x00.yaml", "x" * 300 + ".yaml"],
)
def test_scenario_in_log_extracted_without_overwriting_log(
    name: str, tmp_path: Path, osprey_gust: Scenario
) -> None:
    log_before = constant_flight(osprey_gust, name=name)
    run = write_run(tmp_path, log_before)
    extract_scenario(run)
    assert (run / "run_0.mcap").read_bytes() == log_before
    name_kept = "x.yaml" if name == "../../x.yaml" else "scenario.yaml"
    assert {path.name for path in run.iterdir()} == {"run_0.mcap", name_kept}
    assert (run / name_kept).read_bytes() == osprey_gust.path.read_bytes()


@pytest.mark.parametrize("t", [float("nan"), float("inf"), -1e300])
def test_with_invalid_flight_time_first_sample_is_at_0(t: float, tmp_path: Path) -> None:
    run = write_run(
        tmp_path, log([*Y[3:], ("/truth", JOINT_STATE, vector(50_000_000, ("t",), (t,)))])
    )
    assert read_run(run).tape.start_ns == 30_000_000
    assert read_playback(run).start_ns == read_playback(run).messages[0].due_ns


def test_invalid_topic_names_are_rejected(tmp_path: Path) -> None:
    run = write_run(tmp_path, log([("y", kind, data) for _, kind, data in Y]))
    with refusing("found topics that begin with no slash: y, expected a recorded flight"):
        read_run(run)


@pytest.mark.parametrize("last", [".inf", "0x" + "f" * 40, "[1]"])
def test_metadata_with_an_invalid_end_is_rejected(last: str, tmp_path: Path) -> None:
    text = (
        f"rosbag2_bagfile_information: {{starting_time: {{nanoseconds_since_epoch: 0}}, "
        f"duration: {{nanoseconds: {last}}}}}"
    )
    (tmp_path / METADATA).write_text(text)
    with refusing(r"metadata\.yaml: found .*, expected the metadata.yaml that rosbag2 writes"):
        read_bag_metadata(tmp_path)


@pytest.mark.parametrize(
    "content", [b"", b"[: x", b"5", b"/**/flight: {ros__parameters: {duration: [1]}}"]
)
def test_a_log_with_any_parameters_is_repaired(content: bytes, tmp_path: Path) -> None:
    bag = log(Y).replace(b"rise_di_lost", b"rise_di_more")
    run = write_run(tmp_path, bag[: len(bag) // 2])
    stored = log(Y[:1], attached={"parameters.yaml": content})
    (run / "run_1.mcap").write_bytes(stored.replace(b"application/yaml", b"text/yaml_______"))
    assert repair(run).has_new_metadata


def test_exponential_and_recursive_aliases_are_rejected() -> None:
    for name in ("aliases_of_a_billion", "itself_inside"):
        with refusing(r"not valid YAML \(found more than 100000 values"):
            parse_yaml((CORPUS / "scenario" / name).read_bytes(), "x", "y")
    assert parse_yaml("{a: &b [1, 2], c: *b}", "x", "y") == {"a": [1, 2], "c": [1, 2]}


def test_notes_of_log_contain_no_terminal_control_codes(tmp_path: Path) -> None:
    hostile = [
        ("/\x1b[2Jz", JOINT_STATE, vector(k, (name,), (1.0,))) for k, name in ((1, "a"), (2, "b"))
    ]
    notes = read_run(write_run(tmp_path, log([*Y, *hostile]))).tape.notes
    assert r"\x1b[2Jz: 1 samples refused: damaged, not finite, or of other channels" in notes
    assert all(note.isprintable() for note in notes)


def test_an_error_is_one_printable_sentence() -> None:
    message = str(ParameterError("found \x1b[2J\r\na" + "x" * 5000))
    assert message.startswith(r"found \x1b[2J\r\na")
    assert message.isprintable()
    assert len(message) <= MAX_LENGTH + 10


def test_text_of_log_cannot_end_script_of_page() -> None:
    hostile = "</script><!--<script>"
    assert "<" not in script_json({"name": hostile})
    assert json.loads(script_json({"name": hostile})) == {"name": hostile}


@pytest.mark.parametrize("value", [float("nan"), float("-inf")])
def test_log_without_finite_value_is_refused(
    value: float, tmp_path: Path, osprey_gust: Scenario
) -> None:
    with refusing(
        r"found no sample of a flight among .*/y: \d+ samples refused: damaged, not finite"
    ):
        read_flight(write_run(tmp_path, constant_flight(osprey_gust, value)))
