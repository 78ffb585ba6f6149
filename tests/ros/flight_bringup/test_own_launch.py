# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the launch file of docs/ros.md with nodes of the user, by the official launch.

launch and launch_ros are not on PyPI. .ci/ros has them.
"""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tests.conftest import REPOSITORY
from tests.ros.waiting import until

from flight_bringup.processes import end_with_parent
from flight_log.tape_reader import read_run

pytest.importorskip("launch_ros.actions", reason="launch_ros is not on PyPI")
pytestmark = pytest.mark.timeout(120)

PAGE = (REPOSITORY / "docs" / "ros.md").read_text()
LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
service = LaunchService()
source = PythonLaunchDescriptionSource("my.launch.py")
service.include_launch_description(LaunchDescription([IncludeLaunchDescription(source)]))
sys.exit(service.run())
"""


def test_launch_file_of_page_flies_an_aircraft_and_a_reference_model_of_ones_own(
    tmp_path: Path,
) -> None:
    programs = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    names = ("my_aircraft.py", "my_reference.py", "my.launch.py")
    for name, program in zip(names, programs, strict=True):
        (tmp_path / name).write_text(program)
    (parameters,) = re.findall(r"^    (printf .* > my_params\.yaml)$", PAGE, re.MULTILINE)
    subprocess.run(["/bin/bash", "-c", parameters], cwd=tmp_path, check=True)
    packages = ":".join(map(str, (REPOSITORY / "ros_ws" / "install").glob("*/")))
    prefix = f"{packages}:{os.environ.get('AMENT_PREFIX_PATH', sys.prefix)}"
    with (tmp_path / "out.txt").open("wb") as output:
        process = subprocess.Popen(
            [*end_with_parent(), sys.executable, "-c", LAUNCH],
            cwd=tmp_path,
            env={**os.environ, "AMENT_PREFIX_PATH": prefix},
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        until(lambda: "flight completed" in (tmp_path / "out.txt").read_text(), "a flight")
        until(lambda: "messages in" in (tmp_path / "out.txt").read_text(), "a closed log")
        assert process.poll() is None  # the nodes are not the flight's
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(timeout=30)
    (run,) = (tmp_path / "runs").glob("*-osprey_servo")
    recorded = read_run(run)
    assert recorded.namespace == "/uav7"
    assert b"delay: 0.02" in recorded.scenario_file().content
    # The reference model began at the t = 0 of the flight, which lasted 5 s from there.
    assert recorded.tape.time("y_m")[-1] == pytest.approx(5.0, abs=0.5)
    q, reference = (abs(recorded.tape[topic]["q"]).max() for topic in ("y", "y_m"))
    assert q > 0.7 * reference > 0.0  # without control q would stay 0
