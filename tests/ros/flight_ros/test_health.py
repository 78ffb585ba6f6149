# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the health check of the containers, which fails for a suspended or missing node."""

import subprocess
import sys

from tests.conftest import REPOSITORY
from tests.ros.conftest import Start
from tests.ros.waiting import HANG

HEALTH = REPOSITORY / "docker" / "health.py"


def check(*names: str) -> tuple[int, str]:
    result = subprocess.run(
        [sys.executable, str(HEALTH), *names],
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    return result.returncode, result.stdout


def test_running_node_is_healthy_and_suspended_or_missing_one_is_not(start_node: Start) -> None:
    recorder = start_node("flight_recorder").wait_for("ready")
    assert check()[0] == 0
    status, output = check("recorder")
    assert status == 0
    assert "recorder: recording to" in output
    status, output = check("absent")
    assert status == 1
    assert "no report of absent" in output
    with recorder.stopped():
        assert check("recorder")[0] == 1
    recorder.interrupt().succeed()
