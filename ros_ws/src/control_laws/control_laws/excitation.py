# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Excite the inputs one after the other, in open loop, for an identification.

Each input is excited by doublets and a multisine.
"""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from flight_core.fields import Field
from flight_core.parameters import NonNegative, NonNegatives, Positives, require, require_length
from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller.law.control_law import ControlLaw, Measurements, without_limits
from rise_di_controller.law.saturation import Limits, saturate
from rise_di_controller.params import ControllerConfig


class Pulse(NamedTuple):
    """A pulse of a doublet, in widths after the excitation of its input begins."""

    first: float
    last: float
    sign: float


# a doublet, a gap of a width, and the opposite doublet at half the frequency
PULSES = (
    Pulse(0.0, 1.0, 1.0),
    Pulse(1.0, 2.0, -1.0),
    Pulse(3.0, 5.0, -1.0),
    Pulse(5.0, 7.0, 1.0),
)
DOUBLETS = PULSES[-1].last + 1.0  # total length in widths, with a gap at the end


class ExcitationParams(NamedTuple):
    """The timetable of the m inputs, (m,), and the harmonics of their multisines, (h, m)."""

    amplitude: Array  # units of u
    width: Array  # s
    begin: Array  # time after engagement at which the doublets of an input begin, s
    period: Array  # period of the multisine, which lasts for one period, s
    harmonic: Array  # frequencies as multiples of 1 / period
    phase: Array  # rad
    part: Array  # fraction of the amplitude in each harmonic; 0 if an input lacks it


class ExcitationState(NamedTuple):
    """State of the excitation between two ticks, each field with the shape (m,)."""

    e: Array  # y - y_m, only for the log: this law does not correct it
    elapsed: Array  # time since engagement, s, the same for every input


def signal(elapsed: Array, params: ExcitationParams) -> Array:
    """Compute the excitation of every input divided by its amplitude, (m,), in [-1, 1].

    With tau = elapsed - begin, in units of the width w of an input:

        +1 in [0, 1), -1 in [1, 2), -1 in [3, 5), +1 in [5, 7)  two opposite doublets, PULSES
        sum_k part_k sin(2 pi harmonic_k (tau - 8) w / period + phase_k) in [8, 8 + period / w)
            a multisine

    Each doublet and the multisine have the mean 0. If an angular rate is proportional to u, the
    attitude is therefore the same at the end as at the beginning.
    """
    xp = array_namespace(params.amplitude)
    since = elapsed - params.begin
    tau = since / params.width
    zero = 0.0 * tau
    doublets = zero
    for first, last, sign in PULSES:
        doublets = xp.where((tau >= first) & (tau < last), sign + zero, doublets)
    turns = (since - DOUBLETS * params.width) / params.period
    waves = xp.sum(params.part * xp.sin(2.0 * np.pi * params.harmonic * turns + params.phase), 0)
    return xp.where((turns >= 0.0) & (turns < 1.0), waves, doublets)


def multisine(
    period: float, lowest: float, highest: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the harmonics of a multisine, with their phases and sizes, each (h,).

    The harmonics are all multiples of 1 / period from `lowest` to `highest`, Hz. The sizes are
    equal, and give the sum a peak of 1. The phases phase_k = -pi k (k - 1) / h keep the peak low.
    Source: M. R. Schroeder, IEEE Trans. Information Theory 16(1), 1970.
    """
    harmonic = np.arange(
        max(round(lowest * period), 1), max(int(highest * period), 1) + 1, dtype=np.float64
    )
    k = np.arange(1, len(harmonic) + 1)
    phase = -np.pi * k * (k - 1) / len(k)
    turns = np.linspace(0.0, 1.0, 64 * int(harmonic[-1]), endpoint=False)
    peak = np.max(np.abs(np.sin(2.0 * np.pi * np.outer(turns, harmonic) + phase).sum(axis=1)))
    return harmonic, phase, np.full(len(k), 1.0 / peak)


def _engage(measurements: Measurements, params: ExcitationParams) -> ExcitationState:
    e = measurements.y - measurements.y_m
    return ExcitationState(e, 0.0 * e)


def _limited(
    state: ExcitationState,
    measurements: Measurements,
    dt: Array,
    params: ExcitationParams,
    limits: Limits,
) -> tuple[ExcitationState, Array, Array]:
    elapsed = state.elapsed + dt
    u = measurements.u_trim + params.amplitude * signal(elapsed, params)
    after = ExcitationState(measurements.y - measurements.y_m, elapsed)
    return after, u, saturate(u, measurements.u_before, dt, limits)


def _retune(
    state: ExcitationState, old: ExcitationParams, new: ExcitationParams
) -> ExcitationState:
    return state


EXCITATION = ControlLaw(
    state=ExcitationState,
    engage=_engage,
    step=without_limits(_limited),
    limited=_limited,
    retune=_retune,
)


class ExcitationConfig(ControllerConfig):
    """A controller that excites the inputs one after the other, in their order, in open loop."""

    amplitude: NonNegatives = Field(description="largest deviation of each input from trim")
    width: Positives = Field(description="half the length of each input's first doublet, s")
    period: Positives = Field(description="period of the multisine of each input, s")
    lowest: Positives = Field(description="lowest frequency of each multisine, Hz")
    highest: Positives = Field(description="highest frequency of each multisine, Hz")
    pause: NonNegative = Field(
        description="time before each input's excitation, and after the last one, s"
    )

    @classmethod
    def tunable(cls) -> frozenset[str]:
        """Return no parameter, because the timetable holds for a whole flight."""
        return frozenset()

    def check_law(self) -> None:
        """Check that each input has its values, and that u stays inside its limits.

        The frequencies of a multisine must be in order, and below half the rate of the law.
        """
        for key in ("amplitude", "width", "period", "lowest", "highest"):
            require_length(key, getattr(self, key), self.inputs)
        nyquist = self.rate / 2.0
        for i, name in enumerate(self.inputs):
            low, high = (
                (limit or (np.inf,) * len(self.inputs))[i] for limit in (self.lower, self.upper)
            )
            room = min(abs(low), abs(high))
            slowest = self.lowest[i]
            fastest = self.highest[i]
            require(
                self.amplitude[i] <= room,
                f"amplitude[{i}]",
                self.amplitude[i],
                f"at most {room:g}, the limits of {name}",
            )
            require(
                slowest <= fastest,
                f"lowest[{i}]",
                slowest,
                f"at most highest[{i}] = {fastest:g} Hz",
            )
            require(
                fastest < nyquist,
                f"highest[{i}]",
                fastest,
                f"below half the rate of the law, {nyquist:g} Hz",
            )

    @property
    def duration(self) -> float:
        """Time from engagement to the end of the excitation, s."""
        return float(self.pause + sum(self._each))

    @cached_property
    def _each(self) -> list[float]:
        """Time for each input, including the pause, s."""
        return [
            DOUBLETS * width + period + self.pause
            for width, period in zip(self.width, self.period, strict=True)
        ]

    def control_law(self) -> ControlLaw:
        """Return the excitation as a control law."""
        return EXCITATION

    def law_params(self) -> Any:
        """Return the arrays of the excitation."""
        waves = [
            multisine(*band) for band in zip(self.period, self.lowest, self.highest, strict=True)
        ]
        table = np.zeros((3, max(len(harmonic) for harmonic, _, _ in waves), len(waves)))
        for i, wave in enumerate(waves):
            table[:, : len(wave[0]), i] = wave
        begin = self.pause + np.cumsum([0.0, *self._each[:-1]])
        return ExcitationParams(
            np.array(self.amplitude), np.array(self.width), begin, np.array(self.period), *table
        )
