# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Vanes: angle of attack and sideslip relative to the air, with icing before the sensor and lost
readings behind it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from aircraft_sim import random_streams
from flight_core.vectors import FloatArray

ANGLES = ("alpha", "beta")
"""Channels of vanes: angle of attack and sideslip relative to the air, rad from trim."""


class Vanes(NamedTuple):
    """Parameters of k vanes."""

    places: Sequence[int]  # (k,) in ANGLES
    frozen_at: FloatArray  # (k,) s, from when on a vane keeps its angle, infinite for never
    dropout: float  # probability that a reading of a vane is lost, each vane by itself
    seed: int


class VaneState(NamedTuple):
    """State of the vanes between two samples."""

    angle: FloatArray  # (k,) of the vanes
    reading: FloatArray  # (k,) the last received


def initial_state(params: Vanes) -> VaneState:
    """The state before the first sample, in trim."""
    zero = np.zeros(len(params.places))
    return VaneState(zero, zero)


def turned(t: float, angles: FloatArray, state: VaneState, params: Vanes) -> VaneState:
    """The angles of the vanes at t for (alpha, beta) of the air, (2,); a frozen vane stays."""
    return state._replace(
        angle=np.where(t >= params.frozen_at, state.angle, angles[list(params.places)])
    )


def read(number: int, measured: FloatArray, state: VaneState, params: Vanes) -> VaneState:
    """The readings of sample `number`, (k,), from measured angles with errors: a lost reading
    repeats the last.
    """
    if params.dropout == 0.0:
        return state._replace(reading=measured)
    draws = random_streams.generator(number, random_streams.VANE_LOSS, params.seed).random(
        len(measured)
    )
    return state._replace(reading=np.where(draws < params.dropout, state.reading, measured))
