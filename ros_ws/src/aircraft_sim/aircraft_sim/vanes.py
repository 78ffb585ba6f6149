# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Vanes: angle of attack and sideslip relative to the air.

Icing is before the sensor, lost readings are behind it.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from aircraft_sim import random_streams
from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.sections import Times
from flight_core.fields import Field
from flight_core.parameters import Config, require, require_length
from flight_core.vectors import FloatArray

ANGLES = ("alpha", "beta")
"""Channels of vanes: angle of attack and sideslip relative to the air, rad from trim."""


class Vanes(NamedTuple):
    """Parameters of k vanes."""

    places: Sequence[int]  # (k,) in ANGLES
    frozen_at: FloatArray  # (k,) s, from when on a vane keeps its angle, infinite for never
    dropout: float  # probability that a reading of a vane is lost, each vane by itself
    seed: int


class VaneSensorsConfig(Config):
    """Vanes: further channels of y, alpha and beta relative to the air.

    The errors of `sensors` apply, too.
    """

    channels: tuple[Literal["alpha", "beta"], ...] = Field(
        default=(), description="the angles that have a vane; none if empty"
    )
    frozen_at: Times = Field(default=(), description="from when on each keeps its angle, s")
    dropout: float = Field(
        default=0.0, ge=0, lt=1, description="the probability that a reading repeats the one before"
    )

    def _check(self) -> None:
        require(
            len(set(self.channels)) == len(self.channels),
            "channels",
            ", ".join(self.channels),
            "different ones",
        )
        if self.frozen_at:
            require_length("frozen_at", self.frozen_at, self.channels)

    def require_fit(self, airframe: Airframe) -> None:
        """Raise ParameterError for a vane that an airframe cannot have."""
        key = "vanes.channels"
        has_none = f"none: the airframe {airframe.name} has no"
        for name in self.channels:
            require(name in airframe.states, key, name, f"{has_none} state {name}")
            is_output = f"none: {name} is an output of {airframe.name}"
            require(name not in airframe.outputs, key, name, is_output)
            require(airframe.speed > 0.0, key, name, f"{has_none} speed")

    def arrays(self, seed: int) -> Vanes | None:
        """The vanes as arrays, with losses of this seed; None without any."""
        if not self.channels:
            return None
        frozen_at = np.array(self.frozen_at or (np.inf,) * len(self.channels))
        places = [ANGLES.index(name) for name in self.channels]
        return Vanes(places, frozen_at, self.dropout, seed)


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


def read_vanes(number: int, measured: FloatArray, state: VaneState, params: Vanes) -> VaneState:
    """The readings of sample `number`, (k,), from measured angles with errors.

    A lost reading repeats the last.
    """
    if params.dropout == 0.0:
        return state._replace(reading=measured)
    draws = random_streams.generator(number, random_streams.VANE_LOSS, params.seed).random(
        len(measured)
    )
    return state._replace(reading=np.where(draws < params.dropout, state.reading, measured))
