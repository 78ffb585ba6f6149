# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the simulated aircraft, validated once, and the arrays that the maths takes."""

from collections.abc import Sequence
from typing import Annotated, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from aircraft_sim.actuators import Actuators
from aircraft_sim.airframe import Airframe, load_airframe
from aircraft_sim.disturbance import Gusts
from aircraft_sim.dynamics import Aircraft
from aircraft_sim.plant import Plant
from aircraft_sim.sensors import Sensors
from flight_core.freshness import fade
from flight_core.parameters import Parameters, Positive, as_tuple, require, require_length
from flight_core.rates import divide, nanoseconds, period_ns, seconds
from flight_core.vectors import FloatArray


class Gust(Parameters):
    """A 1-cosine gust."""

    start: float = Field(ge=0, description="the instant of entry, s")
    speed: float = Field(description="the peak speed U_ds, m/s")
    length: Positive = Field(description="the distance H from entry to peak, m")


# One value a channel, or none at all for an ideal one. A limit may be infinite (.inf in YAML): none on that channel.
NonNegativesOrNone = Annotated[tuple[Annotated[float, Field(ge=0)], ...], BeforeValidator(as_tuple)]
Lower = Annotated[tuple[Annotated[float, Field(le=0, allow_inf_nan=True)], ...], BeforeValidator(as_tuple)]
Upper = Annotated[tuple[Annotated[float, Field(ge=0, allow_inf_nan=True)], ...], BeforeValidator(as_tuple)]
Rates = Annotated[tuple[Annotated[float, Field(gt=0, allow_inf_nan=True)], ...], BeforeValidator(as_tuple)]


class ActuatorParameters(Parameters):
    """The actuators, one value an input in the airframe's order; a list that is left out is that of ideal ones."""

    lag: NonNegativesOrNone = Field(
        default=(), description="time constants of the first-order response, s, 0 where there is none"
    )
    lower: Lower = Field(default=(), description="lower end stops, deviations from trim, SI")
    upper: Upper = Field(default=(), description="upper end stops, deviations from trim, SI")
    rate: Rates = Field(default=(), description="rate limits, SI per s")


class SensorParameters(Parameters):
    """The sensors; as they stand by default they are ideal."""

    noise: NonNegativesOrNone = Field(default=(), description="standard deviation of the noise per sample, one an output, SI")
    delay: float = Field(default=0.0, ge=0, le=1e6, description="from its instant to its arrival, s; whole periods of `rate`")
    dropout: float = Field(default=0.0, ge=0, lt=1, description="the probability that a sample is lost")
    seed: int = Field(default=1, ge=0, lt=2**63, description="the seed of noise and losses")


class AircraftParameters(Parameters):
    """All parameters of the aircraft's node."""

    airframe: str = Field(description="the name of an airframe of the library, or the path of an airframe file")
    rate: Annotated[float, Field(ge=1, le=1000)] = Field(description="the rate at which y is published and u taken, Hz")
    step: Annotated[float, Field(gt=0, le=1)] = Field(description="the integration step, s; a whole fraction of 1 / rate")
    start_time: float = Field(
        default=0.0, ge=0, le=1e10, description="system time of t = 0, s since the epoch; 0 starts at once"
    )
    gusts: dict[str, Gust] = Field(default={}, description="gusts by their name in the airframe")
    actuators: ActuatorParameters = Field(default=ActuatorParameters(), description="the actuators, ideal where left out")
    sensors: SensorParameters = Field(default=SensorParameters(), description="the sensors, ideal where left out")

    max_age: float = Field(default=0.2, gt=0, le=1e6, description="how long without u until its controller counts as silent, s")
    hold: float = Field(default=0.5, ge=0, le=1e6, description="how long the last u is then held, s")
    ramp: float = Field(default=2.0, ge=0, le=1e6, description="how long it then takes to trim, s")

    @model_validator(mode="after")
    def _check(self) -> Self:
        period = period_ns(self.rate, "rate")
        divide(period, self.step_ns, "step", "1 / rate")
        airframe = load_airframe(self.airframe)
        for name in self.gusts:
            airframe.gust_direction(name)
        for key, values in self.actuators:
            if values:
                require_length(f"actuators.{key}", values, list(airframe.inputs))
        if self.sensors.noise:
            require_length("sensors.noise", self.sensors.noise, airframe.outputs)
        require(
            nanoseconds(self.sensors.delay) % period == 0,
            "sensors.delay",
            f"{self.sensors.delay:g} s",
            f"a whole multiple of 1 / rate ({seconds(period):g} s)",
        )
        return self

    @property
    def step_ns(self) -> int:
        """The integration step in ns."""
        return nanoseconds(self.step)

    def commanded_share(self, silence_ns: int) -> float:
        """How much of the last u is still commanded after a silence of its controller: `fade` from max_age on."""
        return fade(silence_ns, nanoseconds(self.max_age + self.hold), nanoseconds(self.ramp))

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

    def plant(self) -> Plant:
        """All of the aircraft as arrays: equation (1), actuators, sensors."""
        airframe, aircraft = self.load()
        inputs, outputs = len(airframe.inputs), len(airframe.outputs)
        limits = self.actuators
        return Plant(
            aircraft,
            Actuators(
                lag=_filled(limits.lag, inputs, 0.0),
                lower=_filled(limits.lower, inputs, -np.inf),
                upper=_filled(limits.upper, inputs, np.inf),
                rate=_filled(limits.rate, inputs, np.inf),
            ),
            Sensors(
                noise=_filled(self.sensors.noise, outputs, 0.0),
                delay_ns=nanoseconds(self.sensors.delay),
                dropout=self.sensors.dropout,
                seed=self.sensors.seed,
            ),
            self.step_ns,
        )


def _filled(values: Sequence[float], length: int, default: float) -> FloatArray:
    return np.array(values, dtype=np.float64) if values else np.full(length, default)
