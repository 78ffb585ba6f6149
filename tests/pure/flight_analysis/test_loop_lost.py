# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A loop that limits alone keep bounded: the outcome of its flight, and what counts as one."""

import numpy as np
import pytest

import rise_di
from flight_analysis.closed_loop.loop_margins import margins
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.account import Account
from flight_analysis.report.flight_outcome import final_outcome
from flight_analysis.report.loop_lost import lost_parts
from flight_core.outcome import COMPLETED, STATUS_INCOMPLETE, exit_status
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray

STAMPS = np.arange(4000, dtype=np.int64) * 10_000_000  # 40 s at 100 Hz
TIME = STAMPS / 1e9


def of_input(u_free: FloatArray, limit: float = 1.0) -> Tape:
    """A flight whose controller saturated an input."""
    u = np.clip(u_free, -limit, limit)
    names = ("limited.rudder", "u_free.rudder", "u.rudder")
    values = np.stack([(u != u_free).astype(float), u_free, u], axis=1)
    return Tape({"internals": Signal(STAMPS, names, values)})


def of_error(e: FloatArray) -> Tape:
    """A flight with an error of p."""
    zero = np.zeros((len(STAMPS), 1))
    signals = {"y": Signal(STAMPS, ("p",), e[:, None]), "y_m": Signal(STAMPS, ("p",), zero)}
    return Tape(signals)


def test_input_from_limit_to_limit_is_a_lost_loop() -> None:
    """A sine of twice the limit is beyond it in two thirds of the time."""
    assert lost_parts(of_input(2.0 * np.sin(7.0 * TIME))) == (
        "rudder went from limit to limit in 67 % of 10 s",
    )


@pytest.mark.parametrize(
    "u_free",
    [
        pytest.param(np.full(4000, 2.0), id="a climb at full throttle"),
        pytest.param(1.1 * np.sin(7.0 * TIME), id="a sine just beyond the limits"),
        pytest.param(np.where(TIME < 4.0, 2.0 * np.sin(7.0 * TIME), 0.0), id="four seconds"),
    ],
)
def test_saturation_of_a_sound_loop_is_none(u_free: FloatArray) -> None:
    assert lost_parts(of_input(u_free)) == ()


def test_error_that_grows_up_to_the_end_is_a_lost_loop() -> None:
    """Exp(0.2 t) grows by e^2 = 7.4 in 10 s."""
    growing = np.exp(0.2 * TIME)
    (part,) = lost_parts(of_error(1e-3 * growing))
    assert part == "the measured error of p grew 7.4 times in the last 10 s"
    # the same below what counts as a divergence, and a gust before the end
    assert lost_parts(of_error(1e-5 * growing)) == ()
    assert lost_parts(of_error(0.5 * np.exp(-(((TIME - 20.0) / 2.0) ** 2)))) == ()


def test_error_that_oscillates_is_a_lost_loop() -> None:
    (part,) = lost_parts(of_error(0.3 * np.sin(2.0 * np.pi * TIME)))
    assert part == "the measured error of p oscillated by 0.21 rms, 1 s a cycle"
    assert lost_parts(of_error(0.05 * np.sin(2.0 * np.pi * TIME))) == ()
    noise = np.random.default_rng(1).standard_normal(len(TIME))
    assert lost_parts(of_error(0.3 * noise)) == ()


def test_short_log_and_log_without_internals_tell_nothing() -> None:
    assert lost_parts(Tape({})) == ()
    few = Tape(
        {
            "internals": Signal(
                STAMPS[:1], ("limited.rudder", "u_free.rudder", "u.rudder"), np.zeros((1, 3))
            )
        }
    )
    assert lost_parts(few) == ()


def test_outcome_of_an_unstable_flight_has_a_status() -> None:
    """U late by 80 ms beyond the margin of 47 ms: the rates of the servos bound the oscillation."""
    servo = find_scenario("osprey_servo")
    late = servo.vary(aircraft={"actuators": {"delay": 0.08}}, flight={"duration": 12.0})
    assert margins(late).delay < 0.08
    outcome = rise_di.simulate(late).outcome
    assert outcome.startswith("completed, loop lost: the true error of q oscillated by 0.1")
    assert exit_status(outcome) == STATUS_INCOMPLETE
    assert final_outcome(outcome, Account(10.0, {}, ())) == COMPLETED  # a report made again
