# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Probe of the inputs while engaged, and the test of the answer.

A surface that is stuck in trim shows no error in calm air.

Each probed input has a sine of its own frequency beside what the law commands. Over a window all
sines are orthogonal, also to the frequencies between, where the disturbances are measured.
"""

from collections import deque
from typing import Annotated, NamedTuple

import numpy as np

from flight_core.channels import UNKNOWN
from flight_core.fields import Field
from flight_core.parameters import Config, NonNegatives, Positive
from flight_core.rates import NANOSECONDS
from flight_core.vectors import FloatArray

RATES = frozenset({"p", "q", "r"})
EFFECT = 0.02  # rad/s, of a body rate by default: ArduPlane's noise in calm air is 0.006 rms
GAP = 4  # multiples of 1 / window between two sines: those between show the disturbances
BIN_NS = NANOSECONDS // 20  # y and u are averaged over it
TESTS = 12  # a window
FILLED = 0.8  # of the bins of a window that a test needs
DRIFT = 3  # degree of the polynomial for what is slower than the window, as a turn
LEAST_SINE = 0.05  # of the amplitude: less of it is left in u at a limit
LARGEST = 4.0  # Hz, of a sine: five bins a period


class ProbeConfig(Config):
    """Probe of the inputs, an extension of the paper: finds a stuck surface without a command."""

    effect: NonNegatives | None = Field(
        default=None,
        description="amplitude of each output by its sine; 0: not probed; none: 0.02 rad/s of "
        "p, q, r, else 0",
    )
    lowest: Positive = Field(
        default=1.5, description="lowest frequency of a sine, Hz: above the commands of guidance"
    )
    window: Annotated[float, Field(ge=2, le=60)] = Field(
        default=6.0, description="time over which the answer is measured, s"
    )
    false_alarm: Annotated[float, Field(ge=1e-9, le=0.05)] = Field(
        default=1e-3,
        description="largest probability of a false alarm in a window",
    )

    def amplitudes(self, outputs: tuple[str, ...]) -> FloatArray:
        """Amplitudes of the outputs, (m,), units of y."""
        rates = tuple(EFFECT if name in RATES else 0.0 for name in outputs)
        return np.array(self.effect or rates)

    def harmonics(self, outputs: tuple[str, ...], input_scale: tuple[float, ...]) -> FloatArray:
        """Multiples of 1 / window of the sines, (m,), 0 for an input that is not probed.

        The weakest input has the lowest frequency, because it moves the aircraft the least.
        """
        probed = np.flatnonzero(self.amplitudes(outputs))
        first = max(round(self.lowest * self.window), GAP)
        harmonics = np.zeros(len(outputs))
        ordered = probed[np.argsort(-np.array(input_scale)[probed], kind="stable")]
        harmonics[ordered] = first + GAP * np.arange(len(probed))
        return harmonics


class Probe(NamedTuple):
    """Sines of m inputs."""

    amplitude: FloatArray  # (m,) units of u
    harmonic: FloatArray  # (m,) whole multiples of 1 / window, 0 without a sine
    window_ns: int

    def at(self, stamp_ns: int) -> FloatArray:
        """Amplitude sin(2 pi harmonic t / window) at a stamp, (m,).

        Flight and replay have the same value.
        """
        part = (stamp_ns % self.window_ns) / self.window_ns
        return np.asarray(self.amplitude * np.sin(2.0 * np.pi * self.harmonic * part))


class EffectTest:
    """The effect of each probed input over the last window.

    Args:
        probe: The sines.
        gain: abs(y / u) of the model at the frequency of each sine, (m,).
        false_alarm: Probability, see `most`.
    """

    def __init__(self, probe: Probe, gain: FloatArray, false_alarm: float) -> None:
        from scipy.special import stdtrit  # noqa: PLC0415 - a flight without a probe starts faster

        self._probe = probe
        self._gain = gain
        self._probed = np.flatnonzero(probe.amplitude)
        sines = probe.harmonic[self._probed].astype(int)
        low = int(sines.min()) - GAP + 1
        self._harmonics = np.arange(low, int(sines.max()) + GAP)
        self._sines = sines - low
        self._between = np.setdiff1d(np.arange(len(self._harmonics)), self._sines)
        self._quantile = float(stdtrit(2.0 * len(self._between), 1.0 - false_alarm))
        bins = probe.window_ns // BIN_NS
        self._means: deque[FloatArray] = deque(maxlen=bins)  # t, y, u of the bins
        self._every = max(bins // TESTS, 1)
        self.clear()

    def clear(self) -> None:
        """Begin again, as at an engagement."""
        self._means.clear()
        self._bin = -1
        self._samples: list[FloatArray] = []

    def take(self, stamp_ns: int, y: FloatArray, u: FloatArray) -> FloatArray | None:
        """Take a tick: `most` where a test is due, else None."""
        place = stamp_ns // BIN_NS
        result = None
        if place != self._bin:
            if self._samples:
                self._means.append(np.mean(self._samples, axis=0))
            self._samples = []
            due = place // self._every != self._bin // self._every
            self._bin = place
            if due and self._is_filled(stamp_ns):
                result = self.most()
        self._samples.append(np.concatenate([[stamp_ns / NANOSECONDS], y, u]))
        return result

    def _is_filled(self, stamp_ns: int) -> bool:
        begin = (stamp_ns - self._probe.window_ns) / NANOSECONDS
        while self._means and self._means[0][0] < begin:
            self._means.popleft()
        return len(self._means) >= FILLED * (self._means.maxlen or 0)

    def most(self) -> FloatArray:
        """The largest effect of each input that fits the window, (m,), parts of the model's.

        UNKNOWN without a sine.

            H = Y(f) / U(f),  R = Y - H (f / f') U  at the frequencies f' between the sines
            s^2 = mean abs(R)^2 / 2
            most = (abs(H) + q s / abs(U(f))) / gain

        with Y and U the complex amplitudes by least squares, beside a cubic, and q the quantile of
        Student's t of two degrees of freedom a frequency: for noise that is Gaussian and flat over
        the frequencies, an input falls below its true effect with a probability of `false_alarm` at
        most. The law answers the sine and the disturbances, so H is the quotient of y and the
        command, each correlated with the sine.
        """
        window = np.array(self._means)
        t = (window[:, 0] - window[-1, 0]) / (self._probe.window_ns / NANOSECONDS)
        angle = 2.0 * np.pi * np.outer(t, self._harmonics)
        drift = np.polynomial.legendre.legvander(2.0 * t + 1.0, DRIFT)
        basis = np.hstack([drift, np.cos(angle), np.sin(angle)])
        fit = np.linalg.lstsq(basis, window[:, 1:], rcond=None)[0][DRIFT + 1 :]
        cosine, sine = np.split(fit, 2)
        Y, U = np.split(cosine - 1j * sine, 2, axis=1)
        most = np.full(len(self._gain), UNKNOWN)
        for i, place in zip(self._probed.tolist(), self._sines.tolist(), strict=True):
            size = abs(U[place, i])
            if size < LEAST_SINE * self._probe.amplitude[i]:
                continue  # a u that rests at a limit tells nothing
            H = Y[place, i] / U[place, i]
            slope = self._harmonics[place] / self._harmonics[self._between]
            residual = Y[self._between, i] - H * slope * U[self._between, i]
            s = np.sqrt(np.mean(np.abs(residual) ** 2) / 2.0)
            most[i] = min((abs(H) + self._quantile * s / size) / self._gain[i], UNKNOWN)
        return most
