# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test a control law of another package over real DDS.

In lockstep it is equal to the loop in one process, and it is replayed.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.conftest import invoke
from tests.other_laws import EXAMPLE, SECTIONS
from tests.recordings import require_equal_bits
from tests.ros.conftest import Start
from tests.ros.flight_bringup.test_lockstep import TOPICS, payloads

from flight_analysis.closed_loop.scenario import load_scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_log.tape_reader import read_run
from rise_di_controller import laws

OPTIONS = {"lockstep": ["--lockstep"], "composed": ["--lockstep", "--composed"]}
PULSES = {
    "q": {"start": [0.2], "stop": [1.0], "value": [0.1]},
    "p": {"start": [0.4], "stop": [1.4], "value": [0.4]},
}


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder into which pip installs a copy of the example.

    Pip leaves build artefacts beside the source.
    """
    copy = tmp_path_factory.mktemp("source") / "pid_law"
    target = tmp_path_factory.mktemp("installed")
    shutil.copytree(
        EXAMPLE, copy, ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__")
    )
    options = (
        "--quiet",
        "--no-index",
        "--no-deps",
        "--no-build-isolation",
        "--target",
        str(target),
    )
    subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, str(copy)], check=True, timeout=120.0
    )
    return target


@pytest.fixture
def _example(installed: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Make the installed example available in this process and in those that it starts."""
    path = os.environ.get("PYTHONPATH")
    monkeypatch.setenv("PYTHONPATH", f"{installed}{os.pathsep}{path}" if path else str(installed))
    monkeypatch.syspath_prepend(str(installed))
    laws._registered.cache_clear()
    yield
    laws._registered.cache_clear()


def scenario_file(path: Path, controller: dict[str, Any]) -> Path:
    """Return a second of a scenario with commands, lost samples and another controller."""
    tree = yaml.safe_load(find_scenario("osprey_servo").path.read_text())
    sections = {
        name.removeprefix("/**/"): section["ros__parameters"] for name, section in tree.items()
    }
    sections["flight"]["duration"] = 1.0
    sections["reference_model"]["pulses"] = PULSES
    sections["aircraft"]["sensors"]["dropout"] = 0.2
    sections["controller"].clear()
    sections["controller"].update(controller)
    path.write_text(yaml.safe_dump(tree))
    return path


@pytest.mark.usefixtures("_example")
def test_law_of_another_package_flies_in_lockstep_as_without_ros_and_replayed(
    start: Start, tmp_path: Path
) -> None:
    """The law flies in four processes and in one.

    tests/nodes/flight_bringup/test_lockstep.py flies the other laws.
    """
    scenario = scenario_file(tmp_path / "pid.yaml", SECTIONS["pid"])
    runs = []
    for folder, options in OPTIONS.items():
        start("flight_cli.cli", "fly", str(scenario), *options, "--runs", str(folder)).succeed()
        runs.append(tmp_path / folder / "latest")
    first = payloads(runs[0])
    for payload in map(payloads, runs[1:]):
        for topic in TOPICS:
            assert first[topic] == payload[topic], topic
    tape = simulate(load_scenario(scenario))
    recorded = read_run(runs[0]).tape
    assert tape["u"].values.any(axis=0).all()
    require_equal_bits(recorded, tape)
    replay = invoke("replay", runs[0])
    assert replay.exit_code == 0
    assert replay.stdout.startswith("101 ticks, every bit equal\naircraft.sensors.dropout: ")
