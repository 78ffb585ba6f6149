# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the tracking error of a flight, its size and the noise below it.

A simulation logs the true state and pose too, without the errors of the sensors. The functions
`best_...` take what is true if the tape has it, and else what was measured.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from flight_core.parameters import require
from flight_core.tape import Signal, Tape, as_tape
from flight_core.vectors import FloatArray, as_array

# names that `best_error` returns
TRUE_ERROR = "true error"
MEASURED_ERROR = "measured error"


@dataclass(frozen=True, kw_only=True)
class ErrorMetrics:
    """Tracking error of a channel over some samples, in the unit of the channel."""

    rms: float
    max: float


def best_pose(tape: Tape) -> Signal | None:
    """Return the true pose if the simulation has logged it, else the measured one, if any.

    The channels are `flight_core.channels.POSE`. The true pose is better, because errors of the
    sensors, or a pose from another publisher, change the measured pose but not the aircraft.
    """
    if "truth" in tape and len(tape["truth"].stamp_ns):
        pose = tape["truth"].group("pose")
        if pose.names:
            return pose
    if "pose" in tape and len(tape["pose"].stamp_ns):
        return tape["pose"]
    return None


def tracking_error(tape: Tape) -> Signal:
    """Return the measured error e = y - y_m, (N, m).

    The result has a row for each sample of y within the time of y_m. Channels that y_m lacks are
    left out. y_m is interpolated linearly. The law controls this error, which contains the noise of
    the sensors.
    """
    names = _controlled(tape)
    return _minus_reference(
        Signal(tape["y"].stamp_ns, names, _columns(tape["y"], names)), tape["y_m"]
    )


def _controlled(tape: Tape) -> tuple[str, ...]:
    """Return the channels that y and y_m share. Raises ParameterError if there are none."""
    names = tuple(name for name in tape["y"].names if name in tape["y_m"].names)
    require(
        bool(names),
        "the log",
        f"y of {', '.join(tape['y'].names)}",
        f"a channel of y_m: {', '.join(tape['y_m'].names)}",
    )
    return names


def true_error(tape: Tape) -> Signal | None:
    """Return the true error C x - y_m, (N, m), which only a simulation logs.

    The result has a row for each sample of the topic `truth` within the time of y_m. It has the
    same channels as `tracking_error`. The noise and bias of the sensors do not enter this error,
    except through their effect on the flight. Returns None if `truth` lacks the state x.CHANNEL of
    one of the channels.
    """
    if "truth" not in tape:
        return None
    truth = tape["truth"]
    names = _controlled(tape)
    states = [f"x.{name}" for name in names]
    if not set(states) <= set(truth.names):
        return None
    return _minus_reference(Signal(truth.stamp_ns, names, _columns(truth, states)), tape["y_m"])


def best_error(tape: Tape) -> tuple[str, Signal]:
    """Return the name and the signal of the most accurate error e = y - y_m on a tape.

    This is the true error if the tape has it, else the measured one. The name is "true error" or
    "measured error". The signal has the shape (N, m) and is in SI. Raises ParameterError if the
    tape has no y and y_m.
    """
    error = true_error(as_tape(tape))
    return (MEASURED_ERROR, tracking_error(tape)) if error is None else (TRUE_ERROR, error)


def _minus_reference(y: Signal, y_m: Signal) -> Signal:
    if len(y.stamp_ns) == 0 or len(y_m.stamp_ns) == 0:
        return Signal(np.zeros(0, dtype=np.int64), y.names, np.zeros((0, len(y.names))))
    first = np.searchsorted(y.stamp_ns, y_m.stamp_ns[0])
    end = np.searchsorted(y.stamp_ns, y_m.stamp_ns[-1], side="right")
    stamps = y.stamp_ns[first:end]
    values = y.values[first:end]
    if np.array_equal(stamps, y_m.stamp_ns):
        return Signal(stamps, y.names, values - _columns(y_m, y.names))
    # float64 represents a stamp exactly if it is relative to the first one, but not if it counts ns
    # since the epoch.
    instants = (stamps - y_m.stamp_ns[0]).astype(float)
    knots = (y_m.stamp_ns - y_m.stamp_ns[0]).astype(float)
    reference = np.stack([np.interp(instants, knots, y_m[name]) for name in y.names]).T
    return Signal(stamps, y.names, values - reference)


def _columns(signal: Signal, names: Sequence[str]) -> FloatArray:
    return np.stack([signal[name] for name in names]).T


def noise_floor(tape: Tape) -> dict[str, float]:
    """Return the noise floor of y by channel, SI: the error below which the sensors tell nothing.

    The floor is the rms of "noise.CHANNEL" of the topic `truth` if the tape has this channel. If
    not, the floor is estimated for white noise from the second differences d_k = y_(k+1) - 2 y_k +
    y_(k-1), as rms = median(abs(d)) / (0.6745 sqrt(6)). d has 6 times the variance of the noise,
    and half of a normal distribution lies within 0.6745 rms. The floor is at least the rounding of
    the largest y. A true error, which only a simulation knows, can be smaller than the floor.
    """
    noise = tape["truth"].group("noise") if "truth" in tape else None
    floor = {}
    for name in tape["y"].names:
        y = tape["y"][name]
        if noise is not None and name in noise.names:
            rms = float(np.sqrt(np.mean(noise[name] ** 2)))
        elif len(y) > 2:
            rms = float(np.median(np.abs(np.diff(y, 2)))) / (0.6745 * 6.0**0.5)
        else:
            rms = math.nan
        largest = np.max(np.abs(y), initial=0.0)
        floor[name] = max(rms, float(np.spacing(largest)) if largest > 0.0 else 0.0)
    return floor


def error_metrics(errors: ArrayLike, times: FloatArray | None = None) -> ErrorMetrics:
    """Compute the root mean square and the largest abs(e) of N samples.

    rms = sqrt(sum t e^2 / sum t) with the `times` t of the samples. If all times are equal, it is
    sqrt(mean e^2).

    Args:
        errors: Samples e of a channel, shape (N,), in any unit.
        times: Time that each sample stands for, shape (N,), s. If None, all times are equal.

    Returns:
        `rms` and `max`, in the unit of the errors. Both are NaN if N = 0.

    Raises:
        ParameterError: `errors` are no numbers of shape (N,).

    Examples:
        >>> rise_di.error_metrics([3.0, -4.0]).max
        4.0
    """
    e = as_array(errors, "errors", expected := "samples of one channel, (N,)")
    require(e.ndim == 1, "errors", f"an array of shape {e.shape}", expected)
    if len(e) == 0:
        return ErrorMetrics(rms=math.nan, max=math.nan)
    weighted = times is not None and np.ptp(times) > 0.0
    square = np.average(e**2, weights=times) if weighted else np.mean(e**2)
    return ErrorMetrics(rms=float(np.sqrt(square)), max=float(np.max(np.abs(e))))
