# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test logs of all kinds with every command.

Each log gives the figures of the flight, or is refused with what it contains.
"""

from pathlib import Path
from typing import Any

import pytest
import zstandard
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin
from tests.bags import (
    FOREIGN_FILES,
    Recorded,
    flight_messages,
    foreign_topics,
    in_namespace,
    packed,
    split,
    whole_bags,
    write_mcap,
    write_rosbags,
)
from tests.conftest import invoke, refusing
from tests.joint_states import JOINT_STATE, STORE, vector
from tests.recordings import EPOCH, MS

from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.recorded_flight import read_flight
from flight_core.outcome import STATUS_ENDED_EARLY
from flight_core.parameters import ParameterError
from flight_log.disk import try_lock
from flight_log.open_log import ROSBAG2
from flight_log.playback import read_playback
from flight_log.repair import repair
from flight_log.tape_reader import read_run
from flight_view.flight import Flight
from flight_view.watch import require_log

pytestmark = pytest.mark.slow

WHOLE = whole_bags()
TICKS = 201  # of two seconds at 100 Hz, both ends included


@pytest.fixture(scope="module")
def messages(recorded: Path) -> list[Recorded]:
    """Return the messages of two seconds of flight, as a recorder stores them."""
    return flight_messages(recorded / "run_0.mcap")


@pytest.fixture(scope="module")
def figures(recorded: Path) -> dict[str, Any]:
    """Return the errors and inputs of the flight in the log of the stack."""
    return figures_of(read_flight(recorded).summary)


def figures_of(summary: dict[str, Any]) -> dict[str, Any]:
    return {key: summary[key] for key in ("duration", "error", "errors", "inputs")}


@pytest.fixture(params=WHOLE)
def whole(request: pytest.FixtureRequest, messages: list[Recorded], tmp_path: Path) -> Path:
    """Return a bag with the whole flight.

    For a file that only its path can name, return the file.
    """
    WHOLE[request.param](tmp_path / "bag", messages)
    single = tmp_path / "bag" / "flight.log"
    return single if single.exists() else tmp_path / "bag"


def test_whole_flight_is_read_replayed_shown_and_played(
    whole: Path, messages: list[Recorded], figures: dict[str, Any], osprey_gust: Scenario
) -> None:
    """The scenario is given with `--scenario`, because the bag has none.

    Bags of `ros2 bag record` have none either.
    """
    with refusing(r"a log without its scenario, expected .* --scenario FILE"):
        read_flight(whole)
    contents = read_run(whole, scenario=osprey_gust.path)
    assert figures_of(read_flight(whole, scenario=osprey_gust.path).summary) == figures
    result = replay(contents)
    assert (len(result.number), int(result.checked.sum()), result.is_equal()) == (
        TICKS,
        TICKS,
        True,
    )
    flight = Flight(whole, scenario=contents.scenario)
    flight.update()
    assert (flight.state(), flight.faults(), flight.samples["internals"].count) == (
        "ended",
        [],
        TICKS,
    )
    assert flight.description["units"]
    playback = read_playback(whole, ["y"])
    assert [message.data for message in playback.messages] == [
        m.data for m in messages if m.topic == "/y"
    ]
    assert all(message.is_stamped for message in playback.messages)
    # Nothing is written.
    assert {path.name for path in whole.parent.rglob("*.yaml")} <= {"metadata.yaml"}


COMMANDS = {
    "report": ["report"],
    "replay": ["replay"],
    "watch": ["watch", "--text"],
    "play": ["play"],
    "repair": ["report", "--repair"],
    "identify": ["identify", "log", "--airframe", "osprey"],
    "check": ["check", "ardupilot", "--run"],
}


def refusal(command: str, *words: str) -> str:
    """Return the sentence of a command that refuses."""
    line = [*COMMANDS[command], *words]
    result = invoke(*line)
    assert isinstance(result.exception, ParameterError), (result.output, result.exception)
    return str(result.exception)


@pytest.mark.parametrize("command", COMMANDS)
def test_file_that_is_no_log_is_named(command: str, tmp_path: Path) -> None:
    for name, (content, words) in FOREIGN_FILES.items():
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(content)
        sentence = refusal(command, str(path))
        if (command, name) == ("repair", "empty"):
            assert sentence.startswith(f"{path}: found no message that could be read")
        else:
            assert sentence.startswith(f"{path}: found {words}"), name
        assert path.read_bytes() == content
    assert {path.suffix for path in tmp_path.iterdir()} == {".mcap"}


@pytest.mark.parametrize("command", COMMANDS)
def test_path_without_log_names_its_content(command: str, recorded: Path, tmp_path: Path) -> None:
    assert refusal(command, str(tmp_path / "nowhere")).startswith(
        f"{tmp_path}/nowhere: found no such file or folder"
    )
    assert refusal(command, str(tmp_path)).startswith(f"{tmp_path}: found no .mcap file, expected")
    (tmp_path / "a.ulg").write_bytes(FOREIGN_FILES["ULog"][0])
    assert "found no .mcap file, but a.ulg, a ULog of PX4" in refusal(command, str(tmp_path))
    (tmp_path / "b.log").write_text("FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n")
    for file in (f"{tmp_path}/a.ulg", f"{tmp_path}/b.log"):
        mend = f"; rise-di import {file} makes one of it"
        # A repair takes an MCAP file alone.
        assert (mend in refusal(command, file)) == (command != "repair")
    assert "found no .mcap file, but the folders of runs run" in refusal(
        command, str(recorded.parent)
    )


@pytest.mark.parametrize("mode", [None, CompressionMode.MESSAGE])
@pytest.mark.parametrize("command", COMMANDS)
def test_bag_of_sqlite_names_the_converter(
    command: str, mode: CompressionMode | None, messages: list[Recorded], tmp_path: Path
) -> None:
    write_rosbags(tmp_path / "bag", messages, mode, StoragePlugin.SQLITE3)
    words = "a database of SQLite, of which `ros2 bag convert` or `rosbags-convert` makes"
    for path in (tmp_path / "bag", tmp_path / "bag" / "bag.db3"):
        sentence = refusal(command, str(path))
        assert sentence.startswith(str(path))  # `--repair` names the file in a folder
        assert words in sentence


@pytest.mark.parametrize("command", ["report", "replay", "watch", "play"])
def test_bag_of_sqlite_is_refused_packed_and_beside_mcap(
    command: str, messages: list[Recorded], tmp_path: Path
) -> None:
    write_rosbags(tmp_path / "packed", messages, CompressionMode.FILE, StoragePlugin.SQLITE3)
    write_mcap(tmp_path / "run", messages)
    write_rosbags(tmp_path / "run" / ROSBAG2, messages, None, StoragePlugin.SQLITE3)
    for name in ("packed", "run"):
        assert "`rosbags-convert`" in refusal(command, str(tmp_path / name))


@pytest.mark.parametrize("command", sorted(COMMANDS.keys() - {"play", "repair"}))
def test_log_without_flight_names_its_topics(
    command: str, messages: list[Recorded], tmp_path: Path
) -> None:
    text = STORE.types["std_msgs/msg/String"]("a")
    chatter = [
        Recorded("/chatter", EPOCH, EPOCH, bytes(STORE.serialize_cdr(text, "std_msgs/msg/String")))
    ]
    schema = ("std_msgs/msg/String", "ros2msg", b"string data")
    write_mcap(tmp_path / "talker", chatter, schema=schema)
    assert "among /chatter (std_msgs/msg/String)" in refusal(command, str(tmp_path / "talker"))
    floats = [message._replace(data=bytes(12)) for message in messages if message.topic == "/y"]
    write_mcap(
        tmp_path / "float", floats, schema=("std_msgs/msg/Float64", "ros2msg", b"float64 data")
    )
    assert "among /y (std_msgs/msg/Float64)" in refusal(command, str(tmp_path / "float"))
    write_mcap(tmp_path / "json", floats, encoding="json")
    assert f"among /y ({JOINT_STATE} in json)" in refusal(command, str(tmp_path / "json"))
    arm = [
        Recorded("/joint_states", EPOCH + k * MS, EPOCH, vector(EPOCH + k * MS, ("a",), (k,)))
        for k in range(9)
    ]
    write_mcap(tmp_path / "arm", arm)
    assert "/joint_states" in refusal(command, str(tmp_path / "arm"))


REMAPS = {"y": "/sensors/y", "u": "/act/command", "y_m": "/ref/y_m"}


def test_remapped_topics_are_one_aircraft_where_the_reader_is_told_their_names(
    messages: list[Recorded], osprey_gust: Scenario, tmp_path: Path
) -> None:
    names = {f"/{name}": topic for name, topic in REMAPS.items()}
    write_mcap(tmp_path / "plain", messages)
    write_mcap(
        tmp_path / "bag",
        [message._replace(topic=names.get(message.topic, message.topic)) for message in messages],
    )
    words = [word for name, topic in REMAPS.items() for word in ("--remap", f"{name}:={topic}")]
    # The log ends before the flight of the scenario.
    for command, status in (("report", STATUS_ENDED_EARLY), ("replay", 0)):
        given = ["--scenario", "osprey_gust"]
        assert refusal(command, str(tmp_path / "bag"), *given)
        assert "expected NAME:=/TOPIC" in refusal(
            command, str(tmp_path / "bag"), *given, "--remap", "y=/sensors/y"
        )
        results = [
            invoke(command, tmp_path / folder, *given, *options, "--json")
            for folder, options in (("plain", []), ("bag", words))
        ]
        assert results[1].stdout == results[0].stdout.replace(
            str(tmp_path / "plain"), str(tmp_path / "bag")
        )
        assert results[1].exit_code == results[0].exit_code == status
    flight = Flight(tmp_path / "bag", remaps=REMAPS)
    while flight.update():
        pass
    assert {*REMAPS} <= {*flight.samples}


def test_two_aircraft_are_shown_one_at_time(
    messages: list[Recorded], osprey_gust: Scenario, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    shorter = [message for message in messages if message.log_ns < EPOCH + 1000 * MS]
    both = [*in_namespace("/uav1", messages), *in_namespace("/uav2", shorter)]
    write_mcap(bag, sorted(both, key=lambda message: message.log_ns))
    for command in ("report", "replay", "check", "identify"):
        given = ["--scenario", "osprey_gust"]
        assert "aircraft in the namespaces /uav1, /uav2" in refusal(command, str(bag), *given)
        third = ["--namespace", "uav3"]
        assert "expected one in 'uav3'" in refusal(command, str(bag), *given, *third)
    assert "expected one in 'uav3'" in refusal("watch", str(bag), "--namespace", "uav3")
    assert "expected one in 'uav3'" in refusal("play", str(bag), "--namespace", "uav3")
    # By the last u.
    for name, duration in (("uav1", 2.0), ("uav2", 0.99)):
        assert read_flight(bag, namespace=name, scenario=osprey_gust.path).summary[
            "duration"
        ] == pytest.approx(duration)
        flight = Flight(bag, namespace=name)
        flight.update()
        assert flight.end == pytest.approx(duration)
        assert {*read_playback(bag, namespace=name).types} == {
            f"/{name}{topic}" for topic in {m.topic for m in messages}
        }
    first = Flight(bag)
    first.update()
    assert first.faults() == [
        "another aircraft in the namespace /uav2 is not shown: --namespace /uav2"
    ]


def test_topics_without_cdr_are_skipped(messages: list[Recorded], tmp_path: Path) -> None:
    write_mcap(tmp_path / "bag", messages, beside=foreign_topics)
    playback = read_playback(tmp_path / "bag")
    assert playback.skipped == {"/log": "foxglove.Log in json", "/bare": "no type"}
    assert "/secret" in playback.types  # whether its type is installed, ROS knows
    assert "/log" not in playback.types


MISSING = "bag_1.mcap: named in metadata.yaml and missing"


@pytest.mark.parametrize(
    "names, metadata, note",
    [
        (["bag_0.mcap", "", "bag_2.mcap"], True, MISSING),
        (["", "bag_1.mcap", "bag_2.mcap"], True, MISSING.replace("_1", "_0")),
        (
            ["bag_0.mcap", "", "bag_2.mcap"],
            False,
            "bag_1.mcap: a number before the last and missing",
        ),
    ],
)
def test_missing_part_stays_named_after_repair(
    names: list[str], metadata: bool, note: str, messages: list[Recorded], tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    split(bag, messages, names, metadata=metadata)
    before = {path.name: path.read_bytes() for path in bag.iterdir()}
    assert any(line.startswith(note) for line in read_run(bag).tape.notes)
    if metadata and "bag_0.mcap" in names:
        assert not repair(bag).has_new_metadata
        assert {path.name: path.read_bytes() for path in bag.iterdir()} == before
    file = next(path for path in sorted(bag.glob("*.mcap")))
    file.write_bytes(file.read_bytes()[:-500])
    assert note.partition(":")[0] in repair(bag).missing
    assert any(line.startswith(note.partition(":")[0]) for line in read_run(bag).tape.notes)


def test_truncated_packed_file_read_to_end(messages: list[Recorded], tmp_path: Path) -> None:
    packed(tmp_path / "bag", messages, ".zstd", zstandard.compress, part=0.95)
    tape = read_run(tmp_path / "bag").tape
    assert 0.0 < float(tape.time("y")[-1]) < 1.95
    assert any("truncated" in note for note in tape.notes)


def test_rosbags_reads_what_the_generator_writes(messages: list[Recorded], tmp_path: Path) -> None:
    """Rosbags reads the bags of these tests, if it can read their kind."""
    for name in ("chunks_zstd", "unchunked", "namespace"):
        WHOLE[name](tmp_path / name, messages)
        with Reader(tmp_path / name / "bag_0.mcap") as reader:
            assert reader.message_count == len(messages)


def test_log_in_recording_watched_before_topics(tmp_path: Path) -> None:
    file = tmp_path / "run_0.mcap"
    file.write_bytes(b"\x89MCAP0\r\n")
    with file.open("rb") as stream:
        assert try_lock(stream)
        require_log(tmp_path)
    with refusing("found no topic"):
        require_log(tmp_path)
