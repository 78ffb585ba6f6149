# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure the timing of the controller's ticks, and the latency and the age of u."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.rates import seconds
from flight_core.tape import Tape


class TickMetrics(NamedTuple):
    """The timing of the controller's ticks, with times in s."""

    ticks: int
    # number of periods in which no new y arrived, or the tick was missed
    without_new_y: int
    period_mean: float
    period_p99: float
    period_max: float
    jitter: float  # rms deviation of the time between ticks from a whole number of periods, s
    late_p99: float
    late_max: float
    age_p99: float


class AgeMetrics(NamedTuple):
    """The age of u at the aircraft, s: the delay of the whole loop from y to u."""

    mean: float
    max: float


class LatencyMetrics(NamedTuple):
    """The time from sending y to sending the u that is computed from it, s."""

    median: float
    p99: float
    max: float


def tick_periods(tape: Tape) -> NDArray[np.int64]:
    """Return the time between successive ticks of the controller, ns, shape (N - 1,).

    The instant of a tick is the stamp of its sample plus the channel "age". The same instant is the
    deadline of the tick plus the channel "late".
    """
    internals = tape["internals"]
    return np.diff(internals.stamp_ns + np.round(internals["age"] * 1e9).astype(np.int64))


def tick_metrics(tape: Tape, period_ns: int) -> TickMetrics | None:
    """Return the metrics of the controller's ticks, or None if there are fewer than two ticks.

    The topic `internals` only has ticks with a new y. So a period without a tick in the log is
    counted as a tick without a new y, although the controller may have missed this tick.
    """
    internals = tape["internals"]
    if len(internals.stamp_ns) < 2:
        return None
    periods = tick_periods(tape)
    elapsed = round(float(periods.sum()) / period_ns)
    deviation = periods - period_ns * np.round(periods / period_ns)
    return TickMetrics(
        ticks=len(internals.stamp_ns),
        without_new_y=max(elapsed - len(periods), 0),
        period_mean=seconds(int(periods.mean())),
        period_p99=seconds(int(np.percentile(periods, 99))),
        period_max=seconds(int(periods.max())),
        jitter=float(np.sqrt(np.mean(deviation**2))) / 1e9,
        late_p99=float(np.percentile(internals["late"], 99)),
        late_max=float(internals["late"].max()),
        age_p99=float(np.percentile(internals["age"], 99)),
    )


def latency_metrics(tape: Tape) -> LatencyMetrics | None:
    """Return the metrics of the signal `latency`, or None if the tape has none."""
    if "latency" not in tape or len(tape["latency"].stamp_ns) == 0:
        return None
    latency = tape["latency"].values[:, 0]
    return LatencyMetrics(
        float(np.median(latency)), float(np.percentile(latency, 99)), float(latency.max())
    )


def age_metrics(tape: Tape) -> AgeMetrics | None:
    """Return the metrics of the signal `age_of_u`, or None if the tape has none."""
    if "age_of_u" not in tape or len(tape["age_of_u"].stamp_ns) == 0:
        return None
    return AgeMetrics(float(tape["age_of_u"]["mean"].mean()), float(tape["age_of_u"]["max"].max()))
