# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di fly`: what a flight has to say comes before what cannot be written after it."""

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import pytest
from tests.conftest import invoke

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report import run_folder
from flight_bringup.fly import fly_in_process
from flight_cli import fly, watch
from flight_core.outcome import STATUS_ENDED_EARLY, STATUS_SHORTFALL, Outcome, never_flew
from flight_core.parameters import ParameterError

Then = Callable[[Path], object]


def full(*_: object, **__: object) -> NoReturn:
    """A disk without space."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def flown(folder: Path, monkeypatch: pytest.MonkeyPatch, then: Then = lambda run: None) -> Any:
    """A flight after which the disk is full. `then` is called with its folder."""

    def fly_and_fill(scenario: Scenario, run: Path, *rest: Any) -> Outcome:
        outcome = fly_in_process(scenario, run, *rest)
        then(run)
        monkeypatch.setattr(run_folder, "write_file", full)
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
    monkeypatch.setattr(run_folder, "write_file", full)
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
    """On two cores a browser without a GPU took samples from the flight, on 16 none."""

    @contextmanager
    def watched(*runs: Path, fleet: bool) -> Iterator[list[str]]:
        yield ["page: http://127.0.0.1:8077", ""]

    monkeypatch.setattr(watch, "watched", watched)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(cores)))
    words = ["fly", "osprey_servo", "--watch", "--in-process", "--duration", "0.5"]
    result = invoke(*words, "--runs", str(tmp_path))
    assert (f"this host has {cores} cores: a browser" in result.stderr) is is_warned
