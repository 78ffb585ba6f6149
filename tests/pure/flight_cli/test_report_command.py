# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test `rise-di report` for one or several runs, as page, figure, table and JSON."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import typer
from tests.conftest import refusing

from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report import recorded_flight, run_report
from flight_analysis.report.recorded_flight import read_flight
from flight_analysis.report.run_folder import new_run
from flight_analysis.report.run_report import write_report
from flight_analysis.report.summary import empty_summary
from flight_bringup.fly import fly_in_process
from flight_cli.report import Report
from flight_cli.runs import Runs
from flight_core.outcome import COMPLETED, STATUS_ENDED_EARLY, UNKNOWN, ended_early
from flight_core.rates import NANOSECONDS
from flight_log.engagements import Engagement
from flight_log.log_messages import LogMessage
from flight_log.tape_reader import read_run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return two flights of two seconds with different scenarios."""
    folder = tmp_path_factory.mktemp("runs")
    runs = []
    for name in ("osprey_gust", "osprey_servo"):
        scenario = find_scenario(name, 2.0)
        run = new_run(scenario, folder)
        write_report(run, fly_in_process(scenario, run, lambda t, output: None))
        runs.append(run)
    return runs


def test_one_run_as_figure_tables_and_json(
    runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    png, csv, parquet = (tmp_path / f"run.{suffix}" for suffix in ("png", "csv", "parquet"))
    Report(runs=runs[:1], png=png, csv=csv, parquet=parquet, as_json=True).execute()
    assert json.loads(capsys.readouterr().out) == json.loads((runs[0] / "summary.json").read_text())
    assert png.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert csv.read_bytes()[:8] == b"stamp_ns"
    assert parquet.read_bytes()[:4] == b"PAR1"


def test_runs_are_listed_with_their_outcome_and_a_killed_one_with_its_mend(
    runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for run in runs:
        shutil.copytree(run, tmp_path / run.name)
    (tmp_path / runs[1].name / "summary.json").unlink()  # killed before its report
    (tmp_path / "notes").mkdir()
    (tmp_path / "latest").symlink_to(runs[0].name)
    Runs(folder=tmp_path, as_json=True).execute()
    rows = json.loads(capsys.readouterr().out)
    assert [Path(row["run"]).name for row in rows] == sorted(
        (run.name for run in runs), reverse=True
    )
    by_name = {Path(row["run"]).name: row for row in rows}
    whole = by_name[runs[0].name]
    assert (whole["scenario"], whole["outcome"]) == ("osprey_gust", "completed")
    assert whole["duration"] == pytest.approx(2.0, abs=0.01)
    assert "rise-di report" in by_name[runs[1].name]["outcome"]
    Runs(folder=tmp_path).execute()
    assert "osprey_gust" in capsys.readouterr().out
    Runs(folder=tmp_path / "notes").execute()
    assert "rise-di fly records one" in capsys.readouterr().out


@pytest.mark.parametrize(
    "terminal, display, words, is_opened",
    [
        (True, ":0", {}, True),
        (True, "", {}, False),
        (False, ":0", {}, False),
        (True, ":0", {"as_json": True}, False),
        (True, ":0", {"opens": False}, False),
        (False, "", {"opens": True}, True),
    ],
)
def test_report_opens_by_itself_for_somebody_at_a_desktop(
    terminal: bool,
    display: str,
    words: dict[str, bool],
    is_opened: bool,
    run: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pages: list[str] = []
    monkeypatch.setattr("webbrowser.open", pages.append)
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal, raising=False)
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    Report(runs=[run], **words).execute()  # type: ignore[arg-type]
    assert pages == [(run / "report.html").absolute().as_uri()] * is_opened


def test_engagement_shorter_than_sample_leaves_figures_of_flight(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = read_run(run)
    instant = int(log.tape["y"].stamp_ns[5]) + 1  # between two samples
    monkeypatch.setattr(
        recorded_flight,
        "read_run",
        lambda *_: log._replace(engagements=[Engagement(instant, instant + 1, "lost")]),
    )
    summary = read_flight(run, COMPLETED).summary
    assert summary["duration"] > 1.0
    assert summary["notes"][0].endswith("s: lost")
    assert summary["notes"][1] == "the figures are of the whole flight: no y while engaged"


def test_two_runs_are_compared(
    runs: list[Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    before = (runs[0] / "report.html").read_bytes()
    Report(runs=runs, html=Path("two.html")).execute()
    output = capsys.readouterr().out
    assert "2 flights compared" in (tmp_path / "two.html").read_text()
    assert f"1: {runs[0].name}, completed" in output
    assert "settling" not in output  # the terminal shows errors only
    assert output.splitlines()[-1] == "report:  two.html"
    assert (runs[0] / "report.html").read_bytes() == before
    Report(runs=runs, as_json=True).execute()
    assert [report["scenario"] for report in json.loads(capsys.readouterr().out)] == [
        "osprey_gust",
        "osprey_servo",
    ]
    (first,) = runs[0].parent.glob("*-comparison*/comparison.html")
    page = first.read_bytes()
    Report(runs=[*runs]).execute()
    # The page of an earlier comparison stays.
    assert first.read_bytes() == page
    pages = sorted(runs[0].parent.glob("*-comparison*/comparison.html"))
    assert len(pages) == 2
    last = Path(capsys.readouterr().out.splitlines()[-1].partition("report:")[2].strip())
    assert last.resolve() in [each.resolve() for each in pages]
    assert last.resolve() != first.resolve()


def test_flight_that_hung_before_y_m_is_told_with_its_cause(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nodes that were started by hand have a log without an outcome.

    `rise-di runs` then knows the outcome from the log.
    """
    log = read_run(run)
    waits = "uav7.controller: waiting for /uav7/y_m: no sample of its publisher arrives"
    messages = (
        LogMessage(
            stamp_ns=0,
            kind="warning",
            text="uav7.controller: waiting for /uav7/y: no publisher",
        ),
        *(LogMessage(stamp_ns=k * NANOSECONDS, kind="warning", text=waits) for k in (2, 4, 6)),
    )
    tape = replace(log.tape, signals={"y": log.tape["y"]}, outcome=UNKNOWN)
    monkeypatch.setattr(
        run_report, "read_run", lambda *_: log._replace(tape=tape, messages=messages)
    )
    with pytest.raises(typer.Exit) as end:
        Report(runs=[run]).execute()
    assert end.value.exit_code == STATUS_ENDED_EARLY
    error = capsys.readouterr().err.strip()
    with refusing(f"{run}: found no sample of internals among .*; {waits}"):
        replay(log._replace(tape=tape, messages=messages))
    assert error.startswith(f"error: {run}: the log: found no sample of y_m, expected ")
    assert error.endswith(f"; {waits}")
    assert "no publisher" not in error  # y came later
    Runs(folder=run.parent, as_json=True).execute()
    (row,) = json.loads(capsys.readouterr().out)
    assert row["outcome"].startswith("never flew: the controller never engaged; uav7.controller")


def test_tolerance_of_unknown_channel_and_of_a_single_run_is_refused(
    runs: list[Path], tmp_path: Path
) -> None:
    page = tmp_path / "page.html"
    with refusing("tolerances: found 'w', expected one of"):
        Report(runs=runs, html=page, tolerance=["w=0.1"]).execute()
    with refusing("tolerances: found a single run, expected several runs"):
        Report(runs=runs[:1], tolerance=["q=0.1"]).execute()
    Report(runs=runs, html=page, tolerance=["q=0.1"]).execute()
    assert "5.73" in page.read_text()  # 0.1 rad/s in deg/s


@pytest.mark.parametrize("option", ["html", "csv"])
def test_file_that_cannot_be_written_is_one_sentence(runs: list[Path], option: str) -> None:
    nowhere: dict[str, Any] = {option: Path("/proc/none/file")}
    with refusing(f"^{option}: /proc/none/file cannot be written "):
        Report(runs=runs[:1], **nowhere).execute()


def test_flight_without_samples_has_summary_with_same_keys(runs: list[Path]) -> None:
    empty = empty_summary(find_scenario("osprey_gust"), ended_early("no progress"))
    assert empty.keys() == json.loads((runs[0] / "summary.json").read_text()).keys()


def test_folder_in_the_place_of_the_link_to_the_run_is_refused_before_the_flight(
    tmp_path: Path,
) -> None:
    (tmp_path / "latest").mkdir()
    with refusing("latest: found a file or folder, expected none: this name is for a link"):
        new_run(find_scenario("osprey_gust"), tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["latest"]
