# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test how close the aircraft of a fleet came to each other.

The results are compared with distances that are computed by hand.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.recorded_flight import read_flight
from flight_analysis.report.separation import (
    PLACE,
    SEPARATION,
    Track,
    approach,
    place_of,
    separation_shortfalls,
)
from flight_bringup.fleet import Fleet, Member, MemberFlight, read_fleet
from flight_bringup.fly import fly_and_report
from flight_cli import fleet as module
from flight_core.outcome import COMPLETED, Aim, Outcome, read_outcome
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape

EPOCH = 1_700_000_000 * NANOSECONDS


def path(
    place: Callable[[float], Sequence[float]],
    rate: float = 50.0,
    begin: float = 0.0,
    end: float = 20.0,
    since_ns: int = EPOCH,
) -> Signal:
    """Return the places of an aircraft over time in s."""
    t = np.arange(round((end - begin) * rate) + 1) / rate + begin
    values = np.array([place(instant) for instant in t.tolist()], dtype=float)
    return Signal(since_ns + np.round(t * NANOSECONDS).astype(np.int64), PLACE, values)


def north(t: float) -> Sequence[float]:
    """Return the place of an aircraft that flies to the north at 25 m/s."""
    return 25.0 * t - 250.0, 0.0, 100.0


@pytest.mark.parametrize("rate", [50.0, 10.0, 1.0, 0.7])
@pytest.mark.parametrize("miss", [0.0, 5.0, 30.0])
def test_two_aircraft_that_cross_are_nearest_between_two_samples(rate: float, miss: float) -> None:
    """Two aircraft approach each other at 50 m/s and pass at t = 10 s, whatever the rates are."""
    second = path(lambda t: (250.0 - 25.0 * t, miss, 100.0), rate)
    found = approach(path(north), second)
    assert found is not None
    assert found.distance == pytest.approx(miss, abs=1e-5)
    assert (found.at_ns - EPOCH) / NANOSECONDS == pytest.approx(10.0, abs=1e-3)


def test_height_counts() -> None:
    above = path(lambda t: (*north(t)[:2], 140.0))
    found = approach(path(north), above)
    assert found is not None
    assert found.distance == pytest.approx(40.0)


@pytest.mark.parametrize("begin, end, near", [(20.5, 30.0, False), (15.0, 30.0, True)])
def test_aircraft_are_compared_while_both_fly(begin: float, end: float, near: bool) -> None:
    there = path(lambda t: (250.0, 1.0, 100.0), begin=begin, end=end)
    found = approach(path(north), there)
    assert (found is not None and found.distance < 2.0) == near
    if not near:
        assert found is None


def tracks(*places: Signal, **origins: tuple[float, ...]) -> dict[str, Track]:
    """Return tracks named a, b, ... that begin at EPOCH."""
    return {
        name: Track(EPOCH, place, origins.get(name))
        for name, place in zip("abcdef", places, strict=False)
    }


def test_each_aircraft_that_came_near_has_a_shortfall_with_its_figures() -> None:
    beside = path(lambda t: (north(t)[0], 10.0 + abs(t - 8.0), 100.0))
    far = path(lambda t: (north(t)[0], 500.0, 100.0))
    found = separation_shortfalls(tracks(path(north), beside, far), SEPARATION)
    assert {*found} == {"a", "b"}
    assert all(each.aim is Aim.SEPARATION for each in found.values())
    assert found["a"].sentence == "10 m from b at t = 8.00 s, 22 m asked"
    assert found["b"].sentence == "10 m from a at t = 8.00 s, 22 m asked"
    assert found["a"].figures == {
        "other": "b",
        "distance": pytest.approx(10.0),
        "time": pytest.approx(8.0),
        "least": 22.0,
        "count": 1,
    }
    assert separation_shortfalls(tracks(path(north), beside, far), 9.0) == {}


def test_swarm_in_one_place_is_no_success() -> None:
    found = separation_shortfalls(tracks(*[path(north)] * 5), SEPARATION)
    assert {*found} == {*"abcde"}
    assert found["c"].sentence.endswith(", nearer than that to 4 aircraft")
    assert separation_shortfalls(tracks(*[path(north)] * 5), 0.0) == {}


def test_maps_of_different_origins_are_not_compared() -> None:
    places = [path(north)] * 3
    here, there = (47.0, 8.0, 400.0), (48.0, 9.0, 400.0)
    found = separation_shortfalls(tracks(*places, a=here, b=there, c=here), SEPARATION)
    assert {*found} == {"a", "c"}


def test_true_place_goes_before_the_measured_one() -> None:
    measured = path(lambda t: (*north(t)[:2], 180.0))
    true = path(north)
    names = tuple(f"pose.{name}" for name in true.names)
    both = Tape({"pose": measured, "truth": Signal(true.stamp_ns, names, true.values)})
    found = place_of(both)
    assert found is not None
    assert np.array_equal(found.values, true.values)
    time = Signal(true.stamp_ns, ("t",), np.zeros((len(true.stamp_ns), 1)))
    alone = place_of(Tape({"pose": measured, "truth": time}))
    assert alone is not None
    assert np.array_equal(alone.values, measured.values)
    assert place_of(Tape({"truth": time})) is None


def test_shortfall_is_kept_by_a_record_of_the_outcome_and_no_other_one_is() -> None:
    shortfall = separation_shortfalls(tracks(path(north), path(north)), SEPARATION)["a"]
    record = json.loads(json.dumps(Outcome(COMPLETED.end, "", (shortfall,)).as_json()))
    record["shortfalls"].append({"aim": "route", "sentence": "legs 1 not flown", "figures": {}})
    kept = read_outcome(record)
    assert [each.aim for each in kept.shortfalls] == [Aim.SEPARATION]
    assert kept.status == 4
    assert read_outcome({"end": "completed", "reason": "", "shortfalls": "x"}) == COMPLETED


@pytest.mark.parametrize("apart, status", [(15.0, 4), (60.0, 0)])
def test_fleet_with_two_aircraft_in_one_place_has_status_4(
    apart: float,
    status: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The page and the summary of each flight say so, too, and a report that is written again."""

    def scenario(east: float) -> Scenario:
        return find_scenario("osprey_gust").vary(
            flight={"duration": 0.5}, aircraft={"start": {"east": east}}
        )

    members = (Member("one", scenario(0.0)), Member("two", scenario(apart)))
    flights = []
    for member in members:
        result = fly_and_report(member.scenario, tmp_path / member.name)
        flights.append(MemberFlight(member, result.mcap.parent, COMPLETED))

    def flown(*_: Any) -> list[MemberFlight]:
        return flights

    monkeypatch.setattr(module, "fly_fleet", flown)
    fleet = Fleet("two", members, lockstep=True)
    runs = [flight.run for flight in flights]
    assert module.fly_fleet_file(fleet, runs, as_json=True) == status
    printed = json.loads(capsys.readouterr().out)
    for name, run in zip(("one", "two"), runs, strict=True):
        summary = json.loads((run / "summary.json").read_text())
        aims = [each["aim"] for each in summary["outcome"]["shortfalls"]]
        assert aims == (["separation"] if status else [])
        assert printed[name]["outcome"] == summary["outcome"]
        assert read_flight(run).summary["outcome"] == summary["outcome"]


def test_separation_is_a_key_of_the_fleet(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text("aircraft: {one: {}}")
    assert read_fleet(file).separation == SEPARATION
    file.write_text("{separation: 5.5, aircraft: {one: {}}}")
    assert read_fleet(file).separation == 5.5
