# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test flights of the module's switch with a linear airplane: tests/px4/flight.c.

Setpoint, gyro, spare and parameters are as an autopilot and its user may give them. The samples
come at 250 Hz unless a flight names a rate. RISE-DI is enabled at 2.5 s of 10 s.
"""

import csv
import math
import shutil
import subprocess
from pathlib import Path

import pytest
from pytest import approx
from tests.conftest import REPOSITORY

from c_export.autopilots import SHELLS, write_module
from c_export.proof import FLAGS, build
from flight_analysis.closed_loop.scenario_library import find_scenario

pytestmark = pytest.mark.skipif(
    shutil.which("gcc") is None, reason="no gcc on this machine, which compiles the exported code"
)
ENABLED = 7.5  # s, in a flight
FLIES, STALE_RATES, STALE_SETPOINT, SLOW, SILENT = 0, 5, 6, 12, 13
WRONG_AGE, WRONG_ERROR, WRONG_HOLD = 14, 15, 16
SANITIZED = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight")
    rates = REPOSITORY / "examples" / "px4_airplane" / "rates.yaml"
    write_module("px4", find_scenario(str(rates)), folder, float32=False)
    module = folder / SHELLS["px4"].place
    sources = [REPOSITORY / "tests" / "px4" / "flight.c", "rise_di.c", "rise_di_rates.c"]
    flags = [*(flag for flag in FLAGS if not flag.startswith(("-std", "-O"))), "-std=gnu99"]
    build(
        ["gcc", *flags, *SANITIZED, "-I.", "-o", "flight", *map(str, sources), "-lm"],
        module,
    )
    return module / "flight"


def flown(program: Path, **words: float) -> dict[str, float]:
    """Return the figures of a flight. A finding of a sanitizer ends it."""
    command = [str(program), *(f"{name}={value}" for name, value in words.items())]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    figures = dict(word.split("=") for word in done.stdout.split())
    assert figures["not_numbers"] == "0"  # neither torque nor thrust, whatever comes
    return {name: float(text) for name, text in figures.items()}


@pytest.mark.parametrize("set_hz", [250.0, 50.0, 20.0, 10.0, 2.0])
def test_slow_setpoint_is_held(program: Path, set_hz: float) -> None:
    """PX4 asks for 2 Hz in offboard.

    There is one take-over, and the error is as at the full rate.
    """
    figures = flown(program, set_hz=set_hz)
    assert figures["takeovers"] == 1
    assert figures["fallbacks"] == 0
    assert figures["flown"] == approx(ENABLED, abs=0.02)
    full = flown(program)["rms"]
    # Of y - y_m: the steps of the setpoint are those of y_m too. At 2 Hz it is 1.12, because steps
    # are faster than the sine, and the bank that the feedforward expects decays in 3 s.
    assert figures["rms"] < 1.2 * full


def test_setpoint_that_stops_is_held_as_long_as_the_autopilot_holds_it(program: Path) -> None:
    for hold in (0.5, 1.0, 2.0):
        figures = flown(program, stop_set_at=5.0, hold=hold)
        assert figures["refusal"] == STALE_SETPOINT
        assert figures["fell"] == approx(5.0 + hold, abs=0.01)
    assert flown(program, stop_set_at=5.0, hold=0.0)["fell"] == approx(5.04, abs=0.01)  # max_age


def test_law_keeps_its_period_under_any_faster_gyro(program: Path) -> None:
    """There are 250 ticks per second, and the ratio of the rates need not be a whole number.

    The error stays as small as at 250 Hz, where each sample is a tick.
    """
    at_the_rate = flown(program)["rms"]
    for hz in (251.0, 300.0, 330.0, 400.0, 800.0, 1000.0, 2000.0):
        figures = flown(program, hz=hz)
        assert figures["takeovers"] == 1, hz
        assert figures["measured"] == approx(hz, rel=2e-3)
        assert figures["tick_rate"] == approx(251.0 if hz == 251.0 else 250.0, abs=0.5), hz
        # 10 %: an interpolated y is up to a sample late
        assert figures["rms"] < 1.1 * at_the_rate, hz
    assert flown(program, jitter=0.0003)["tick_rate"] == approx(250.0, abs=0.5)


def test_slower_gyro_is_refused_by_its_measured_rate(program: Path) -> None:
    for hz in (50.0, 100.0, 200.0, 243.0):
        figures = flown(program, hz=hz, max_age=0.1)
        assert figures["takeovers"] == 0
        assert figures["refusal"] == SLOW
        assert figures["measured"] == approx(hz, rel=2e-3)


def test_gyro_that_becomes_slower_in_flight_hands_over(program: Path) -> None:
    """It hands over within two windows of a second."""
    figures = flown(program, hz_at=5.0, next_hz=200.0)
    assert figures["refusal"] == SLOW
    assert figures["fell"] < 7.0
    assert figures["fallbacks"] == 1


@pytest.mark.parametrize("name", ["nan_rates_at", "nan_set_at"])
def test_return_after_a_fault_waits_for_a_second(program: Path, name: str) -> None:
    figures = flown(program, **{name: 5.0})
    assert (figures["takeovers"], figures["fallbacks"]) == (2, 1)
    assert figures["fell"] == approx(5.0, abs=0.005)
    assert figures["flown"] == approx(ENABLED - 1.0, abs=0.02)


@pytest.mark.parametrize("at", [0.3, 2.4, 5.0])
def test_torque_of_the_spare_with_nan_counts_as_none(program: Path, at: float) -> None:
    """A NaN before the take-over and in flight does not prevent it, and no NaN is sent."""
    for name in ("nan_spare_at", "nan_thrust_at"):
        figures = flown(program, **{name: at})
        assert figures["takeovers"] == 1
        assert figures["flown"] == approx(ENABLED, abs=0.02)


def test_spare_that_never_published_is_not_taken_over_from(program: Path) -> None:
    figures = flown(program, spare_from=99.0)
    assert figures["takeovers"] == 0
    assert figures["refusal"] == SILENT
    late = flown(program, spare_from=4.0)
    assert late["takeovers"] == 1
    assert late["first"] == approx(5.0, abs=0.01)  # a second after the fault
    before = flown(program, stop_spare_at=2.0)  # half a second before RISE-DI is enabled
    assert before["takeovers"] == 0
    assert before["refusal"] == SILENT


def test_spare_that_stops_in_flight_leaves_rise_di_alone(program: Path) -> None:
    """It flies on, and returns immediately after a NaN of the gyro.

    It also flies on when it is switched off, with a wrong parameter, and with a gyro that became
    slow. The thrust is the one of the setpoint, which the spare would pass on. So it changes, and
    is not frozen.
    """
    nothing_to_go_to = {"wrong_age_at": 6.0}, {"hz_at": 6.0, "next_hz": 200.0}
    for words in ({}, {"off_at": 6.0}, *nothing_to_go_to):
        figures = flown(program, stop_spare_at=5.0, **words)
        assert figures["silent"] == 1
        assert figures["takeovers"] == 1
        assert figures["fallbacks"] == 0
        assert figures["thrust"] == figures["wanted_thrust"]
        assert figures["thrust"] != approx(0.5 + 0.1 * math.sin(5.0), abs=0.01)  # that at 5 s
    again = flown(program, stop_spare_at=5.0, nan_rates_at=6.0)
    assert (again["takeovers"], again["fallbacks"]) == (2, 1)
    assert again["flown"] == approx(ENABLED, abs=0.02)


def test_nothing_frozen_is_sent_where_neither_controls(program: Path) -> None:
    """The spare and the setpoint stop. Then the torque fades to 0, and the thrust is 0."""
    figures = flown(program, stop_spare_at=5.0, stop_set_at=5.0)
    assert figures["refusal"] == STALE_SETPOINT
    assert figures["torque"] < 1e-3
    assert figures["thrust"] == 0.0


@pytest.mark.parametrize(
    "name, refusal", [("max_age", WRONG_AGE), ("max_error", WRONG_ERROR), ("hold", WRONG_HOLD)]
)
def test_parameters_out_of_their_bounds_are_refused(program: Path, name: str, refusal: int) -> None:
    values = [math.nan, 1e9, -1.0] + ([] if name == "hold" else [0.0])
    for value in values:
        figures = flown(program, **{name: value})
        assert figures["takeovers"] == 0, value
        assert figures["refusal"] == refusal, value
        assert figures["torque"] > 0.01  # of the spare


def test_parameter_that_becomes_nan_in_flight_hands_over_to_a_living_spare(program: Path) -> None:
    figures = flown(program, wrong_age_at=5.0)
    assert figures["refusal"] == WRONG_AGE
    assert figures["fell"] == approx(5.0, abs=0.01)
    assert figures["torque"] > 0.01
    passing = flown(program, wrong_age_at=5.0, stop_wrong_at=6.0)
    assert passing["takeovers"] == 2
    assert passing["refusal"] == FLIES


def test_rates_that_stop_are_told_by_their_age(program: Path) -> None:
    figures = flown(program, stop_rates_at=5.0)
    assert figures["refusal"] == STALE_RATES
    assert figures["fell"] == approx(5.04, abs=0.01)


def test_table_of_the_page_is_what_these_flights_give(program: Path) -> None:
    table = REPOSITORY / "docs" / "evidence" / "tables" / "export-switch.csv"
    with table.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))[1:]
    assert len(rows) > 25
    for name, words, *published, _ in rows:
        figures = flown(program, **dict(word.split("=") for word in words.split()))  # type: ignore[arg-type]
        figures["rms"] *= 1e3  # mrad/s
        columns = ("flown", "takeovers", "tick_rate", "jump", "rms")
        # of the digits printed, and the last bits of a sine of another library
        bounds = (0.006, 0, 0.6, 6e-4, 0.06)
        for column, value, bound in zip(columns, published, bounds, strict=True):
            assert figures[column] == approx(float(value), abs=bound), (name, column)
