# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test `rise-di import --scenario`: a log of the exported module replays to the bit.

The log was recorded in PX4 SITL.
"""

import json
import shutil
from pathlib import Path

import pytest
from tests.conftest import REPOSITORY, invoke

from flight_cli.cli import application

app = application(["import", "replay"])


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Return a log with the topic rise_di_status alone, and its scenario.

    It has a take-over and a second of flight.
    """
    pytest.importorskip("pyulog", reason="pyulog is not installed: make autopilot")
    archive = REPOSITORY / "tests" / "recorded" / "px4_module.tar.xz"
    shutil.unpack_archive(archive, tmp_path, filter="data")
    return tmp_path / "px4_module" / "flight.ulg"


def test_flight_inside_px4_replays_to_the_bit(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(REPOSITORY)  # the scenario names its airframe from there
    scenario = str(log.parent / "rates.yaml")
    run = str(tmp_path / "run")
    options = ["import", str(log), "--scenario", scenario, "--output", run]
    imported = invoke(*options)
    assert imported.exit_code == 0, imported.output
    assert "239 of 239 ticks have the u of Python to the bit" in imported.output
    replayed = invoke("replay", run, "--json")
    assert replayed.exit_code == 0, replayed.output
    answer = json.loads(replayed.stdout)
    assert answer["differing"] == 0
    other = str(tmp_path / "other.yaml")
    text = Path(scenario).read_text("utf-8").replace("k_g: 22.0", "k_g: 22.5")
    Path(other).write_text(text, "utf-8")
    refused = invoke("import", log, "--scenario", other)
    assert refused.exit_code != 0


@pytest.mark.parametrize("options", [[], ["--map", "px4", "--scenario", "osprey_servo"]])
def test_import_takes_a_map_or_a_scenario(log: Path, options: list[str]) -> None:
    result = invoke("import", log, *options)
    assert result.exit_code == 2
    assert "--map MAP or --scenario SCENARIO" in result.output
