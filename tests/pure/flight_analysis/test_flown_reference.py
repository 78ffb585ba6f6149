# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a flight whose y_m is not the scenario's has flown other commands.

This is told even if it tracked them well.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import MappingProxyType

import numpy as np
import pytest
from tests.closed_loop import calm_osprey

import rise_di
from flight_analysis.closed_loop import stations
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.flown_reference import (
    NotCompared,
    ReferenceErrors,
    reason_not_compared,
    reference_errors,
    reference_shortfalls,
)
from flight_core.outcome import COMPLETED, Aim
from flight_core.tape import Process, Signal, Tape
from flight_core.vectors import FloatArray
from reference_model.reference import Reference

EPOCH_NS = 1_760_000_000_000_000_000  # a day of 2025: a flight in real time


@cache
def servo() -> Scenario:
    """Return osprey_servo at 100 Hz up to the commands of p."""
    return find_scenario("osprey_servo").vary(
        flight={"duration": 20.0},
        aircraft={"rate": 100.0, "step": 0.005},
        reference_model={"rate": 100.0},
    )


@cache
def guided() -> Scenario:
    """Return a route with a turn, whose u_m comes from guidance."""
    route = {"north": [0.0, 100.0, 400.0], "east": [0.0, 0.0, 300.0], "altitude": [0.0, 0.0, 10.0]}
    return calm_osprey(8.0, route=route)


@cache
def flown(name: str) -> Tape:
    return rise_di.simulate({"servo": servo, "guided": guided}[name]())


@pytest.mark.parametrize("name", ["servo", "guided"])
def test_y_m_of_a_healthy_flight_is_computed_again_to_the_bit(name: str) -> None:
    tape = flown(name)
    assert isinstance(tape.scenario, Scenario)
    errors = reference_errors(tape, tape.scenario)
    assert isinstance(errors, ReferenceErrors)
    assert not errors.error.any()
    assert reason_not_compared(tape, tape.scenario) is None


def changed(factor: list[float], first: int = 0) -> Callable[[FloatArray], FloatArray]:
    """Multiply the channels of y_m from a sample on."""

    def change(y_m: FloatArray) -> FloatArray:
        y_m[first:] *= factor
        return y_m

    return change


FAULTS: MappingProxyType[str, Callable[[FloatArray], FloatArray]] = MappingProxyType(
    {
        "stuck from 11 s on": lambda y_m: y_m[np.minimum(np.arange(len(y_m)), 1100)],
        "p reversed": changed([1.0, 1.0, -1.0, 1.0]),
        "a hundredth too small": changed([0.99] * 4),
        "V of the last second lost": changed([1.0, 0.0, 1.0, 1.0], 1900),
        "50 ms late": lambda y_m: y_m[np.maximum(np.arange(len(y_m)) - 5, 0)],
        "channels swapped": lambda y_m: y_m[:, [3, 1, 2, 0]],
        "not a number": changed([1.0, 1.0, 1.0, np.nan], 1990),
    }
)


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_fault_of_the_reference_model_is_told(fault: Callable[[FloatArray], FloatArray]) -> None:
    """The law tracks y_m, so that most of these faults leave no error."""
    tape = flown("servo")
    y_m = replace(tape["y_m"], values=fault(tape["y_m"].values.copy()))
    (told,) = reference_shortfalls(with_y_m(tape, y_m), servo())
    assert told.aim is Aim.REFERENCE
    assert told.sentence.startswith("y_m differs from the scenario's: ")


def with_y_m(tape: Tape, y_m: Signal) -> Tape:
    return replace(tape, signals=dict(tape.signals) | {"y_m": y_m})


def test_fault_of_the_reference_model_is_told_where_guidance_commands(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Guidance reacts to the missing turn, so u_m differs, and y_m does not follow from it."""

    class Faulty(Reference):
        def sample(self, number: int) -> FloatArray:
            y_m = super().sample(number)
            return y_m * [1.0, 1.0, 0.5, 1.0] if number >= 300 else y_m

    monkeypatch.setattr(stations, "Reference", Faulty)
    outcome = rise_di.simulate(guided()).outcome
    assert Aim.REFERENCE in {shortfall.aim for shortfall in outcome.shortfalls}


def test_fault_is_told_from_its_first_sample_to_its_last() -> None:
    """A reversed p is told from its first sample to its last.

    It is reversed for three seconds of its pulse.
    """
    tape = flown("servo")
    values = tape["y_m"].values.copy()
    values[1250:1550, 2] *= -1.0
    y_m = replace(tape["y_m"], values=values)
    (told,) = reference_shortfalls(with_y_m(tape, y_m), servo())
    assert (told.figures["start"], told.figures["stop"]) == pytest.approx((12.5, 15.49), abs=0.02)
    assert told.figures["largest"] == pytest.approx(2.0 * np.abs(values[1250:1550, 2]).max())
    assert told.sentence.endswith(" at most, from t = 12.5 to 15.5 s")


def test_flight_of_other_commands_is_told() -> None:
    """The file that judges has another pulse than the file that was flown."""
    pulses = {name: each.model_dump() for name, each in servo().reference_model.pulses.items()}
    pulses["p"]["value"] = [0.39, *pulses["p"]["value"][1:]]
    other = servo().vary(reference_model={"pulses": pulses})
    (shortfall,) = reference_shortfalls(flown("servo"), other)
    # the filter of p has a gain of 1 and overshoots by 0.2 %
    assert shortfall.figures["largest"] == pytest.approx(0.01, rel=0.01)
    assert shortfall.figures["start"] == pytest.approx(12.0, abs=0.02)


def in_real_time(
    late: Callable[[int], int], *, lost: slice | None = None, part: float = 1.0
) -> Tape:
    """Return the guided flight as nodes in real time log it, with u_m some samples late.

    `part` of its u_m is sent.
    """
    tape = flown("guided")
    scenario = guided()
    reference = Reference(scenario.reference_model)
    whole = tape["u_m"]
    u_m = Signal(whole.stamp_ns, whole.names, part * whole.values)
    outputs = scenario.reference_model.outputs
    arrivals: dict[int, list[int]] = {}
    last = 0
    for k, stamp_ns in enumerate(u_m.stamp_ns.tolist()):
        # a reliable topic keeps the order
        last = max(stamp_ns // reference.period_ns + late(k), last)
        arrivals.setdefault(last, []).append(k)
    rows = []
    for number in range(len(tape["y_m"].stamp_ns)):
        rows.append(reference.sample(number))
        for k in arrivals.get(number, ()):
            row = u_m.values[k]
            command = np.array([row[u_m.names.index(name)] for name in outputs])
            attitude = np.array([row[u_m.names.index(name)] for name in ("phi", "theta")])
            reference.take(int(u_m.stamp_ns[k]), command, attitude)
    y_m = Signal(tape["y_m"].stamp_ns + EPOCH_NS, outputs, np.array(rows))
    heard = np.ones(len(u_m.stamp_ns), dtype=bool)
    if lost is not None:
        heard[lost] = False
    sent = Signal(u_m.stamp_ns + EPOCH_NS, u_m.names, u_m.values).where(heard)
    return replace(
        tape,
        signals={"y_m": y_m, "u_m": sent},
        start_ns=EPOCH_NS,
        processes={
            "/reference_model#7": Process(ready_ns=None, first_ns=0, last_ns=0, samples=len(rows))
        },
    )


def test_u_m_may_arrive_late_in_real_time() -> None:
    """Each u_m takes effect 0 to 3 samples after its stamp, and every bit of y_m is explained."""
    delays = np.random.default_rng(1).integers(0, 4, 10_000)
    errors = reference_errors(in_real_time(lambda k: int(delays[k])), guided())
    assert isinstance(errors, ReferenceErrors)
    assert not errors.error.any()


def test_u_m_that_hardly_changes_does_not_hide_when_it_acted() -> None:
    """A u_m of 1e-6 that is taken a step too early shows only some steps later.

    Only then is it wrong by more than 1e-9. y_m is off by 1e-10, so that it cannot be compared bit
    by bit.
    """
    rng = np.random.default_rng(2)
    delays = rng.integers(0, 4, 10_000)
    tape = in_real_time(lambda k: int(delays[k]), part=1e-5)
    y_m = tape["y_m"]
    off = 1e-10 * rng.standard_normal(y_m.values.shape)
    rounded = replace(y_m, values=y_m.values + off)
    errors = reference_errors(with_y_m(tape, rounded), guided())
    assert isinstance(errors, ReferenceErrors)
    assert np.abs(errors.error).max() < 1e-9


def test_u_m_that_the_log_lost_is_no_fault_of_the_reference_model() -> None:
    """The u_m with the largest step is missing in the log.

    y_m is off for a moment, by less than a harmful error.
    """
    p = flown("guided")["u_m"]["p"]
    k = int(np.argmax(np.abs(np.diff(p)))) + 1
    tape = in_real_time(lambda k: 1, lost=slice(k, k + 1))
    errors = reference_errors(tape, guided())
    assert isinstance(errors, ReferenceErrors)
    assert errors.error.any()
    assert reference_shortfalls(tape, guided()) == []


def test_u_m_that_acts_after_its_age_limit_is_told() -> None:
    """Commands that are half a second old are a fault of the reference model.

    They are not explained by a slow network.
    """
    tape = in_real_time(lambda k: 50)
    (shortfall,) = reference_shortfalls(tape, guided())
    assert shortfall.aim is Aim.REFERENCE


def with_reference_model_of_a_user() -> Tape:
    return replace(
        flown("servo"),
        scenario=None,
        processes={"/my_reference": Process(ready_ns=None, first_ns=0, last_ns=0, samples=2001)},
    )


def test_reference_model_of_a_user_is_not_compared_and_that_is_said() -> None:
    tape = with_reference_model_of_a_user()
    assert reference_errors(tape, servo()) is NotCompared.FOREIGN
    assert reference_shortfalls(tape, servo()) == []
    notes = rise_di.summarise(tape, servo())["notes"]
    assert sum(note.startswith("y_m is not compared with the commands") for note in notes) == 1


def test_log_without_a_channel_of_y_m_is_not_compared() -> None:
    tape = flown("servo")
    signals = dict(tape.signals)
    y_m = signals.pop("y_m")
    assert reference_errors(replace(tape, signals=signals), servo()) is NotCompared.ABSENT
    signals["y_m"] = Signal(y_m.stamp_ns, y_m.names[:2], y_m.values[:, :2])
    lacking = replace(tape, signals=signals)
    assert reference_errors(lacking, servo()) is NotCompared.OTHER_CHANNELS
    assert reason_not_compared(lacking, servo()) is NotCompared.OTHER_CHANNELS


def test_reference_model_of_a_user_flies_no_command_of_the_scenario() -> None:
    """Such commands are not counted, do not divide the errors, and have no settling."""
    of_stack = rise_di.summarise(flown("servo"), servo())
    own = rise_di.summarise(with_reference_model_of_a_user(), servo())
    assert of_stack["account"]["commands"]["given"] > 0
    assert own["account"]["commands"]["given"] == own["account"]["commands"]["flown"] == 0
    assert {transient["kind"] for transient in own["transients"]} <= {"engagement", "gust"}
    for name, parts in own["errors"].items():
        assert parts["command"]["rms"] is None
        assert parts["whole"] == of_stack["errors"][name]["whole"]


def test_reference_model_that_was_started_by_itself_begins_at_its_first_sample() -> None:
    """No message tells the instant of t = 0.

    It is the first y_m, unless the log begins later.
    """
    tape = flown("servo")
    y_m = tape["y_m"]
    alone = replace(
        tape,
        scenario=None,
        signals=dict(tape.signals) | {"y_m": replace(y_m, stamp_ns=y_m.stamp_ns + 3_000_000_000)},
        processes={
            "/reference_model#7": Process(ready_ns=None, first_ns=0, last_ns=0, samples=2001)
        },
    )
    errors = reference_errors(alone, servo())
    assert isinstance(errors, ReferenceErrors)
    assert not errors.error.any()
    late = y_m.where(y_m.stamp_ns >= 2_500_000_000)
    signals = dict(tape.signals) | {"y_m": late}
    cut = replace(alone, signals=signals, start_ns=2_500_000_000)
    assert reference_errors(cut, servo()) is NotCompared.NO_START


def test_healthy_flights_have_no_shortfall() -> None:
    assert flown("servo").outcome == COMPLETED
