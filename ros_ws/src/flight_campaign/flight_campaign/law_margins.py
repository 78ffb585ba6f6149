# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Margins of a law of a comparison around the nominal aircraft, for many sets of gains at once."""

from control_laws.catalogue import Gains, Law
from control_laws.nominal_model import NominalModel
from rise_di_controller.control_law import TunedLaw
from rise_di_controller.linear_loop import LinearPlant, Loop, linear_law
from rise_di_controller.margins import Margins, loop_margins

MEASURES_Y = "y"  # of a law whose linear loop is closed by y alone


def has_margins(law: Law) -> bool:
    """Whether a law has a linear loop from y to u: not with further measurements, the implicit sign
    or a root of the error.
    """
    return law.linear and law.measurements == MEASURES_Y


def nominal_margins(law: Law, gains: Gains, model: NominalModel) -> Margins:
    """Margins for N sets of gains, (m, N) or (1, N), shapes (N, m) and (N,), without those of all
    inputs at once.

    u has no delay, as in a benchmark.
    """
    tuned = TunedLaw(law.control_law(model), law.params(gains, model))
    count = max((gain.shape[-1] for gain in gains.values()), default=1)
    plant = LinearPlant(model.A + model.gravity, model.B, model.C)
    candidates = linear_law(tuned, len(model.lag), model.period, count)
    loop = Loop(model.lag, 0.0, model.period)
    return loop_margins(plant, candidates, loop, together=False)
