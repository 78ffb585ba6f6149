# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test whose messages a log has, and which clock they show.

A flight is timed by its own publishers, and a time is checked by two clocks.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from tests.joint_states import JOINT_STATE, vector

from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_log.bag import BagWriter
from flight_log.tape_reader import read_run

EPOCH = 1_700_000_000 * NANOSECONDS
MS = 1_000_000
NAMES = ("q", "V", "p", "r")
OWN = {"y": "/aircraft#1", "y_m": "/reference_model#2", "u": "/controller#3"}


class Sent(NamedTuple):
    """A message of a topic."""

    topic: str
    data: bytes
    log_ns: int
    sent_ns: int
    number: int


def flight(
    duration: int = 10,
    since_ns: int = EPOCH,
    stamp: Callable[[str, int], int] = lambda topic, ns: ns,
    log: Callable[[int], int] = lambda ns: ns,
) -> list[Sent]:
    """Return whole topics at 100 Hz. `stamp` and `log` move the times since the start, ns."""
    sent = []
    for k in range(100 * duration + 1):
        for topic, sender in OWN.items():
            ns = 10 * MS * k
            data = vector(since_ns + stamp(topic, ns), NAMES, [1e-3 * k] * 4, sender)
            received_ns = since_ns + log(ns) + MS // 2
            sent.append(Sent(topic, data, received_ns, received_ns - MS // 4, k + 1))
    return sent


def written(folder: Path, messages: Sequence[Sent]) -> Tape:
    """Return the tape of a log with these messages."""
    with BagWriter(folder / "run") as bag:
        channels = {name: bag.add_topic(f"/{name}", JOINT_STATE, "") for name in OWN}
        for message in sorted(messages, key=lambda each: each.log_ns):
            times = message.log_ns, message.sent_ns, message.number
            bag.write(channels[message.topic], *times, message.data)
    return read_run(folder / "run").tape


def foreign(topic: str, now_ns: int, number: int) -> list[bytes]:
    """Return messages of foreign publishers.

    They have wrong bytes, other channels, and old, zero or future stamps.
    """
    nan = [float("nan")] * 4
    return [
        b"\x00",
        b"\x00\x01\x00\x00" + bytes(60),
        vector(0, NAMES, [0.0] * 4, "/doors"),
        vector(now_ns - 10**15, NAMES, [0.0] * 4, "/doors"),
        vector(now_ns + 10**15, NAMES, [0.0] * 4, "/doors"),
        vector(now_ns, NAMES, nan, "/doors"),
        vector(now_ns, ("x",), [0.0], "/other"),
        vector(now_ns, (), [], "/third"),
        vector(0, NAMES, [1.0] * 4, f"{OWN[topic]}1"),
        vector(now_ns, NAMES, [9.0] * 4, f"name{number}"),
        vector(now_ns, NAMES, [9.0] * 4, ""),
    ]


@pytest.mark.parametrize("since_ns", [0, EPOCH], ids=["flight time", "time of day"])
@pytest.mark.parametrize("begin", [0.0, 3.0], ids=["from the start", "amid"])
@pytest.mark.parametrize("topics", [("y",), ("u",), ("y", "y_m", "u")])
def test_messages_of_foreign_publishers_count_for_no_topic_of_the_flight(
    since_ns: int, begin: float, topics: tuple[str, ...], tmp_path: Path
) -> None:
    own = flight(since_ns=since_ns)
    first = round(begin * NANOSECONDS) + 2 * MS
    others = [
        Sent(topic, data, since_ns + first + k * 7 * MS, since_ns + first, k + 1)
        for topic in topics
        for k in range(300)
        for data in foreign(topic, since_ns + first + k * 7 * MS, k)[k % 11 : k % 11 + 1]
    ]
    tape = written(tmp_path / "both", [*own, *others])
    alone = written(tmp_path / "alone", own)
    for name in OWN:
        assert tape.recording[name] == alone.recording[name], name
        assert len(tape[name].stamp_ns) == len(alone[name].stamp_ns)
        assert not np.any(tape[name].values == 9.0)
    assert tape.refused == {}
    assert all("usable stamp" not in note and "clock" not in note for note in tape.notes)
    assert any("/other" in note for note in tape.notes)
    assert alone.notes == ()


def test_own_messages_without_a_usable_stamp_still_count(tmp_path: Path) -> None:
    """There is a foreign publisher, but the fault is in the flight's own publisher."""
    own = flight()
    damaged = [
        sent._replace(data=vector(0, NAMES, [0.0] * 4, OWN["y"]))
        if sent.topic == "y" and 200 <= sent.number < 250
        else sent
        for sent in own
    ]
    others = [
        Sent("y", vector(0, NAMES, [0.0] * 4, "/doors"), EPOCH + k * MS, EPOCH, k)
        for k in range(400)
    ]
    tape = written(tmp_path, [*damaged, *others])
    assert tape.recording["y"].unset == 50
    assert len(tape["y"].stamp_ns) == 951


@pytest.mark.parametrize("lost", [0.1, 0.3, 0.5, 0.8])
def test_sensor_that_drops_samples_in_lockstep_is_no_step_of_the_clock(
    lost: float, tmp_path: Path
) -> None:
    """An instant without a sample has a shorter message, without channels.

    The flight is ten times as fast as the reception.
    """
    is_lost = np.random.default_rng(1).random(2001) < lost
    sent = flight(duration=20, since_ns=0, log=lambda ns: EPOCH + ns // 10)
    for k, message in enumerate(sent):
        number = message.number - 1
        if message.topic == "y" and is_lost[number]:
            sent[k] = message._replace(data=vector(10 * MS * number, (), [], OWN["y"]))
    tape = written(tmp_path, sent)
    assert tape["y"].stamp_ns.tolist() == (10 * MS * np.flatnonzero(~is_lost)).tolist()
    assert (tape.recording["y"].step_ns, tape.recording["y"].unset) == (0, 0)


@pytest.mark.parametrize("late", [0.106, 0.25, 0.6])
@pytest.mark.parametrize("topic", ["u", "y"])
def test_late_samples_are_no_step_of_the_clock(topic: str, late: float, tmp_path: Path) -> None:
    """The stamps of a topic go back during the flight, while reception and numbers go on.

    The samples were sent late, and catch up within a second.
    """
    behind = round(late * 1000) * MS

    def stamp(name: str, ns: int) -> int:
        lag = max(behind - max(ns - 4 * NANOSECONDS, 0), 0) if ns >= 4 * NANOSECONDS else 0
        return ns - lag if name == topic else ns

    tape = written(tmp_path, flight(stamp=stamp))
    assert tape.notes == ()
    assert tape.recording[topic].step_ns == 0
    assert len(tape[topic].stamp_ns) == 1001


@pytest.mark.parametrize("by", [0.15, 0.3, 0.7, 2.0, 100.0])
@pytest.mark.parametrize("topic", ["u", "y"])
def test_clock_of_a_topic_that_is_set_back_is_a_step(topic: str, by: float, tmp_path: Path) -> None:
    """The stamps of the topic stay behind the reception."""
    step_ns = round(by * 1000) * MS

    def stamp(name: str, ns: int) -> int:
        return ns - step_ns if name == topic and ns >= 5 * NANOSECONDS else ns

    tape = written(tmp_path, flight(stamp=stamp))
    assert tape.recording[topic].step_ns == 10 * MS - step_ns
    assert any(
        note.startswith(f"{topic}: the clock of its stamps steps back") for note in tape.notes
    )


@pytest.mark.parametrize("pause", [0.4, 0.8, 5.0, 3600.0])
@pytest.mark.parametrize("count", [1, 3])
def test_pause_of_the_host_is_no_leap_of_the_clock(
    pause: float, count: int, tmp_path: Path
) -> None:
    """No topic goes on meanwhile, nor does the reception: a busy or a suspended host."""

    def paused(ns: int) -> int:
        return ns + sum(ns > 2 * NANOSECONDS * (k + 1) for k in range(count)) * round(
            pause * NANOSECONDS
        )

    tape = written(tmp_path, flight(stamp=lambda _, ns: paused(ns), log=paused))
    assert tape.notes == ()
    assert tape.time("y")[-1] == pytest.approx(10.0 + count * pause)


@pytest.mark.parametrize("leap", [0.4, 0.8, 5.0, 3600.0])
@pytest.mark.parametrize("pause", [0.0, 0.5])
def test_leap_of_all_stamps_beside_the_reception_is_told(
    leap: float, pause: float, tmp_path: Path
) -> None:
    """The reception goes on, or pauses for a shorter time than the leap.

    Later times are counted by the clock before the leap.
    """
    leap_ns = round(leap * NANOSECONDS)
    pause_ns = round(pause * NANOSECONDS) if pause < leap - 0.3 else 0

    def stamp(_: str, ns: int) -> int:
        return ns + (leap_ns if ns > 5 * NANOSECONDS else 0)

    def log(ns: int) -> int:
        return ns + (pause_ns if ns > 5 * NANOSECONDS else 0)

    tape = written(tmp_path, flight(stamp=stamp, log=log))
    (note,) = tape.notes
    assert note.startswith(f"the clock of all stamps leaps forth by {leap:.3f} s at t = 5.000 s")
    assert tape.time("y")[-1] == pytest.approx(10.0)
