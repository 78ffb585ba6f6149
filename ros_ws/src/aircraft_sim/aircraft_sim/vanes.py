# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Model vanes, which measure angle of attack and sideslip relative to the air.

Icing acts before the errors of the sensor, and readings are lost after them.
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

    places: Sequence[int]  # (k,) indices in ANGLES
    # (k,) flight time from which on a vane keeps its angle, s, infinite for never
    frozen_at: FloatArray
    dropout: float  # probability that a reading of a vane is lost, independently for each vane
    seed: int


class VaneSensorsConfig(Config):
    """The vanes, which add alpha and beta relative to the air to y as channels.

    The errors of `sensors` apply to these channels, too.
    """

    channels: tuple[Literal["alpha", "beta"], ...] = Field(
        default=(), description="angles that have a vane; empty for none"
    )
    frozen_at: Times = Field(
        default=(), description="instant from which each vane keeps its angle, s"
    )
    dropout: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="probability that a reading is lost and the last one is repeated",
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
        """Check that the vanes fit an airframe. Raises ParameterError if one does not."""
        key = "vanes.channels"
        has_none = f"none: the airframe {airframe.name} has no"
        for name in self.channels:
            require(name in airframe.states, key, name, f"{has_none} state {name}")
            is_output = f"none: {name} is an output of {airframe.name}"
            require(name not in airframe.outputs, key, name, is_output)
            require(airframe.speed > 0.0, key, name, f"{has_none} speed")

    def arrays(self, seed: int) -> Vanes | None:
        """Return the vanes as arrays, with random losses from a seed, or None without vanes."""
        if not self.channels:
            return None
        frozen_at = np.array(self.frozen_at or (np.inf,) * len(self.channels))
        places = [ANGLES.index(name) for name in self.channels]
        return Vanes(places, frozen_at, self.dropout, seed)


class VaneState(NamedTuple):
    """State that the vanes keep from one sample to the next."""

    angle: FloatArray  # (k,) angles of the vanes
    reading: FloatArray  # (k,) last readings that were received


def initial_state(params: Vanes) -> VaneState:
    """Return the state before the first sample, in trim."""
    zero = np.zeros(len(params.places))
    return VaneState(zero, zero)


def turned(t: float, angles: FloatArray, state: VaneState, params: Vanes) -> VaneState:
    """Turn the vanes to the alpha and beta of the air, (2,), except for iced ones.

    An iced vane keeps its angle.
    """
    return state._replace(
        angle=np.where(t >= params.frozen_at, state.angle, angles[list(params.places)])
    )


def read_vanes(number: int, measured: FloatArray, state: VaneState, params: Vanes) -> VaneState:
    """Return the state of the vanes with the readings of sample `number`, (k,).

    `measured` are the angles with the errors of the sensor. If a reading is lost, the last reading
    is repeated.
    """
    if params.dropout == 0.0:
        return state._replace(reading=measured)
    draws = random_streams.generator(number, random_streams.VANE_LOSS, params.seed).random(
        len(measured)
    )
    return state._replace(reading=np.where(draws < params.dropout, state.reading, measured))
