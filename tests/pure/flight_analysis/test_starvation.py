# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a starved host is known by what was never sent, and says nothing about the law.

Samples are left out of healthy and of faulty flights in the way in which a host leaves them out, so
that no number of a message is missing. Shortfalls of the flight without the gaps must remain.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from tests.recordings import EPOCH

import rise_di
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.summary import summarise
from flight_core.outcome import HEADLINE, STATUS_HOST, STATUS_SHORTFALL, Outcome, never_flew
from flight_core.tape import Process, Recording, Signal, Tape

T = 30.0  # s
SENT = ("y", "y_m", "u", "internals", "truth", "pose")
NODES = ("/aircraft#1", "/reference_model#2", "/controller#3", "/recorder#4")
Spans = tuple[tuple[float, float], ...]

STARVED: Spans = tuple((start, start + 0.3) for start in np.arange(1.0, 20.0, 0.5).tolist())
"""s. The host takes 0.3 s of each half a second away, until t = 20 s."""


def servo(*faults: str) -> Scenario:
    scenario = find_scenario("osprey_servo").vary(
        flight={"duration": T},
        aircraft={"rate": 100.0, "step": 0.005},
        reference_model={"rate": 100.0},
    )
    actuators = scenario.aircraft.actuators.model_dump() | {"faults": list(faults)}
    return scenario.vary(aircraft={"actuators": actuators})


@cache
def flown(*faults: str) -> Tape:
    return rise_di.simulate(servo(*faults))


def in_real_time(
    tape: Tape,
    spans: Spans = STARVED,
    topics: tuple[str, ...] = SENT,
    lost: Mapping[str, int] = {},
    start_ns: int = EPOCH,
) -> Tape:
    """Return the flight by the time of day, without samples of the topics within the spans."""
    signals = {}
    for name, signal in tape.signals.items():
        t = tape.time(name)
        is_left_out = np.zeros(len(t), dtype=bool)
        for start, stop in spans if name in topics else ():
            is_left_out |= (t >= start) & (t < stop)
        kept = signal.where(~is_left_out)
        signals[name] = Signal(kept.stamp_ns + start_ns, kept.names, kept.values, kept.sender)
    recording = {
        name: Recording(len(signal.stamp_ns), lost=lost.get(name, 0))
        for name, signal in signals.items()
    }
    return replace(
        tape,
        signals=signals,
        start_ns=start_ns,
        recording=recording,
        duration=T,
        processes={
            node: Process(ready_ns=None, first_ns=start_ns, last_ns=start_ns, samples=1)
            for node in NODES
        },
    )


def outcome(tape: Tape, *faults: str, end: Outcome | None = None) -> dict[str, Any]:
    record: dict[str, Any] = summarise(tape, servo(*faults), end)["outcome"]
    return record


def test_starved_flight_has_one_outcome_and_one_sentence() -> None:
    record = outcome(in_real_time(flown()))
    assert (record["end"], record["status"]) == ("host", STATUS_HOST)
    assert record["sentence"].startswith("this host was too busy for real time: ")
    assert len(record["sentence"]) <= HEADLINE
    assert record["details"] == record["shortfalls"] == []


def test_whole_flight_is_none_of_a_starved_host() -> None:
    record = outcome(in_real_time(flown(), ()))
    assert (record["sentence"], record["status"]) == ("completed", 0)


@pytest.mark.parametrize("spans", [STARVED, ((5.0, 6.0),)])
def test_fault_of_the_law_outside_of_the_starved_spans_is_told(spans: Spans) -> None:
    """The elevator is reversed from t = 26 s on, and the host starves up to 20 s at most."""
    fault = "elevator weak 26 -1"
    assert outcome(in_real_time(flown(fault), ()), fault)["status"] == STATUS_SHORTFALL
    record = outcome(in_real_time(flown(fault), spans), fault)
    assert record["status"] == STATUS_SHORTFALL
    assert "error" in {each["aim"] for each in record["shortfalls"]}


def test_errors_of_a_starved_span_are_no_finding_about_the_law() -> None:
    """During one second, q is off by 30 deg/s in the few samples that were sent."""
    spans = tuple((start, start + 0.09) for start in np.arange(9.0, 10.0, 0.1).tolist())
    tape = flown()
    truth = tape["truth"]
    values = truth.values.copy()
    is_off = (tape.time("truth") >= 9.0) & (tape.time("truth") < 10.0)
    values[is_off, truth.names.index("x.q")] += np.radians(30.0)
    shaken = Signal(truth.stamp_ns, truth.names, values)
    off = replace(tape, signals={**tape.signals, "truth": shaken})
    assert outcome(in_real_time(off, ()))["status"] == STATUS_SHORTFALL
    record = outcome(in_real_time(off, spans))
    assert (record["end"], record["status"], record["details"]) == ("host", STATUS_HOST, [])


def test_hiccup_that_harms_nothing_is_no_outcome() -> None:
    record = outcome(in_real_time(flown(), ((5.0, 5.06), (15.0, 15.2))))
    assert (record["sentence"], record["status"]) == ("completed", 0)


def test_lost_messages_are_a_lack_of_the_log() -> None:
    """Lost messages leave gaps in the numbers, which shows that they were sent."""
    whole = in_real_time(flown(), ())
    starved = in_real_time(flown())
    lost = {name: len(whole[name].stamp_ns) - len(starved[name].stamp_ns) for name in SENT}
    record = outcome(in_real_time(flown(), lost=lost))
    assert (record["end"], record["status"]) == ("completed", STATUS_SHORTFALL)
    assert {each["aim"] for each in record["shortfalls"]} >= {"log"}


def test_law_that_computes_for_too_long_is_none_of_the_host() -> None:
    """The law leaves out ticks, while the other nodes send every sample."""
    tape = in_real_time(flown(), topics=("u", "internals"))
    assert summarise(tape, servo())["account"]["starved"] == []
    assert outcome(tape)["end"] == "completed"


def test_time_of_lockstep_is_none_of_the_host() -> None:
    assert outcome(in_real_time(flown(), start_ns=0))["end"] == "completed"


def test_flight_that_never_flew_on_a_starved_host_names_the_host() -> None:
    why = never_flew("y did not reach the controller")
    tape = flown()
    held = {name: signal for name, signal in tape.signals.items() if name not in {"u", "internals"}}
    unflown = replace(tape, signals=held)
    record = outcome(in_real_time(unflown), end=why)
    assert (record["end"], record["status"]) == ("host", STATUS_HOST)
    assert record["sentence"].startswith("never flew: this host was too busy for real time in ")
    assert outcome(in_real_time(unflown, ()), end=why)["sentence"] == str(why)
