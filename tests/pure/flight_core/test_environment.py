# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test environments in which no node can start.

Every command and every node says this in one sentence, with the mend.
"""

import resource
import shutil
import subprocess
import sys
import time
import timeit
from datetime import datetime
from pathlib import Path

import pytest
from tests.conftest import refusing

from flight_core import environment
from flight_core.environment import require_ros_environment

BAD_INPUT = 2
RISE_DI = [sys.executable, "-m", "flight_cli.cli"]
STARTS = {
    "fly": [*RISE_DI, "fly", "--duration", "1"],
    "guide": [*RISE_DI, "guide", "heading=90"],
    "engage": [*RISE_DI, "engage"],
    "node": [sys.executable, "-m", "rise_di_controller.main"],
}


@pytest.fixture(autouse=True)
def plain(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Set up an environment in which nodes can start."""
    for name in (
        "ROS_LOG_DIR",
        "ROS_HOME",
        "ROS_DOMAIN_ID",
        "RMW_IMPLEMENTATION",
        environment.PROFILE_VARIABLE,
    ):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))


def test_right_environment_passes_in_a_millisecond() -> None:
    """The time is the best of 5 means of 20 calls, because the host may be busy."""
    assert min(timeit.repeat(require_ros_environment, number=20, repeat=5)) / 20 < 1e-3


@pytest.mark.parametrize(
    "variables, sentence",
    [
        ({"HOME": ""}, r"ROS_LOG_DIR: found none and no HOME, expected .* ROS_LOG_DIR=FOLDER"),
        (
            {"ROS_LOG_DIR": "/proc/nope"},
            r"/proc/nope: cannot be written \(.*\), expected .* ROS_LOG_DIR=FOLDER",
        ),
        ({"ROS_DOMAIN_ID": "233"}, r"ROS_DOMAIN_ID: found '233', expected a number from 0 to 232"),
        (
            {"RCUTILS_LOGGING_USE_STDOUT": "5"},
            r"^RCUTILS_LOGGING_USE_STDOUT: found '5', expected 0, 1, or none$",
        ),
        (
            {"RMW_IMPLEMENTATION": "rmw_nope"},
            r"RMW_IMPLEMENTATION: found 'rmw_nope', expected one of .*rmw_fastrtps_cpp",
        ),
    ],
)
def test_variable_without_use_is_named(
    variables: dict[str, str], sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with refusing(sentence):
        require_ros_environment()


@pytest.mark.parametrize(
    "date",
    ["1969-12-31T23:59:59", "2038-01-18T03:14:08", "2038-01-20T00:00:00", "2107-01-01T00:00:00"],
)
def test_clock_beyond_the_stamps_of_ros_is_named(
    date: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """2^31 s is 2038-01-19T03:14:08 UTC, and the middleware then "cannot publish data"."""
    at = datetime.fromisoformat(f"{date}+00:00").timestamp()
    monkeypatch.setattr(time, "time", lambda: at)
    with refusing(rf"^system clock: found {date[:10]} .* to 2038-01-18 03:14 UTC.* --in-process$"):
        require_ros_environment()


def test_limit_of_open_files_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (12, 4096))
    with refusing(r"^ulimit -n: found 12 open files, expected 128 or more: ulimit -n 1024$"):
        require_ros_environment()


def test_log_folder_is_made_and_left_empty(tmp_path: Path) -> None:
    require_ros_environment()
    assert not list((tmp_path / ".ros" / "log").iterdir())


@pytest.mark.parametrize(
    "options, before, sentence",
    [
        (["--net"], "true", "error: 127.0.0.1: cannot be reached"),
        (
            ["--mount"],
            (
                "mount -t tmpfs -o size=1m tmpfs /dev/shm && ! dd if=/dev/zero of=/dev/shm/x "
                "bs=64k 2> /dev/null"
            ),
            "error: /dev/shm: found 0 bytes free",
        ),
    ],
)
def test_host_that_cannot_fly_is_told(
    options: list[str], before: str, sentence: str, tmp_path: Path
) -> None:
    pytest.importorskip("rclpy")
    if (unshare := shutil.which("unshare")) is None:
        pytest.skip("needs unshare")
    separate = [unshare, *options]
    if subprocess.run([*separate, "sh", "-c", before], check=False, capture_output=True).returncode:
        pytest.skip("needs the right to unshare")
    for start in ("fly", "node"):
        command = [*separate, "sh", "-c", f'{before} && exec "$@"', "sh", *STARTS[start]]
        result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert result.returncode == BAD_INPUT, result.stderr
        assert result.stderr.startswith(sentence)
        assert result.stderr.count("\n") == 1
