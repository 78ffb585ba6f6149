# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test writing and reading bags.

Independent readers read what was written. Truncated and damaged files and bags of other recorders
are read.
"""

import math
import struct
import sys
import tracemalloc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg
from tests.conftest import refusing
from tests.joint_states import JOINT_STATE, STORE, vector
from tests.recordings import require_equal_bits, summary_of, truncate

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_log.bag import BagWriter, LogAttachments
from flight_log.engagements import Engagement
from flight_log.message_definitions import definition
from flight_log.named_vectors import Samples, decoder, encoded, stamp_in, tables
from flight_log.open_log import ROSBAG2
from flight_log.playback import read_playback
from flight_log.scan import MESSAGE_INDEX, RECORD, FilePart, MessageBatch, Scan, decode_batches
from flight_log.tape_reader import read_run
from flight_log.tape_writer import write_run
from flight_view.flight import Flight


def test_written_tape_read_back_bit_by_bit(tape: Tape, recorded: Path) -> None:
    back = read_run(recorded).tape
    assert set(back.signals) == set(tape.signals)
    assert back.notes == ()
    require_equal_bits(back, tape)


def test_log_has_bytes_that_library_writes_by_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The messages are not in order of time.
    messages = [(k % 3, NANOSECONDS + (7919 * k) % 1000, k, bytes(k % 5) * k) for k in range(3000)]
    logs = []
    for name in ("ours", "library"):
        if name == "library":
            monkeypatch.setattr("flight_log.bag.CHUNK_BUILDER", "unused")
            monkeypatch.setattr("flight_log.bag.CHUNK_INDEXES", "unused")
        with BagWriter(tmp_path / name / "run") as bag:
            channels = [bag.add_topic(f"/{topic}", JOINT_STATE, "") for topic in "abc"]
            for channel, received_ns, sequence, data in messages:
                bag.write(channels[channel], received_ns, received_ns - sequence, sequence, data)
                if sequence % 500 == 100:
                    bag.flush()
        logs.append(bag.path.read_bytes())
    assert logs[0] == logs[1]


def test_memory_of_long_recording_does_not_grow(tmp_path: Path) -> None:
    with BagWriter(tmp_path) as bag:
        channels = [bag.add_topic(f"/{k}", JOINT_STATE, "") for k in range(9)]
        tracemalloc.start()
        try:
            # Chunks: 100 s of flight.
            for k in range(1000):
                for channel in channels:
                    bag.write(channel, k, k, k, b"")
                bag.flush()
                if k == 500:
                    middle, _ = tracemalloc.get_traced_memory()
            end, _ = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert end - middle < 500 * 20  # bytes; an index of a chunk in memory has 1 kB
    assert len(summary_of(bag.path).chunk_indexes) == 1000


def test_the_scenario_is_stored_unchanged(recorded: Path, osprey_gust: Scenario) -> None:
    assert read_run(recorded).scenario == ("osprey_gust.yaml", osprey_gust.path.read_bytes())


def test_attachments_and_metadata_are_stored_unchanged(
    tape: Tape, osprey_gust: Scenario, tmp_path: Path
) -> None:
    attached = tmp_path / "airframe.yaml"
    metadata = tmp_path / "metadata.yaml"
    attached.write_bytes(b"A: [[1.0]]\n\xc3\xa9")
    metadata.write_text("host: {cores: '2', kernel: '6.1 #1'}\nversions: {}\n")
    write_run(tape, tmp_path / "run", LogAttachments(osprey_gust.path, (attached,), metadata))
    back = read_run(tmp_path / "run")
    assert back.attachments == (("airframe.yaml", attached.read_bytes()),)
    assert (back.metadata["host"], back.metadata["versions"]) == (
        {"cores": "2", "kernel": "6.1 #1"},
        {},
    )


@pytest.mark.parametrize("text", ["host: 3\n", "- a\n", "host: {cores: 2}\n"])
def test_metadata_other_than_strings_are_rejected(
    text: str, tape: Tape, osprey_gust: Scenario, tmp_path: Path
) -> None:
    metadata = tmp_path / "metadata.yaml"
    metadata.write_text(text)
    with refusing("expected a mapping of mappings of strings"):
        write_run(tape, tmp_path / "run", LogAttachments(osprey_gust.path, (), metadata))


def test_rosbags_reads_every_topic(tape: Tape, recorded: Path) -> None:
    with AnyReader([recorded]) as reader:
        counts = {
            connection.topic.lstrip("/"): connection.msgcount for connection in reader.connections
        }
        assert counts == {name: len(signal.stamp_ns) for name, signal in tape.signals.items()}
        connection, _, raw = next(
            reader.messages([c for c in reader.connections if c.topic == "/y"])
        )
        message: Any = reader.deserialize(raw, connection.msgtype)
        assert message.name == ["q", "V", "p", "r"]
        assert message.position.tolist() == tape["y"].values[0].tolist()


def test_file_is_ros2_profile_with_installed_definitions_and_hashes(recorded: Path) -> None:
    summary = summary_of(recorded / "run_0.mcap")
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    hashes = {channel.metadata["topic_type_hash"] for channel in summary.channels.values()}
    assert hashes == {definition(JOINT_STATE).type_hash}
    with (recorded / "run_0.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        assert any(record.name == "rosbag2" for record in reader.iter_metadata())


@pytest.mark.parametrize("fraction", [0.4, 0.6, 0.9])
def test_truncated_file_read_up_to_last_complete_chunk(
    fraction: float, tape: Tape, run: Path
) -> None:
    truncate(run, fraction)
    back = read_run(run).tape
    assert 0 < len(back["y"].stamp_ns) <= len(tape["y"].stamp_ns)
    assert (back["y"].values == tape["y"].values[: len(back["y"].stamp_ns)]).all()
    end = max(back.time(name)[-1] for name in back.signals)
    assert (
        f"run_0.mcap is truncated: read up to its last complete chunk, t = {end:.3f} s"
        in back.notes[0]
    )
    assert back.notes[1] == f"metadata.yaml is missing: rise-di report --repair {run}"


@pytest.mark.parametrize(
    "opcode",
    [None, Opcode.DATA_END, Opcode.FOOTER],
    ids=["content", "opcode of an end", "of a footer"],
)
@pytest.mark.parametrize("number", [0, 1])
def test_damaged_chunk_left_out_and_all_others_read(
    number: int, opcode: Opcode | None, tape: Tape, run: Path
) -> None:
    file = run / "run_0.mcap"
    chunks = sorted(summary_of(file).chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)
    assert len(chunks) > 2
    content = bytearray(file.read_bytes())
    start = chunks[number].chunk_start_offset
    if opcode is None:
        content[start + chunks[number].chunk_length - 100] ^= 1
    else:
        content[start] = opcode
    file.write_bytes(content)
    back = read_run(run).tape
    assert back.notes == ("run_0.mcap is damaged: 1 of its parts left out",)
    begin, end = (
        np.array([getattr(chunks[number], f"message_{end}_time")]) for end in ("start", "end")
    )
    stamps = tape["y"].stamp_ns
    kept = back["y"].stamp_ns  # the log times, in one process
    assert set(stamps[(stamps < begin) | (stamps > end)]) <= set(kept)
    assert len(kept) < len(stamps)


def test_memory_for_chunks_of_few_bytes_that_hold_much_bounded(tmp_path: Path) -> None:
    size = 8 << 20
    count = 30
    with BagWriter(tmp_path) as bag:
        channel = bag.add_topic("/y", JOINT_STATE, "")
        for k in range(count):
            bag.write(channel, k, k, k, bytes(size))
            bag.flush()
    assert bag.path.stat().st_size < count * size // 1000
    tracemalloc.start()
    try:
        messages = sum(
            len(batch.data) for batch in Scan(bag.path).batches() if isinstance(batch, MessageBatch)
        )
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert messages == count
    # Chunk and batch are in memory for each of AHEAD, for the one that is decoded and the one that
    # is counted.
    assert peak < 12 * size


def test_two_bags_in_a_folder_are_rejected(run: Path) -> None:
    (run / "copy.mcap").write_bytes((run / "run_0.mcap").read_bytes())
    with refusing(r"run: found 2 \.mcap files that are not parts of one bag, expected one bag"):
        read_run(run)


def test_a_folder_without_a_bag_is_rejected(tmp_path: Path) -> None:
    with refusing(r"found no \.mcap file"):
        read_run(tmp_path)


def test_definitions_include_all_referenced_types() -> None:
    lines = definition(JOINT_STATE).text.splitlines()
    assert [line for line in lines if line.startswith("MSG: ")] == [
        "MSG: builtin_interfaces/Time",
        "MSG: std_msgs/Header",
    ]
    with refusing("install the package no_such_msgs"):
        definition("no_such_msgs/msg/Thing")


@pytest.mark.parametrize(
    "type_name", [JOINT_STATE, "nav_msgs/msg/Path", "diagnostic_msgs/msg/DiagnosticArray"]
)
def test_definitions_need_no_ros_package(
    type_name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Rosbags finds the fields and the hash of the installed definition, without its comments."""
    installed = definition(type_name)
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    single = definition.__wrapped__(type_name)
    assert single.type_hash == installed.type_hash
    assert get_types_from_msg(single.text, type_name) == get_types_from_msg(
        installed.text, type_name
    )


def record(
    folder: Path,
    topics: dict[str, list[bytes]],
    compression: CompressionMode = CompressionMode.NONE,
) -> None:
    """Write a bag with rosbags, with the messages of each topic 1 ms apart.

    A further topic has another type.
    """
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    if compression is not CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {
            topic: writer.add_connection(topic, JOINT_STATE, typestore=STORE) for topic in topics
        }
        other = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=STORE)
        text = STORE.types["std_msgs/msg/String"]("hello")
        writer.write(other, 1, STORE.serialize_cdr(text, "std_msgs/msg/String"))
        for topic, messages in topics.items():
            for index, message in enumerate(messages):
                writer.write(connections[topic], 1_000_000 * (index + 1), message)


SAMPLES = [vector(2_000_000 * k, ("q", "V"), (0.1 * k, -k)) for k in range(50)]


def test_flight_that_rosbag2_recorded_read_with_scenario_beside_it(
    osprey_gust: Scenario, tmp_path: Path
) -> None:
    """The launch files leave a log without messages, and the bag in a folder of its own."""
    with BagWriter(tmp_path / "run") as bag:
        bag.add_attachments(LogAttachments(osprey_gust.path), 1)
    record(tmp_path / "run" / ROSBAG2, {"/y": SAMPLES})
    back = read_run(tmp_path / "run")
    assert back.scenario == ("osprey_gust.yaml", osprey_gust.path.read_bytes())
    assert back.tape["y"]["q"].tolist() == [0.1 * k for k in range(50)]
    assert back.tape.notes == ()


@pytest.mark.parametrize(
    "compression", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE]
)
def test_bags_of_other_recorders_are_read(compression: CompressionMode, tmp_path: Path) -> None:
    record(tmp_path / "bag", {"/y": SAMPLES}, compression)
    back = read_run(tmp_path / "bag").tape
    assert list(back.signals) == ["y"]
    assert back.notes == ()
    assert back["y"].stamp_ns.tolist() == [2_000_000 * k for k in range(50)]
    assert back["y"]["q"].tolist() == [0.1 * k for k in range(50)]


@pytest.mark.parametrize("compression", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_bags_of_other_recorders_are_played(compression: CompressionMode, tmp_path: Path) -> None:
    record(tmp_path / "bag", {"/y": SAMPLES}, compression)
    playback = read_playback(tmp_path / "bag", ["y"])
    assert [message.data for message in playback.messages] == SAMPLES
    assert all(message.is_stamped for message in playback.messages)


def test_bag_in_several_files_is_one_flight(tmp_path: Path) -> None:
    # There are more than ten parts, so that the order of numbers is not that of names.
    for part in range(12):
        record(tmp_path / f"part{part}", {"/y": SAMPLES[4 * part : 4 * part + 4]})
        (tmp_path / "bag").mkdir(exist_ok=True)
        (tmp_path / f"part{part}" / f"part{part}.mcap").rename(
            tmp_path / "bag" / f"bag_{part}.mcap"
        )
    files = [f"bag_{part}.mcap" for part in range(12)]
    information = yaml.safe_load((tmp_path / "part0" / "metadata.yaml").read_text())
    information["rosbag2_bagfile_information"]["relative_file_paths"] = files
    (tmp_path / "bag" / "metadata.yaml").write_text(yaml.safe_dump(information))
    back = read_run(tmp_path / "bag").tape
    assert back["y"].stamp_ns.tolist() == [2_000_000 * k for k in range(48)]
    assert back["y"]["V"].tolist() == [-float(k) for k in range(48)]


def test_two_aircraft_in_one_bag_selected_by_namespace(tmp_path: Path) -> None:
    topics = {
        "/one/y": SAMPLES,
        "/fleet/two/y": SAMPLES[:7],
        "/fleet/two/gps/speed": SAMPLES[:3],
        "/one/u": SAMPLES[1:6],
    }
    record(tmp_path / "bag", topics)
    result = "bag: found aircraft in the namespaces /fleet/two, /one, expected"
    with refusing(f"{result} that one of them"):
        read_run(tmp_path / "bag")
    with refusing(r"namespaces /fleet/two, /one, expected one in '/three'"):
        read_run(tmp_path / "bag", "/three")
    for namespace, counts in (
        ("/one", {"y": 50, "u": 5}),
        ("fleet/two/", {"y": 7, "gps/speed": 3}),
    ):
        back = read_run(tmp_path / "bag", namespace)
        assert {name: len(signal.stamp_ns) for name, signal in back.tape.signals.items()} == counts
        assert back.namespace == f"/{namespace.strip('/')}"
        assert (back.latency is not None) == ("u" in counts)


def one_by_one(messages: Sequence[bytes]) -> list[tuple[tuple[str, ...], int, bytes]]:
    samples = []
    for message in messages:
        one: Any = STORE.deserialize_cdr(message, JOINT_STATE)
        if one.name:
            stamp = one.header.stamp.sec * NANOSECONDS + one.header.stamp.nanosec
            samples.append((tuple(one.name), stamp, one.position.tobytes()))
    return sorted(samples)


MIXTURES = {
    "a change of sender": [
        *SAMPLES[:5],
        *(vector(k, ("q", "V"), (k, 1.0), "/another#1") for k in range(5)),
        *SAMPLES[5:9],
    ],
    "missing samples": [SAMPLES[0], vector(1, (), ()), SAMPLES[1], vector(2, (), ())],
    "other channels of the same length": [
        SAMPLES[0],
        vector(3, ("V", "q"), (1.0, 2.0)),
        SAMPLES[1],
    ],
    "velocities": [vector(k, ("q",), (k,), velocity=(1.0,)) for k in range(3)],
    "equal values": [vector(k, ("q", "V", "p"), (0.0, 0.0, 0.0)) for k in range(3)] + [SAMPLES[3]],
    "before 1970 and not finite": [
        vector(-5 * NANOSECONDS, ("q",), (np.nan,)),
        vector(1, ("q",), (np.inf,)),
    ],
    "no messages": [],
}


def index_of(places: Sequence[int]) -> bytes:
    """Return a message index with messages at `places`."""
    return MESSAGE_INDEX.pack(1, 16 * len(places)) + b"".join(
        struct.pack("<Qq", 0, place) for place in places
    )


def messages_of(chunk: bytes, index: bytes) -> list[tuple[int, bytes, int, int]]:
    """Return channel, content and times of the messages of a chunk with this message index."""
    return [
        (batch.channel_id, bytes(message), int(log_ns), int(publish_ns))
        for batch in decode_batches([FilePart(Opcode.CHUNK, chunk, [index], 0)])
        if isinstance(batch, MessageBatch)
        for message, log_ns, publish_ns in zip(
            batch.data, batch.log_ns, batch.publish_ns, strict=True
        )
    ]


def first_chunk(log: bytes) -> tuple[bytes, list[int]]:
    """Return the content of the first chunk of a log, and the places of its messages."""
    place = len(MCAP0_MAGIC)
    chunk = b""
    places = list[int]()
    while True:
        opcode, length = RECORD.unpack_from(log, place)
        content = log[place + RECORD.size : place + RECORD.size + length]
        if opcode == Opcode.CHUNK and chunk:
            return chunk, sorted(places)
        if opcode == Opcode.CHUNK:
            chunk = content
        elif opcode == Opcode.MESSAGE_INDEX and chunk:
            places += [
                offset for _, offset in struct.iter_unpack("<QQ", content[MESSAGE_INDEX.size :])
            ]
        place += RECORD.size + length


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_wrong_message_index_changes_no_message(data: st.DataObject, recorded: Path) -> None:
    """The index saves the steps from message to message: it is used where it agrees with them."""
    chunk, places = first_chunk((recorded / "run_0.mcap").read_bytes())
    by_steps = messages_of(chunk, b"")
    assert messages_of(chunk, index_of(places)) == by_steps
    assert len(by_steps) == len(places) > 10
    listed = st.lists(
        st.sampled_from(places) | st.integers(-(2**63), 2**63 - 1) | st.integers(0, 5000)
    )
    assert messages_of(chunk, data.draw(listed.map(index_of) | st.binary(max_size=40))) == by_steps


@pytest.mark.parametrize("messages", MIXTURES.values(), ids=MIXTURES)
def test_messages_decoded_together_equal_those_decoded_one_by_one(messages: list[bytes]) -> None:
    decode = decoder(JOINT_STATE)
    assert decode is not None
    decoded = [
        (samples.names, int(stamp), values.tobytes())
        for part in (messages[:4], messages[4:])
        for table in tables(part)
        for samples in decode(table).samples
        for stamp, values in zip(samples.stamp_ns, samples.values, strict=True)
    ]
    assert sorted(decoded) == one_by_one(messages)


def test_other_types_have_no_decoder_and_malformed_messages_counted() -> None:
    assert decoder("rcl_interfaces/msg/Log") is None
    decode = decoder(JOINT_STATE)
    assert decode is not None
    decoded = [decode(table) for table in tables([SAMPLES[0][:20], SAMPLES[1], b""])]
    assert [table.unreadable for table in decoded] == [1, 0, 1]
    assert [len(samples.stamp_ns) for table in decoded for samples in table.samples] == [1]


def test_engagements_of_log_begin_with_phase_engaged_and_end_with_reason(tmp_path: Path) -> None:
    """Reports are sent at each change and once a second.

    The messages are written by the library rosbags.
    """
    kind = "diagnostic_msgs/msg/KeyValue"
    bag = BagWriter(tmp_path / "run")
    other = bag.add_topic("/y", JOINT_STATE, "")
    bag.write(other, 1, stamp_in(SAMPLES[0]), 1, SAMPLES[0])
    bag.flush()
    assert read_run(tmp_path / "run").engagements is None
    channel, of_another = (
        bag.add_topic(f"{name}/bridge/engagement", kind, "") for name in ("", "/plane")
    )
    reports = [
        "DISENGAGED",
        "ENGAGED",
        "ENGAGED",
        "RELEASE lost",
        "DISENGAGED lost",
        "ENGAGING mode",
        "ENGAGED",
        "ENGAGED",
    ]
    for number, report in enumerate(reports):
        key, _, value = report.partition(" ")
        data = bytes(STORE.serialize_cdr(STORE.types[kind](key=key, value=value), kind))
        bag.write(channel, number, 10 * number, number, data)
        bag.write(of_another, number, 10 * number + 5, number, data)
    bag.close()
    # The instants are those of sending.
    assert read_run(tmp_path / "run").engagements == [
        Engagement(10, 30, "lost"),
        Engagement(60, None, ""),
    ]


def test_publisher_with_channels_in_another_order_read_by_names(tmp_path: Path) -> None:
    with BagWriter(tmp_path) as bag:
        channel = bag.add_topic("/y", JOINT_STATE, "")
        for k in range(20):
            q_first = k < 10
            names, values = (("q", "V"), (k, 50.0)) if q_first else (("V", "q"), (50.0, k))
            bag.write(
                channel, k, k, k, vector(k, names, values, "/first" if q_first else "/second")
            )
    tape = read_run(tmp_path).tape
    assert (tape["y"].names, tape.notes) == (("q", "V"), ())
    assert tape["y"].values.tolist() == [[k, 50.0] for k in range(20)]


def test_samples_that_nodes_refuse_are_left_out_and_noted(tmp_path: Path) -> None:
    """The refused samples have values that are not finite, or a name twice."""
    with BagWriter(tmp_path) as bag:
        channel = bag.add_topic("/y", JOINT_STATE, "")
        only = bag.add_topic("/u", JOINT_STATE, "")
        for k, q in enumerate((1.0, math.nan, 3.0, math.inf)):
            bag.write(channel, k, k, k, vector(k + 1, ("q", "V"), (q, 50.0)))
            bag.write(only, k, k, k, vector(k + 1, ("thrust", "thrust"), (q, 50.0)))
    tape = read_run(tmp_path).tape
    assert tape["y"]["q"].tolist() == [1.0, 3.0]
    why = "samples refused: damaged, not finite, or of other channels"
    assert set(tape.notes) == {f"y: 2 {why}", f"u: 4 {why}"}


@pytest.mark.parametrize(
    "numbers, lost", [([1, 2, 5, 6], 2), ([1, 2, 1, 6], None), ([0, 0, 0, 0], None)]
)
def test_lost_messages_are_known_of_one_publisher_alone(
    numbers: list[int], lost: int | None, tmp_path: Path
) -> None:
    """A restarted publisher counts from the beginning again.

    What was not sent in between is unknown.
    """
    with BagWriter(tmp_path) as bag:
        channel = bag.add_topic("/y", JOINT_STATE, "")
        for k, number in enumerate(numbers):
            bag.write(channel, k, k, number, vector(k + 1, ("q",), (0.0,)))
    assert read_run(tmp_path).tape.recording["y"].lost == lost


def test_samples_of_two_publishers_at_same_time_noted(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "run")
    # A second aircraft and a restarted one.
    spans = {
        "/y": ("/aircraft#1", "/aircraft#2"),
        "/y_m": ("/reference_model#3", "/reference_model#9"),
    }
    for topic, (first, second) in spans.items():
        channel = bag.add_topic(topic, JOINT_STATE, "")
        later = 4 if topic == "/y" else 10
        for sender, stamps in ((first, np.arange(0, 10)), (second, np.arange(later, later + 3))):
            for data in encoded(
                Samples(
                    names=("q",),
                    stamp_ns=stamps * NANOSECONDS + 1,
                    values=np.zeros((len(stamps), 1)),
                    sender=sender,
                )
            ):
                bag.write(channel, 1, 1, 1, data.tobytes())
    bag.close()
    both = (
        "y: samples of /aircraft#1, /aircraft#2: the figures are of the first, and of the next "
        "once that is silent, as the nodes admit them"
    )
    tape = read_run(tmp_path / "run").tape
    assert tape.notes == (both,)
    assert len(tape["y"].stamp_ns) == 10  # of /aircraft#1
    assert len(tape["y_m"].stamp_ns) == 13  # of both: the second begins after the first


def test_without_truth_flight_time_counts_from_first_y_m(tmp_path: Path) -> None:
    """A bridge publishes y before the reference model starts.

    Commands are timed from the start of the reference model.
    """
    bag = BagWriter(tmp_path / "run")
    for name, first in (("y", 3), ("y_m", 5)):
        channel = bag.add_topic(f"/{name}", JOINT_STATE, "")
        stamps = np.arange(first, 9) * NANOSECONDS
        samples = encoded(
            Samples(
                names=("q",), stamp_ns=stamps, values=np.zeros((len(stamps), 1)), sender="/node#1"
            )
        )
        for stamp_ns, data in zip(stamps.tolist(), samples, strict=True):
            bag.write(channel, stamp_ns, stamp_ns, 1, data.tobytes())
    bag.close()
    assert read_run(tmp_path / "run").tape.start_ns == 5 * NANOSECONDS
    assert read_playback(tmp_path / "run").start_ns == 5 * NANOSECONDS
    flight = Flight(tmp_path / "run")
    while flight.update(1.0):
        pass
    assert flight.start_ns == 5 * NANOSECONDS
