# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Step tests of an unknown aircraft: Omega and lags from the steepest tangents of the responses."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from flight_core.outcome import FlightEnded
from flight_core.vectors import FloatArray

SIZES = (0.05, 0.1, 0.2)
"""Steps, in normalised commands: the small ones stay linear, the large ones exceed a hysteresis and
reach a rate limit."""
MAX_STEP_FRACTION = 0.9  # upper bound of a step, as a fraction of the distance to the end stop
WINDOWS = {"V": 10.0}  # s, length of a response: engines and propellers need seconds to spin up
WINDOW = 0.5  # s, the same for body rates
SPAN = 0.025  # s, length of a chord
# the search ends when the slope has fallen to this fraction of the largest one so far
TANGENT_CUTOFF = 0.7
Fly = Callable[[FloatArray, float], FloatArray]
"""(constant u from trim, shape (m,); duration in s) -> y every `dt` from t = 0, shape (N + 1, m),
deviations from trim."""


class Tangent(NamedTuple):
    """The steepest chord of a step response, an estimate of the steepest tangent: y = slope (t -
    lag).
    """

    slope: float
    lag: float  # s
    first: int  # samples at its ends
    last: int


class Responses(NamedTuple):
    """Result of the step tests, outputs and inputs in their canonical order, output i driven by
    input i.
    """

    Omega: FloatArray  # (m, m) effective C B: slopes of y per unit of u
    lag: FloatArray  # (m,) s, of each input's own output
    size: FloatArray  # (m,) of the step with the steepest tangent
    spread: FloatArray  # (m,) smallest slope of all sizes / largest one: 1 is linear
    rejected: tuple[str, ...]  # steps without a result, with the reason


def steepest_tangent(y: FloatArray, dt: float) -> Tangent | None:
    """The steepest tangent of a unit step response, y of shape (N,) every dt; None if y is
    constant.

    A chord joins samples 25 ms apart. The result is the chord at the first maximum of the slope:
    the search ends when the slope has fallen to 0.7 of it. For y_dot = slope (1 - exp(-t / lag)) it
    gives slope and lag, up to exp(-t / lag) at the end. Source: the process reaction curve of J. G.
    Ziegler, N. B. Nichols, Trans. ASME 64, 1942.
    """
    count = max(round(SPAN / dt), 1)
    slopes = (y[count:] - y[:-count]) / (count * dt)
    sizes = np.abs(slopes)
    passed = np.flatnonzero(sizes < TANGENT_CUTOFF * np.maximum.accumulate(sizes))
    k = int(np.argmax(sizes[: passed[0]] if len(passed) else sizes))
    if sizes[k] == 0.0:
        return None
    lag = (k + count / 2.0) * dt - (y[k] + y[k + count]) / 2.0 / slopes[k]
    return Tangent(float(slopes[k]), max(float(lag), 0.0), k, k + count)


def step_responses(
    fly: Fly,
    lower: FloatArray,
    upper: FloatArray,
    outputs: Sequence[str],
    inputs: Sequence[str],
    dt: float,
    progress: Callable[[str], None] = lambda _: None,
) -> Responses:
    """Step each input in both directions, by several sizes, and take Omega and the lags from the
    tangents of its output.

    The response is the odd part, (y(+s) - y(-s)) / 2s: a drift of the trim and all even parts
    cancel. The steepest response of all sizes gives the column, Omega_ij = y_i / (t - lag) at the
    middle of the chord of j, and the longest lag is used: too large an Omega or lag costs little
    performance, too small a one costs stability. Raises FlightEnded if an output does not respond
    to any step.

    Arguments: `lower`, `upper` the end stops of u from trim, (m,); `dt` that of `fly`.
    """
    m = len(inputs)
    Omega = np.zeros((m, m))
    lag = np.zeros(m)
    size = np.zeros(m)
    spread = np.zeros(m)
    rejected: list[str] = []
    for j, (output, name) in enumerate(zip(outputs, inputs, strict=True)):
        progress(f"steps of {name}")
        responses: list[tuple[Tangent, float, FloatArray]] = []
        for step in sorted(
            {min(size, MAX_STEP_FRACTION * float(min(-lower[j], upper[j]))) for size in SIZES}
        ):
            u = step * np.eye(m)[j]
            window = WINDOWS.get(output, WINDOW)
            try:
                y = (fly(u, window) - fly(-u, window)) / (2.0 * step)
            except FlightEnded as error:
                rejected.append(f"{name} by {step:.3g}: {error}")
                continue
            chord = steepest_tangent(y[:, j], dt)
            if chord is None:
                rejected.append(f"{name} by {step:.3g}: {output} does not move")
                continue
            middle = (chord.first + chord.last) / 2.0 * dt
            responses.append(
                (chord, step, (y[chord.first] + y[chord.last]) / 2.0 / (middle - chord.lag))
            )
        if not responses:
            raise FlightEnded(f"{output} does not respond to {name}: {'; '.join(rejected)}")
        steepest, size[j], Omega[:, j] = max(responses, key=lambda response: abs(response[0].slope))
        lag[j] = max(chord.lag for chord, *_ in responses)
        spread[j] = min(abs(chord.slope) for chord, *_ in responses) / abs(steepest.slope)
    return Responses(Omega, lag, size, spread, tuple(rejected))
