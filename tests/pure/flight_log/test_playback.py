# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the playback schedule of a log: the messages, their order and their due times."""

from pathlib import Path

import pytest
from tests.conftest import refusing
from tests.joint_states import STORE, vector
from tests.recordings import EPOCH, MS

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.rates import NANOSECONDS
from flight_log import playback
from flight_log.bag import BagWriter, LogAttachments
from flight_log.named_vectors import JOINT_STATE
from flight_log.playback import read_playback
from flight_log.stored_messages import StoredMessage
from flight_log.tape_writer import write_run


@pytest.fixture(scope="module")
def run(osprey_gust: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return one second in one process, from t = 0 to 1 s.

    y, y_m and truth have 500 Hz, u and internals 100 Hz, and pose 50 Hz.
    """
    tape = simulate(osprey_gust.vary(flight={"duration": 1.0}))
    return write_run(
        tape, tmp_path_factory.mktemp("playback") / "run", LogAttachments(osprey_gust.path)
    ).parent


def test_every_message_of_flight_in_one_process_is_due_at_stamp(run: Path) -> None:
    playback = read_playback(run)
    assert len(playback.messages) == 3 * 501 + 2 * 101 + 51
    assert dict.fromkeys(playback.types.values()) == {JOINT_STATE: None}
    assert list(playback.types) == ["/internals", "/pose", "/truth", "/u", "/y", "/y_m"]
    for message in playback.messages:
        stamp = STORE.deserialize_cdr(message.data, JOINT_STATE).header.stamp  # type: ignore[attr-defined] # made at run time
        assert message.is_stamped
        assert message.due_ns == stamp.sec * NANOSECONDS + stamp.nanosec
    due = [message.due_ns for message in playback.messages]
    assert due == sorted(due)
    assert (playback.t(due[0]), playback.t(due[-1])) == (0.0, 1.0)


def test_topics_selected_by_full_or_last_name_and_start_by_flight_time(run: Path) -> None:
    playback = read_playback(run, ["y", "/u"], start=0.5)
    assert list(playback.types) == ["/u", "/y"]
    assert len(playback.messages) == 251 + 51
    assert playback.t(playback.messages[0].due_ns) == 0.5


@pytest.mark.parametrize(
    "topics, start, sentence",
    [
        (
            ["y", "z"],
            0.0,
            r"run: found no message of z, expected some of /internals, /pose, /truth, /u, /y, /y_m",
        ),
        ([], 1.5, r"start: found 1.5 s, expected a flight time before the end of the log, 1 s"),
    ],
)
def test_topic_or_start_outside_log_rejected(
    topics: list[str], start: float, sentence: str, run: Path
) -> None:
    with refusing(sentence):
        read_playback(run, topics, start)


def test_a_log_without_messages_is_rejected(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run") as bag:
        bag.add_topic("/y", JOINT_STATE, "")
    with refusing("found no message, expected a recorded flight"):
        read_playback(tmp_path / "run")


def bag_of(folder: Path, sent: list[tuple[str, int, int, float]]) -> Path:
    """Return a log of (topic, time of sending, stamp, value) in the order of receipt.

    `truth` has the channel t.
    """
    with BagWriter(folder) as bag:
        channels = {
            topic: bag.add_topic(topic, JOINT_STATE, "")
            for topic in dict.fromkeys(row[0] for row in sent)
        }
        for number, (topic, sent_ns, stamp_ns, value) in enumerate(sent, start=1):
            message = vector(stamp_ns, ["t" if topic == "/truth" else "q"], [value], "peer")
            bag.write(channels[topic], EPOCH + number * MS, sent_ns, number, message)
    return folder


def test_in_real_time_message_is_due_when_it_was_sent_not_when_it_was_received(
    tmp_path: Path,
) -> None:
    begin = EPOCH - 5_000 * MS  # t = 0
    messages = [
        ("/truth", begin + 2001 * MS, begin + 2000 * MS, 2.0),
        ("/y", begin + 2006 * MS, begin + 1990 * MS, 0.2),  # 16 ms old when it was sent
        ("/y", begin + 2003 * MS, begin + 1985 * MS, 0.1),
    ]
    playback = read_playback(bag_of(tmp_path / "run", messages))
    assert [round(playback.t(message.due_ns), 6) for message in playback.messages] == [
        2.001,
        2.003,
        2.006,
    ]


def test_message_without_stamp_is_due_when_it_was_sent(tmp_path: Path) -> None:
    """A driver forgot the header, so no sample has a stamp."""
    messages = [
        (topic, EPOCH + k * NANOSECONDS, 0, 0.0) for k in range(3) for topic in ("/truth", "/y_m")
    ]
    playback = read_playback(bag_of(tmp_path / "run", messages))
    assert [playback.t(message.due_ns) for message in playback.messages] == [
        0.0,
        0.0,
        1.0,
        1.0,
        2.0,
        2.0,
    ]


def test_in_lockstep_message_is_due_at_stamp_but_not_before_those_sent_before_it(
    tmp_path: Path,
) -> None:
    # The host sent all of it within 3 ms; the second y is 20 ms late, and /other carries the host's
    # time.
    messages = [
        ("/truth", EPOCH + MS, 0, 0.0),
        ("/y", EPOCH + 2 * MS, 0, 0.1),
        ("/truth", EPOCH + 3 * MS, 30 * MS, 0.03),
        ("/y", EPOCH + 4 * MS, 10 * MS, 0.2),
        ("/other", EPOCH + 5 * MS, EPOCH + 5 * MS, 0.0),
    ]
    playback = read_playback(bag_of(tmp_path / "run", messages))
    assert [
        (message.topic, message.due_ns, message.is_stamped) for message in playback.messages
    ] == [
        ("/truth", 0, True),
        ("/y", 0, True),
        ("/truth", 30 * MS, True),
        ("/y", 30 * MS, True),
        ("/other", 30 * MS, False),  # a stamp on the other time scale is not shifted
    ]


def test_clock_is_not_played_and_shared_topics_only_by_name(tmp_path: Path) -> None:
    topics = ("/clock", "/y", "/diagnostics", "/rosout")
    bag = bag_of(
        tmp_path / "run",
        [(topic, EPOCH + k * MS, EPOCH + k * MS, 0.0) for k, topic in enumerate(topics)],
    )
    assert list(read_playback(bag).types) == ["/y"]
    assert list(read_playback(bag, ["y", "rosout"]).types) == ["/rosout", "/y"]
    with refusing("found no message of /clock, expected some of /diagnostics, /rosout, /y"):
        read_playback(bag, ["/clock"])


@pytest.mark.parametrize(
    "durability, depth, early",
    [("transient_local", 1, 1), (1, 3, 2), ("volatile", 1, 0), (1, 20_000, 0)],
)
def test_start_in_the_middle_sends_latched_messages_first(
    durability: str | int, depth: int, early: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    qos = f"- history: keep_last\n  depth: {depth}\n  durability: {durability}\n"
    stored = [
        StoredMessage(
            topic=topic,
            type_name="x/msg/X",
            definition="",
            received_ns=t,
            sent_ns=t,
            data=b"",
            qos=qos if topic == "/a" else "",
        )
        for topic, t in LATCHED
    ]
    monkeypatch.setattr(playback, "stored_messages", lambda run: iter(stored))
    played = read_playback(tmp_path, start=2.0).messages
    assert [message.topic for message in played] == ["/a"] * early + ["/y"]
    assert {message.due_ns for message in played[:early]} <= {LATCHED[0][1] + 2 * NANOSECONDS}


LATCHED = [
    ("/a", 10 * NANOSECONDS),
    ("/a", 11 * NANOSECONDS),
    ("/y", 11 * NANOSECONDS),
    ("/y", 13 * NANOSECONDS),
]
