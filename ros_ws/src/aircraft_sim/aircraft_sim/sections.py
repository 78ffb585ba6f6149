# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The sections in the parameters of the simulated aircraft."""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np

from aircraft_sim.atmosphere import wind_field
from aircraft_sim.atmosphere.turbulence import HIGH, LOW, LOWEST
from aircraft_sim.plant import effector_faults
from aircraft_sim.uncertainty import AIR_RELATIVE, Distribution, Spread, WindEffect
from flight_core.fields import Field
from flight_core.parameters import (
    Config,
    NonNegative,
    Number,
    Positive,
    require,
    require_length,
)
from flight_core.vectors import FloatArray


class Gust(Config):
    """A 1-cosine gust."""

    start: NonNegative = Field(description="instant of entry, s")
    speed: Number = Field(description="peak speed U_ds, m/s")
    length: Positive = Field(description="distance H from entry to peak, m")
    every: Annotated[float, Field(gt=0, allow_inf_nan=True)] = Field(
        default=math.inf, description="period after which the gust comes again, s"
    )


class TurbulenceConfig(Config):
    """Dryden turbulence of MIL-F-8785C.

    `wind` sets the intensity at low altitude, and `sigma` sets it at high altitude.
    """

    altitude: Number = Field(ge=LOWEST, description="altitude above the ground, m")
    wind: NonNegative | None = Field(
        default=None,
        description="wind at 20 ft above the ground, m/s: 7.7 light, 15.4 moderate, 23.1 severe",
    )
    sigma: NonNegative | None = Field(
        default=None, description="standard deviation at high altitude, m/s"
    )
    rotary: bool = Field(
        default=False,
        description="whether the air also turns with p_g, q_g, r_g",
    )
    seed: int = Field(default=1, ge=0, lt=2**63, description="seed of the turbulence")

    def _check(self) -> None:
        for key, acts, where in (
            ("wind", self.altitude < HIGH, f"below {HIGH:g} m"),
            ("sigma", self.altitude > LOW, f"above {LOW:g} m"),
        ):
            value = getattr(self, key)
            actual, expected = ("none", "a value") if value is None else (f"{value:g} m/s", "none")
            require(
                (value is not None) == acts,
                key,
                actual,
                f"{expected} at {self.altitude:g} m: it acts {where}",
            )


NEEDS = {
    "log": ("reference", "roughness"),
    "power": ("reference", "exponent"),
    "table": ("height", "north", "east"),
}
"""Keys of a wind shear by its law."""


class ShearConfig(Config):
    """The steady wind as a function of the height above the ground.

    Either `aircraft.wind` is the wind at the height `reference`, or a table gives the wind.
    """

    law: Literal["log", "power", "table"] = Field(description="how the wind depends on the height")
    ground: Number = Field(description="altitude of the ground, m, as in `pose`")
    reference: Positive | None = Field(
        default=None, description="for log and power: height at which `aircraft.wind` holds, m"
    )
    roughness: Positive | None = Field(default=None, description="for log: roughness length, m")
    exponent: Positive | None = Field(default=None, description="for power: exponent, no unit")
    height: tuple[Number, ...] = Field(default=(), description="for table: rising heights, m")
    north: tuple[Number, ...] = Field(
        default=(), description="for table: wind to the north at each height, m/s"
    )
    east: tuple[Number, ...] = Field(
        default=(), description="for table: wind to the east at each height, m/s"
    )

    def _check(self) -> None:
        every = {key for keys in NEEDS.values() for key in keys}
        for key in sorted(every):
            is_set = bool(getattr(self, key))
            is_needed = key in NEEDS[self.law]
            expected = f"{'a value' if is_needed else 'none'} beside law {self.law}"
            require(is_set == is_needed, key, "a value" if is_set else "none", expected)
        for key in ("north", "east"):
            if self.law == "table":
                require_length(key, getattr(self, key), [f"{h:g} m" for h in self.height])
        rises = all(b > a for a, b in pairwise(self.height))
        require(rises, "height", list(self.height), "rising heights")
        if self.reference is not None and self.roughness is not None:
            expected = f"more than roughness, {self.roughness:g} m"
            above = self.reference > self.roughness
            require(above, "reference", f"{self.reference:g} m", expected)

    def profile(self) -> wind_field.Log | wind_field.Power | wind_field.Table:
        """Return the wind profile over the height, as the equations use it."""
        if self.law == "table":
            return wind_field.Table(self.height, self.north, self.east)
        reference = self.reference or math.inf
        if self.law == "log":
            return wind_field.Log(reference, self.roughness or math.inf)
        return wind_field.Power(reference, self.exponent or 0.0)


class MicroburstConfig(Config):
    """A microburst: a downdraft that spreads over the ground."""

    ground: Number = Field(description="altitude of the ground, m, as in `pose`")
    north: Number = Field(description="north coordinate of the centre, m")
    east: Number = Field(description="east coordinate of the centre, m")
    radius: Positive = Field(description="radius R of the downdraft, m")
    speed: Positive = Field(description="largest outflow, m/s")
    height: Positive = Field(description="height of the largest outflow above the ground, m")

    def model(self) -> wind_field.Microburst:
        """Return the microburst as the equations use it."""
        values = self.model_dump(exclude={"ground"})
        return wind_field.Microburst(**values)


def require_one_wind(
    wind: Sequence[float], shear: ShearConfig | None, burst: MicroburstConfig | None
) -> None:
    """Check that the steady wind is given once, and the altitude of the ground once.

    Raises ParameterError for a steady wind beside a table of the wind, and for two altitudes.
    """
    if shear is not None and shear.law == "table":
        expected = "0 beside shear.law table, which has the whole wind"
        require(not any(wind), "wind", list(wind), expected)
    if shear is not None and burst is not None:
        expected = f"{shear.ground:g} m, as in shear"
        is_same = burst.ground == shear.ground
        require(is_same, "microburst.ground", f"{burst.ground:g} m", expected)


def wind_field_of(
    wind: Sequence[float], shear: ShearConfig | None, burst: MicroburstConfig | None
) -> wind_field.WindField | None:
    """Return the wind as a function of place, or None if it is the same everywhere."""
    section = burst if shear is None else shear
    if section is None:
        return None
    return wind_field.WindField(
        (wind[0], wind[1]),
        section.ground,
        None if shear is None else shear.profile(),
        None if burst is None else burst.model(),
    )


class BiasConfig(Config):
    """A bias on the derivative of a state.

    The bias rises from 0 to `value` along half a cosine. If `rise` is 0, it is a step.
    """

    start: NonNegative = Field(description="instant at which it begins, s")
    value: Number = Field(description="final value, SI unit of the state per s")
    rise: NonNegative = Field(
        description="rise time, s; 0 for a step, which is outside the theorem"
    )


class SineConfig(Config):
    """A sine on the derivative of a state: amplitude sin(frequency t + phase)."""

    amplitude: Number = Field(description="amplitude, SI unit of the state per s")
    frequency: Positive = Field(description="frequency, rad/s")
    phase: Number = Field(default=0.0, description="phase, rad")


class DrawConfig(Config):
    """A random draw of A and B: entries are multiplied by 1 + d, with d drawn from a seed."""

    A: float = Field(
        default=0.0, ge=0, lt=1, description="largest relative deviation d of an entry of A"
    )
    B: float = Field(
        default=0.0, ge=0, lt=1, description="largest relative deviation d of an entry of B"
    )
    seed: int = Field(default=1, ge=0, lt=2**63, description="seed of the draw")
    number: int = Field(default=0, ge=0, lt=2**32, description="number of the draw with this seed")


class UncertaintyConfig(DrawConfig):
    """An uncertain aircraft, which is sampled around the airframe.

    Every entry of A and B is multiplied by 1 + d, with an independent d for each entry. The rows of
    angles stay as they are.
    """

    entries: tuple[str, ...] = Field(
        default=(), description="entries that have their own largest d, such as A[q,alpha]"
    )
    parts: tuple[Annotated[float, Field(ge=0, lt=1)], ...] = Field(
        default=(), description="largest d of each of these entries"
    )
    distribution: Distribution = Field(
        default="uniform",
        description="distribution of d; normal: cut at three standard deviations; corners: one of"
        " the limits",
    )
    wind: WindEffect = Field(
        default=AIR_RELATIVE,
        description="whose A the wind acts through: the aircraft's own, or the published one",
    )

    def _check(self) -> None:
        require(
            len(set(self.entries)) == len(self.entries),
            "entries",
            ", ".join(self.entries),
            "different ones",
        )
        require_length("parts", self.parts, self.entries)

    def spread(self) -> Spread:
        """Return the distribution from which the entries are drawn."""
        return Spread(dict(zip(self.entries, self.parts, strict=True)), self.distribution)


class DriftConfig(DrawConfig):
    """A change of A and B in flight, such as by ice or damage.

    Every entry is multiplied by 1 + d, with an independent and uniform d for each entry.
    """

    start: Annotated[float, Field(ge=0, allow_inf_nan=True)] = Field(
        description="instant at which it begins, s"
    )
    duration: NonNegative = Field(
        default=60.0, description="how long the entries change, s; 0 for at once"
    )

    def _check(self) -> None:
        require(self.A > 0.0 or self.B > 0.0, "A", "0, and B 0", "how far A or B change")


# These lists have a value for each channel. An empty list means that all channels are ideal. An
# infinite limit (.inf in YAML) means that a channel has no limit.
NonNegativesOrNone = tuple[NonNegative, ...]


Lower = tuple[Annotated[float, Field(le=0, allow_inf_nan=True)], ...]


Upper = tuple[Annotated[float, Field(ge=0, allow_inf_nan=True)], ...]


Rates = tuple[Annotated[float, Field(gt=0, allow_inf_nan=True)], ...]


NumbersOrNone = tuple[Number, ...]


Times = Upper  # times from 0 on, .inf for never


class ActuatorConfig(Config):
    """The actuators.

    Each list has one value for each input, in the airframe's order. If a list is missing, the
    actuators are ideal in this respect.
    """

    lag: NonNegativesOrNone = Field(
        default=(), description="time constants of first-order lags, s; 0 for none"
    )
    lower: Lower = Field(default=(), description="lower end stops, deviations from trim, SI")
    upper: Upper = Field(default=(), description="upper end stops, deviations from trim, SI")
    rate: Rates = Field(default=(), description="rate limits, SI per s")
    dead_zone: NonNegativesOrNone = Field(default=(), description="half-widths of the dead zones")
    faults: tuple[str, ...] = Field(
        default=(),
        description="INPUT KIND AT, AT in s, and a strength if the kind has one: aileron lost 60",
    )
    delay: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="delay of u, s; a whole number of the aircraft's periods",
    )

    def _check(self) -> None:
        self.read_faults()

    def read_faults(self) -> tuple[effector_faults.Fault, ...]:
        """Return the faults in `faults`. Raises ParameterError if one does not have its form."""
        return tuple(
            effector_faults.read_fault(sentence, f"faults[{number}]")
            for number, sentence in enumerate(self.faults)
        )


class SensorConfig(Config):
    """The errors and delays of the sensors. By default the sensors are ideal."""

    bias: NumbersOrNone = Field(default=(), description="constant errors, SI")
    drift: NonNegativesOrNone = Field(
        default=(), description="standard deviation of the random walks, SI per sqrt(s)"
    )
    noise: NonNegativesOrNone = Field(
        default=(), description="standard deviation of the noise per sample, SI"
    )
    quantisation: NonNegativesOrNone = Field(
        default=(), description="steps of the quantised values, SI; 0 for none"
    )
    delay: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="delay, s; a whole number of periods of `rate`",
    )
    dropout: float = Field(default=0.0, ge=0, lt=1, description="probability that a sample is lost")
    seed: int = Field(default=1, ge=0, lt=2**63, description="seed of noise, drift and losses")


PerPose = dict[str, Number]


class PoseConfig(Config):
    """The measurement of `pose`.

    By default the estimator is ideal. It gives the true pose without delay, at up to 50 Hz.
    """

    rate: Positive | None = Field(
        default=None,
        description="rate, Hz, a whole fraction of the aircraft's rate; none: at most 50 Hz",
    )
    delay: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="delay, s; a whole number of the aircraft's periods",
    )
    bias: PerPose = Field(default={}, description="constant errors, SI")
    drift: dict[str, NonNegative] = Field(
        default={}, description="standard deviation of the random walks, SI per sqrt(s)"
    )
    noise: dict[str, NonNegative] = Field(
        default={}, description="standard deviation of the noise per sample, SI"
    )
    seed: int = Field(default=1, ge=0, lt=2**63, description="seed of noise and drift")


class StartConfig(Config):
    """The position and the heading of the aircraft at t = 0."""

    north: Number = Field(default=0.0, description="distance to the north of the origin, m")
    east: Number = Field(default=0.0, description="distance to the east of the origin, m")
    heading: Number = Field(default=0.0, description="heading, rad, positive to the right of north")


def by_state(
    configs: Mapping[str, Config], keys: Sequence[str], states: Iterable[str]
) -> list[FloatArray]:
    """Return an array for each key, with the value of this key for each of `states`.

    The value is 0 for a state without a section in `configs`.
    """
    sections = [configs.get(state) for state in states]
    return [np.array([float(getattr(section, key, 0.0)) for section in sections]) for key in keys]
