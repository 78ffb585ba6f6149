# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""How well a model predicts held-out samples, and the reasons against a model."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.closed_loop.learning_loop import Entry
from flight_core.outcome import Refusal
from flight_core.vectors import FloatArray
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.identification.likelihood import (
    MAX_ERROR,
    MAX_FACTOR,
    PRIOR,
    Innovations,
    largest_error,
)

# Largest deviation of the best known effect of an input on each output: two deviations are a fifth
# of the loop gain.
MAX_DEVIATION = 0.1
# The same for the part of this deviation that an uncertain delay of u makes: with it, the guarantee
# has to cover 30 % of the loop gain.
MAX_BY_TIMING = 0.15
# White innovations have 1, with a deviation of 0.3. A model with more than this leaves out
# something that the aircraft does.
MAX_WHITENESS = 3.0
LAGS = 20  # lags of the autocorrelation in the figure of whiteness: 0.2 s at 100 Hz


class Prediction(NamedTuple):
    """How well a model predicts the held-out samples a period ahead."""

    rms: FloatArray  # (m,) rms of the innovations, units of y
    whiteness: FloatArray  # (m,) 1 for white noise, see `whiteness`
    log_likelihood: float  # mean of a sample, up to a constant


def prediction(innovations: Innovations, held_out: NDArray[np.bool_]) -> Prediction:
    """Assess how innovations predict the held-out samples, (T,)."""
    rms = np.sqrt(np.mean(innovations.r[held_out] ** 2, axis=0))
    likelihood = float(np.mean(innovations.log_likelihood[held_out]))
    return Prediction(rms, whiteness(innovations.normalised, held_out), likelihood)


def whiteness(e: FloatArray, held_out: NDArray[np.bool_]) -> FloatArray:
    """Return the mean of n_k rho_k^2 over the lags k = 1 .. LAGS, (m,).

    rho_k is the autocorrelation of n_k pairs of held-out samples. For white noise the mean is 1,
    with a standard deviation of sqrt(2 / LAGS). e is (T, m), held_out (T,). Source: G. M. Ljung, G.
    E. P. Box, Biometrika 65(2), 1978, here for the pairs within the held-out spans.
    """
    return np.diag(correlation(e, e, held_out))


def correlation(e: FloatArray, before: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
    """Return the mean of n_k rho_k^2 over the lags k = 1 .. LAGS, (m, k).

    rho_k is the correlation of e with `before` k samples earlier. For independent white noises the
    mean is 1. e is (T, m), before (T, k), and `used` (T,) is the mask of n samples.
    """
    now, then = (np.where(used[:, None], values, 0.0) for values in (e, before))
    power = np.outer(*(np.sum(values**2, axis=0) / used.sum() for values in (now, then)))
    total = np.zeros_like(power)
    for lag in range(1, LAGS + 1):
        pairs = max(int(np.sum(used[lag:] & used[:-lag])), 1)
        total += (now[lag:].T @ then[:-lag]) ** 2 / pairs / power
    return np.asarray(total / LAGS)


def advantage(
    first: Innovations, second: Innovations, span: int, counts: NDArray[np.bool_]
) -> float:
    """Return by how many standard deviations one model predicts a record better than another.

        t = sum d_k / sqrt(K var d),  d_k the difference of log-likelihood of span k of K
        z = Phi^-1(F_(K-1)(t)),  F of Student's distribution, Phi of the normal one

    If both models are equally far from the aircraft, z has a standard normal distribution,
    whichever is simpler, and even if both are wrong. Source: Q. H. Vuong, Econometrica 57(2), 1989,
    here with spans of `span` samples, whose d_k are nearly independent. K is small, hence Student's
    t. Only samples of the mask `counts`, (T,), count. With fewer than two spans z is 0.
    """
    end = len(counts) // span * span
    d = np.where(counts, first.log_likelihood - second.log_likelihood, 0.0)[:end]
    is_counted = counts[:end].reshape(-1, span).any(axis=1)
    sums = d.reshape(-1, span).sum(axis=1)[is_counted]
    if len(sums) < 2 or np.ptp(sums) == 0.0:
        return 0.0
    t = np.sum(sums) / (np.sqrt(len(sums)) * np.std(sums, ddof=1))
    return float(np.sign(t) * stats.norm.isf(stats.t.sf(abs(t), len(sums) - 1)))


def best_known(entries: Iterable[Entry], outputs: Iterable[str]) -> list[Entry]:
    """Return the best known effect of an input on each output."""
    effects = [entry for entry in entries if entry.matrix == "B" and entry.nominal]
    best = []
    for output in outputs:
        on_output = [entry for entry in effects if entry.row == output]
        best.append(min(on_output, key=lambda effect: effect.deviation))
    return best


def reason_against_excitation(entries: Iterable[Entry], outputs: Iterable[str]) -> Refusal | None:
    """Refuse the output whose inputs are known worst, if even its best known effect is uncertain.

    An effect is uncertain if its deviation is above MAX_DEVIATION.
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
    """Return the factor on the amplitude with which an effect becomes known to MAX_DEVIATION.

    Information grows with the square of the amplitude. If the factor is 1 or less, the effect is
    already known that well.
    """
    information = effect.deviation**-2 - PRIOR**-2
    return float(np.sqrt((MAX_DEVIATION**-2 - PRIOR**-2) / max(information, 1e-2 * PRIOR**-2)))


def at_bound(entries: Iterable[Entry], factor: float = MAX_FACTOR) -> list[Entry]:
    """Return the entries at a bound of a search whose largest factor is `factor`."""
    found = []
    for entry in entries:
        lower, upper = -MAX_ERROR, largest_error(entry)
        if factor > MAX_FACTOR and entry.nominal:
            lower, upper = 1.0 / factor - 1.0, factor - 1.0
        if not lower < entry.error < upper:
            found.append(entry)
    return found


def reason_against_airframe(
    entries: Iterable[Entry], name: str, allowed: int = 0, factor: float = MAX_FACTOR
) -> Refusal | None:
    """Refuse the airframe of a name if more than `allowed` entries are at a bound of the search.

    A single one is too many if the record shows it, with at most half of its deviation before: then
    the aircraft lies beyond the bound.
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
    """Return the signs of the leading minors."""
    return [np.sign(np.linalg.det(Omega[:k, :k])) for k in range(1, len(Omega) + 1)]


def reason_against_signs(
    nominal: Airframe, identified: Airframe, channels: ChannelPairing
) -> Refusal | None:
    """Refuse an identified model that gives the law another D.

    D follows from the signs of the leading minors of C B.
    """
    columns = [list(nominal.inputs).index(name) for name in channels.inputs]
    order = np.ix_([nominal.outputs.index(name) for name in channels.outputs], columns)
    before = _minor_signs((nominal.matrix_c() @ nominal.matrix_b())[order])
    after = _minor_signs((identified.matrix_c() @ identified.matrix_b())[order])
    if before == after:
        return None
    return Refusal(
        "C B: found other signs of its minors than in the nominal airframe, expected the same D"
    )


@dataclass(frozen=True)
class NoBetter(Refusal):
    """The only reason against a model is that it predicts no better than the nominal one."""


def reason_against_prediction(
    before: Prediction, after: Prediction, outputs: Sequence[str]
) -> NoBetter | None:
    """Refuse a model that predicts the held-out samples no better than before.

    A model is refused, too, if the innovations of one of its outputs are neither white nor whiter
    than before.
    """
    if after.log_likelihood <= before.log_likelihood:
        return NoBetter(
            f"held-out samples: found a log-likelihood of {after.log_likelihood:.4g} a sample, "
            "expected more than the"
            f" {before.log_likelihood:.4g} of the nominal airframe, which explains this flight "
            "as it is"
        )
    coloured = (after.whiteness > MAX_WHITENESS) & (after.whiteness >= before.whiteness)
    if coloured.any():
        worst = int(np.argmax(np.where(coloured, after.whiteness, 0.0)))
        return NoBetter(
            f"held-out samples: found innovations of {outputs[worst]} with a whiteness of "
            f"{after.whiteness[worst]:.3g}, expected less than the {before.whiteness[worst]:.3g} "
            "of the nominal airframe"
        )
    return None


def in_time(entries: Iterable[Entry], by_timing: Iterable[float]) -> list[Entry]:
    """Return the entries with the deviations that they have if the delay of u is known."""
    return [
        entry._replace(deviation=float(np.sqrt(max(entry.deviation**2 - late**2, 0.0))))
        for entry, late in zip(entries, by_timing, strict=True)
    ]


def reason_against_timing(
    entries: Sequence[Entry], by_timing: Sequence[float], outputs: Iterable[str]
) -> Refusal | None:
    """Refuse a part whose best known effect of an input hangs on when u acts.

    `by_timing` is the part of the deviation of each entry that an uncertain delay of u makes.
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
