# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute metrics of what the controller and its learner log.

They are how often an input saturates, how often the sign term switches, and which entries of the
model are learned.
"""

import numpy as np

from flight_analysis.metrics.errors import tracking_error
from flight_core.rates import seconds
from flight_core.tape import Signal, Tape
from rise_di_controller.internals import Saturation

# A flight shows an entry if the entry's standard deviation, relative to its value, is below this
# number. The number is half of the deviation before the flight.
MAX_DEVIATION = 0.15


def known_entries(learned: Signal) -> list[str]:
    """Return the names of the entries of A and B that the flight has identified.

    `learned` has the samples of the topic `learned`. An entry is identified if at least one sample
    has a standard deviation of the entry below MAX_DEVIATION times its value.
    """
    values = learned.group("value")
    deviations = learned.group("deviation")
    return [
        name
        for name in values.names
        if np.any(deviations[name] < MAX_DEVIATION * np.abs(values[name]))
    ]


def saturation_shares(tape: Tape) -> dict[str, dict[str, float]]:
    """Return the fraction of the ticks in which an input is saturated, by input and kind.

    The kinds of saturation are "magnitude" and "rate".
    """
    limited = tape["internals"].group("limited") if "internals" in tape else None
    if limited is None or len(limited.stamp_ns) == 0:
        return {}
    kinds = (Saturation.MAGNITUDE, Saturation.RATE)
    shares = {}
    for name in limited.names:
        shares[name] = {kind.name.lower(): float(np.mean(limited[name] == kind)) for kind in kinds}
    return shares


def sign_switches(tape: Tape) -> dict[str, float]:
    """Return how often the sign term beta Sgn(e) switches, by output, 1/s.

    This is the number of changes of sign between successive nonzero increments of Pi, divided by
    the time of the ticks. If the tape has no topic `internals`, the changes of sign of the measured
    error are counted in their place.
    """
    if "internals" in tape:
        signal = tape["internals"].group("Pi")
        moves = np.diff(signal.values, axis=0)
    else:
        signal = tracking_error(tape)
        moves = signal.values
    time = seconds(int(np.ptp(signal.stamp_ns))) if len(signal.stamp_ns) else 0.0
    if time == 0.0:
        return {}
    signs = {
        name: np.sign(column[column != 0.0])
        for name, column in zip(signal.names, moves.T, strict=True)
    }
    return {name: float(np.count_nonzero(np.diff(sign))) / time for name, sign in signs.items()}
