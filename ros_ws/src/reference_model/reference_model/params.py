# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Validate the parameters of the reference model, and convert them to arrays.

There are arrays of the model, of the profile of commands, and of live commands.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any, Self

import numpy as np

from flight_core import parameters
from flight_core.channels import WITHOUT_RUDDER, vertical
from flight_core.fields import Field, Problems
from flight_core.parameters import (
    Config,
    Names,
    NodeConfig,
    Number,
    Numbers,
    ParameterError,
    Positive,
    Positives,
    Rate,
    RateOrZero,
    require,
)
from flight_core.rates import nanoseconds, period_ns
from flight_core.units import GRAVITY
from flight_core.vectors import selection_matrix
from reference_model.command import Chirps, Edge, Line, Polyline, Profile
from reference_model.live import LiveParams
from reference_model.model import ReferenceMatrices, second_order, stepper
from reference_model.stick import read_stick

SIGNALS = ("pulses", "doublets", "ramps", "sines", "chirps", "recorded")
"""The parameters with commands by channel."""

MOST_RECORDED = 10_000  # number of points; with more, a scenario file could become too large


class Pulses(Config):
    """Pulses on a channel."""

    start: Numbers = Field(description="start times of the rising edges, s")
    stop: Numbers = Field(description="start times of the falling edges, s")
    value: Numbers = Field(description="heights of the pulses, in the channel's unit")

    def _check(self) -> None:
        _require_spans(self.start, self.stop, self.value, "pulse")

    def edges(self, rise: float) -> list[Edge]:
        """Return two edges for each pulse."""
        return [
            Edge(t, t + rise, sign * value)
            for times, sign in ((self.start, 1.0), (self.stop, -1.0))
            for t, value in zip(times, self.value, strict=True)
        ]


class Doublets(Config):
    """Doublets on a channel: a pulse, then its opposite."""

    start: Numbers = Field(description="start times of the first pulses, s")
    width: Positives = Field(description="durations of each of the two pulses, s")
    value: Numbers = Field(description="heights of the first pulses, in the channel's unit")

    def _check(self) -> None:
        _require_one_each(self.start, {"width": self.width, "value": self.value}, "doublet")

    def edges(self, rise: float) -> list[Edge]:
        """Return three edges for each doublet. The middle edge has twice the height."""
        return [
            Edge(start + k * width, start + k * width + rise, factor * value)
            for start, width, value in zip(self.start, self.width, self.value, strict=True)
            for k, factor in ((0.0, 1.0), (1.0, -2.0), (2.0, 1.0))
        ]


class Ramps(Config):
    """Ramps on a channel: a linear change from `start` to `stop`, held from there on."""

    start: Numbers = Field(description="start times, s")
    stop: Numbers = Field(description="end times, s")
    value: Numbers = Field(description="changes of the command, in the channel's unit")

    def _check(self) -> None:
        _require_spans(self.start, self.stop, self.value, "ramp")

    def edges(self, _rise: float) -> list[Edge]:
        """Return one edge for each ramp."""
        return list(map(Edge, self.start, self.stop, self.value))


class Sine(Config):
    """A sine on a channel: amplitude sin(frequency t + phase)."""

    amplitude: Number = Field(description="amplitude, in the channel's unit")
    frequency: Positive = Field(description="frequency, rad/s")
    phase: Number = Field(default=0.0, description="phase, rad")


class Chirp(Config):
    """A linear chirp on a channel: a sine whose frequency changes linearly.

    After the sweep the last frequency continues until the next zero.
    """

    amplitude: Number = Field(description="amplitude, in the channel's unit")
    start: Number = Field(description="start of the sweep, s")
    stop: Number = Field(description="end of the sweep, s; the chirp ends at the next zero")
    first_frequency: Positive = Field(description="frequency at `start`, rad/s")
    last_frequency: Positive = Field(description="frequency at `stop`, rad/s")

    def _check(self) -> None:
        require(self.stop > self.start, "stop", self.stop, f"later than start = {self.start:g} s")
        sweeps = self.last_frequency != self.first_frequency
        require(sweeps, "last_frequency", self.last_frequency, "a value other than first_frequency")


class Recorded(Config):
    """A recorded command on a channel, interpolated linearly; the last value is held.

    A `file` is read only once. The set then contains its values, and its path as `source`.
    """

    file: str = Field(
        default="",
        description="path of a CSV file `time,value`, relative to the folder of the scenario",
    )
    source: str = Field(default="", description="file from which the values come")
    time: Numbers = Field(default=(), max_length=MOST_RECORDED, description="times from 0 on, s")
    value: Numbers = Field(default=(), description="values at `time`, in the channel's unit")

    @classmethod
    def read(
        cls, values: Mapping[Any, Any], key: str, problems: Problems, *, check: bool = True
    ) -> Self | None:
        """Build the parameter set, with values from the file if one is given."""
        if isinstance(file := values.get("file"), str) and file:
            try:
                others = ", ".join(name for name in values if name != "file" and values[name])
                require(not others, f"{key}.file", f"a file together with {others}", "a file alone")
                values = read_stick(file, f"{key}.file") | {"source": file}
            except ParameterError as error:
                problems.others.append(str(error))
                return None
        return super().read(values, key, problems, check=check)

    def _check(self) -> None:
        points = [f"time {k + 1}" for k in range(len(self.time))]
        parameters.require_length("value", self.value, points)
        require(len(self.time) > 1, "time", f"{len(self.time)} values", "at least 2, or a file")
        require(self.time[0] == 0.0, "time[0]", self.time[0], "0: the start of the flight")
        for k, (before, t) in enumerate(pairwise(self.time), 1):
            require(t > before, f"time[{k}]", t, f"later than time[{k - 1}] = {before:g} s")

    def line(self) -> Line:
        """Return the command as a line through its points."""
        return Line(np.array(self.time), np.array(self.value))


def _require_one_each(start: Numbers, others: Mapping[str, Numbers], kind: str) -> None:
    for key, values in others.items():
        parameters.require_length(key, values, [f"{kind} {k + 1}" for k in range(len(start))])


def _require_spans(start: Numbers, stop: Numbers, value: Numbers, kind: str) -> None:
    """Check that the lists have the same length, and that each stop is after its start.

    Raises ParameterError if not.
    """
    _require_one_each(start, {"stop": stop, "value": value}, kind)
    for k, (begin, end) in enumerate(zip(start, stop, strict=True)):
        require(end > begin, f"stop[{k}]", end, f"later than start[{k}] = {begin:g} s")


class CoordinatedTurn(Config):
    """Adds the turn rate of a coordinated turn to a channel.

    The rate is g/V0 sin(integral of the commanded bank rate).
    """

    bank_rate: str = Field(description="channel whose integral is the bank angle, such as p")
    turn_rate: str = Field(description="channel to which the turn rate is added, such as r")
    speed: Positive = Field(description="trim speed V0, m/s")


class LiveCommands(Config):
    """Live commands, which come on the topic u_m in place of the profile.

    They end if their publisher is lost.
    """

    max_age: Annotated[float, Field(gt=0, le=1e6)] = Field(
        default=0.2, description="age at which u_m times out, s"
    )
    speed: Positive | None = Field(
        default=None,
        description="trim speed V0, m/s, for levelling the wings; none: zero commands at once",
    )
    levelling: Annotated[float, Field(ge=0, le=1e6)] = Field(
        default=10.0, description="how long the wings are levelled after a timeout, s"
    )
    roll_rate: Positive = Field(
        default=0.35, description="largest roll rate for levelling the wings, rad/s"
    )
    bounds: dict[str, Positive] = Field(default={}, description="largest absolute commands")
    slew: dict[str, Positive] = Field(
        default={}, description="largest rates of the commands, in their units per s"
    )


class SecondOrder(Config):
    """The model as a second-order filter per channel."""

    natural_frequency: Positives = Field(description="natural frequencies, one per channel, rad/s")
    damping: Numbers = Field(description="damping ratios, one per channel")


class Linear(Config):
    """The model x_m_dot = A_m x_m + B_m u_m, equation (2), as matrices row by row."""

    states: Names = Field(description="names of the states x_m, with the outputs among them")
    A_m: Numbers = Field(description="A_m row by row, 1/s")
    B_m: Numbers = Field(description="B_m row by row")


class ReferenceModelConfig(NodeConfig):
    """Parameters of the reference model node."""

    rate: Rate = Field(description="rate at which y_m is published, Hz")
    start_time: float = Field(
        default=0.0,
        ge=-1,
        le=1e10,
        description="system time of t = 0, s since the epoch; 0: at once; -1: as the topic "
        "`start` says",
    )
    outputs: Names = Field(description="names of the outputs y_m")
    second_order: SecondOrder | None = Field(
        default=None, description="model as one filter per channel"
    )
    linear: Linear | None = Field(default=None, description="model as matrices")
    rise: Positive = Field(
        description="duration of an edge of a pulse or doublet, s; bounds u_m_dot"
    )
    pulses: dict[str, Pulses] = Field(default={}, description="pulses by channel")
    doublets: dict[str, Doublets] = Field(default={}, description="doublets by channel")
    ramps: dict[str, Ramps] = Field(default={}, description="ramps by channel")
    sines: dict[str, Sine] = Field(default={}, description="sines by channel")
    chirps: dict[str, Chirp] = Field(default={}, description="linear chirps by channel")
    recorded: dict[str, Recorded] = Field(
        default={}, description="recorded commands by channel, for example of a stick"
    )
    coordinated_turn: CoordinatedTurn | None = Field(
        default=None, description="yaw rate in a coordinated turn"
    )
    live: LiveCommands = Field(default=LiveCommands(), description="limits of live commands u_m")
    u_m_rate: RateOrZero = Field(
        default=0.0, description="rate of u_m in lockstep, Hz; 0 for no u_m"
    )

    def _check(self) -> None:
        period = period_ns(self.rate, "rate")
        parameters.require_distinct("outputs", self.outputs)
        if self.linear is not None:
            parameters.require_distinct("linear.states", self.linear.states)
        if self.u_m_rate:
            divides = period_ns(self.u_m_rate, "u_m_rate") % period == 0
            require(
                divides,
                "u_m_rate",
                f"{self.u_m_rate:g} Hz",
                f"a whole fraction of rate ({self.rate:g} Hz)",
            )
        turn = self.coordinated_turn
        names = {f"{key}.{name}": name for key in SIGNALS for name in getattr(self, key)}
        if turn is not None:
            names |= {
                "coordinated_turn.bank_rate": turn.bank_rate,
                "coordinated_turn.turn_rate": turn.turn_rate,
            }
        names |= {f"live.bounds.{name}": name for name in self.live.bounds}
        names |= {f"live.slew.{name}": name for name in self.live.slew}
        for key, name in names.items():
            require(
                name in self.outputs, key, f"channel {name!r}", f"one of {', '.join(self.outputs)}"
            )
        self._check_model()
        missing = [name for name in WITHOUT_RUDDER if name not in self.outputs]
        levels = self.live.speed is None or (not missing and self.second_order is not None)
        expected = (
            f"none: wings are levelled by {', '.join(WITHOUT_RUDDER)} of a second_order model"
        )
        require(levels, "live.speed", self.live.speed, expected)

    def _check_model(self) -> None:
        has_one = (self.second_order is None) != (self.linear is None)
        models = "no model" if self.linear is None else "a section together with linear"
        require(has_one, "second_order", models, "exactly one model: second_order or linear")
        key = "second_order.damping"
        if self.second_order is not None:
            for name in ("natural_frequency", "damping"):
                parameters.require_length(
                    f"second_order.{name}", getattr(self.second_order, name), self.outputs
                )
        elif self.linear is not None:
            key = "linear.A_m"
            n = len(self.linear.states)
            m = len(self.outputs)
            for name, rows, columns in (("A_m", n, n), ("B_m", n, m)):
                count = len(getattr(self.linear, name))
                require(
                    count == rows * columns,
                    f"linear.{name}",
                    f"{count} values",
                    f"{rows} rows of {columns}",
                )
            for output in self.outputs:
                require(
                    output in self.linear.states,
                    "linear.states",
                    ", ".join(self.linear.states),
                    f"{output} among them",
                )
        largest = float(np.linalg.eigvals(self.model().A_m).real.max())
        require(
            largest < 0,
            key,
            f"an eigenvalue of A_m with real part {largest:.3g}",
            "A_m Hurwitz: all of them negative",
        )
        with np.errstate(over="ignore", invalid="ignore"):
            Phi = stepper(1.0 / self.rate, self.model()).Phi
        # With a damping of 1 two eigenvalues are equal, and are only computed to 1e-8, so 1e-6 is
        # allowed.
        stable = (
            bool(np.isfinite(Phi).all())
            and float(np.abs(np.linalg.eigvals(Phi)).max()) < 1.0 + 1e-6
        )
        require(
            stable,
            "rate",
            f"{self.rate:g} Hz",
            "a higher one: the Runge-Kutta steps of the model diverge",
        )

    def model(self) -> ReferenceMatrices:
        """Return the matrices of equation (2)."""
        if self.second_order is not None:
            return second_order(
                np.array(self.second_order.natural_frequency), np.array(self.second_order.damping)
            )
        if self.linear is None:
            raise ParameterError("second_order: found no model, expected second_order or linear")
        n = len(self.linear.states)
        m = len(self.outputs)
        C = selection_matrix(self.outputs, self.linear.states)
        return ReferenceMatrices(
            np.reshape(self.linear.A_m, (n, n)), np.reshape(self.linear.B_m, (n, m)), C
        )

    def live_params(self) -> LiveParams:
        """Return the limits of u_m, and the gains that level the aircraft after the last u_m.

        The gains are a quarter of the reference model's natural frequencies of p and q, or 0 if
        nothing is levelled. If the reference model has a damping of 0.9, the loop of the angle then
        has a damping of about 0.74.
        """
        section = self.live
        channels = None
        gain = (0.0, 0.0)
        speed = section.speed
        climbs = vertical(self.outputs)
        if climbs and {"p", "q", "r"} <= {*self.outputs}:
            speed = math.inf  # a multicopter levels without a turn
        if speed is not None and self.second_order is not None:
            q, V, p = (self.outputs.index(name) for name in ("q", climbs or "V", "p"))
            r = self.outputs.index("r") if "r" in self.outputs else None
            channels = (q, V, p, r)
            frequency = self.second_order.natural_frequency
            gain = (frequency[p] / 4.0, frequency[q] / 4.0)
        return LiveParams(
            max_age_ns=nanoseconds(section.max_age),
            levelling_ns=nanoseconds(section.levelling),
            bounds=np.array([section.bounds.get(name, np.inf) for name in self.outputs]),
            reach=np.array([section.slew.get(name, np.inf) for name in self.outputs]) / self.rate,
            speed=speed,
            channels=channels,
            gain=gain,
            roll_rate=section.roll_rate,
        )

    def edges(self) -> dict[str, list[Edge]]:
        """Return the edges of pulses, doublets and ramps by channel, in the outputs' order."""
        return self._edges(self.pulses, self.doublets, self.ramps)

    def _edges(self, *signals: Mapping[str, Pulses | Doublets | Ramps]) -> dict[str, list[Edge]]:
        return {
            name: [
                edge
                for by_channel in signals
                if name in by_channel
                for edge in by_channel[name].edges(self.rise)
            ]
            for name in self.outputs
        }

    def profile(self) -> Profile:
        """Return the commands u_m(t) as arrays over the outputs. The signals of a channel add up.

        Channels with fewer edges of pulses and doublets are padded with edges of height 0.
        """
        m = len(self.outputs)
        rows = [*self._edges(self.pulses, self.doublets).values()]
        time = np.zeros((m, max(map(len, rows))))
        change = np.zeros_like(time)
        for row, edges in enumerate(rows):
            time[row, : len(edges)] = [edge.start for edge in edges]
            change[row, : len(edges)] = [edge.change for edge in edges]
        lines = [[edge.line() for edge in edges] for edges in self._edges(self.ramps).values()]
        for name, recorded in self.recorded.items():
            lines[self.outputs.index(name)].append(recorded.line())
        sines = [self.sines.get(name) for name in self.outputs]
        bank_rate = np.zeros(m)
        turn_rate = np.zeros(m)
        if (turn := self.coordinated_turn) is not None:
            bank_rate[self.outputs.index(turn.bank_rate)] = 1.0
            turn_rate[self.outputs.index(turn.turn_rate)] = GRAVITY / turn.speed
        return Profile(
            time=time,
            change=change,
            rise=np.array(self.rise),
            amplitude=np.array([0.0 if sine is None else sine.amplitude for sine in sines]),
            frequency=np.array([1.0 if sine is None else sine.frequency for sine in sines]),
            phase=np.array([0.0 if sine is None else sine.phase for sine in sines]),
            bank_rate=bank_rate,
            turn_rate=turn_rate,
            lines=Polyline.through(lines) if any(lines) else None,
            chirps=self._chirps() if self.chirps else None,
        )

    def _chirps(self) -> Chirps:
        """Return the chirps of all channels. A channel without a chirp has amplitude 0."""
        columns = [
            (0.0, 0.0, 1.0, 1.0, 1.0)
            if chirp is None
            else (
                chirp.amplitude,
                chirp.start,
                chirp.stop - chirp.start,
                chirp.first_frequency,
                (chirp.last_frequency - chirp.first_frequency) / (chirp.stop - chirp.start),
            )
            for chirp in map(self.chirps.get, self.outputs)
        ]
        return Chirps(*np.array(columns).T)
