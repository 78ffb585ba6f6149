# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the difference of two logs is the one of their signals, at any rates and with gaps."""

import numpy as np
import pytest

from flight_analysis.report.overlay import TOLERANCE, difference
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray


def tape(topic: str, t: FloatArray, values: FloatArray, start: float = 0.0) -> Tape:
    stamps = np.round((t + start) * NANOSECONDS).astype(np.int64)
    signal = Signal(stamps, ("phi",), values[:, None])
    return Tape({topic: signal}, round(start * NANOSECONDS))


def test_difference_of_sines_is_the_closed_form() -> None:
    """The difference of sin t and 0.9 sin t has the rms 0.1 / sqrt 2 and a maximum of 0.1.

    The maximum is at pi / 2. The logs have other rates and begin at other times of day.
    """
    t, finer = np.linspace(0.0, 2.0 * np.pi, 2001), np.linspace(0.0, 2.0 * np.pi, 7001)
    found = difference(
        tape("y", t, np.sin(t), 100.0), tape("y", finer, 0.9 * np.sin(finer), 5e3), "y", "phi"
    )
    assert found is not None
    assert found.rms == pytest.approx(0.1 / np.sqrt(2.0), rel=1e-3)
    assert found.most == pytest.approx(0.1, rel=1e-3)
    assert found.at % np.pi == pytest.approx(np.pi / 2.0, abs=0.02)
    assert found.tolerance == pytest.approx(TOLERANCE)
    # abs(0.1 sin t) > 0.02 in all but 4 asin(0.2) of 2 pi
    assert found.outside == pytest.approx(1.0 - 4.0 * np.arcsin(0.2) / (2.0 * np.pi), abs=0.01)


def test_tolerance_of_a_channel_replaces_that_of_its_size() -> None:
    """abs(0.1 sin t) is above 0.05 in all but 4 asin(0.5) of 2 pi, which leaves two thirds."""
    t = np.linspace(0.0, 2.0 * np.pi, 2001)
    logs = (tape("y", t, np.sin(t)), tape("y", t, 0.9 * np.sin(t)))
    found = difference(*logs, "y", "phi", tolerance=0.05)
    assert found is not None
    assert found.tolerance == 0.05
    assert found.outside == pytest.approx(2.0 / 3.0, abs=0.01)


def test_gap_and_values_that_are_no_number_are_not_compared_and_that_is_said() -> None:
    """The second log has no samples from 4 to 8 s.

    The first log has no numbers in its last tenth.
    """
    t = np.linspace(0.0, 10.0, 1001)
    values = np.where(t > 9.0, np.nan, 1.0)
    kept = t[(t <= 4.0) | (t >= 8.0)]
    found = difference(tape("y", t, values), tape("y", kept, np.ones(len(kept))), "y", "phi")
    assert found is not None
    assert found.outside == 0.0
    assert found.compared == pytest.approx(0.5, abs=0.01)


def test_angle_between_two_samples_goes_the_short_way() -> None:
    """The angle halfway between 179 and -179 deg is 180 deg, and not 0."""
    ends = np.array([0.0, 1.0])
    second = tape("pose", ends, np.radians([179.0, -179.0]))
    found = difference(tape("pose", np.array([0.5]), np.array([np.pi])), second, "pose", "phi")
    assert found is not None
    assert found.most == pytest.approx(0.0, abs=1e-9)


def test_input_is_held_between_samples_and_output_is_linear() -> None:
    """At 0.5 s, a step from 0 to 1 at 1 s is still 0 if it is held, and 0.5 if it is linear."""
    first = {topic: tape(topic, np.array([0.5]), np.array([1.0])) for topic in ("y", "u")}
    second = {
        topic: tape(topic, np.array([0.0, 1.0]), np.array([0.0, 1.0])) for topic in ("y", "u")
    }
    found = {topic: difference(first[topic], second[topic], topic, "phi") for topic in ("y", "u")}
    assert {topic: each.most for topic, each in found.items() if each} == {"y": 0.5, "u": 1.0}


def test_angle_over_the_turn_differs_by_the_short_way() -> None:
    """The difference between 179 and -179 deg is 2 deg."""
    t = np.array([0.0, 1.0])
    first, second = (tape("pose", t, np.radians(np.full(2, angle))) for angle in (179.0, -179.0))
    found = difference(first, second, "pose", "phi")
    assert found is not None
    assert np.degrees(found.most) == pytest.approx(2.0)


def test_logs_without_a_common_time_have_no_difference() -> None:
    """Times are counted from the start of each log."""
    early, late = np.array([0.0, 1.0]), np.array([2.0, 3.0])
    assert difference(tape("y", early, early), tape("y", late, late), "y", "phi") is None
    empty = np.array([np.nan, np.nan])
    assert difference(tape("y", early, early), tape("y", early, empty), "y", "phi") is None
