# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the errors and the control effort of a flight, by part of the flight."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from flight_analysis.metrics.errors import ErrorMetrics, best_error, error_metrics
from flight_analysis.metrics.time_spans import sample_times
from flight_analysis.metrics.transients import SETTLING_DWELL, Air, Transient, part_masks
from flight_core.tape import Tape
from flight_core.vectors import FloatArray


@dataclass(frozen=True, kw_only=True)
class InputMetrics(ErrorMetrics):
    """Deviation of an input from trim over some samples, in the unit of the input.

    `rate` is the mean of abs(u_dot), in this unit per s.
    """

    rate: float


def errors_by_part(
    tape: Tape,
    transients: Sequence[Transient],
    settle: float = SETTLING_DWELL,
    air: Air = Air.CALM,
) -> dict[str, dict[str, ErrorMetrics]]:
    """Return rms and maximum of `best_error` by channel and part of the flight.

    The maximum of the part "calm" is the ultimate bound. This is the largest abs(e) in calm air,
    later than `settle` s after the end of every transient.
    """
    _, error = best_error(tape)
    masks = part_masks((error.stamp_ns - tape.start_ns) / 1e9, transients, settle, air)
    times = sample_times(error.stamp_ns)
    by_channel = {}
    for name in error.names:
        by_channel[name] = {
            part: error_metrics(error[name][mask], times[mask]) for part, mask in masks.items()
        }
    return by_channel


def inputs_by_part(
    tape: Tape,
    transients: Sequence[Transient],
    settle: float = SETTLING_DWELL,
    topic: str = "u",
    air: Air = Air.CALM,
) -> dict[str, dict[str, InputMetrics]]:
    """Return the control effort by input and part of the flight.

    The metrics are rms and max abs(u) about trim, and mean abs(u_dot), which is sum abs(u_k -
    u_(k-1)) / sum (t_k - t_(k-1)) over the steps that end in the part. This mean is NaN if there is
    no such step. If `topic` is "y", the metrics are computed from y in place of u.
    """
    if topic not in tape:
        return {}
    u = tape[topic]
    t = tape.time(topic)
    masks = part_masks(t, transients, settle, air)
    times = sample_times(u.stamp_ns)

    def metrics(values: FloatArray, mask: NDArray[np.bool_]) -> InputMetrics:
        steps = mask[1:]
        time = float(np.diff(t)[steps].sum())
        rate = float(np.abs(np.diff(values))[steps].sum()) / time if time > 0 else float("nan")
        return InputMetrics(**asdict(error_metrics(values[mask], times[mask])), rate=rate)

    by_input = {}
    for name in u.names:
        by_input[name] = {part: metrics(u[name], mask) for part, mask in masks.items()}
    return by_input
