# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Divide a recording into spans, some of which are held out to validate the model."""

import numpy as np
from numpy.typing import NDArray

from flight_design.identification.innovation_filters import HOLD, FlightData

SPAN = 1.0  # s, length of a span, within which the level of the wind is constant
# Every third span is held out, so that each command and gust is in both sets of samples. Commands
# may be missing in the last third of a flight.
HELD_OUT = 3


def span_length(recorded: FlightData) -> int:
    """Return the number of periods in a span: whole blocks of the filters, about SPAN s."""
    return HOLD * max(round(SPAN / recorded.period / HOLD), 1)


def held_out(periods: int, span: int) -> NDArray[np.bool_]:
    """Return the mask of the periods that validate the model: every HELD_OUT-th span."""
    return np.asarray(np.arange(periods) // span % HELD_OUT == HELD_OUT - 1)
