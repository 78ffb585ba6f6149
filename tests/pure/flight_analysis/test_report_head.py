# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the head of a page: a verdict in its colour, and a tile for each output."""

from dataclasses import replace

import numpy as np
import pytest

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report import figures, intervals
from flight_analysis.report.flight_head import meta_lines, tiles_of, verdict_of
from flight_analysis.report.page import Colour
from flight_analysis.report.summary import RecordedFlight, summarise
from flight_core.outcome import COMPLETED, Aim, Outcome, Shortfall, ended_early, host_starved
from flight_core.tape import Tape


@pytest.fixture(scope="module")
def servo() -> Scenario:
    return find_scenario("osprey_servo", 12.0)


@pytest.fixture(scope="module")
def tape(servo: Scenario) -> Tape:
    return simulate(servo)


def flown(scenario: Scenario, tape: Tape, outcome: Outcome = COMPLETED) -> RecordedFlight:
    return RecordedFlight("run", scenario, tape, summarise(tape, scenario, outcome))


def test_healthy_flight_is_green_and_each_tile_is_the_error_over_ten_seconds(
    servo: Scenario, tape: Tape
) -> None:
    """The expected rms is computed from y - y_m of the truth, over the ten seconds of the tile."""
    flight = flown(servo, tape)
    verdict = verdict_of(flight, servo)
    assert verdict.colour is Colour.GOOD
    assert verdict.step is not None
    assert verdict.step.command == "rise-di replay runs/run"
    tiles = tiles_of(flight)
    names = ("pitch rate q", "roll rate p", "yaw rate r", "airspeed V")
    assert [tile.name for tile in tiles] == [f"{name}, worst 10 s" for name in names]
    assert all(tile.is_within for tile in tiles)
    figures_of_q = flight.summary["outcome"]["errors"][0]
    t = tape.time("truth")
    inside = (t >= figures_of_q["start"] - 1e-9) & (t <= figures_of_q["stop"] + 1e-9)
    y_m = np.interp(t, tape.time("y_m"), tape["y_m"]["q"])
    rms = np.sqrt(np.mean((tape["truth"]["x.q"] - y_m)[inside] ** 2))
    assert figures_of_q["rms"] == pytest.approx(rms, rel=0.02)  # ticks at 100 Hz, truth at 500 Hz
    assert float(tiles[0].value) == pytest.approx(np.degrees(rms), rel=0.1)  # of two digits


def test_output_that_is_off_is_red_first_and_over_its_limit(servo: Scenario, tape: Tape) -> None:
    """The y of r is off by 0.3 rad/s, which is more than a gust of the scenario causes."""
    channels = tape["truth"].names
    values = tape["truth"].values.copy()
    values[:, channels.index("x.r")] += 0.3
    off = replace(tape, signals={**tape.signals, "truth": replace(tape["truth"], values=values)})
    y = replace(tape["y"], values=tape["y"].values + 0.3 * (np.array(tape["y"].names) == "r"))
    off = replace(off, signals={**off.signals, "y": y})
    flight = flown(servo, off)
    verdict = verdict_of(flight, servo)
    assert verdict.colour is Colour.BAD
    assert verdict.headline.startswith("r off by 17 deg/s rms")
    assert verdict.step is not None
    assert verdict.step.command == "rise-di gains check osprey --scenario osprey_servo"
    over = [tile.name.partition(",")[0] for tile in tiles_of(flight) if not tile.is_within]
    assert over == ["yaw rate r"]


@pytest.mark.parametrize(
    ("outcome", "colour", "headline"),
    [
        (host_starved("this host was too busy"), Colour.HOST, "No finding about the law."),
        (ended_early("ended early: the aircraft broke up"), Colour.BAD, "Ended early: the air"),
        (
            replace(
                COMPLETED,
                shortfalls=(Shortfall(aim=Aim.SEPARATION, sentence="3 m from uav2, 20 asked"),),
            ),
            Colour.BAD,
            "3 m from uav2, 20 asked",
        ),
    ],
)
def test_verdict_has_the_colour_of_what_it_is_about(
    servo: Scenario, tape: Tape, outcome: Outcome, colour: Colour, headline: str
) -> None:
    flight = flown(servo, tape, outcome)
    verdict = verdict_of(flight, servo)
    assert verdict.colour is colour
    assert verdict.headline.startswith(headline)


def test_errors_of_flight_that_ended_early_are_shown_without_a_limit(
    servo: Scenario, tape: Tape
) -> None:
    tiles = tiles_of(flown(servo, tape, ended_early("ended early")))
    assert [tile.has_limit for tile in tiles] == [False] * 4
    assert all("not judged" in tile.text for tile in tiles)


def test_errors_of_starved_flight_are_no_finding_and_its_spans_are_shaded(
    servo: Scenario, tape: Tape
) -> None:
    flight = flown(servo, tape, host_starved("this host was too busy"))
    assert [tile.has_limit for tile in tiles_of(flight)] == [False] * 4
    flight.summary["account"]["starved"] = [(2.0, 8.0)]
    shaded = figures.plot_context([flight]).intervals
    assert ("host too busy", 2.0, 8.0) in [(each.label, each.start, each.stop) for each in shaded]


def test_injected_fault_is_in_the_head(servo: Scenario, tape: Tape) -> None:
    faulty = servo.vary(aircraft={"actuators": {"faults": ["rudder lost 80"]}})
    flight = flown(faulty, tape)
    verdict = verdict_of(flight, faulty)
    assert "injects: rudder lost at t = 80 s" in verdict.text


def test_head_names_no_aircraft_that_did_not_fly(servo: Scenario, tape: Tape) -> None:
    """In a log without truth, y came from another aircraft than the simulator's."""
    signals = {name: each for name, each in tape.signals.items() if name != "truth"}
    behind = replace(tape, signals=signals, scenario=None)
    described, run = meta_lines(flown(servo, behind), servo)
    assert "osprey" not in described
    assert "m/s" not in described  # the trim speed is that of the osprey
    assert run == "run run"


def test_time_without_a_sample_of_y_is_shaded(servo: Scenario, tape: Tape) -> None:
    """Half a second without samples is shaded, and a gap of a few periods is not."""
    t = tape.time("y")
    kept = ~((t > 3.0) & (t < 3.5)) & ~((t > 5.0) & (t < 5.01))
    y = replace(tape["y"], stamp_ns=tape["y"].stamp_ns[kept], values=tape["y"].values[kept])
    gaps = intervals.gap_intervals(replace(tape, signals={**tape.signals, "y": y}))
    assert [(each.start, each.stop) for each in gaps] == [pytest.approx((3.0, 3.5), abs=0.003)]
