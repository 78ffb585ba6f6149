# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the log has evidence for the cause that an account names.

A damaged log must not be told as a busy host.
"""

import json
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from tests.conftest import few
from tests.damaged import restamped
from tests.recordings import EPOCH

from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.account import account
from flight_analysis.report.recorded_flight import read_flight
from flight_bringup.fly import fly_and_report
from flight_core.outcome import UNKNOWN, End, Outcome, ended_early
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_core.tape import Process, Recording, Tape
from flight_log.flight_processes import controller_starts
from flight_log.named_vectors import Samples, encoded, stamp_in
from flight_log.tape_reader import read_run

pytestmark = pytest.mark.slow

fewer = settings(few, max_examples=15)
LOOP = ("/y", "/y_m", "/u", "/internals", "/truth")
STAMPED = (*LOOP, "/pose")


class Sent(NamedTuple):
    """A message in the order of the recording, with times in ns."""

    topic: str
    log_ns: int
    number: int
    data: bytes


class Messages(list[Sent]):
    """A list of messages that a failing test does not print."""

    def __repr__(self) -> str:
        return f"{len(self)} messages"


def read_messages(log: Path) -> Messages:
    """Return the messages of a log with the time of day and the numbers of their publishers.

    A message is stored 1 ms after its stamp.
    """
    numbers: Counter[str] = Counter()
    messages = []
    with log.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            if channel.topic in STAMPED:
                numbers[channel.topic] += 1
                stamp_ns = EPOCH + stamp_in(message.data)
                data = restamped(message.data, stamp_ns)
                messages.append(
                    Sent(channel.topic, stamp_ns + 1_000_000, numbers[channel.topic], data)
                )
    return Messages(sorted(messages, key=lambda sent: sent.log_ns))


def write_messages(
    log: Path, copy: Path, messages: Sequence[Sent], *, attached: bool = True
) -> Path:
    """Write messages with the schemas and attachments of a log, in small chunks."""
    copy.parent.mkdir(parents=True, exist_ok=True)
    with log.open("rb") as source, copy.open("wb") as target:
        reader = make_reader(source)
        writer = Writer(target, chunk_size=30_000)
        writer.start(profile="ros2", library="damaged")
        for stored in reader.iter_attachments() if attached else ():
            writer.add_attachment(
                stored.log_time, stored.create_time, stored.name, stored.media_type, stored.data
            )
        summary = reader.get_summary()
        assert summary is not None
        channels = {}
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            identity = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.topic] = writer.register_channel(
                channel.topic, channel.message_encoding, identity
            )
        for sent in messages:
            writer.add_message(
                channels[sent.topic], sent.log_ns, sent.data, sent.log_ns, sent.number
            )
        writer.finish()  # type: ignore[no-untyped-call]
    return copy


@pytest.fixture(scope="module")
def numbered(recorded: Path) -> Messages:
    """Return the messages of a flight of two seconds."""
    return read_messages(recorded / "run_0.mcap")


def damaged(messages: list[Sent], kind: str, at: float, size: float, topic: str) -> list[Sent]:
    """Damage messages from a fraction `at` of the flight on, by a size in s."""
    begin_ns = EPOCH + nanoseconds(2.0 * at)
    end_ns = begin_ns + nanoseconds(size)
    leap_ns = nanoseconds(size)
    hit = {topic} if topic else {*STAMPED}
    stays = dict(
        zip(messages, np.random.default_rng(1).random(len(messages)) > at / 2.0, strict=True)
    )

    def is_hit(sent: Sent) -> bool:
        return sent.topic in hit

    def moved(sent: Sent, stamp_by: int, log_by: int) -> Sent:
        is_later = is_hit(sent) and sent.log_ns > begin_ns
        data = restamped(sent.data, stamp_in(sent.data) + stamp_by) if is_later else sent.data
        return sent._replace(log_ns=sent.log_ns + log_by * is_later, data=data)

    changes: dict[str, Callable[[], list[Sent]]] = {
        "cut": lambda: [sent for sent in messages if not (is_hit(sent) and sent.log_ns > begin_ns)],
        "begun late": lambda: [
            sent for sent in messages if not (is_hit(sent) and sent.log_ns < begin_ns)
        ],
        "hole": lambda: [
            sent for sent in messages if not (is_hit(sent) and begin_ns < sent.log_ns < end_ns)
        ],
        "thinned": lambda: [sent for sent in messages if not is_hit(sent) or stays[sent]],
        "unset": lambda: [
            sent._replace(data=restamped(sent.data, 0))
            if is_hit(sent) and begin_ns < sent.log_ns < end_ns
            else sent
            for sent in messages
        ],
        "stamps forth": lambda: [moved(sent, leap_ns, 0) for sent in messages],
        "stamps back": lambda: [moved(sent, -leap_ns, 0) for sent in messages],
        "clock forth": lambda: [moved(sent, leap_ns, leap_ns) for sent in messages],
        "clock back": lambda: [moved(sent, -leap_ns, -leap_ns) for sent in messages],
        "swapped": lambda: messages[len(messages) // 2 :] + messages[: len(messages) // 2],
        "twice": lambda: messages[: len(messages) // 2] * 2,
    }
    return changes[kind]()


LEAPS = ("stamps forth", "stamps back", "clock forth", "clock back")
KINDS = ("cut", "begun late", "hole", "thinned", "unset", *LEAPS, "swapped", "twice")


@fewer
@given(
    kind=st.sampled_from(KINDS),
    at=st.floats(0.05, 0.95),
    size=st.sampled_from([0.3, 0.5, 3.0, 3600.0]),
    topic=st.sampled_from(["", "", *STAMPED]),
)
def test_no_damage_of_a_log_is_told_as_a_busy_host(
    numbered: Messages,
    recorded: Path,
    tmp_path_factory: pytest.TempPathFactory,
    kind: str,
    at: float,
    size: float,
    topic: str,
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    log = write_messages(
        recorded / "run_0.mcap", folder / "run_0.mcap", damaged(numbered, kind, at, size, topic)
    )
    check(log)
    shutil.rmtree(folder)


@fewer
@given(
    at=st.floats(0.02, 0.98),
    size=st.sampled_from([1, 200, 5000]),
    kind=st.sampled_from(["cut", "inverted", "removed"]),
)
def test_no_damaged_byte_is_told_as_a_busy_host(
    numbered: Messages,
    recorded: Path,
    tmp_path_factory: pytest.TempPathFactory,
    at: float,
    size: int,
    kind: str,
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    log = write_messages(recorded / "run_0.mcap", folder / "run_0.mcap", numbered)
    content = log.read_bytes()
    place = int(at * len(content))
    middle = content[place : place + size]
    tail = content[place + size :]
    inverted = bytes(byte ^ 0x55 for byte in middle)
    log.write_bytes(
        content[:place] + {"cut": b"", "inverted": inverted + tail, "removed": tail}[kind]
    )
    check(log)
    shutil.rmtree(folder)


def told(log: Path) -> list[str]:
    """Return the headline of a log's outcome, followed by the sentences below it."""
    outcome = read_flight(log).summary["outcome"]
    return [outcome["sentence"], *outcome["details"]]


def check(log: Path) -> None:
    """Check that no sentence on a damaged log names a busy host.

    A share below 90 % must not be told as a success.
    """
    try:
        summary = read_flight(log).summary
    except ParameterError:
        return
    outcome = summary["outcome"]
    text = " ".join([outcome["sentence"], *outcome["details"], *summary["notes"]])
    assert "busy" not in text
    assert "never sent" not in text
    shares = [topic["share"] for topic in summary["account"]["topics"].values()]
    if any(share is not None and share < 0.9 for share in shares):
        assert summary["outcome"]["status"] != 0


def figures(summary: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a summary that depend on the time."""
    return {key: summary[key] for key in ("duration", "errors", "inputs", "transients", "ticks")}


@fewer
@given(
    at=st.floats(0.05, 0.95),
    topics=st.lists(st.sampled_from(STAMPED), min_size=2, max_size=2, unique=True),
    kinds=st.lists(st.sampled_from(("cut", "begun late", "hole", "thinned")), min_size=2),
    jumbled=st.booleans(),
)
def test_two_damages_of_a_log_are_not_told_as_a_busy_host(
    numbered: Messages,
    recorded: Path,
    tmp_path_factory: pytest.TempPathFactory,
    at: float,
    topics: list[str],
    kinds: list[str],
    jumbled: bool,
) -> None:
    """Two topics are damaged, also with neighbours swapped and a tenth of the messages repeated."""
    messages: list[Sent] = list(numbered)
    for kind, topic in zip(kinds, topics, strict=False):
        messages = damaged(messages, kind, at, 0.5, topic)
    if jumbled:
        order = np.arange(len(messages) - len(messages) % 2).reshape(-1, 2)[:, ::-1].ravel()
        messages = [messages[k] for k in order] + messages[: len(messages) // 10]
    folder = tmp_path_factory.mktemp("damaged")
    check(write_messages(recorded / "run_0.mcap", folder / "run_0.mcap", messages))
    shutil.rmtree(folder)


def test_log_that_begins_late_is_no_flight_that_began_late(
    numbered: Messages, recorded: Path, tmp_path: Path
) -> None:
    """The numbers of the ticks show that there were ticks before the log."""
    log = write_messages(
        recorded / "run_0.mcap",
        tmp_path / "run_0.mcap",
        damaged(numbered, "begun late", 0.75, 0.0, ""),
    )
    headline, *details = told(log)
    assert headline.startswith("completed, ")
    lack = "log incomplete: u 51 of 201 samples, begins at t = 1.500 of 2.000 s"
    assert any(lack in sentence for sentence in (headline, *details))


def test_short_hole_that_is_the_lack_is_named(
    numbered: Messages, recorded: Path, tmp_path: Path
) -> None:
    log = write_messages(
        recorded / "run_0.mcap", tmp_path / "run_0.mcap", damaged(numbered, "hole", 0.5, 0.4, "/y")
    )
    lack = "y 801 of 1001 samples, no sample from t = 0.998 to 1.400 s"
    assert any(lack in sentence for sentence in told(log))


@pytest.mark.parametrize("beside", ["summary.json", "outcome"])
def test_outcome_of_another_flight_beside_a_log_is_not_believed(
    beside: str, numbered: Messages, recorded: Path, tmp_path: Path
) -> None:
    """Neither a summary that names no flight nor the outcome of a launch is believed.

    They lie beside a log without an outcome, in a folder of another name.
    """
    half = damaged(numbered, "cut", 0.5, 0.0, "")
    log = write_messages(recorded / "run_0.mcap", tmp_path / "other" / "run_0.mcap", half)
    landed = Outcome(End.LANDED).as_json()
    content = json.dumps({"outcome": landed} if beside == "summary.json" else landed)
    (log.parent / beside).write_text(content)
    assert "landed" not in " ".join([*told(log), *told(log.parent)])


@pytest.mark.parametrize(
    "kind, by, pose",
    [
        ("stamps forth", 0.5, True),
        ("stamps forth", 3600.0, False),
        ("clock forth", 0.5, False),
        ("clock forth", 3600.0, True),
    ],
)
def test_leap_of_all_topics_is_told_and_figures_are_over_flight_time(
    kind: str, by: float, pose: bool, numbered: Messages, recorded: Path, tmp_path: Path
) -> None:
    """The figures of the log without the leap are the expected values, to the last digit."""
    messages = [sent for sent in numbered if pose or sent.topic != "/pose"]
    intact = read_flight(
        write_messages(recorded / "run_0.mcap", tmp_path / "intact" / "run_0.mcap", messages)
    ).summary
    log = write_messages(
        recorded / "run_0.mcap",
        tmp_path / "leap" / "run_0.mcap",
        damaged(messages, kind, 0.5, by, ""),
    )
    summary = read_flight(log).summary
    sentence = f"the clock of all stamps leaps forth by {by:.3f} s at t = 0.998 s"
    assert summary["outcome"]["sentence"] == f"completed; log incomplete: {sentence}"
    assert summary["notes"] == [f"{sentence}: later times are by the clock before the leap"]
    assert figures(summary) == figures(intact)
    result = replay(log)
    assert result.is_equal()
    assert result.is_compared.sum() == len(result.number) == 201


def test_pause_of_all_processes_is_no_leap_of_the_clock(
    numbered: Messages, recorded: Path, tmp_path: Path
) -> None:
    """Flight times of truth and the numbers go on after a pause, so the flight went on in it."""
    remaining = [
        sent
        for sent in numbered
        if not EPOCH + NANOSECONDS // 2 < sent.log_ns < EPOCH + 17 * NANOSECONDS // 10
    ]
    counts: Counter[str] = Counter()
    messages = []
    for sent in remaining:
        counts[sent.topic] += 1
        messages.append(sent._replace(number=counts[sent.topic]))
    log = write_messages(recorded / "run_0.mcap", tmp_path / "run_0.mcap", messages)
    summary = read_flight(log).summary
    assert (summary["outcome"]["end"], summary["outcome"]["details"]) == ("host", [])
    lack = "y 401 of 1001 samples, no sample from t = 0.498 to 1.700 s, 600 were never sent"
    assert lack in summary["account"]["lacks"]
    assert "this host is too busy: 600 of 1001 y were never sent" in summary["notes"][0]


def test_rate_of_another_aircraft_is_that_of_its_log(tape: Tape, osprey_gust: Scenario) -> None:
    """The samples of y at a fifth of 500 Hz have numbers without a gap.

    The log has the processes of a controller, and no aircraft.
    """
    signals = {name: tape[name] for name in ("y_m", "u", "internals")}
    every = np.arange(len(tape["y"].stamp_ns)) % 5 == 0
    signals["y"] = tape["y"].where(every)
    shifted = {name: Recording(0, lost=0) for name in signals}
    moved = {
        name: type(signal)(signal.stamp_ns + EPOCH, signal.names, signal.values)
        for name, signal in signals.items()
    }
    processes = {
        "/controller#7": Process(ready_ns=None, first_ns=EPOCH, last_ns=EPOCH, samples=201)
    }
    flight = Tape(
        moved, tape.start_ns + EPOCH, duration=2.0, recording=shifted, processes=processes
    )
    result = account(flight, osprey_gust)
    assert (result.topics["y"].expected, result.topics["y"].found) == (201, 201)
    assert (result.busy, result.lacks) == ("", ())


def test_simulated_flight_without_truth_lacks_it(
    numbered: Messages, recorded: Path, tmp_path: Path
) -> None:
    messages = [sent for sent in numbered if sent.topic != "/truth"]
    log = write_messages(recorded / "run_0.mcap", tmp_path / "run_0.mcap", messages)
    assert (
        read_flight(log).summary["outcome"]["sentence"]
        == "completed; log incomplete: truth 0 of 1001 samples"
    )


def test_ticks_of_less_than_nine_tenths_are_no_success(
    numbered: Messages, recorded: Path, tmp_path: Path
) -> None:
    """The controller leaves out every second tick, while its numbers go on."""
    ticks: Counter[str] = Counter()
    messages = []
    for sent in numbered:
        ticks[sent.topic] += 1
        if sent.topic not in {"/u", "/internals"} or ticks[sent.topic] % 2:
            messages.append(sent)
    log = write_messages(recorded / "run_0.mcap", tmp_path / "run_0.mcap", messages)
    assert any("u 101 of 201 samples" in sentence for sentence in told(log))


def test_ticks_of_another_controller_do_not_count_among_those_of_the_flight(
    recorded: Path, tmp_path: Path
) -> None:
    """A second controller sends forty ticks from t = 1 s on, and the nodes refuse them."""
    tape = read_run(recorded).tape
    nodes = dict.fromkeys(("u", "internals"), "/controller#7") | {"y_m": "/reference_model#8"}
    messages = []
    for name in ("y", "y_m", "truth", "u", "internals"):
        signal = tape[name]
        parts = [
            Samples(
                names=signal.names,
                stamp_ns=signal.stamp_ns + EPOCH,
                values=signal.values,
                sender=nodes.get(name, "/aircraft#9"),
            )
        ]
        if name in {"u", "internals"}:
            later_ns = signal.stamp_ns[:40] + EPOCH + NANOSECONDS + 1_000_000
            parts.append(
                Samples(
                    names=signal.names,
                    stamp_ns=later_ns,
                    values=signal.values[:40],
                    sender="/controller#10",
                )
            )
        for part in parts:
            rows = zip(part.stamp_ns.tolist(), encoded(part), strict=True)
            messages += [
                Sent(f"/{name}", stamp_ns + 1_000_000, number, row.tobytes())
                for number, (stamp_ns, row) in enumerate(rows, 1)
            ]
    messages.sort(key=lambda sent: sent.log_ns)
    log = write_messages(recorded / "run_0.mcap", tmp_path / "run_0.mcap", messages)
    summary = read_flight(log).summary
    assert summary["outcome"]["sentence"] == "completed"
    u = summary["account"]["topics"]["u"]
    assert (u["found"], u["expected"], u["repeated"]) == (201, 201, 0)
    assert summary["ticks"]["ticks"] == 201
    sentence = (
        "u, internals: samples of /controller#10, /controller#7: the figures are of the first"
    )
    assert summary["notes"][0].startswith(sentence)
    result = replay(log)
    assert result.is_equal()
    assert len(result.number) == 201


@pytest.mark.parametrize(
    "numbers, starts",
    [
        ([1, 2, 3, 4], []),
        ([41, 43, 42, 44], []),
        ([2, 1, 3, 4], []),
        ([1, 2, 3, 4, 5, 1, 2, 3], [5]),
        ([100, 101, 1, 2], [2]),
        ([1, 2, 3, 1, 2, 3, 1, 2], [3, 6]),
    ],
)
def test_another_controller_begins_where_its_numbers_are_there_again(
    numbers: list[int], starts: list[int]
) -> None:
    assert controller_starts(np.array(numbers, dtype=float)) == starts


def test_two_ticks_stored_in_reverse_replay_as_one_controller(recorded: Path) -> None:
    """The numbers tell the order of two ticks that the log has in reverse."""
    run = read_run(recorded)
    signal = run.tape["internals"]
    order = np.arange(len(signal.stamp_ns))
    order[[100, 101]] = order[[101, 100]]
    ages = signal.names.index("age")
    values = signal.values[order].copy()
    values[100, ages] = 0.0
    values[101, ages] = 0.0
    reversed_ticks = type(signal)(
        np.where(order == 101, signal.stamp_ns[101], signal.stamp_ns[order]), signal.names, values
    )
    tape = Tape({**run.tape.signals, "internals": reversed_ticks}, run.tape.start_ns)
    result = replay(run._replace(tape=tape))
    assert result.number.tolist() == list(range(1, 202))
    assert not any("another controller" in note for note in result.notes)


def test_note_on_another_controller_names_the_process(recorded: Path) -> None:
    run = read_run(recorded)
    signal = run.tape["internals"]
    values = signal.values.copy()
    column = signal.names.index("number")
    values[100:, column] -= 100.0
    begin_ns = int(signal.stamp_ns[100])
    processes = {
        "/controller#4": Process(ready_ns=0, first_ns=0, last_ns=begin_ns - 1, samples=100),
        "/controller#9": Process(ready_ns=0, first_ns=begin_ns, last_ns=begin_ns + 1, samples=101),
    }
    ticks = type(signal)(signal.stamp_ns, signal.names, values)
    tape = Tape({**run.tape.signals, "internals": ticks}, run.tape.start_ns, processes=processes)
    notes = replay(run._replace(tape=tape)).notes
    assert "another controller, /controller#9, begins at t = 1.00 s" in notes


def test_outcome_in_the_log_is_before_that_of_a_summary_beside(
    osprey_gust: Scenario, tmp_path: Path
) -> None:
    run = fly_and_report(osprey_gust.vary(flight={"duration": 0.5}), tmp_path).mcap.parent
    (run / "summary.json").write_text(
        json.dumps({"outcome": ended_early("another flight").as_json()})
    )
    assert str(read_run(run).tape.outcome) == "completed"
    assert read_flight(run).summary["outcome"]["sentence"] == "completed"


@pytest.mark.parametrize("later_by", [0, NANOSECONDS])
def test_summary_of_another_flight_is_not_believed(
    recorded: Path, numbered: Messages, tmp_path: Path, later_by: int
) -> None:
    """A log without an outcome takes the outcome of a summary only if it is of the same flight."""
    run = tmp_path / "run"
    log = write_messages(recorded / "run_0.mcap", run / "run_0.mcap", numbered)
    summary = read_flight(log).summary
    summary["flight"]["start_ns"] += later_by
    outcome = ended_early("aircraft was killed by SIGKILL")
    (run / "summary.json").write_text(json.dumps(summary | {"outcome": outcome.as_json()}))
    assert read_run(log).tape.outcome == UNKNOWN
    sentence = read_flight(log).summary["outcome"]["sentence"]
    assert (sentence == str(outcome)) is not bool(later_by)
    assert sentence.startswith("completed") is bool(later_by)


def test_scenario_beside_a_log_without_attachments_is_that_of_the_flight(run: Path) -> None:
    """The scenario and the parameters of the flight lie in the folder of the run."""
    path = run / "run_0.mcap"
    intact = read_flight(run).summary
    attached = read_run(run).scenario_file()
    (run / attached.name).write_bytes(attached.content)
    with path.open("rb") as stream:
        messages = [
            (channel.topic, message) for _, channel, message in make_reader(stream).iter_messages()
        ]
    heads = [
        Sent(topic, message.log_time, message.sequence, message.data) for topic, message in messages
    ]
    write_messages(path, run / "bare", heads, attached=False).replace(path)
    assert read_run(run).scenario == attached
    assert figures(read_flight(run).summary) == figures(intact)
