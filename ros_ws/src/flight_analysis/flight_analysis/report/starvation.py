# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the spans of a flight in real time in which the host was too busy to run the nodes.

A node of this package sends a sample at each instant of its rate, and numbers its messages. If an
instant has no sample and yet no number is missing, the node did not send, because the host did not
let it run. The errors of the flight are not used to find such spans.

A law that computes for too long also leaves out ticks. Missing ticks are therefore used only if
another node has left out samples as well. If a publisher was replaced, or if messages were lost, a
gap proves nothing.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.metrics.time_spans import mask_spans
from flight_analysis.report.sample_counts import TopicAccount, is_real_time, is_sent_by_stack
from flight_core.tape import Recording, Tape
from flight_core.vectors import FloatArray

BUSY = 0.05  # share of the ticks; a host that leaves out more is too busy

WINDOW = 1.0  # s, window in which BUSY counts, so that one missing sample is harmless

RECOVERY = 5.0
"""Time after a starved span until the errors that it caused have decayed, s. The airspeed of the
osprey has settled by then."""


class Starvation(NamedTuple):
    """The spans of a flight in which the host was too busy, flight time in s, in order.

    The flight in these spans says nothing about the law.
    """

    spans: tuple[tuple[float, float], ...] = ()

    @property
    def length(self) -> float:
        """The total length of the spans, s."""
        return math.fsum(stop - start for start, stop in self.spans)

    def is_starved(self, t: FloatArray) -> NDArray[np.bool_]:
        """Return a mask of the instants t, (N,), that lie within a span."""
        inside = np.zeros(len(t), dtype=bool)
        for start, stop in self.spans:
            inside |= (t >= start) & (t <= stop)
        return inside


def starvation(
    tape: Tape, scenario: Scenario, topics: Mapping[str, TopicAccount], end: float
) -> Starvation:
    """Return the spans in which the host was too busy to run the nodes.

    Each span is lengthened by RECOVERY, because the errors that the busy host caused decay only
    after it. `end` is the length of the flight, s. A flight in lockstep, in one process or by the
    clock of a simulator has no such spans.
    """
    if not is_real_time(tape) or tape.is_by_clock or end <= 0.0:
        return Starvation()
    step = 1.0 / scenario.controller.rate
    count = math.ceil(end / step)
    drops = scenario.aircraft.sensors.dropout > 0.0
    rates = {
        # A sensor may drop samples of y, but truth has a sample at each instant.
        "truth" if drops else "y": scenario.aircraft.rate,
        "y_m": scenario.reference_model.rate,
    }
    is_missing = np.zeros(count, dtype=bool)
    for name, rate in rates.items():
        if name in topics and topics[name].is_of_stack:
            is_missing |= _is_missing(tape, name, max(step, 1.0 / rate), step, count)
    length = max(round(WINDOW / step), 1)
    is_starved = _windowed(is_missing, length) >= 1.0
    if not drops:
        is_missing |= _is_missing(tape, "internals", step, step, count)
    is_starved &= _windowed(is_missing, length) >= BUSY * length
    # Each such instant is in the middle of a WINDOW that was starved.
    t: FloatArray = step * np.arange(count, dtype=np.float64)
    spans: list[tuple[float, float]] = []
    for start, stop in mask_spans(t, is_starved):
        begin = max(start - WINDOW / 2.0, 0.0)
        last = min(stop + WINDOW / 2.0 + RECOVERY, end)
        if spans and begin <= spans[-1][1]:
            spans[-1] = (spans[-1][0], last)
        else:
            spans.append((begin, last))
    return Starvation(tuple(spans))


def _is_missing(tape: Tape, name: str, period: float, step: float, count: int) -> NDArray[np.bool_]:
    """Return a mask of the instants k * step at which a node should have sent a sample, (count,).

    `period` is the period of the samples, s, and is at least a step.
    """
    is_missing = np.zeros(count, dtype=bool)
    signal = tape.signals.get(name)
    has_all = tape.recording.get(name, Recording(0)).lost == 0
    if signal is None or not has_all or not is_sent_by_stack(tape, name):
        return is_missing
    t = tape.time(name)
    if name == "internals":
        t = t + signal["age"]  # the instant of the tick
    for k in np.flatnonzero(np.diff(t) >= 1.5 * period):
        is_replaced = signal.sender is not None and signal.sender[k] != signal.sender[k + 1]
        if is_replaced:
            continue
        left_out = t[k] + period * np.arange(1, round((t[k + 1] - t[k]) / period))
        instants = np.floor(left_out / step).astype(int)
        is_missing[instants[(instants >= 0) & (instants < count)]] = True
    return is_missing


def _windowed(is_missing: NDArray[np.bool_], length: int) -> FloatArray:
    """Count, for each instant, the missing samples at the `length` instants around it, (N,)."""
    total = np.concatenate([[0.0], np.cumsum(is_missing)])
    k = np.arange(len(is_missing))
    first = np.maximum(k - length // 2, 0)
    last = np.minimum(first + length, len(is_missing))
    return np.asarray(total[last] - total[first])
