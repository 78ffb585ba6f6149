# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compare the signals that several logs have in common, even if other programs wrote the logs.

The difference of a signal is taken at the instants of the first log. At these instants the other
log must have samples at most LONGEST_INTERVAL apart. Between its samples, y and pose are
interpolated linearly, and u is held. A value that is not finite is not compared. The table states
which part of the time was compared. The tolerance of a signal can be given by its name. If it is
not given, it is the fraction TOLERANCE of the largest absolute value in the first log.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from flight_analysis.metrics.time_spans import LONGEST_INTERVAL
from flight_analysis.report.display_units import (
    NO_UNIT,
    NO_VALUE,
    POSE_UNITS,
    DisplayUnit,
    channel_label,
    format_value,
    in_order,
)
from flight_analysis.report.summary import RecordedFlight, labels
from flight_analysis.report.summary_rows import Column
from flight_analysis.report.tables import MetricTable
from flight_core.parameters import one_of, require
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray

TOPICS = ("y", "u", "pose")
HELD = ("u",)  # topics whose values are held until the next sample
ANGLES = ("phi", "theta", "psi")  # angles of a pose, rad, which differ by at most pi
TOLERANCE = 0.02


class Difference(NamedTuple):
    """How a signal of a log differs from the same signal of the first log, SI."""

    rms: float
    most: float
    at: float  # when the difference is largest, s
    tolerance: float
    outside: float  # fraction of the compared instants beyond the tolerance
    compared: float  # fraction of the instants of the first log that were compared


def difference(
    first: Tape, second: Tape, topic: str, name: str, tolerance: float | None = None
) -> Difference | None:
    """Return how a channel differs between two logs, or None if they have no time in common.

    The tolerance is in SI. If None, it is the fraction TOLERANCE of the largest absolute value in
    the first log.
    """
    t, before = _samples(first, topic, name)
    instants, values = _samples(second, topic, name)
    if not (len(t) and len(instants)):
        return None
    if topic == "pose" and name in ANGLES:
        values = np.unwrap(values)
    last = np.searchsorted(instants, t, side="right") - 1
    following = np.minimum(last + 1, len(instants) - 1)
    is_common = (t >= instants[0]) & (t <= instants[-1])
    is_common &= instants[following] - instants[last] <= LONGEST_INTERVAL
    if not is_common.any():
        return None
    t, before = t[is_common], before[is_common]
    if topic in HELD:
        after = values[np.searchsorted(instants, t, side="right") - 1]
    else:
        after = np.interp(t, instants, values)
    change = after - before
    if topic == "pose" and name in ANGLES:
        change = np.angle(np.exp(1j * change))
    if tolerance is None:
        tolerance = TOLERANCE * float(np.max(np.abs(before)))
    size = np.abs(change)
    worst = int(np.argmax(size))
    return Difference(
        rms=float(np.sqrt(np.mean(change**2))),
        most=float(size[worst]),
        at=float(t[worst]),
        tolerance=tolerance,
        outside=float(np.mean(size > tolerance)),
        compared=len(t) / len(first[topic].stamp_ns),
    )


def _samples(tape: Tape, topic: str, name: str) -> tuple[FloatArray, FloatArray]:
    """Return the times of the finite values of a channel, s from the start, and these values."""
    signal: Signal = tape[topic]
    values = signal[name]
    is_finite = np.isfinite(values)
    t = (signal.stamp_ns - tape.start_ns) / NANOSECONDS
    return t[is_finite], values[is_finite]


def difference_table(
    flights: Sequence[RecordedFlight],
    units: Mapping[str, DisplayUnit],
    tolerances: Mapping[str, float],
) -> MetricTable:
    """Return the differences of each later log from the first, with a row for each common signal.

    `tolerances` has the tolerances of channels by name, SI. Raises ParameterError if `tolerances`
    names a channel that no two logs have in common.
    """
    first, *others = flights
    rows = []
    left_out = []
    named: set[str] = set()
    for label, other in zip(labels(flights)[1:], others, strict=True):
        for topic in TOPICS:
            in_first, in_other = (
                each.tape[topic].names if topic in each.tape else () for each in (first, other)
            )
            left_out += [f"{topic} {name}" for name in {*in_first} ^ {*in_other}]
            known = POSE_UNITS if topic == "pose" else units
            common = [name for name in in_first if name in in_other]
            for name in in_order(common, known):
                named.add(name)
                found = difference(first.tape, other.tape, topic, name, tolerances.get(name))
                title = f"{topic} {channel_label(name, known)}"
                of_log = f"{label}: {title}" if len(others) > 1 else title
                rows.append([of_log, *_cells(found, known.get(name, NO_UNIT))])
    for name in tolerances:
        require(name in named, "tolerances", repr(name), one_of(sorted(named), name))
    heads = ("rms", "largest", "at (s)", "tolerance", "outside, %", "compared, %")
    absent = ", ".join(sorted(set(left_out)))
    note = (
        f"Unless given, the tolerance is {100 * TOLERANCE:g} % of the largest value in the first "
        "log. Outside is the part of the compared instants in which the difference is larger"
    )
    if absent:
        note += f". Not in both logs: {absent}"
    return MetricTable("", [Column(group="", head=head) for head in heads], rows, note)


def _cells(found: Difference | None, unit: DisplayUnit) -> list[str]:
    """Return the cells of a row in the unit of the signal, or empty cells for None."""
    if found is None:
        return [*[NO_VALUE] * 5, "0.0"]
    rms, most, tolerance = (
        format_value(value, unit.factor) for value in (found.rms, found.most, found.tolerance)
    )
    shares = (f"{100 * share:.1f}" for share in (found.outside, found.compared))
    return [rms, most, f"{found.at:.2f}", tolerance, *shares]
