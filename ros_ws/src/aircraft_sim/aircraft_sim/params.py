# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the simulated aircraft, validated once, and the arrays that the maths takes."""

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from aircraft_sim.airframe import Airframe, load_airframe
from aircraft_sim.disturbance import Gusts
from aircraft_sim.dynamics import Aircraft
from flight_core.parameters import Parameters, Positive
from flight_core.rates import divide, nanoseconds, period_ns


class Gust(Parameters):
    """A 1-cosine gust."""

    start: float = Field(ge=0, description="the instant of entry, s")
    speed: float = Field(description="the peak speed U_ds, m/s")
    length: Positive = Field(description="the distance H from entry to peak, m")


class AircraftParameters(Parameters):
    """All parameters of the aircraft's node."""

    airframe: str = Field(description="the name of an airframe of the library, or the path of an airframe file")
    rate: Annotated[float, Field(gt=0, le=1000)] = Field(description="the rate at which y is published and u taken, Hz")
    step: Positive = Field(description="the integration step, s; a whole fraction of 1 / rate")
    start_time: float = Field(default=0.0, ge=0, description="system time of t = 0, s since the epoch; 0 starts at once")
    gusts: dict[str, Gust] = Field(default={}, description="gusts by their name in the airframe")

    @model_validator(mode="after")
    def _check(self) -> Self:
        divide(period_ns(self.rate, "rate"), nanoseconds(self.step), "step", "1 / rate")
        airframe = load_airframe(self.airframe)
        for name in self.gusts:
            airframe.gust_direction(name)
        return self

    @property
    def step_ns(self) -> int:
        """The integration step in ns."""
        return nanoseconds(self.step)

    def load(self) -> tuple[Airframe, Aircraft]:
        """The airframe and the arrays of equation (1) in this disturbance."""
        airframe = load_airframe(self.airframe)
        gusts = self.gusts.values()
        direction = [airframe.gust_direction(name) for name in self.gusts]
        return airframe, Aircraft(
            airframe.matrix_a(),
            airframe.matrix_b(),
            airframe.matrix_c(),
            airframe.matrix_gravity(),
            np.reshape(direction, (len(direction), len(airframe.states))).T,
            Gusts(*(np.array([getattr(gust, key) for gust in gusts]) for key in ("start", "speed", "length"))),
            np.array(airframe.speed),
        )
