# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compare the models that a log shows with and without its slow changes of trim.

A climb or another airspeed has another trim. A linear model does not know this, and takes the
inputs that hold the new trim for inputs that have little effect. Its innovations stay white,
because most of the log is quiet. In a log that began with the climb, the damping of pitch came out
50 stated deviations off.

A linear aircraft has the same model with and without the slow changes of the log. If the two models
differ, the difference is an error that the stated deviations of neither model include.
"""

import math
from collections.abc import Mapping

import numpy as np
from scipy import signal

from flight_analysis.closed_loop.learning_loop import Entry
from flight_core.outcome import Refusal
from flight_design.identification.innovation_filters import FlightData
from flight_design.identification.model_identification import Identification, Part
from flight_design.identification.model_quality import NoBetter
from flight_design.identification.model_refusals import best_known

SLOW = 3.0  # s, time constant of the high-pass, several times as long as a doublet
# Largest difference of the best known effect on an output, as a fraction of its nominal value. It
# is as large as what an uncertain delay of u may cause.
MOST_APART = 0.15


def without_trim(recorded: FlightData) -> FlightData:
    """Take slow changes of trim out of y and u by one high-pass for both.

        y' = F(z) y,  u' = F(z) u,  F(z) = (1 + a)/2 (1 - 1/z)/(1 - a/z),  a = exp(-period / SLOW)

    F commutes with a linear aircraft, so the model from u' to y' is the model from u to y. F begins
    at rest at the mean of the first 2 SLOW, which is close to the trim at the beginning. The first
    sample itself may lie within a doublet. Across lost samples of y, a straight line is filtered,
    and the samples stay lost in the result.
    """
    a = math.exp(-recorded.period / SLOW)
    numerator = (1.0 + a) / 2.0 * np.array([1.0, -1.0])
    is_lost = np.asarray(~np.isfinite(recorded.y).all(axis=1))
    y = recorded.y.copy()
    for channel in y.T:
        channel[is_lost] = np.interp(recorded.t[is_lost], recorded.t[~is_lost], channel[~is_lost])
    first = max(1, round(2.0 * SLOW / recorded.period))
    y, u = (
        np.asarray(signal.lfilter(numerator, [1.0, -a], values - values[:first].mean(0), axis=0))
        for values in (y, recorded.u)
    )
    y[is_lost] = np.nan
    return recorded._replace(y=y, u=u)


def doubted(found: Identification, steady: Identification) -> Identification:
    """Widen the deviations of a model by its differences from the model of `without_trim`.

        deviation^2 + (error of the entry - its error in `steady`)^2

    `steady` is the model of `without_trim`. An entry that it lacks is nominal in it, so its error
    is 0. A part is refused if the best known effect on one of its outputs differs by more than
    MOST_APART. A part that is already refused for another reason keeps this reason. The exception
    is a part that is refused as no better than the nominal model, but has the higher likelihood:
    such a part may be used, so it is tested too.
    """
    errors = {entry.name: entry.error for entry in steady.entries}
    return found._replace(parts=tuple(_doubted(part, errors) for part in found.parts))


def _doubted(part: Part, steady: Mapping[str, float]) -> Part:
    """Widen the deviations of a part, whose entries have other errors in the `steady` model."""
    entries, by_trim = [], []
    for entry in part.entries:
        apart = abs(entry.error - steady.get(entry.name, 0.0))
        by_trim.append(apart)
        entries.append(entry._replace(deviation=math.hypot(entry.deviation, apart)))
    refusal = part.refusal
    is_likelier = part.after.log_likelihood > part.before.log_likelihood
    if refusal is None or (isinstance(refusal, NoBetter) and is_likelier):
        refusal = _reason_against_trim(part, steady) or refusal
    return part._replace(entries=tuple(entries), refusal=refusal, by_trim=tuple(by_trim))


def _reason_against_trim(part: Part, steady: Mapping[str, float]) -> Refusal | None:
    """Refuse a part whose best known effects follow the slow changes of trim."""

    def apart(effect: Entry) -> float:
        return abs(effect.error - steady.get(effect.name, 0.0))

    worst = max(best_known(part.entries, part.outputs), key=apart)
    if apart(worst) <= MOST_APART:
        return None
    without = steady.get(worst.name, 0.0)
    return Refusal(
        f"trim: found {worst.name} changed by {100 * worst.error:+.0f} % with the slow changes of "
        f"trim in the log, and by {100 * without:+.0f} % without them, expected at most "
        f"{100 * MOST_APART:.2g} % apart: take the doublets alone, by --from and --until"
    )
