# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Refuse a model whose entries the log does not show, or that cannot be the aircraft."""

from collections.abc import Iterable, Sequence

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.closed_loop.learning_loop import Entry
from flight_core.outcome import Refusal
from flight_core.vectors import FloatArray
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.identification.entry_units import MAX_ERROR, MAX_FACTOR, largest_error
from flight_design.identification.likelihood import PRIOR

# Largest relative standard deviation of the best known effect on each output. Two such deviations
# change the loop gain by a fifth.
MAX_DEVIATION = 0.1
# Largest relative deviation of a best known effect that an uncertain delay of u may cause. For two
# such deviations the guarantee must cover a loop gain that is 30 % off.
MAX_BY_TIMING = 0.15
# tolerance at a bound, because the search has the bound of a rough entry as a logarithm
ROUNDING = 1e-9


class Coupling(Refusal):
    """A refusal of a part whose model lacks the coupling with another part of the aircraft."""


def best_known(entries: Iterable[Entry], outputs: Iterable[str]) -> list[Entry]:
    """Return, for each output, the effect of an input on it that is known best."""
    effects = [entry for entry in entries if entry.matrix == "B" and entry.nominal]
    best = []
    for output in outputs:
        on_output = [entry for entry in effects if entry.row == output]
        best.append(min(on_output, key=lambda effect: effect.deviation))
    return best


def reason_against_excitation(entries: Iterable[Entry], outputs: Iterable[str]) -> Refusal | None:
    """Return a refusal if even the best known effect on some output is uncertain, else None.

    An effect is uncertain if its relative standard deviation is above MAX_DEVIATION. The refusal
    names the output whose effects are known worst.
    """
    worst = max(best_known(entries, outputs), key=lambda effect: effect.deviation)
    if worst.deviation <= MAX_DEVIATION:
        return None
    factor = excitation_factor(worst)
    return Refusal(
        f"excitation of {worst.row}: found {worst.name} known to {100 * worst.deviation:.3g} %, "
        "expected"
        f" {100 * MAX_DEVIATION:.2g} %: {worst.row} needs {factor:.3g} times the amplitude, or "
        f"{factor**2:.3g} times the time"
    )


def excitation_factor(effect: Entry) -> float:
    """Return the factor on the amplitude at which an effect would be known to MAX_DEVIATION.

    Information grows with the square of the amplitude. If the factor is 1 or less, the effect is
    already known that well.
    """
    information = effect.deviation**-2 - PRIOR**-2
    return float(np.sqrt((MAX_DEVIATION**-2 - PRIOR**-2) / max(information, 1e-2 * PRIOR**-2)))


def at_bound(entries: Iterable[Entry], factor: float = MAX_FACTOR) -> list[Entry]:
    """Return the entries that ended at a bound of a search, which allows factors up to `factor`."""
    found = []
    for entry in entries:
        lower, upper = -MAX_ERROR, largest_error(entry)
        if factor > MAX_FACTOR and entry.nominal:
            lower, upper = 1.0 / factor - 1.0, factor - 1.0
        if not lower + ROUNDING < entry.error < upper - ROUNDING:
            found.append(entry)
    return found


def reason_against_airframe(
    entries: Iterable[Entry], name: str, allowed: int = 0, factor: float = MAX_FACTOR
) -> Refusal | None:
    """Return a refusal of the airframe `name` if too many entries ended at a bound of the search.

    At most `allowed` entries may be at a bound. But one entry is too many if its standard deviation
    is less than half of that before the flight. The record then shows clearly that the aircraft
    lies beyond the bound. Returns None if the airframe is not refused.
    """
    found = at_bound(entries, factor)
    is_shown = any(entry.deviation < PRIOR / 2.0 for entry in found)
    if len(found) <= allowed and not is_shown:
        return None
    return Refusal(
        f"airframe {name}: found {', '.join(entry.name for entry in found)} at a bound of the "
        f"search, {1.0 / factor:.2g} or {factor:.2g} times the nominal value, expected a log of "
        "this airframe, in calm air if its effect of wind is not known"
    )


def _minor_signs(Omega: FloatArray) -> list[float]:
    """Return the signs of the leading minors of Omega."""
    return [np.sign(np.linalg.det(Omega[:k, :k])) for k in range(1, len(Omega) + 1)]


def reason_against_signs(
    nominal: Airframe, identified: Airframe, channels: ChannelPairing
) -> Refusal | None:
    """Return a refusal of an identified model that gives the law another D, else None.

    D follows from the signs of the leading minors of C B.
    """
    columns = [list(nominal.inputs).index(name) for name in channels.inputs]
    order = np.ix_([nominal.outputs.index(name) for name in channels.outputs], columns)
    of_nominal = _minor_signs((nominal.matrix_c() @ nominal.matrix_b())[order])
    of_identified = _minor_signs((identified.matrix_c() @ identified.matrix_b())[order])
    if of_nominal == of_identified:
        return None
    return Refusal(
        "C B: found other signs of its minors than in the nominal airframe, expected the same D"
    )


def entries_without(entries: Iterable[Entry], by_cause: Iterable[float]) -> list[Entry]:
    """Return entries with the standard deviations that they would have without a cause of error.

    `by_cause` has the part of each standard deviation that the cause makes. If the cause is, for
    example, an uncertain delay of u, the result has the standard deviations for a known delay.
    """
    return [
        entry._replace(deviation=float(np.sqrt(max(entry.deviation**2 - part**2, 0.0))))
        for entry, part in zip(entries, by_cause, strict=True)
    ]


def reason_against_timing(
    entries: Sequence[Entry], by_timing: Sequence[float], outputs: Iterable[str]
) -> Refusal | None:
    """Return a refusal if the best known effects depend too much on the delay of u, else None.

    The entries belong to one part of the aircraft. `by_timing` is the part of each entry's standard
    deviation that an uncertain delay of u causes.
    """
    late = dict(zip((entry.name for entry in entries), by_timing, strict=False))
    worst = max(best_known(entries, outputs), key=lambda effect: late.get(effect.name, 0.0))
    part = late.get(worst.name, 0.0)
    if part <= MAX_BY_TIMING:
        return None
    return Refusal(
        f"timing of u: found {worst.name} known to {100 * part:.3g} %, because u may act at any "
        f"instant between two samples, expected {100 * MAX_BY_TIMING:.2g} %: log u more often"
    )
