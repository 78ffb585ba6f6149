# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures of a flight: pure functions of a tape."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.rates import seconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray

Windows = Mapping[str, tuple[float, float]]

SETTLE = 1.0
"""s. What a gust leaves behind is counted to it for as long after its end."""

PARTS = f"gust: from the entry of a gust to {SETTLE:g} s after its end; calm: the rest"
"""What the parts of the tables mean, for people."""


class ErrorFigures(NamedTuple):
    """Tracking error of one channel over some samples, in its unit."""

    rms: float
    max: float


class TickFigures(NamedTuple):
    """How regularly the controller ticked; times in s."""

    ticks: int
    without_new_y: int  # periods of the controller in which it took no step: no new y had come, or the tick was missed
    period_mean: float
    period_p99: float
    period_max: float
    late_p99: float
    late_max: float
    age_p99: float


def tracking_error(tape: Tape) -> Signal:
    """Error e = y - y_m at every y whose stamp y_m has too or spans (linear between samples), shape (N, m), channels of y.

    It is the error that the law sees: the sensors' noise is part of it.
    """
    return _minus_reference(tape["y"], tape["y_m"])


def true_error(tape: Tape) -> Signal | None:
    """True error C x - y_m at every sample of `truth` that y_m has too or spans, shape (N, m), channels of y.

    It is the error that the aircraft makes, without the sensors' own, and also at samples that were lost. None where the tape
    has no "x.output" in `truth` for each channel of y; only a simulation knows it.
    """
    if "truth" not in tape:
        return None
    x, names = tape["truth"].group("x"), tape["y"].names
    if not set(names) <= set(x.names):
        return None
    return _minus_reference(Signal(x.stamp_ns, names, np.column_stack([x[name] for name in names])), tape["y_m"])


def known_error(tape: Tape) -> tuple[str, Signal]:
    """The best error that a tape knows, after what it is called: "true error", else "measured error"."""
    error = true_error(tape)
    return ("measured error", tracking_error(tape)) if error is None else ("true error", error)


def _minus_reference(y: Signal, y_m: Signal) -> Signal:
    if len(y.stamp_ns) == 0 or len(y_m.stamp_ns) == 0:
        return Signal(np.zeros(0, dtype=np.int64), y.names, np.zeros((0, len(y.names))))
    inside = (y.stamp_ns >= y_m.stamp_ns[0]) & (y.stamp_ns <= y_m.stamp_ns[-1])
    stamps = y.stamp_ns[inside]
    # Relative to the first stamp float64 is exact; the epoch in ns is not.
    at, knots = (stamps - y_m.stamp_ns[0]).astype(float), (y_m.stamp_ns - y_m.stamp_ns[0]).astype(float)
    reference = np.column_stack([np.interp(at, knots, y_m[name]) for name in y.names])
    return Signal(stamps, y.names, y.values[inside] - reference)


def in_windows(t: FloatArray, windows: Windows, settle: float) -> NDArray[np.bool_]:
    """Which instants lie in a window or up to `settle` seconds after it, shape (N,)."""
    inside = np.zeros(len(t), dtype=bool)
    for start, stop in windows.values():
        inside |= (t >= start) & (t <= stop + settle)
    return inside


def error_figures(errors: FloatArray) -> ErrorFigures:
    """Root mean square sqrt(mean e^2) and max abs(e) of samples of shape (N,); NaN where N = 0."""
    if len(errors) == 0:
        return ErrorFigures(float("nan"), float("nan"))
    return ErrorFigures(float(np.sqrt(np.mean(errors**2))), float(np.max(np.abs(errors))))


def error_table(tape: Tape, gusts: Windows, settle: float = SETTLE) -> dict[str, dict[str, ErrorFigures]]:
    """Figures of `known_error` by channel and part: "whole", "calm", "gust" (the gusts and `settle` seconds after each)."""
    _, error = known_error(tape)
    t = (error.stamp_ns - tape.start_ns) / 1e9
    gust = in_windows(t, gusts, settle)
    parts = {"whole": np.ones(len(t), dtype=bool), "calm": ~gust, "gust": gust}
    return {name: {part: error_figures(error[name][mask]) for part, mask in parts.items()} for name in error.names}


def tick_figures(tape: Tape, period_ns: int) -> TickFigures | None:
    """Figures of the controller's ticks from `internals`, None where there are fewer than two.

    The instant of a tick is stamp + "age", which is its deadline plus "late". Only a tick with a new y is in `internals`, so a
    period without one is counted alike whether y did not come or the tick was missed.
    """
    internals = tape["internals"]
    if len(internals.stamp_ns) < 2:
        return None
    offset = np.round(internals["age"] * 1e9).astype(np.int64)
    instants = internals.stamp_ns + offset
    periods = np.diff(instants)
    elapsed = round(float(instants[-1] - instants[0]) / period_ns)
    return TickFigures(
        ticks=len(instants),
        without_new_y=max(elapsed + 1 - len(instants), 0),
        period_mean=seconds(int(periods.mean())),
        period_p99=seconds(int(np.percentile(periods, 99))),
        period_max=seconds(int(periods.max())),
        late_p99=float(np.percentile(internals["late"], 99)),
        late_max=float(internals["late"].max()),
        age_p99=float(np.percentile(internals["age"], 99)),
    )
