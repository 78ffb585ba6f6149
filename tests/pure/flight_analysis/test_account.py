# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the account of a flight says what a log lacks.

Every command says so, and no figure covers more than was recorded.
"""

import json
import math
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from rich.console import Console
from tests.conftest import refusing
from tests.damaged import DAMAGES, Damage, damage
from tests.recordings import EPOCH

import rise_di
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.metrics.errors import error_metrics
from flight_analysis.metrics.time_spans import sample_times
from flight_analysis.report.account import Account, account
from flight_analysis.report.disturbances import command_edges
from flight_analysis.report.html import write_page
from flight_analysis.report.recorded_flight import read_flight
from flight_analysis.report.sample_counts import TopicAccount
from flight_analysis.report.shortfalls import judge
from flight_analysis.report.summary import (
    RecordedFlight,
    command_results,
    coverage_suffix,
    summarise,
)
from flight_analysis.report.tables import EventInterval, flight_tables
from flight_bringup.fleet import Member, MemberFlight
from flight_bringup.fly import fly_and_report
from flight_cli.fleet import _AircraftResult as FleetResult
from flight_cli.fleet import _show as show_fleet
from flight_cli.output import show_flight
from flight_cli.replay import Replay
from flight_cli.report import Report
from flight_core.modes import Mode
from flight_core.outcome import COMPLETED, STATUS_SHORTFALL, End
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_core.tape import Process, Recording, Signal, Tape
from flight_log.clock import StampClock
from flight_log.flight_processes import SampleSpan, flight_processes
from flight_log.rosbag2_metadata import METADATA, bag_files
from flight_view.flight import Flight

pytestmark = pytest.mark.slow

TOPICS = ("y", "y_m", "u", "internals", "truth", "pose")
TABLES = ("errors", "inputs", "ticks")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the log of two seconds in one process, with the first command of the scenario.

    There is a sample of y every 5 ms, so that the log is read quickly.
    """
    scenario = find_scenario("osprey_gust").vary(
        flight={"duration": 2.0},
        aircraft={"rate": 200.0, "step": 0.005},
        reference_model={"rate": 200.0},
    )
    return fly_and_report(scenario, tmp_path_factory.mktemp("runs")).mcap


@pytest.fixture(scope="module")
def figures(whole: Path) -> dict[str, Any]:
    """Return the summary of the whole log."""
    return read_flight(whole.parent).summary


def replayed(log: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """Return what `rise-di replay --json` prints."""
    with pytest.raises(typer.Exit) as end:
        Replay(run=log, as_json=True).execute()
    assert end.value.exit_code in {0, 1, STATUS_SHORTFALL}
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


def test_whole_log_lacks_nothing(
    whole: Path, figures: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    """Count the samples by hand: 200 Hz, 100 Hz and 50 Hz over two seconds, with both ends."""
    assert (figures["outcome"]["sentence"], figures["notes"], figures["account"]["lacks"]) == (
        "completed",
        [],
        [],
    )
    counts = {name: topic["expected"] for name, topic in figures["account"]["topics"].items()}
    assert counts == {
        "y": 401,
        "y_m": 401,
        "truth": 401,
        "u": 201,
        "internals": 201,
        "pose": 101,
    }
    assert [coverage_suffix(figures, table) for table in TABLES] == ["", "", ""]
    result = replayed(whole, capsys)
    assert (result["checked"], result["ticks"], result["expected"], result["notes"]) == (
        201,
        201,
        201,
        [],
    )


@pytest.mark.parametrize("name", DAMAGES)
@pytest.mark.parametrize("topic", TOPICS)
def test_every_command_says_what_log_lacks(
    topic: str,
    name: str,
    whole: Path,
    figures: dict[str, Any],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Half of the logs have flight times. Those of y_m, u and truth have the time of day."""
    since = EPOCH * (topic in {"y_m", "u", "truth"})
    log = damage(
        whole, tmp_path / "damaged" / "damaged_0.mcap", f"/{topic}", DAMAGES[name], from_ns=since
    )
    if topic in {"y", "y_m"} and name == "stamps are zero":
        with refusing(f"found no sample of {topic} with a stamp, expected a flight with y and y_m"):
            read_flight(log)
        return
    summary = read_flight(log).summary
    shortfalls = [each["sentence"] for each in summary["outcome"]["shortfalls"]]
    assert any(sentence.startswith(f"log incomplete: {topic} ") for sentence in shortfalls)
    for table in TABLES:
        if json.dumps(summary[table]) != json.dumps(figures[table]):
            assert coverage_suffix(summary, table).startswith(", over ")
    flight = Flight(log)
    while flight.update():
        pass
    flight.counted()
    assert any(topic in sentence for sentence in flight.faults())
    if since or (topic == "internals" and "zero" in name):
        return  # a replay takes its time, and needs the times of the ticks
    result = replayed(log, capsys)
    assert any(note.startswith(f"the log lacks {topic} ") for note in result["notes"])
    if topic == "internals":
        assert result["checked"] < result["expected"] == 201


def test_report_prints_part_beside_figures(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = damage(whole, tmp_path / "run" / "run_0.mcap", "/truth", DAMAGES["ends at a third"])
    with pytest.raises(typer.Exit) as end:
        Report(runs=[log], csv=tmp_path / "run.csv", png=tmp_path / "run.png").execute()
    assert end.value.exit_code == STATUS_SHORTFALL
    output = " ".join(capsys.readouterr().out.split())
    assert "Tracking error (true error), 2.0 s flown, over 33 % of truth" in output
    assert (
        "outcome: completed; log incomplete: truth 133 of 401 samples, ends at t = 0.660 of "
        "2.000 s" in output
    )
    assert "over 33 % of truth" in (log.parent / "report.html").read_text()


def test_replay_claims_no_tick_without_its_u(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = damage(whole, tmp_path / "run" / "run_0.mcap", "/u", DAMAGES["ends at a third"])
    with pytest.raises(typer.Exit):
        Replay(run=log).execute()
    output = capsys.readouterr().out
    assert output.startswith("67 of 201 ticks checked, every bit equal\n")
    assert "note: 134 ticks have no sample on the topic u: what was sent is not compared" in output


@pytest.mark.parametrize(
    "begin, outcome",
    [(0.5, "completed"), (1.9, "never flew: the first u came at t = 1.900 of 2.000 s")],
)
def test_flight_counts_from_its_first_u(
    begin: float, outcome: str, tape: Tape, osprey_gust: Scenario
) -> None:
    """A flight is counted from its first u.

    The controller may first have received many y that were too old.
    """
    late = {name: tape[name] for name in ("y", "y_m", "truth")} | {
        "u": tape["u"].where(tape.time("u") >= begin)
    }
    flight = Tape(late, duration=2.0)
    flight_account = account(flight, osprey_gust)
    assert str(judge(COMPLETED, flight, osprey_gust, flight_account)).startswith(outcome)


def test_number_of_the_first_tick_tells_that_u_came_before_the_log(
    tape: Tape, osprey_gust: Scenario
) -> None:
    """Tick 191 is the first in the log, so the law had already flown.

    The log has no u and no `internals` before 1.9 s.
    """
    late = {name: tape[name].where(tape.time(name) >= 1.9) for name in ("u", "internals")}
    signals = {name: tape[name] for name in ("y", "y_m", "truth")} | late
    flight = Tape(signals, duration=2.0)
    outcome = judge(COMPLETED, flight, osprey_gust, account(flight, osprey_gust))
    assert outcome.end is End.COMPLETED
    assert [shortfall.sentence for shortfall in outcome.shortfalls] == [
        f"log incomplete: {name} 11 of 201 samples, begins at t = 1.900 of 2.000 s"
        for name in ("u", "internals")
    ]


@pytest.mark.parametrize("share, named", [(0.005, False), (0.02, True), (0.1, True), (0.5, True)])
def test_clock_that_stands_now_and_then_is_named(
    share: float, named: bool, tape: Tape, osprey_gust: Scenario
) -> None:
    """A hundredth of the samples may have the instant of the sample before.

    Every sample has an instant of its own. If more than a hundredth repeat one, the clock is at
    fault, and not the recorder.
    """
    y = tape["y"]
    stamp_ns = y.stamp_ns.copy()
    every = round(1.0 / share)
    stamp_ns[every::every] = stamp_ns[every - 1 :: every][: len(stamp_ns[every::every])]
    count = int(np.count_nonzero(np.diff(stamp_ns) == 0))
    stood = replace(tape, signals={**tape.signals, "y": replace(y, stamp_ns=stamp_ns)})
    sentence = f"{count} samples with the stamp of the sample before"
    lacks = account(stood, osprey_gust).lacks
    assert any(sentence in lack for lack in lacks if lack.startswith("y ")) is named


@pytest.mark.parametrize("topic", ["y", "u"])
def test_replay_covers_no_tick_without_its_sample(topic: str, tape: Tape) -> None:
    """A tick whose y or u is missing is not compared.

    A twentieth of the samples is missing, so 95 % of the ticks are compared.
    """
    signal = tape[topic]
    keep = ~np.isin(signal.stamp_ns, tape["internals"].stamp_ns[10::20])
    result = replay(replace(tape, signals={**tape.signals, topic: signal.where(keep)}))
    assert result.is_equal()
    assert result.is_compared.mean() == pytest.approx(0.95, abs=0.01)
    assert result.checked.mean() > 0.98
    assert any(f"no sample on the topic {topic}" in note for note in result.notes)


def test_replay_without_some_y_is_incomplete(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = damage(whole, tmp_path / "run" / "run_0.mcap", "/y", DAMAGES["ends at a third"])
    with pytest.raises(typer.Exit) as end:
        Replay(run=log).execute()
    assert end.value.exit_code == STATUS_SHORTFALL
    assert "have no sample on the topic y: y taken from internals" in capsys.readouterr().out


@pytest.mark.parametrize(
    "of_y, lost, lacks",
    [("without", 0, True), ("with", 0, True), ("without", 1, True), ("after", 0, False)],
    ids=[
        "log ends with y and pose",
        "pose alone is missing",
        "messages were lost",
        "pose goes on after the end",
    ],
)
def test_samples_that_busy_host_withheld_are_no_lack_of_log(
    of_y: str, lost: int, lacks: bool, tape: Tape, osprey_gust: Scenario
) -> None:
    """Samples that a busy host never sent are not missing from the log.

    The case is the last 0.1 s of a flight in real time. The numbers of the messages show whether
    the pose was sent.
    """
    begin_ns = NANOSECONDS * 1_795_000_000
    until = 1.8 if of_y == "after" else 2.0
    withheld = ("y", "truth", "pose") if of_y == "without" else ("pose",)
    signals = {}
    for name in ("y", "y_m", "u", "truth", "pose"):
        t = tape.time(name)
        of = tape[name].where((t < 1.7) | (t > until)) if name in withheld else tape[name]
        signals[name] = replace(of, stamp_ns=of.stamp_ns - tape.start_ns + begin_ns)
    recording = {name: Recording(0, lost=lost) for name in signals}
    lacking = account(Tape(signals, begin_ns, duration=1.8, recording=recording), osprey_gust).lacks
    assert any(lack.startswith("pose ") for lack in lacking) == lacks


def foreign_flight(rate: float, ticks_held: slice) -> Tape:
    """Return ten seconds of a foreign aircraft whose timer has a jitter of 0.3 ms.

    The controller runs at 100 Hz and publishes u at each tick with a new y.
    """
    rng = np.random.default_rng(3)
    y_t = np.arange(0.0, 10.0, 1.0 / rate)
    y_t += rng.normal(0.0, 3e-4, len(y_t))
    tick_t = np.arange(0.004, 10.0, 0.01)
    newest = np.searchsorted(y_t, tick_t - 5e-4, side="right") - 1
    newest_before = np.concatenate([[-1], newest[:-1]])
    is_new = newest > newest_before
    stamp_ns = EPOCH + np.round(y_t * NANOSECONDS).astype(np.int64)
    u_ns = stamp_ns[newest[is_new]]
    number = np.arange(1.0, len(u_ns) + 1.0)
    age = tick_t[is_new] - y_t[newest[is_new]]
    internals = np.column_stack([number, age, np.full(len(number), float(Mode.ENGAGED))])
    signals = {
        "y": Signal(stamp_ns, ("q",), np.zeros((len(stamp_ns), 1))),
        "u": Signal(u_ns, ("elevator",), np.zeros((len(u_ns), 1))).where(
            np.isin(np.arange(len(u_ns)), np.arange(len(u_ns))[ticks_held])
        ),
        "internals": Signal(u_ns, ("number", "age", "mode"), internals),
    }
    recording = {name: Recording(len(signal.stamp_ns), lost=0) for name, signal in signals.items()}
    processes = {
        "my_aircraft": Process(
            ready_ns=EPOCH, first_ns=EPOCH, last_ns=int(stamp_ns[-1]), samples=len(stamp_ns)
        )
    }
    return Tape(signals, EPOCH, recording=recording, processes=processes)


@pytest.mark.parametrize("rate", [20.0, 70.0, 100.0, 110.0, 500.0])
def test_u_of_a_foreign_aircraft_is_judged_by_the_ticks_with_a_new_y(
    rate: float,
) -> None:
    """With continuous numbers of the ticks, u is complete at any rate of y.

    Half of u is not.
    """
    osprey_servo = find_scenario("osprey_servo")
    every_tick = account(foreign_flight(rate, slice(None)), osprey_servo).topics["u"]
    assert every_tick.is_enough(every_tick.found)
    every_other = account(foreign_flight(rate, slice(None, None, 2)), osprey_servo).topics["u"]
    assert every_other.share == pytest.approx(0.5, abs=0.02)


def test_missing_part_of_bag_is_named(whole: Path, tmp_path: Path) -> None:
    run = shutil.copytree(whole.parent, tmp_path / "run")
    metadata = (run / METADATA).read_text()
    name = bag_files(run)[0].name
    (run / METADATA).write_text(
        metadata.replace(
            f"relative_file_paths:\n  - {name}",
            f"relative_file_paths:\n  - {name}\n  - part_1.mcap",
        ),
    )
    assert "part_1.mcap" in (run / METADATA).read_text()
    summary = read_flight(run).summary
    assert summary["notes"][0].startswith("part_1.mcap: named in metadata.yaml and missing")
    assert (
        summary["outcome"]["sentence"]
        == "completed; log incomplete: part_1.mcap: named in metadata.yaml and missing"
    )


@pytest.mark.parametrize(
    "found, expected, whole", [(96, 97, True), (95, 97, False), (1, 2, True), (0, 1, False)]
)
def test_one_missing_sample_is_no_lack_of_short_topic(
    found: int, expected: int, whole: bool
) -> None:
    """A share of 99 % is enough, and so is one missing sample.

    The last tick of a flight may come after its end.
    """
    topic = TopicAccount(
        expected=expected,
        found=found,
        first=0.0,
        last=0.97,
        gap=0.01,
        gap_at=0.5,
        repeated=0,
        unset=0,
        step=0.0,
        left_out=0,
        unsent=0,
    )
    assert topic.is_enough(found) == whole
    assert (Account(0.97, {"u": topic}, ()).over("u") == "") == whole


def stamps(*parts: range) -> Iterator[Any]:
    """Yield the stamps, ns, that samples of 100 Hz have by their numbers."""
    yield from (np.array(part, dtype=np.int64) * (NANOSECONDS // 100) for part in parts)


def test_stray_messages_are_no_step_of_clock() -> None:
    """Old stamps of a second publisher are no step of the clock.

    A step is between successive messages.
    """
    first, second = stamps(range(1000, 1200), range(1, 201))
    stamp_ns = np.stack([first, second], axis=1).ravel()
    clock = StampClock()
    keep, count = clock.usable(stamp_ns, np.repeat(first, 2), more=False, end=True)
    assert keep.all()
    assert (count, clock.recording().step_ns) == (400, 0)


@pytest.mark.parametrize("damaged", [[0], [40], [199], [40, 41, 42]])
@pytest.mark.parametrize("by", [-5 * NANOSECONDS, 2**62], ids=["back", "forth"])
def test_samples_with_damaged_stamps_are_left_out_alone(damaged: list[int], by: int) -> None:
    """Only the samples with a damaged stamp are left out, because the clock goes on after them."""
    (log_ns,) = stamps(range(1000, 1200))
    stamp_ns = log_ns.copy()
    stamp_ns[damaged] += by
    clock = StampClock()
    keep, _ = clock.usable(stamp_ns, log_ns, more=False, end=True)
    assert np.flatnonzero(~keep).tolist() == damaged
    assert (clock.recording().unset, clock.recording().step_ns) == (len(damaged), 0)


@pytest.mark.parametrize("late", [0.6, 3.0])
def test_first_sample_that_a_busy_recorder_stored_late_before_a_pause_stays(late: float) -> None:
    """The next sample comes 0.6 s after the first one was stored, and is stored at once."""
    (log_ns,) = stamps(range(1000, 1200))
    stamp_ns = log_ns.copy()
    log_ns[0] = log_ns[1] - nanoseconds(0.6)
    stamp_ns[0] = log_ns[0] - nanoseconds(late)
    clock = StampClock()
    keep, _ = clock.usable(stamp_ns, log_ns, more=False, end=True)
    assert keep.all()
    assert clock.recording().unset == 0


@pytest.mark.parametrize("size", [400, 60])
@pytest.mark.parametrize("live", [0, 100])
def test_pause_in_history_of_publisher_is_no_step_of_clock(live: int, size: int) -> None:
    """A pause within stored history is no step of the clock.

    A recorder that joins late stores 3 s of history at once. The publisher paused for 0.6 s in this
    history, and `live` samples come later. If the log continues in between, the same pause is a
    step.
    """
    (stamp_ns,) = stamps(range(1000, 1300))
    stamp_ns[200:] += nanoseconds(0.6)
    late_ns = np.maximum(stamp_ns, stamp_ns[-1 - live])
    (live_ns,) = stamps(range(1000, 1300))
    steps_ns = []
    for log_ns in (late_ns, live_ns):
        clock = StampClock()
        for first in range(0, 300, size):
            part = slice(first, first + size)
            clock.usable(stamp_ns[part], log_ns[part], more=False, end=first + size >= 300)
        steps_ns.append(clock.recording().step_ns)
    assert steps_ns == [0, nanoseconds(0.61)]


def test_clock_step_is_found_across_batches() -> None:
    stamp_ns = np.concatenate([*stamps(range(1000, 1100), range(900, 1000))])
    log_ns = np.concatenate([*stamps(range(1000, 1200))])
    clock = StampClock()
    count_taken = 0
    usable = 0
    while count_taken < len(stamp_ns):
        end = min(count_taken + 15, len(stamp_ns))
        more = end < len(stamp_ns)
        keep, count = clock.usable(
            stamp_ns[count_taken:end], log_ns[count_taken:end], more=more, end=not more
        )
        count_taken = count_taken + count
        usable = usable + int(keep.sum())
    of = clock.recording()
    assert (usable, of.found, of.left_out, of.step_ns) == (100, 200, 100, -199 * NANOSECONDS // 100)


def test_channel_of_scenario_that_y_does_not_have_is_a_lack(
    tape: Tape, osprey_gust: Scenario
) -> None:
    y = tape["y"]
    renamed = Signal(y.stamp_ns, ("pitch_rate", *y.names[1:]), y.values)
    assert account(replace(tape, signals={**tape.signals, "y": renamed}), osprey_gust).lacks == (
        f"{y.names[0]} of y",
    )


def test_samples_before_the_flight_stand_for_none_of_the_flight(
    tape: Tape, osprey_gust: Scenario
) -> None:
    early = replace(tape["u"], stamp_ns=tape["u"].stamp_ns - 1000 * NANOSECONDS)
    of = account(
        replace(tape, signals={**tape.signals, "u": early}, scenario=osprey_gust), osprey_gust
    )
    assert of.topics["u"].found == 0


def test_rms_is_weighted_by_time() -> None:
    """A second with e = 1 is followed by a second with e = 3 that lacks nine tenths of its samples.

    By hand, the rms is sqrt((1 + 9) / 2).
    """
    t = np.concatenate([np.arange(0.0, 1.0, 0.001), np.arange(1.0, 2.0, 0.01)])
    e = np.where(t < 1.0, 1.0, 3.0)
    times = sample_times(np.round(t * 1e9).astype(np.int64))
    assert error_metrics(e, times).rms == pytest.approx(5.0**0.5, rel=5e-3)
    assert error_metrics(e).rms < 1.4


def test_process_has_ready_time_of_its_own_start() -> None:
    """A process has the ready time of its own start, even if a namesake was killed before.

    There are controllers of two aircraft, and a recorder without samples.
    """
    second = NANOSECONDS
    ready = [
        ("/recorder", 1),
        ("/one/controller", 2),
        ("/controller", 3 * second),
        ("/controller", 40 * second),
    ]
    spans = {
        "/controller#9": SampleSpan(first_ns=10 * second, last_ns=30 * second, samples=2000),
        "/controller#4": SampleSpan(first_ns=41 * second, last_ns=60 * second, samples=1900),
        "": SampleSpan(first_ns=0, last_ns=1, samples=2),  # of ros2 topic pub
    }
    assert flight_processes(spans, ready, "") == {
        "/controller#9": Process(
            ready_ns=3 * second, first_ns=10 * second, last_ns=30 * second, samples=2000
        ),
        "/controller#4": Process(
            ready_ns=40 * second, first_ns=41 * second, last_ns=60 * second, samples=1900
        ),
        "/recorder": Process(ready_ns=1, first_ns=None, last_ns=None),
        "a publisher without a name": Process(ready_ns=None, first_ns=0, last_ns=1, samples=2),
    }
    assert (
        flight_processes({"": SampleSpan(first_ns=0, last_ns=1, samples=2)}, [], "") == {}
    )  # in one process


def test_processes_of_a_lockstep_flight_have_their_samples_and_no_time_of_day(
    whole: Path, figures: dict[str, Any]
) -> None:
    """Nodes in lockstep have no process id, and a recorder that sends nothing is not listed."""
    ready = [("/recorder", EPOCH), ("/controller", EPOCH), ("/aircraft", EPOCH)]
    spans = {
        "/controller": SampleSpan(first_ns=0, last_ns=2 * NANOSECONDS, samples=402),
        "/aircraft": SampleSpan(first_ns=0, last_ns=2 * NANOSECONDS, samples=1001),
        "/stray": SampleSpan(first_ns=0, last_ns=1, samples=3),
    }
    processes = flight_processes(spans, ready, "")
    assert processes["/controller"] == Process(
        ready_ns=EPOCH, first_ns=0, last_ns=2 * NANOSECONDS, samples=402
    )
    assert processes["/recorder"] == Process(ready_ns=EPOCH, first_ns=None, last_ns=None)
    flight = read_flight(whole)
    tape = replace(flight.tape, processes=processes)
    found = account(tape, find_scenario("osprey_gust")).processes
    assert {name: tuple(each) for name, each in found.items()} == {
        "/controller": (None, 0.0, 2.0, 402),
        "/aircraft": (None, 0.0, 2.0, 1001),
        "/stray": (None, 0.0, 1e-9, 3),
    }
    content = {name: each._asdict() for name, each in found.items()}
    summary = figures | {"account": figures["account"] | {"processes": content}}
    # The page says nothing of processes that have no time of their own.
    captions = [each.caption for each in flight_tables(summary, flight.units, [])]
    assert "Processes" not in captions
    assert figures["latency"] is None


def test_recorder_in_the_hosts_time_has_no_number_of_samples() -> None:
    """A recorder sends no samples, and a zero would say that it should have sent some."""
    ready = [("/recorder", EPOCH), ("/controller", EPOCH)]
    spans = {"/controller#7": SampleSpan(first_ns=EPOCH, last_ns=EPOCH + NANOSECONDS, samples=200)}
    processes = flight_processes(spans, ready, "")
    assert processes["/recorder"].samples is None
    assert processes["/controller#7"].samples == 200


def test_summary_counts_commands_of_flight(figures: dict[str, Any]) -> None:
    """The flight ends at 2.0 s, when the first command of the scenario begins."""
    edges = command_edges(find_scenario("osprey_gust"))
    assert figures["account"]["commands"] == {
        "given": len(edges),
        "flown": 1,
        "targets": 0,
        "taken": 0,
    }
    assert command_results(figures) == f"1 of {len(edges)} commands flown"
    assert figures["account"]["processes"] == {}  # of a flight in one process


PARTS_HELD: Mapping[str, tuple[str, Damage, float]] = {
    "cut at half": ("", DAMAGES["ends in the middle"], 0.5),
    "without a third": ("", DAMAGES["without a third"], 2.0 / 3.0),
    "thinned y": ("/y", DAMAGES["every second sample"], 0.5),
}


@pytest.mark.parametrize("name", PARTS_HELD)
def test_python_says_over_which_part_its_figures_are(
    whole: Path, tmp_path: Path, name: str
) -> None:
    topic, change, holds = PARTS_HELD[name]
    run = rise_di.read_run(damage(whole, tmp_path / "damaged.mcap", topic, change))
    assert run.account.topics["y"].share == pytest.approx(holds, abs=0.01)
    counts = run.account.topics["y"]
    assert f"the log lacks y {counts.found} of {counts.expected} samples" in " ".join(
        run.tape.notes
    )
    kind, _ = rise_di.best_error(run.tape)
    percent = math.floor(100.0 * run.account.topics["y_m"].share)
    assert kind == (
        "true error" if topic else f"true error, over {percent} % of truth, {percent} % of y_m"
    )
    notes = rise_di.summarise(run.tape, rise_di.recorded_scenario(run))["notes"]
    assert len(notes) == len(set(notes))


def test_python_says_nothing_of_a_log_that_lacks_nothing(whole: Path) -> None:
    run = rise_di.read_run(whole)
    assert run.tape.notes == ()
    assert run.account.lacks == ()
    assert rise_di.best_error(run.tape)[0] == "true error"


@pytest.fixture(scope="module")
def half(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> RecordedFlight:
    """Return a flight with a learned model whose log ends in the middle of a failsafe."""
    run = tmp_path_factory.mktemp("half") / "run"
    flight = read_flight(damage(whole, run / "run_0.mcap", "", DAMAGES["ends in the middle"]))
    rms = dict.fromkeys(flight.summary["errors"], 0.1)
    models = [{"name": "file", "model": 1, "start": 0.0, "stop": 1.0, "rms": rms}]
    return flight._replace(summary=flight.summary | {"models": models})


def test_every_table_of_the_page_says_its_share(half: RecordedFlight) -> None:
    """Each table with figures of the flight says which share of it the figures cover.

    The samples of a process and the margins are not figures of the flight.
    """
    events = [EventInterval("gust", 0.0, 1.0, "1 s")]
    tables = flight_tables(half.summary, half.units, events)
    captions = [table.caption for table in tables]
    assert len(captions) >= 5
    assert all("over 49 % of " in caption for caption in captions), captions


def test_every_line_of_the_commands_says_its_share(
    half: RecordedFlight, capsys: pytest.CaptureFixture[str]
) -> None:
    show_flight(Console(width=200), half)
    # a title that is longer than its table is folded
    printed = " ".join(capsys.readouterr().out.split())
    for heading in re.finditer("Tracking|Inputs|Rms|commands flown|Ticks|y sent|age of u", printed):
        assert "over 49 % of " in printed[heading.start() : heading.start() + 200]
    assert len(re.findall("over 49 % of (?:truth|y|u|internals)", printed)) >= 5


def test_comparison_says_the_share_of_each_flight(
    half: RecordedFlight, whole: Path, tmp_path: Path
) -> None:
    flights = [half, read_flight(whole)]
    write_page(tmp_path / "page.html", flights)
    assert "(true error, over 49 % of truth" in (tmp_path / "page.html").read_text()


def test_fleet_says_the_share_of_the_ticks_engaged(
    half: RecordedFlight,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert half.scenario is not None
    member = MemberFlight(Member("two", half.scenario), tmp_path, COMPLETED)
    show_fleet("pair", [member], {"two": FleetResult(summary=half.summary, engaged=0.9365)})
    assert "93.65 %, over 49 % of internals" in capsys.readouterr().out


def test_note_on_the_modes_says_the_share_of_the_ticks(half: RecordedFlight) -> None:
    signal = half.tape["internals"]
    values = signal.values.copy()
    values[-20:, signal.names.index("mode")] = Mode.HOLD
    signal_held = replace(signal, values=values)
    tape = replace(half.tape, signals={**half.tape.signals, "internals": signal_held})
    notes = summarise(tape, half.scenario)["notes"]
    assert any("HOLD in 20% of the ticks, over 49 % of internals:" in note for note in notes)
