# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identify the aircraft that a log of body rates shows.

A log of rates lacks two things that move the aircraft slowly. The first is the trim, which changes
in a climb or at another airspeed. The inputs then hold the new trim without moving the rates, and
to a linear model they seem to have little effect. The second is the bank. In a bank, gravity causes
sideslip, and the aircraft turns. A model without the bank angle takes this turn for an effect of
the rudder. In both cases the innovations stay white, because most of the log is quiet, but the
entries are wrong by up to 50 of their standard deviations.

Here a high-pass takes the slow changes out of y and u, and the model has the bank angle. A linear
aircraft has the same model behind any high-pass. If the models behind two different high-passes
differ, the difference is an error that the standard deviations of neither model include.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from scipy import signal

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.closed_loop.learning_loop import Entry
from flight_core.outcome import Refusal
from flight_core.units import GRAVITY
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.identification.innovation_filters import Actuation, FlightData
from flight_design.identification.likelihood import Unknown
from flight_design.identification.model_identification import (
    Identification,
    Part,
    identify_model,
)
from flight_design.identification.model_quality import NoBetter
from flight_design.identification.model_refusals import best_known

SLOW = 2.0  # s, time constant of the high-pass, twice as long as a doublet
FAST = 1.0  # s, time constant of the second high-pass, as long as a doublet
# Largest difference of the best known effect on an output, as a fraction of its nominal value. It
# is as large as what an uncertain delay of u may cause.
MOST_APART = 0.15


def identify_rates(
    recorded: FlightData,
    nominal: Airframe,
    actuation: Actuation,
    pairing: ChannelPairing,
    progress: Callable[..., None] = lambda **_: None,
    *,
    timing: float | None = None,
) -> Identification:
    """Identify the rows of A and B for the body rates from a log, around the nominal airframe.

    The rows of states that are no outputs are known: mass and lift give them. The airframe of the
    result has the bank angle among its states if the nominal airframe can bank. `timing` is the
    standard deviation of the instant at which u acts, s. A second model is fitted behind a faster
    high-pass. The differences between the two models widen the standard deviations of the result.
    """
    searches = [(without_trim(recorded), timing), (without_trim(recorded, FAST), None)]
    found, steady = (
        identify_model(
            of_log,
            banking(nominal),
            actuation,
            pairing,
            partial(_reported, progress, number, len(searches)),
            unknown=Unknown(has_hidden_rows=False),
            searches_again=True,
            timing=deviation,
        )
        for number, (of_log, deviation) in enumerate(searches)
    )
    return doubted(found, steady)


def _reported(
    progress: Callable[..., None], number: int, count: int, *, completed: int, total: int
) -> None:
    """Report how many of `count` searches are completed, with a fraction for the one under way.

    `number` is the number of the search that is under way.
    """
    progress(completed=number * total + completed, total=count * total)


def banking(airframe: Airframe) -> Airframe:
    """Return the airframe of a fixed wing with the bank angle as a further state.

        phi_dot = p,  beta_dot += g / V0 phi

    An airframe that has phi already, or that lacks beta, p or a speed, is returned as it is.
    """
    names = list(airframe.states)
    if "phi" in names or not {"beta", "p"} <= set(names) or airframe.speed <= 0.0:
        return airframe
    A = np.pad(airframe.matrix_a(), (0, 1))
    A[names.index("beta"), -1] = GRAVITY / airframe.speed
    A[-1, names.index("p")] = 1.0
    B = np.pad(airframe.matrix_b(), ((0, 1), (0, 0)))
    return airframe.with_states({"phi": "rad"}, A, B)


def without_trim(recorded: FlightData, slow: float = SLOW) -> FlightData:
    """Take slow changes of trim out of y and u by one high-pass for both.

        y' = F(z) y,  u' = F(z) u,  F(z) = (1 + a)/2 (1 - 1/z)/(1 - a/z),  a = exp(-period / slow)

    F commutes with a linear aircraft, so the model from u' to y' is the model from u to y. F begins
    at rest at the mean over an initial time of 2 `slow`, s. This mean is close to the trim, while
    the first sample itself may lie within a doublet. Across lost samples of y, a straight line is
    filtered, and the samples stay lost in the result.
    """
    a = math.exp(-recorded.period / slow)
    numerator = (1.0 + a) / 2.0 * np.array([1.0, -1.0])
    is_lost = np.asarray(~np.isfinite(recorded.y).all(axis=1))
    y = recorded.y.copy()
    for channel in y.T:
        channel[is_lost] = np.interp(recorded.t[is_lost], recorded.t[~is_lost], channel[~is_lost])
    first = max(1, round(2.0 * slow / recorded.period))
    y, u = (
        np.asarray(signal.lfilter(numerator, [1.0, -a], values - values[:first].mean(0), axis=0))
        for values in (y, recorded.u)
    )
    y[is_lost] = np.nan
    return recorded._replace(y=y, u=u)


def doubted(found: Identification, steady: Identification) -> Identification:
    """Widen the standard deviations of a model by its differences from a second model, `steady`.

        new sigma^2 = sigma^2 + (error of the entry - its error in `steady`)^2

    If `steady` lacks an entry, the error in `steady` is taken as 0. A part (a group of states and
    inputs that does not couple with the rest) is refused if the best known effect on one of its
    outputs differs by more than MOST_APART between the models. A part that is already refused for
    another reason keeps this reason. The exception is a part that is refused as no better than the
    nominal model, but has the higher likelihood: such a part may be used, so it is also tested.
    """
    errors = {entry.name: entry.error for entry in steady.entries}
    return found._replace(parts=tuple(_doubted(part, errors) for part in found.parts))


def _doubted(part: Part, steady: Mapping[str, float]) -> Part:
    """Widen the standard deviations of a part by the differences from the `steady` model."""
    entries, by_motion = [], []
    for entry in part.entries:
        apart = abs(entry.error - steady.get(entry.name, 0.0))
        by_motion.append(apart)
        entries.append(entry._replace(deviation=math.hypot(entry.deviation, apart)))
    refusal = part.refusal
    is_likelier = part.after.log_likelihood > part.before.log_likelihood
    if refusal is None or (isinstance(refusal, NoBetter) and is_likelier):
        refusal = _reason_against_motion(part, steady) or refusal
    return part._replace(entries=tuple(entries), refusal=refusal, by_motion=tuple(by_motion))


def _reason_against_motion(part: Part, steady: Mapping[str, float]) -> Refusal | None:
    """Return a refusal of a part whose best known effects differ between the two models.

    Returns None if they differ by at most MOST_APART.
    """

    def apart(effect: Entry) -> float:
        return abs(effect.error - steady.get(effect.name, 0.0))

    worst = max(best_known(part.entries, part.outputs), key=apart)
    if apart(worst) <= MOST_APART:
        return None
    without = steady.get(worst.name, 0.0)
    return Refusal(
        f"motion: found {worst.name} changed by {100 * worst.error:+.0f} % in what the log shows "
        f"within {SLOW:g} s, and by {100 * without:+.0f} % within {FAST:g} s, expected at most "
        f"{100 * MOST_APART:.2g} % apart: fly more and larger doublets of {worst.row}"
    )
