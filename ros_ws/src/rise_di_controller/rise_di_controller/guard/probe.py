# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Probe the inputs while the law is engaged, to find an input that has no effect.

In calm air a surface that is stuck at trim causes no error, so only a probe can find it.

A sine is added to the command of each probed input. The frequencies of the sines differ. Over a
window all sines are orthogonal to each other, and to the frequencies between them, at which the
disturbances are measured.
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
EFFECT = 0.02  # default amplitude of a body rate, rad/s; ArduPlane has 0.006 rms noise
GAP = 4  # distance of two sines in frequency, 1 / window; disturbances are measured in between
BIN_NS = NANOSECONDS // 20  # length of the bins over which y and u are averaged
TESTS = 12  # tests in a window
FILLED = 0.8  # fraction of the bins of a window that a test needs
DRIFT = 3  # degree of the polynomial for motions slower than the window, as in a turn
LEAST_SINE = 0.05  # least fraction of a sine that must be left in u after its limits
LARGEST = 4.0  # highest frequency of a sine, Hz, with five bins a period


class ProbeConfig(Config):
    """Probe of the inputs, an extension that finds a stuck surface even if no command moves it."""

    effect: NonNegatives | None = Field(
        default=None,
        description="amplitude of each output under its sine; 0: not probed; none: 0.02 rad/s for "
        "p, q, r, else 0",
    )
    lowest: Positive = Field(
        default=1.5,
        description="lowest frequency of a sine, Hz, above the frequencies of guidance commands",
    )
    window: Annotated[float, Field(ge=2, le=60)] = Field(
        default=6.0, description="time over which the response is measured, s"
    )
    false_alarm: Annotated[float, Field(ge=1e-9, le=0.05)] = Field(
        default=1e-3,
        description="largest probability of a false alarm in a window",
    )

    def amplitudes(self, outputs: tuple[str, ...]) -> FloatArray:
        """Return by how much the probe may move each output, (m,), units of y."""
        rates = tuple(EFFECT if name in RATES else 0.0 for name in outputs)
        return np.array(self.effect or rates)

    def harmonics(self, outputs: tuple[str, ...], input_scale: tuple[float, ...]) -> FloatArray:
        """Choose the frequency of each sine as a multiple of 1 / window, (m,).

        An input that is not probed has the multiple 0. The weakest input gets the lowest frequency,
        because it moves the aircraft the least.
        """
        probed = np.flatnonzero(self.amplitudes(outputs))
        first = max(round(self.lowest * self.window), GAP)
        harmonics = np.zeros(len(outputs))
        ordered = probed[np.argsort(-np.array(input_scale)[probed], kind="stable")]
        harmonics[ordered] = first + GAP * np.arange(len(probed))
        return harmonics


class Probe(NamedTuple):
    """The sines that a controller adds to its m inputs."""

    amplitude: FloatArray  # amplitude of each sine, (m,), units of u
    harmonic: FloatArray  # frequencies as integer multiples of 1 / window, (m,), 0 without a sine
    window_ns: int

    def at(self, stamp_ns: int) -> FloatArray:
        """Evaluate amplitude sin(2 pi harmonic t / window) at a stamp, (m,).

        A replay gets the same value as the flight, because t is the stamp.
        """
        part = (stamp_ns % self.window_ns) / self.window_ns
        return np.asarray(self.amplitude * np.sin(2.0 * np.pi * self.harmonic * part))


class EffectTest:
    """Tests the effect of each probed input over the last window.

    Args:
        probe: The sines.
        gain: abs(y / u) of the model at the frequency of each sine, (m,).
        false_alarm: Probability of a false alarm in a window, see `most`.
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
        self._means: deque[FloatArray] = deque(maxlen=bins)  # means of t, y and u in each bin
        self._every = max(bins // TESTS, 1)
        self.clear()

    def clear(self) -> None:
        """Forget all recorded ticks, which is necessary when the law engages."""
        self._means.clear()
        self._bin = -1
        self._samples: list[FloatArray] = []

    def take(self, stamp_ns: int, y: FloatArray, u: FloatArray) -> FloatArray | None:
        """Record a tick. If a test is due, return the result of `most()`, else None."""
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
        """Compute an upper bound of the effect of each input over the window, (m,).

        The bound is a fraction of the effect in the model. It is UNKNOWN for an input without a
        sine.

            H = Y(f) / U(f),  R = Y - H (f / f') U  at the frequencies f' between the sines
            s^2 = mean abs(R)^2 / 2
            most = (abs(H) + q s / abs(U(f))) / gain

        Y and U are the complex amplitudes, fitted by least squares together with a cubic. q is the
        quantile of Student's t with two degrees of freedom per frequency. If the noise is Gaussian
        and flat over the frequencies, the result falls below the true effect of an input with a
        probability of at most `false_alarm`.

        y is not fitted to the command, because the command also contains the response of the law to
        the disturbances. Instead H is the correlation of y with the sine, divided by the
        correlation of the command with the sine.
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
                continue  # a u that stays at a limit shows nothing
            H = Y[place, i] / U[place, i]
            slope = self._harmonics[place] / self._harmonics[self._between]
            residual = Y[self._between, i] - H * slope * U[self._between, i]
            s = np.sqrt(np.mean(np.abs(residual) ** 2) / 2.0)
            most[i] = min((abs(H) + self._quantile * s / size) / self._gain[i], UNKNOWN)
        return most
