# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Choose units and bounds for the relative errors of the entries of A and B.

If the unit of an entry is 0, the entry is taken as known.
"""

import numpy as np

from control_laws.nominal_model import NominalModel
from flight_analysis.closed_loop.learning_loop import Entry
from flight_core.vectors import FloatArray

# Unit of an entry that is 0, relative to the largest effect on its row. With it, the prior
# deviation is 10 % of this effect.
COUPLING = 0.34
# two prior standard deviations; its negative is the lower bound of a relative error
MAX_ERROR = 0.6
# Largest ratio of an entry to its nominal value, 1 / (1 - MAX_ERROR): a rough model errs by a
# factor, up or down.
MAX_FACTOR = 2.5


def units(model: NominalModel, *, coupled: bool = False) -> tuple[FloatArray, FloatArray]:
    """Return the units of the errors of the entries of A and B, SI.

    The units are the nominal values, except in the rows of angles, where they are 0, because these
    entries are known. If `coupled`, an entry that is 0 gets a unit that follows from its row:
    COUPLING times the largest effect there. To compare the effects of states, each state moves by
    its `size`. The columns of angles stay 0.
    """
    free = model.kinematic[:, None] == 0.0
    is_dynamic = model.kinematic == 0.0
    units_A = np.where(free, model.A, 0.0)
    units_B = np.where(free, model.B, 0.0)
    if coupled:
        largest_A = (
            np.max(np.abs(units_A) * model.size, axis=1, keepdims=True) / model.size * is_dynamic
        )
        largest_B = np.max(np.abs(units_B), axis=1, keepdims=True)
        units_A, units_B = (
            np.where((part == 0.0) & free, COUPLING * largest, part)
            for part, largest in ((units_A, largest_A), (units_B, largest_B))
        )
    return units_A, units_B


def largest_error(entry: Entry) -> float:
    """Return the upper bound of the relative error of an entry."""
    return MAX_FACTOR - 1.0 if entry.nominal else MAX_ERROR
