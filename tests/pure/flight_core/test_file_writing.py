# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that writing a file leaves the old content or the new, and never follows a link."""

import ast
import errno
import json
import os
import shutil
import stat
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from tests.conftest import refusing

from flight_analysis.report.run_folder import REPORT, SUMMARY
from flight_analysis.report.run_report import rewrite_report, write_report
from flight_cli.report import Report
from flight_core.files import replacing, write_file
from flight_core.outcome import COMPLETED
from flight_core.parameters import ParameterError

SOURCES = Path(__file__).resolve().parents[3] / "ros_ws" / "src"

OWN_WRITERS = {
    "flight_core/flight_core/files.py": "the door",
    "flight_core/flight_core/isolated.py": "the result of a subprocess, in its temporary folder",
    "aircraft_sim/aircraft_sim/jsbsim/jsbsim_files.py": "the copy of a model in a temporary folder",
    "flight_core/flight_core/scheduling.py": "a file of /proc",
    "flight_bringup/flight_bringup/fly.py": "the growing log of the learner, a new file",
    "flight_bringup/flight_bringup/processes.py": "the growing output of a process, a new file",
    "c_export/c_export/proof.py": "a program in a temporary folder",
    "flight_log/flight_log/open_log.py": "an unpacked log in a temporary folder",
    "flight_log/flight_log/vehicle_log.py": "the null device, for what a library prints",
    "rise_di/rise_di/own_airframe.py": "an airframe on trial in a temporary folder",
}


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_no_module_writes_by_itself() -> None:
    """All files are written by `flight_core.files`, except by the modules of OWN_WRITERS."""
    writers = set()
    for path in SOURCES.glob("*/*/**/*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                given = [value.value for value in node.args if isinstance(value, ast.Constant)]
                opens = node.func.attr in {"open", "fdopen"} and bool(
                    {"w", "wb", "x", "xb", "a", "ab"} & set(map(str, given))
                )
                if opens or node.func.attr in {"write_text", "write_bytes"}:
                    writers.add(str(path.relative_to(SOURCES)))
    assert writers == set(OWN_WRITERS)


def test_write_replaces_content_and_keeps_umask(tmp_path: Path) -> None:
    path = tmp_path / "page"
    write_file(path, "old")
    write_file(path, b"new")
    assert files_in(tmp_path) == {"page": b"new"}
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~mask


def test_failed_write_keeps_old_content(tmp_path: Path) -> None:
    path = tmp_path / "page"
    write_file(path, "old")

    def write_half() -> None:
        with replacing(path) as stream:
            stream.write(b"half of the ")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_half()
    assert files_in(tmp_path) == {"page": b"old"}


@pytest.mark.parametrize("target", ["file", "nothing"])
def test_link_is_replaced_not_followed(tmp_path: Path, target: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    path = tmp_path / "page"
    if target == "file":
        elsewhere.write_text("precious")
    path.symlink_to(elsewhere)
    write_file(path, "page")
    assert not path.is_symlink()
    assert path.read_text() == "page"
    assert elsewhere.exists() == (target == "file")
    if target == "file":
        assert elsewhere.read_text() == "precious"


@pytest.mark.parametrize("kind", ["folder", "pipe", "link to a device"])
def test_folders_and_devices_are_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "page"
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/null")
    with pytest.raises(OSError, match=r"Is a directory|No regular file"):
        write_file(path, "page")
    assert list(tmp_path.iterdir()) == [path]


CALLS: dict[str, Callable[..., Any]] = {
    "flight_core.files.os.fdopen": os.fdopen,
    "flight_core.files.os.fsync": os.fsync,
    "pathlib.Path.replace": Path.replace,
}


@pytest.mark.parametrize("name", CALLS)
def test_dying_report_loses_no_file(run: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """The disk is full at the n-th write of a report.

    Each file has its old or its new content, and the outcome is kept.
    """
    write_report(run, COMPLETED)
    (run / REPORT).write_text("an older page")
    before = files_in(run)
    survived = 0
    for n in count(1):
        numbers = count(1)

        def call(*arguments: object, last: int = n, numbers: "count[int]" = numbers) -> object:
            if next(numbers) == last:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return CALLS[name](*arguments)

        with monkeypatch.context() as patch:
            patch.setattr(name, call)
            try:
                rewrite_report(run)
            except ParameterError as error:
                assert "No space left on device" in str(error)  # noqa: PT017 - the last report succeeds
            else:
                break
        after = files_in(run)
        assert set(after) == set(before)
        assert json.loads(after[SUMMARY])["outcome"]["end"] == "completed"
        assert after[REPORT] == b"an older page"
        survived += 1
    assert survived == 2  # summary and page; the scenario is written once, by the flight
    assert (run / REPORT).stat().st_size > 100_000


def test_report_of_links_writes_nothing_elsewhere(run: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    precious = outside / "precious"
    precious.write_text("precious")
    (run / "osprey_gust.yaml").unlink(missing_ok=True)
    (run / "osprey_gust.yaml").symlink_to(outside / "dangling")
    (run / SUMMARY).symlink_to(precious)
    (run / REPORT).symlink_to(precious)
    rewrite_report(run)
    assert files_in(outside) == {"precious": b"precious"}


def test_report_of_read_only_archive_goes_to_output(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files_in(run)
    Report(runs=[run], output=tmp_path / "pages" / "today").execute()
    assert files_in(run) == before
    assert {SUMMARY, REPORT, "osprey_gust.yaml"} == set(files_in(tmp_path / "pages" / "today"))
    assert "pages/today/report.html" in capsys.readouterr().out
    with refusing("output: found a comparison, expected one run"):
        Report(runs=[run, run], output=tmp_path / "pages").execute()


def test_scenario_parsed_before_any_file_written(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("osprey_gust.yaml", SUMMARY, REPORT):
        (run / name).unlink(missing_ok=True)
    log = next(run.glob("*.mcap"))
    other = shutil.copy(log, run.parent / "log")
    content = Path(other).read_bytes()
    assert content.count(b"/**/controller:") > 0
    # in its attachments, which are not compressed
    log.write_bytes(content.replace(b"/**/controller:", b"/**/controllex:"))
    before = set(files_in(run))
    with pytest.raises(ParameterError):
        rewrite_report(run)
    assert set(files_in(run)) == before
