# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the age of u at the aircraft against the delay margin of the gains.

An independent publisher sends the diagnostics with the age.
"""

from dataclasses import replace
from typing import Any

import pytest
from tests.joint_states import STORE
from tests.recordings import signal

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.loop_margins import margins
from flight_analysis.report.summary import summarise
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_log.age_of_u import age_of_u


def diagnostics(second: int, node: str, **values: str) -> bytes:
    """Return a message on /diagnostics from a node."""
    types: dict[str, Any] = STORE.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](second, 0), "")
    pairs = [
        types["diagnostic_msgs/msg/KeyValue"](key.replace("_", " ") + " (s)", value)
        for key, value in values.items()
    ]
    status = types["diagnostic_msgs/msg/DiagnosticStatus"](0, node, "", node, pairs)
    array = "diagnostic_msgs/msg/DiagnosticArray"
    return bytes(STORE.serialize_cdr(types[array](header, [status]), array))


def test_ages_are_those_of_the_own_aircraft_in_order_of_stamps() -> None:
    messages = [
        diagnostics(7, "/uav1/aircraft", age_of_u_mean="0.0040", age_of_u_max="0.0090"),
        diagnostics(6, "/uav1/aircraft", age_of_u_mean="0.0050", age_of_u_max="0.0060"),
        diagnostics(6, "/uav2/aircraft", age_of_u_mean="0.5", age_of_u_max="0.6"),
        diagnostics(8, "/uav1/aircraft", age_of_u_mean="late", age_of_u_max="0.6"),
        b"age of u mean (s)",
    ]
    ages = age_of_u(messages, "/uav1")
    assert ages is not None
    assert (ages.stamp_ns // NANOSECONDS).tolist() == [6, 7]
    assert (ages["mean"].tolist(), ages["max"].tolist()) == ([0.005, 0.004], [0.006, 0.009])
    assert age_of_u(messages, "") is None


SERVO = find_scenario("osprey_servo")


@pytest.fixture(scope="module")
def margin() -> float:
    return margins(SERVO).delay


@pytest.mark.parametrize("beyond, verdict", [(-2.0, ""), (-0.001, "within"), (0.001, "more than")])
def test_age_of_u_beside_delay_margin_of_gains(
    beyond: float, verdict: str, tape: Tape, margin: float
) -> None:
    """An age of u above the planned one gets a note with the delay margin.

    `beyond` is how far the age exceeds the delay of the gains plus their margin, s.
    """
    mean = max(SERVO.controller.delay + margin + beyond, 0.0)
    figures = summarise(
        replace(tape, signals={**tape.signals, "age_of_u": signal([0, 1], mean=mean, max=1.0)}),
        SERVO,
    )
    assert figures["age_of_u"] == {"mean": mean, "max": 1.0}
    notes = [note for note in figures["notes"] if note.startswith("u is ")]
    assert [note.rpartition(": ")[2].partition(" their")[0] for note in notes] == (
        [verdict] if verdict else []
    )
    assert all(f"delay margin of {1e3 * margin:.1f} ms" in note for note in notes)
