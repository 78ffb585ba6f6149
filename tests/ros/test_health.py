# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Health check of the containers: a running node passes, a suspended and a missing node fail."""

import signal
import subprocess
import sys
from pathlib import Path

from tests.ros.conftest import Start

from flight_analysis.closed_loop.scenario import Scenario

HEALTH = Path(__file__).resolve().parents[2] / "docker" / "health.py"


def check(*names: str) -> tuple[int, str]:
    result = subprocess.run([sys.executable, str(HEALTH), *names], capture_output=True, text=True, timeout=30, check=False)
    return result.returncode, result.stdout


def test_a_running_node_is_healthy_and_a_suspended_or_missing_one_is_not(start: Start, osprey_gust: Scenario) -> None:
    recorder = start("flight_recorder.main", "--ros-args", "--params-file", str(osprey_gust.path))
    recorder.wait_for("ready")
    assert check()[0] == 0
    status, output = check("recorder")
    assert status == 0
    assert "recorder: recording to" in output
    status, output = check("absent")
    assert status == 1
    assert "no report of absent" in output
    recorder.popen.send_signal(signal.SIGSTOP)
    assert check("recorder")[0] == 1
    recorder.popen.send_signal(signal.SIGCONT)
    recorder.interrupt()
    assert recorder.end() == 0
