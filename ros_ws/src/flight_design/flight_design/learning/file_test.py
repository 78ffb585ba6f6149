# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the deviations that an airframe file states, and widen them if the record contradicts them.

A deviation is information: an entry that the record hardly shows stays at the value of the file,
with the deviation of the file. So if the deviation in the file is too small, the stated deviation
of the entry in the model is too small as well.
"""

from collections.abc import Callable
from itertools import chain

import numpy as np
from scipy.stats import chi2

from flight_analysis.closed_loop.learning_loop import Entry
from flight_core.outcome import Refusal
from flight_design.identification.likelihood import PRIOR, Unknown
from flight_design.identification.model_identification import Identification, Part
from flight_design.identification.model_quality import MAX_WHITENESS
from flight_design.identification.model_refusals import (
    Coupling,
    at_bound,
    best_known,
    entries_without,
    reason_against_airframe,
)
from flight_design.learning.change_test import ANGLE
from flight_design.learning.part_checks import DELAY_DEVIATION, LAG_DEVIATION, SERVO_DEVIATION

# number of entries that may lie at a bound: the right model may have one, wrong models have 2 to 6
AT_BOUND = 1
# probability of a false alarm in one test of the file
CONTRADICTED = 1e-3
# largest deviation that is believed; then an entry may be wrong by a factor of 20
ROUGHEST = 1.0


def identified_within(
    identify: Callable[..., Identification], believed: Unknown, *, tests: bool
) -> tuple[Identification, Unknown]:
    """Identify a model, and return it with deviations of the file that the record allows.

    If `tests`, the deviations `believed` are tested. If the record contradicts them, they are
    doubled, the model is identified again, and a remark says so. The function `identify` gets the
    deviations as its argument `unknown`, and also an argument `searches_again`.
    """

    def found_with(deviations: Unknown) -> Identification:
        unknown = deviations._replace(
            delay=DELAY_DEVIATION, angle=ANGLE, lag=LAG_DEVIATION, servo=SERVO_DEVIATION
        )
        return identify(unknown=unknown, searches_again=not tests)

    found = found_with(believed)
    widest = max(believed.error, believed.effect)
    if not tests or widest >= ROUGHEST or not is_contradicted(found, believed):
        return found, believed
    factor = min(2.0, ROUGHEST / widest)
    wider = believed._replace(error=factor * believed.error, effect=factor * believed.effect)
    remark = Refusal(
        f"airframe {found.airframe.name}: found entries further off than their deviation of "
        f"{100 * widest:.3g} %, expected within; from now on it is {100 * factor * widest:.3g} %"
    )
    again = found_with(wider)
    return again._replace(remarks=(remark, *again.remarks)), wider


def is_contradicted(found: Identification, believed: Unknown) -> bool:
    """Return whether a model contradicts the deviations of the file.

        sum (theta_i / s_i)^2,   its mean nu = sum (1 - d_i^2 / s_i^2)

    theta_i are the errors that were found, d_i their deviations, and s_i the deviations of the
    file. If the s_i are right, the variance of the sum is at most that of a chi-squared
    distribution with nu degrees of freedom. The file is contradicted if this distribution exceeds
    the sum with a probability below CONTRADICTED. Entries at the bounds of the search also
    contradict the file.

    Only parts whose model explains the record are used in the sum. A model whose innovations are
    not white, or whose best known effect on an output is at its bound, is wrong for another reason,
    such as parts that couple.
    """
    parts = [part for part in found.parts if _is_counted(part, believed.factor)]
    name = found.airframe.name
    if any(reason_against_airframe(p.entries, name, AT_BOUND, believed.factor) for p in parts):
        return True
    square = degrees = 0.0
    for entry in chain.from_iterable(map(_if_right, parts)):
        s = believed.error if entry.matrix == "A" else believed.effect
        theta, deviation = entry.error, entry.deviation
        if s > PRIOR:  # the search has the logarithm of the factor
            theta, deviation = np.log1p(theta), deviation / (1.0 + theta)
        square += (theta / s) ** 2
        degrees += max(1.0 - (deviation / s) ** 2, 0.0)
    return degrees > 0.0 and float(chi2.sf(square, degrees)) < CONTRADICTED


def _is_counted(part: Part, factor: float) -> bool:
    """Return whether the model of a part explains the record, and the part does not couple."""
    return (
        not isinstance(part.refusal, Coupling)
        and all(entry.nominal for entry in part.entries)
        and float(np.max(part.after.whiteness)) <= MAX_WHITENESS
        and not at_bound(best_known(part.entries, part.outputs), factor)
    )


def _if_right(part: Part) -> list[Entry]:
    """Return the entries of a part with the deviations that they have if the model is exact."""
    return entries_without(part.entries, part.by_model or [0.0] * len(part.entries))
