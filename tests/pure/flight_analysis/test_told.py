# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that claims about a flight are about what flew, and not about what the controller knew."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest import approx

from aircraft_sim.params import AircraftConfig
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario, scenarios
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.linear_loop.certificate import keep, kept_guarantee, unstated
from flight_analysis.linear_loop.guarantee import Guarantee
from flight_analysis.linear_loop.loop_margins import loop_margins, scenario_loop
from flight_analysis.linear_loop.told import (
    IN_LOOP,
    OUTSIDE_LOOP,
    FlightFacts,
    Standing,
    compare,
    flown_lag,
    lag_through,
)
from flight_analysis.report.flown_models import UNKNOWN_AIRCRAFT, flown_loops
from flight_core.known_keys import keys_of
from flight_core.tape import Tape
from rise_di_controller.law.linear_loop import is_stable

OBSERVER = find_scenario("osprey_observer", 2.0)
SERVO = find_scenario("osprey_servo", 2.0)
TWIN = find_scenario("osprey_twin")

BEYOND = {
    "over_airspeed",
    "actuators.dead_zone",
    "actuators.faults",
    "sensors.dropout",
    "sensors.quantisation",
    "vanes.frozen_at",
    "vanes.dropout",
} | {key for key in keys_of(AircraftConfig) if key.startswith("drift.")}
"""No linear loop has these: they are named, and no guarantee is stated."""

# The controller of these is told otherwise on purpose: it learns of a late u.
TOLD_OTHERWISE = {"osprey_learn_speeds"}


def with_aircraft(scenario: Scenario, section: str, **values: Any) -> Scenario:
    """Return a scenario with some keys of a section of the aircraft changed."""
    before = getattr(scenario.aircraft, section).model_dump()
    return scenario.vary(aircraft={section: before | values})


def sentences(scenario: Scenario, flight: FlightFacts | None = None) -> list[str]:
    facts = FlightFacts() if flight is None else flight
    return [each.sentence for each in compare(scenario, scenario.controller, facts).differences]


def test_every_key_of_the_aircraft_is_in_one_set() -> None:
    """A new key of the aircraft must be placed in one of the sets.

    Until then it is named, and no guarantee is stated.
    """
    assert sorted([*IN_LOOP, *OUTSIDE_LOOP, *BEYOND]) == sorted(keys_of(AircraftConfig))


@pytest.mark.parametrize("name", sorted({*scenarios()} - TOLD_OTHERWISE))
def test_a_healthy_scenario_has_the_loop_that_its_controller_was_told(name: str) -> None:
    """The loops are equal to the last bit, so that margins and certificates stay."""
    scenario = find_scenario(name)
    comparison = compare(scenario, scenario.controller)
    assert not comparison.differences
    assert comparison.timing.lag.tolist() == list(scenario.controller.lag)
    assert comparison.timing.delay == scenario.controller.delay


def test_lags_and_delay_that_were_not_told_are_those_of_the_margins() -> None:
    """With the declared lags the loop has a margin of 28 ms.

    The aircraft of the file has other lags, and diverges in flight.
    """
    slow = with_aircraft(OBSERVER, "actuators", lag=[0.1, 0.1, 0.1, 0.1])
    slow = with_aircraft(slow, "sensors", delay=0.02)
    found = sentences(slow)
    for name in ("elevator", "aileron", "rudder"):
        assert (
            f"aircraft.actuators.lag: the aircraft has 0.1 s in {name}, controller.lag 0.02 s; "
            "margins and guarantee apply to the aircraft"
        ) in found
    assert any(
        text.startswith(
            "aircraft.sensors.delay, actuators.delay: 0.02 s to 0.024 s in flight, "
            "controller.delay 0.003 s;"
        )
        for text in found
    )
    loop = scenario_loop(slow, slow.controller)
    assert loop.loop.lag.tolist() == [0.1] * 4
    assert loop.loop.delay == approx(0.024)
    assert not is_stable(loop.nominal, loop.law, loop.loop, np.zeros(4))
    # the same loop, told
    known = slow.controller.model_copy(update={"lag": (0.1,) * 4, "delay": 0.024})
    assert not compare(slow, known).differences


@pytest.mark.parametrize(
    ("section", "values", "key", "standing"),
    [
        ("actuators", {"lag": [0.02, 0.1, 0.02, 0.021]}, "aircraft.actuators.lag", Standing.TAKEN),
        ("actuators", {"lag": []}, "aircraft.actuators.lag", Standing.TAKEN),
        ("actuators", {"delay": 0.01}, "actuators.delay: 0.01 s", Standing.TAKEN),
        ("sensors", {"delay": 0.004}, "aircraft.sensors.delay", Standing.TAKEN),
        (
            "actuators",
            {"upper": [0.3, 0.5, 0.5236, 0.5236]},
            "controller.upper of elevator: found 0.523599, expected the end stop 0.3",
            Standing.LEFT_OUT,
        ),
        ("actuators", {"faults": ["rudder lost 1"]}, "actuators.faults", Standing.LEFT_OUT),
        ("actuators", {"dead_zone": [0.0, 0.0, 0.01, 0.0]}, "dead_zone", Standing.LEFT_OUT),
        ("sensors", {"dropout": 0.1}, "aircraft.sensors.dropout", Standing.LEFT_OUT),
        ("sensors", {"quantisation": [0.01] * 4}, "quantisation", Standing.LEFT_OUT),
    ],
)
def test_a_fact_that_was_not_told_is_named(
    section: str, values: dict[str, Any], key: str, standing: Standing
) -> None:
    changed = with_aircraft(SERVO, section, **values)
    found = compare(changed, changed.controller).differences
    matching = [each for each in found if key in each.fact]
    assert matching
    assert {each.standing for each in matching} == {standing}


@pytest.mark.parametrize(
    ("section", "values"),
    [
        ("actuators", {"lag": [0.02, 0.1, 0.02, 0.020001]}),  # the digits of a file
        ("actuators", {"upper": [0.6, 0.6, 0.6, 0.6]}),  # the limits are inside
        ("actuators", {"dead_zone": [0.0] * 4}),
        ("sensors", {"delay": 0.002}),  # told: 3 ms, of which up to 4 ms are waits
        ("sensors", {"noise": [0.1] * 4, "bias": [0.1] * 4}),  # they move no mode
    ],
)
def test_what_agrees_is_not_named(section: str, values: dict[str, Any]) -> None:
    assert not sentences(with_aircraft(SERVO, section, **values))


def test_drift_and_airspeed_are_beyond_a_linear_loop() -> None:
    drifts = SERVO.vary(aircraft={"drift": {"start": 1.0, "A": 0.3}})
    assert any("aircraft.drift" in text for text in sentences(drifts))
    follows = SERVO.vary(aircraft={"over_airspeed": "thrust"})
    assert any("aircraft.over_airspeed" in text for text in sentences(follows))


def test_signs_and_rates_of_the_controller_are_compared() -> None:
    assert any(
        "controller.D" in text
        for text in sentences(SERVO.vary(controller={"D": [-D for D in SERVO.controller.D]}))
    )
    faster = SERVO.vary(controller={"slew": [10.0, 5.0, 5.0, 2.0]})
    (text,) = sentences(faster)
    assert text.startswith(
        "controller.slew of elevator: found 10, expected aircraft.actuators.rate"
    )


def test_lags_behind_an_allocation_are_those_of_its_effectors() -> None:
    """The twin yaws by its rudder with 20 ms and by its engines with 100 ms.

    In the second part both are slower.
    """
    assert flown_lag(TWIN.aircraft, TWIN.controller) == approx(TWIN.controller.lag, rel=1e-4)
    lag = np.array(TWIN.aircraft.actuators.lag)
    slow = with_aircraft(TWIN, "actuators", lag=(2.0 * lag).tolist())
    assert flown_lag(slow.aircraft, slow.controller) == approx(
        2.0 * np.array(TWIN.controller.lag), rel=1e-4
    )
    assert len(sentences(slow)) == 4
    # two effectors of the same output, half each
    assert lag_through(np.array([[1.0, 1.0]]), np.array([[0.5], [0.5]]), np.array([0.1, 0.3])) == (
        approx([0.2])
    )


def test_an_allocation_for_other_effectors_is_named() -> None:
    allocation = TWIN.controller.model_dump()["allocation"]
    p = len(allocation["effectors"])
    T = np.reshape(allocation["T"], (p, -1))
    effect = np.reshape(allocation["effect"], (-1, p))
    # a factor is in the gains, and effect T = I holds
    other = allocation | {"T": (T / 2.0).ravel().tolist(), "effect": (2 * effect).ravel().tolist()}
    assert not sentences(TWIN.vary(controller={"allocation": other}))
    swapped = effect[[0, 2, 1, 3]]
    other = allocation | {
        "T": T[:, [0, 2, 1, 3]].ravel().tolist(),
        "effect": swapped.ravel().tolist(),
    }
    found = sentences(TWIN.vary(controller={"allocation": other}))
    assert any(text.startswith("effect of the effectors on p: the aircraft has") for text in found)


def test_jsbsim_has_lags_of_its_own_beside_those_of_the_file() -> None:
    """No key has the 1.08 s of the c172p's engine, but one has the 0.1 s of a slow elevator."""
    c172p = find_scenario("jsbsim_c172p")
    slow = with_aircraft(c172p, "actuators", lag=[0.0, 0.0, 0.1, 0.0])
    texts = [text for text in sentences(slow) if text.startswith("aircraft.actuators.lag")]
    slow_surface = slow.aircraft.channels().inputs
    assert len(texts) == 1
    assert f"0.1 s in {[*slow_surface][2]}" in texts[0]
    late = with_aircraft(c172p, "sensors", delay=0.05)
    assert any(text.startswith("aircraft.sensors.delay") for text in sentences(late))


def guarantee_of(loop: Any, stable: float = 0.5) -> Guarantee:
    """Return a guarantee as if it had been computed."""
    return Guarantee(
        uncertainty=0.3,
        stable=stable,
        unstable=None,
        disk=dict.fromkeys(loop.inputs, 0.5),
        disk_all=0.5,
        loop=loop.digest,
    )


def test_a_guarantee_is_stated_of_the_aircraft_that_it_is_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    told = scenario_loop(SERVO, SERVO.controller)
    keep(guarantee_of(told))
    assert kept_guarantee(told) is not None
    for changed in (
        with_aircraft(SERVO, "actuators", lag=[0.1] * 4),
        with_aircraft(SERVO, "actuators", faults=["elevator stuck 1"]),
        with_aircraft(SERVO, "actuators", upper=[0.3] * 4),
        with_aircraft(SERVO, "sensors", dropout=0.1),
        SERVO.vary(aircraft={"drift": {"start": 1.0, "B": 0.3}}),
        SERVO.vary(aircraft={"uncertainty": {"A": 0.9, "B": 0.9, "seed": 3}}),
    ):
        assert kept_guarantee(scenario_loop(changed, changed.controller)) is None
    # an aircraft of the box, and one in a wind
    for same in (
        SERVO.vary(aircraft={"uncertainty": {"A": 0.3, "B": 0.3, "seed": 3}}),
        SERVO.vary(aircraft={"wind": [5.0, 0.0]}),
    ):
        assert kept_guarantee(scenario_loop(same, same.controller)) is not None


def test_an_aircraft_beyond_the_box_is_named_with_its_deviation() -> None:
    far = SERVO.vary(aircraft={"uncertainty": {"A": 0.9, "seed": 3, "distribution": "corners"}})
    loop = scenario_loop(far, far.controller)
    assert loop.off == approx(0.9)
    (reason,) = unstated(loop, guarantee_of(loop))
    assert reason == (
        "aircraft.uncertainty: the aircraft is 90.0 % off, the guarantee ends at 50.0 %: none is "
        "stated"
    )
    assert not unstated(loop._replace(off=0.5), guarantee_of(loop))


@pytest.mark.parametrize(
    ("facts", "expected"),
    [
        (FlightFacts(tick=0.02), "ticks every 20 ms in the log, controller.rate: every 10 ms"),
        (FlightFacts(has_parameters=False), "the flight had other ones than the file"),
        (FlightFacts(age=0.05), "age of u: 0.05 s in the log, controller.delay 0.003 s"),
        (
            FlightFacts(is_simulated=False, y_period=0.04),
            "y every 40 ms: 0.045 s or more in flight, controller.delay 0.003 s",
        ),
        (FlightFacts(later=(with_aircraft(SERVO, "sensors", dropout=0.2).aircraft,)), "dropout"),
    ],
)
def test_facts_of_the_log_are_compared(facts: FlightFacts, expected: str) -> None:
    assert any(expected in text for text in sentences(SERVO, facts))


@pytest.mark.parametrize(
    "facts",
    [
        FlightFacts(tick=0.010001, age=0.008),
        FlightFacts(is_simulated=False, y_period=0.01),
        FlightFacts(later=(SERVO.aircraft,)),
    ],
)
def test_a_log_as_planned_names_nothing(facts: FlightFacts) -> None:
    assert not sentences(SERVO, facts)


@cache
def as_planned() -> Tape:
    """Return the flight of SERVO."""
    return simulate(SERVO)


def test_an_aircraft_that_is_not_simulated_is_not_compared() -> None:
    """Behind a bridge, the aircraft of the scenario does not fly.

    So the loop is the one that the controller was told.
    """
    slow = with_aircraft(SERVO, "actuators", lag=[0.1] * 4, faults=["elevator stuck 1"])
    assert not sentences(slow, FlightFacts(is_simulated=False))
    tape = as_planned()
    signals = {name: signal for name, signal in tape.signals.items() if name != "truth"}
    foreign = replace(tape, signals=signals, scenario=None)
    flown = flown_loops(foreign, slow, ())
    assert flown.sentences == (UNKNOWN_AIRCRAFT,)
    assert flown.loops[0].loop.loop.lag.tolist() == list(slow.controller.lag)


def test_the_loops_of_a_flight_are_of_what_flew() -> None:
    slow = with_aircraft(SERVO, "actuators", lag=[0.05, 0.1, 0.05, 0.05])
    flown = flown_loops(simulate(slow), slow, ())
    assert len(flown.sentences) == 3
    margins = loop_margins(flown.loops[0].loop)
    known = slow.vary(controller={"lag": [0.05, 0.05, 0.05, 0.1]}).controller
    # the softened sign of the law is as wide as it was told: only the margins' loop is compared
    assert flown.loops[0].loop.loop.lag.tolist() == list(known.lag)
    healthy = loop_margins(flown_loops(as_planned(), SERVO, ()).loops[0].loop)
    assert margins.delay < healthy.delay


def test_ticks_of_another_period_have_no_loop() -> None:
    tape = as_planned()
    half = tape["internals"]
    slower = replace(half, stamp_ns=2 * half.stamp_ns)
    late = replace(tape, signals={**tape.signals, "internals": slower})
    flown = flown_loops(late, SERVO, ())
    assert not flown.loops
    assert flown.sentences[0].startswith("ticks every 20 ms in the log")
    assert flown.sentences[0].endswith("neither margins nor a guarantee are stated")


def test_parameters_that_are_not_those_of_the_file_have_no_loop() -> None:
    other = SERVO.vary(controller={"beta": [2.0, 2.0, 1.0, 1.0]})
    flown = flown_loops(simulate(other), SERVO, ())
    assert not flown.loops
    assert "the flight had other ones than the file" in flown.sentences[0]
    assert not math.isnan(scenario_loop(other, other.controller).loop.delay)
