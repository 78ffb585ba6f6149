# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test `rise-di fly`: the result of a flight is printed even if nothing can be written after it."""

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import pytest
from tests.conftest import invoke

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report import run_report
from flight_bringup.fleet import Fleet
from flight_bringup.fly import fly_in_process
from flight_cli import fly, watch
from flight_core.outcome import STATUS_ENDED_EARLY, STATUS_SHORTFALL, Outcome, never_flew
from flight_core.parameters import ParameterError

Then = Callable[[Path], object]


def full(*_: object, **__: object) -> NoReturn:
    """Raise the error of a disk without space."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def flown(folder: Path, monkeypatch: pytest.MonkeyPatch, then: Then = lambda run: None) -> Any:
    """Fly until the disk is full. Then call `then` with the folder of the flight."""

    def fly_and_fill(scenario: Scenario, run: Path, *rest: Any) -> Outcome:
        outcome = fly_in_process(scenario, run, *rest)
        then(run)
        monkeypatch.setattr(run_report, "write_file", full)
        return outcome

    monkeypatch.setattr(fly, "fly_in_process", fly_and_fill)
    return fly_one_second(folder)


def fly_one_second(folder: Path) -> Any:
    words = ("fly", "osprey_gust", "--in-process", "--duration", "1", "--runs", str(folder))
    return invoke(*words)


def test_flight_whose_report_cannot_be_written_tells_its_outcome_and_then_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = flown(tmp_path, monkeypatch)
    assert result.exit_code == 0, "that of the flight"
    assert "outcome: completed\n" in result.stdout
    assert "q (deg/s)" in result.stdout
    assert "report: " not in result.stdout
    assert "error: no report: " in result.stderr
    assert "cannot be written (No space left on device)" in result.stderr


def test_flight_whose_log_ends_early_too_has_the_status_of_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut(run: Path) -> None:
        (log,) = run.glob("*.mcap")
        os.truncate(log, log.stat().st_size // 2)

    result = flown(tmp_path, monkeypatch, cut)
    assert result.exit_code == STATUS_SHORTFALL
    assert "outcome: completed" in result.stdout
    assert "log incomplete: " in result.stdout
    assert "error: no report: " in result.stderr


def test_flight_that_ended_before_the_first_sample_has_its_status_beside_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fly, "fly_in_process", lambda *_: never_flew("no y"))
    monkeypatch.setattr(run_report, "write_file", full)
    result = fly_one_second(tmp_path)
    assert result.exit_code == STATUS_ENDED_EARLY
    assert "error: never flew: no y, before the first sample" in result.stderr
    assert "error: no summary: " in result.stderr


def test_log_that_cannot_be_read_is_no_outcome(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreadable(*_: object) -> NoReturn:
        raise ParameterError("the log cannot be read")

    monkeypatch.setattr(fly, "write_report", unreadable)
    assert isinstance(fly_one_second(tmp_path).exception, ParameterError)


@pytest.mark.parametrize(("cores", "is_warned"), [(2, True), (16, False)])
def test_small_host_is_warned_of_a_browser_beside_the_flight(
    cores: int, is_warned: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On two cores a browser without a GPU makes the flight lose samples, and on 16 it does not."""

    @contextmanager
    def watched(*runs: Path, fleet: bool) -> Iterator[list[str]]:
        yield ["page: http://127.0.0.1:8077", ""]

    monkeypatch.setattr(watch, "watched", watched)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(cores)))
    words = ["fly", "osprey_servo", "--watch", "--in-process", "--duration", "0.5"]
    result = invoke(*words, "--runs", str(tmp_path))
    assert (f"this host has {cores} cores: a browser" in result.stderr) is is_warned


@pytest.fixture
def modes(monkeypatch: pytest.MonkeyPatch) -> list[tuple[bool, bool]]:
    """Return whether each flight was in lockstep and in one process. No flight uses topics."""
    flights: list[tuple[bool, bool]] = []

    def fly_topics(
        scenario: Scenario, run: Path, progress: Any, *, lockstep: bool, one_process: bool, **_: Any
    ) -> Outcome:
        flights.append((lockstep, one_process))
        return fly_in_process(scenario, run, progress)

    monkeypatch.setattr(fly, "_require_flyable", lambda *_, **__: None)
    monkeypatch.setattr(fly, "fly_over_topics", fly_topics)
    return flights


LOCKSTEP = (True, True)
REAL_TIME = (False, False)


@pytest.mark.parametrize(
    ("cores", "words", "mode", "is_told"),
    [
        (2.0, (), REAL_TIME, False),
        (0.5, (), LOCKSTEP, True),
        (0.5, ("--real-time",), REAL_TIME, False),
        (0.5, ("--lockstep",), (True, False), False),
        (0.5, ("--set", "flight.lockstep=true"), (True, False), False),
        # One process gets one share of a busy host.
        (0.5, ("--composed",), LOCKSTEP, True),
        (1.0, ("--composed",), (False, True), False),
        (0.5, ("--composed", "--real-time"), (False, True), False),
        # A simulator and a user have a time of their own.
        (0.5, ("--use-sim-time",), REAL_TIME, False),
        (0.5, ("--set", "controller.start_active=false"), REAL_TIME, False),
    ],
)
def test_flight_without_a_mode_is_in_real_time_where_the_host_can(
    cores: float,
    words: tuple[str, ...],
    mode: tuple[bool, bool],
    is_told: bool,
    modes: list[tuple[bool, bool]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fly, "cores_given", lambda processes: cores)
    result = invoke(
        "fly", "osprey_gust", *words, "--duration", "0.5", "--runs", str(tmp_path), "--json"
    )
    assert modes == [mode]
    sentences = [line for line in result.stderr.splitlines() if "this host" in line]
    assert len(sentences) == is_told
    if is_told:
        assert "cores that a flight in real time needs: flying in lockstep" in sentences[0]
        assert "--real-time" in sentences[0], "how to insist"


@pytest.mark.parametrize("words", [("--lockstep",), ("--in-process",), ("--use-sim-time",)])
def test_two_times_at_once_are_refused(words: tuple[str, ...], tmp_path: Path) -> None:
    result = invoke("fly", "osprey_gust", "--real-time", *words, "--runs", str(tmp_path))
    assert isinstance(result.exception, ParameterError)
    assert str(result.exception).startswith("--real-time: found ")


FLEET = "scenario: osprey_gust\nduration: 1.0\n"


@pytest.mark.parametrize(
    ("content", "cores", "words", "processes", "mode"),
    [
        ("aircraft: {one: {}, two: {}}", 3.0, (), [8], REAL_TIME),
        ("aircraft: {one: {}, two: {}}", 2.0, (), [8], LOCKSTEP),
        ("aircraft: {one: {}, two: {}}", 2.0, ("--real-time",), [], REAL_TIME),
        ("composed: true\naircraft: {one: {}, two: {}}", 2.0, (), [2], (False, True)),
        ("lockstep: true\naircraft: {one: {}, two: {}}", 0.1, (), [], (True, False)),
        ("use_sim_time: true\naircraft: {one: {}}", 0.1, (), [], REAL_TIME),
        # A later t = 0 needs a common time, which lockstep does not have.
        ("aircraft: {one: {}, two: {delay: 1.0}}", 2.0, (), [8], REAL_TIME),
    ],
)
def test_all_processes_of_a_fleet_count(
    content: str,
    cores: float,
    words: tuple[str, ...],
    processes: list[int],
    mode: tuple[bool, bool],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []
    flown: list[Fleet] = []

    def give(count: int) -> float:
        asked.append(count)
        return cores

    def fly_fleet(fleet: Fleet, runs: list[Path], *, as_json: bool) -> int:
        flown.append(fleet)
        return 0

    monkeypatch.setattr(fly, "cores_given", give)
    monkeypatch.setattr(fly, "fly_fleet_file", fly_fleet)
    path = tmp_path / "fleet.yaml"
    path.write_text(FLEET + content)
    result = invoke("fly", str(path), *words, "--runs", str(tmp_path))
    assert result.exit_code == 0
    assert asked == processes
    assert [(fleet.lockstep, fleet.composed) for fleet in flown] == [mode]
