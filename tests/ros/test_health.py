# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The health check of the containers tells a node that works from one that hangs, and from one that is not there."""

import signal
import subprocess
import sys
from pathlib import Path

from tests.ros.conftest import Start

from flight_analysis.closed_loop.scenario import Scenario

HEALTH = Path(__file__).resolve().parents[2] / "docker" / "health.py"


def check(*names: str) -> tuple[int, str]:
    done = subprocess.run([sys.executable, str(HEALTH), *names], capture_output=True, text=True, timeout=30, check=False)
    return done.returncode, done.stdout


def test_a_node_that_works_is_healthy_and_one_that_hangs_is_not(start: Start, osprey_gust: Scenario) -> None:
    recorder = start("flight_recorder.main", "--ros-args", "--params-file", str(osprey_gust.path))
    recorder.wait_for("ready")
    assert check()[0] == 0
    status, said = check("recorder")
    assert status == 0
    assert "recorder: recording to" in said
    status, said = check("pilot")
    assert status == 1
    assert "no report of pilot" in said
    recorder.popen.send_signal(signal.SIGSTOP)
    assert check("recorder")[0] == 1
    recorder.popen.send_signal(signal.SIGCONT)
    recorder.interrupt()
    assert recorder.end() == 0
