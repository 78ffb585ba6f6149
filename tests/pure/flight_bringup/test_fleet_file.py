# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the files of fleets: what each aircraft flies, and what is refused."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import pytest
from tests.conftest import invoke

from flight_bringup.fleet import Fleet, MemberFlight, read_fleet
from flight_cli import fleet
from flight_core.outcome import COMPLETED, Outcome
from flight_core.parameters import ParameterError

FLEET = """
duration: 3.0
set: {aircraft: {wind: [2.0, -1.0], turbulence: {seed: 7}}}
aircraft:
  uav1: {}
  uav2: {start: {north: 50.0, heading: 0.5}, delay: 1.5, set: {controller: {k_g: 2.5}}}
  uav3: {route: there.yaml}
"""
FLEET_OF_TWO = "aircraft: {one: {}, two: {}}"


def fleet_file(folder: Path, text: str) -> Path:
    file = folder / "fleet.yaml"
    file.write_text(text)
    return file


def test_aircraft_share_what_fleet_sets_and_keep_what_is_their_own(tmp_path: Path) -> None:
    (tmp_path / "there.yaml").write_text("route: [[0, 400, 10], [400, 400, 10]]\n")
    first, second, third = read_fleet(fleet_file(tmp_path, FLEET)).members
    for member in (first, second, third):
        assert member.scenario.aircraft.wind == (2.0, -1.0)
        assert member.scenario.aircraft.turbulence is not None
        # The limits are those of osprey_route.
        assert (
            member.scenario.aircraft.turbulence.seed,
            member.scenario.aircraft.turbulence.wind,
        ) == (7, 7.7)
        assert member.scenario.flight.duration == 3.0
    assert (
        second.delay,
        second.scenario.aircraft.start.north,
        second.scenario.aircraft.start.heading,
    ) == (1.5, 50.0, 0.5)
    assert first.scenario.rise_di().k_g != second.scenario.rise_di().k_g == 2.5
    assert third.scenario.guidance is not None
    assert third.scenario.guidance.route is not None
    assert third.scenario.guidance.route.east == (400.0, 400.0)


@pytest.mark.parametrize("node", ["/blue/controller#2", "/stray#2", "/green/stray#2"])
def test_samples_of_node_outside_of_aircraft_are_counted(node: str) -> None:
    def summary_of(*nodes: str) -> dict[str, Any]:
        return {"account": {"processes": {name: {"samples": 3} for name in nodes}}}

    own = "/red/controller#1"
    blue = summary_of("/blue/controller#2")
    assert fleet.foreign_samples({"red": summary_of(own), "blue": blue}) == [
        "samples from outside of the aircraft: 0 of 6"
    ]
    assert fleet.foreign_samples({"red": summary_of(own, node), "blue": blue}) == [
        "red: 3 samples from outside of /red"
    ]


@pytest.fixture
def without_ros(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    for name in ("require_package", "require_ros_environment"):
        monkeypatch.setattr(fleet, name, lambda *words: None)
    return monkeypatch


@pytest.mark.parametrize("words", [["fly"], ["fly", "osprey_gust", "--in-process"]])
def test_interrupt_before_flight_leaves_no_folder(
    words: list[str], without_ros: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def interrupted_watch(*runs: Path, **options: Any) -> NoReturn:
        assert all(run.is_dir() for run in runs)
        raise KeyboardInterrupt

    without_ros.setattr("flight_cli.watch.watched", interrupted_watch)
    file = [str(fleet_file(tmp_path, FLEET_OF_TWO))] if words == ["fly"] else []
    arguments = [*words, *file, "--watch", "--runs", str(tmp_path / "runs")]
    assert invoke(*arguments).exit_code == 130
    assert list((tmp_path / "runs").iterdir()) == []


def test_interrupt_of_reports_shows_what_was_flown(
    without_ros: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fly_at_once(
        fleet_file: Fleet, runs: Sequence[Path], progress: object
    ) -> list[MemberFlight]:
        return [
            MemberFlight(member, run, COMPLETED)
            for member, run in zip(fleet_file.members, runs, strict=True)
        ]

    def refuse_report(run: Path, outcome: Outcome) -> NoReturn:
        raise ParameterError("no sample") if "-one-" in run.name else KeyboardInterrupt

    without_ros.setattr(fleet, "fly_fleet", fly_at_once)
    without_ros.setattr(fleet, "write_report", refuse_report)
    arguments = [
        "fly",
        str(fleet_file(tmp_path, FLEET_OF_TWO)),
        "--runs",
        str(tmp_path / "runs"),
        "--json",
    ]
    result = invoke(*arguments)
    assert result.exit_code == 130
    outcomes = {
        name: summary["outcome"]["sentence"] for name, summary in json.loads(result.stdout).items()
    }
    assert outcomes["one"] == "never flew: no sample"
    assert outcomes["two"] == "completed, no report: rise-di report writes it"
