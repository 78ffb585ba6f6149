# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute how long the error takes to settle after each transient of a flight."""

from collections.abc import Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from flight_analysis.metrics.errors import MEASURED_ERROR, best_error, noise_floor
from flight_analysis.metrics.transients import GUIDED, SETTLING_DWELL, Transient
from flight_core.tape import Tape
from flight_core.vectors import FloatArray

SETTLING_BAND = 0.01  # half-width of the settling band as a fraction of the largest abs(y_m)

MIN_BAND_NOISE_FLOORS = 4.0
"""Least half-width of the settling band of a measured error, as a multiple of the noise floor. With
a probability of 97 %, 500 samples of normal noise stay within 4 noise floors."""


def settling_bands(tape: Tape) -> dict[str, float]:
    """Return the half-width of the settling band by channel, SI: SETTLING_BAND max abs(y_m).

    If y_m is zero throughout, max abs(e) replaces max abs(y_m). If the error is a measured one, the
    half-width is at least MIN_BAND_NOISE_FLOORS noise floors, because noise alone would leave a
    narrower band.
    """
    kind, error = best_error(tape)
    floors = noise_floor(tape) if kind == MEASURED_ERROR else {}

    def largest(values: FloatArray) -> float:
        return float(np.max(np.abs(values), initial=0.0))

    return {
        name: max(
            SETTLING_BAND * (largest(tape["y_m"][name]) or largest(error[name])),
            MIN_BAND_NOISE_FLOORS * floors.get(name, 0.0),
        )
        for name in error.names
    }


def settling_time(
    t: FloatArray, e: FloatArray, band: float, leaves: float, dwell: float = SETTLING_DWELL
) -> float | None:
    """Return the time, s, after which abs(e) stays in the band for `dwell` s or until the end.

    The time is measured from t[0], and t and e have the shape (N,). `leaves` is the time, s, within
    which a transient moves e out of the band. If abs(e) stays in the band for this time, the result
    is 0, even if abs(e) leaves the band later. The result is None if abs(e) does not return to the
    band, or if there is no sample.
    """
    if len(t) == 0:
        return None
    above = np.flatnonzero(np.abs(e) > band)
    if len(above) == 0 or t[above[0]] - t[0] > leaves:
        return 0.0
    next_above = np.append(t[above[1:]], np.inf)
    back = above + 1 < len(t)
    begin = t[above[back] + 1]
    stays = begin[next_above[back] - begin >= dwell]
    return float(stays[0] - t[0]) if len(stays) else None


class Settling(NamedTuple):
    """Settling times after one transient, for each channel that the transient excites."""

    transient: Transient
    until: dict[str, float]  # start of the next transient of the channel, or end of the flight, s
    time: dict[str, float | None]  # settling time, s, or None if not settled before `until`


def settling_times(tape: Tape, transients: Sequence[Transient]) -> list[Settling]:
    """Return, for each transient, how long `best_error` takes to settle in the `settling_bands`.

    The time is measured from the start of the transient. Samples are used up to the next transient
    that excites the same channel. Transients after the end of the flight are left out. Turns and
    captures are also left out, because their commands change until they end.
    """
    _, error = best_error(tape)
    t = (error.stamp_ns - tape.start_ns) / 1e9
    bands = settling_bands(tape)
    end = float(t[-1]) if len(t) else 0.0
    results = []
    events = [
        transient
        for transient in transients
        if transient.start <= end and transient.kind not in GUIDED
    ]
    for transient in sorted(events, key=attrgetter("start")):
        start = transient.start
        leaves = transient.stop + SETTLING_DWELL - transient.start
        until = {}
        times = {}
        for name in filter(transient.is_excitation_of, error.names):
            until[name] = min(
                [
                    later.start
                    for later in transients
                    if later.is_excitation_of(name) and later.start > start
                ]
                + [end]
            )
            inside = (t >= start) & ((t < until[name]) | (until[name] == end))
            times[name] = settling_time(t[inside], error[name][inside], bands[name], leaves)
        results.append(Settling(transient, until, times))
    return results
