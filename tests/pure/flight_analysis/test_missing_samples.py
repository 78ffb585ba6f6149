# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test which missing samples make a log incomplete.

Samples that a sensor drops excuse only its own topic, and a silence is named.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.account import account
from flight_core.rates import NANOSECONDS
from flight_core.tape import Recording, Signal, Tape

RATES = {"y": 100, "y_m": 100, "truth": 100, "u": 100, "internals": 100, "pose": 50}  # Hz
OF_AIRCRAFT = ("y", "y_m", "truth", "pose")  # no mode of the flight interrupts these
Kept = NDArray[np.bool_]


def scenario(**aircraft: object) -> Scenario:
    """Return the default scenario at 100 Hz with other values of the aircraft.

    Its pose is at 50 Hz.
    """
    return find_scenario("osprey_gust").vary(
        aircraft={"rate": 100.0, "step": 0.01, **aircraft},
        reference_model={"rate": 100.0},
        controller={"rate": 100.0},
    )


def lacks(flight: Scenario, duration: int, samples: Mapping[str, Kept]) -> tuple[str, ...]:
    """Return what the log of a flight of whole seconds lacks.

    `samples` says which samples of a topic the log has, (N,). Of all other topics it has all.
    """
    signals = {}
    for name, rate in RATES.items():
        stamp_ns = np.arange(duration * rate + 1) * (NANOSECONDS // rate)
        names = {
            "y": flight.controller.outputs,
            "y_m": flight.controller.outputs,
            "u": flight.controller.inputs,
        }.get(name, ("a",))
        signal = Signal(stamp_ns, tuple(names), np.zeros((len(stamp_ns), len(names))))
        signals[name] = signal.where(samples[name]) if name in samples else signal
    return account(Tape(signals, duration=float(duration)), flight).lacks


def dropped(name: str, duration: int, share: float) -> Kept:
    """Return which samples of a topic are kept if a share is lost at random.

    The last one is kept.
    """
    keep = np.random.default_rng(1).random(duration * RATES[name] + 1) >= share
    keep[-1] = True
    return keep


def silent(name: str, duration: int, begin: float, end: float) -> Kept:
    """Return which samples of a topic are kept if it is silent between two instants."""
    t = np.arange(duration * RATES[name] + 1) / RATES[name]
    return np.asarray((t <= begin) | (t >= end))


def test_samples_that_the_sensor_of_y_drops_are_no_lack() -> None:
    """The share that the sensor of y drops is not missing from the log, but half as much again is.

    That is more than four deviations of the number of dropped samples.
    """
    share = 0.3
    flight = scenario(sensors={"dropout": share})
    assert lacks(flight, 60, {"y": dropped("y", 60, share)}) == ()
    assert lacks(flight, 60, {"y": dropped("y", 60, 1.5 * share)})[0].startswith("y ")


@pytest.mark.parametrize("name", [name for name in RATES if name != "y"])
def test_what_the_sensor_of_y_drops_excuses_no_other_topic(name: str) -> None:
    """Another topic lacks half of the share that y may lose, and this is not excused."""
    share = 0.3
    flight = scenario(sensors={"dropout": share})
    keep = dropped(name, 60, share / 2.0)
    expected = 60 * RATES[name] + 1
    assert lacks(flight, 60, {name: keep}) == (f"{name} {keep.sum()} of {expected} samples",)


@pytest.mark.parametrize("late", ["sensors", "pose"])
@pytest.mark.parametrize("name", OF_AIRCRAFT)
def test_delay_of_a_sensor_excuses_the_end_of_its_topic_alone(name: str, late: str) -> None:
    """A silence of 0.5 s at the end of 20 s is more than the hundredth that a topic may lack."""
    flight = scenario(**{late: {"delay": 0.5}})
    excused = {"sensors": "y", "pose": "pose"}[late]
    sentences = lacks(
        flight, 20, {topic: silent(topic, 20, 19.5, 21.0) for topic in (excused, name)}
    )
    expected = 20 * RATES[name] + 1
    missing = RATES[name] // 2
    sentence = f"{name} {expected - missing} of {expected} samples, ends at t = 19.500 of 20.000 s"
    assert sentences == (() if name == excused else (sentence,))


@pytest.mark.parametrize("length", [1.1, 19.0])
@pytest.mark.parametrize("duration", [60, 600], ids=["short flight", "long flight"])
@pytest.mark.parametrize("name", OF_AIRCRAFT)
def test_silence_of_a_steady_topic_is_named_by_its_times(
    name: str, duration: int, length: float
) -> None:
    """In the long flight, a silence is named even if more than 99 % of the samples are there."""
    sentences = lacks(scenario(), duration, {name: silent(name, duration, 30.0, 30.0 + length)})
    assert len(sentences) == 1
    assert sentences[0].startswith(f"{name} ")
    assert sentences[0].endswith(f"no sample from t = 30.000 to {30.0 + length:.3f} s")


@pytest.mark.parametrize("end, named", [(598.0, True), (598.9, True), (599.1, False)])
@pytest.mark.parametrize("name", ["y", "truth"])
def test_topic_that_ends_a_second_early_is_named(name: str, end: float, named: bool) -> None:
    """In a long flight, the samples missing at the end are less than a hundredth of all."""
    sentences = lacks(scenario(), 600, {name: silent(name, 600, end, 601.0)})
    assert [lack.endswith(f"ends at t = {end:.3f} of 600.000 s") for lack in sentences] == [
        True
    ] * named


def test_late_beginning_is_told_of_a_topic_that_also_stopped_early() -> None:
    """The publisher of y_m stops early and sends again after the end of a flight in real time.

    The numbers of the messages show that it sent nothing in the last second of the flight.
    """
    flight = scenario()
    begin_ns = NANOSECONDS * 1_795_000_000
    signals = {}
    names = flight.controller.outputs
    for name in ("y", "y_m"):
        t_ns = np.arange(20 * RATES[name] + 1) * (NANOSECONDS // RATES[name])
        signals[name] = Signal(begin_ns + t_ns, names, np.zeros((len(t_ns), len(names))))
    t = (signals["y_m"].stamp_ns - begin_ns) / NANOSECONDS
    signals["y_m"] = signals["y_m"].where((t >= 3.0) & ((t <= 17.0) | (t > 18.5)))
    recording = {name: Recording(0, lost=0) for name in signals}
    tape = Tape(signals, begin_ns, duration=18.0, recording=recording)
    (lack,) = [lack for lack in account(tape, flight).lacks if lack.startswith("y_m ")]
    assert lack == (
        "y_m 1401 of 1801 samples, begins at t = 3.000 of 18.000 s, 100 were never sent"
    )


@cache
def flown(share: float, rate: float) -> tuple[Scenario, Tape]:
    """Return a flight whose sensor drops a share of y."""
    flight = scenario(rate=rate, step=1.0 / rate, sensors={"dropout": share})
    flight = flight.vary(flight={"duration": 20.0})
    return flight, simulate(flight)


SHARES = pytest.mark.parametrize(
    "share, rate", [(0.05, 100.0), (0.5, 100.0), (0.8, 100.0), (0.5, 200.0)]
)


@SHARES
def test_flight_whose_sensor_drops_samples_has_a_whole_log(share: float, rate: float) -> None:
    """The log has each u that was sent, and no u is due without a new y."""
    flight, tape = flown(share, rate)
    assert account(tape, flight).lacks == ()


@SHARES
@pytest.mark.parametrize("lost", [0.05, 0.6])
@pytest.mark.parametrize("name", ["u", "internals"])
def test_declared_dropout_excuses_no_lost_u(
    share: float, rate: float, lost: float, name: str
) -> None:
    flight, tape = flown(share, rate)
    signal = tape[name]
    keep = np.random.default_rng(2).random(len(signal.stamp_ns)) >= lost
    keep[[0, -1]] = True
    lossy = replace(tape, signals={**tape.signals, name: signal.where(keep)})
    (sentence,) = account(lossy, flight).lacks
    assert sentence.startswith(f"{name} {np.count_nonzero(keep)} of ")
    expected = int(sentence.split()[3])
    assert expected == pytest.approx(len(signal.stamp_ns), rel=0.01)


def test_y_that_is_lost_beyond_the_declared_dropout_is_named() -> None:
    """A stretch without y and u is named, because the samples of y have numbers of their own."""
    flight, tape = flown(0.5, 100.0)
    signals = {}
    for name in ("y", "u", "internals"):
        t = tape.time(name)
        signals[name] = tape[name].where((t < 8.0) | (t > 12.0))
    lacks = account(replace(tape, signals={**tape.signals, **signals}), flight).lacks
    assert any(lack.startswith("y ") for lack in lacks)
    assert any(lack.startswith("u ") for lack in lacks)
