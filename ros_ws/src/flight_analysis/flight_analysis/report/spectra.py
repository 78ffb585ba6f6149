# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute power spectral densities of signals by Welch's method."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from flight_analysis.metrics import LONGEST_INTERVAL
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal
from flight_core.vectors import FloatArray

# samples of a window, 82 s at 100 Hz: however long a flight, it has no more frequencies than 14 min
MAX_WINDOW = 8192


def spectra(signal: Signal, period_ns: int) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return frequencies, Hz, and the amplitude spectral density of each channel, unit / sqrt(Hz).

    The method is Welch's (Welch 1967). The Hann windows overlap by half, each without its mean, and
    span a tenth of the flight, but at most MAX_WINDOW. If a sample is missing, the last one is
    repeated, for at most LONGEST_INTERVAL: a gap of the log may be of any length. The square of the
    density, integrated over the frequencies, is the variance.
    """
    places = np.round((signal.stamp_ns - signal.stamp_ns[0]) / period_ns).astype(np.int64)
    longest = max(round(LONGEST_INTERVAL * NANOSECONDS / period_ns), 1)
    places = np.cumsum(np.minimum(np.diff(places, prepend=0), longest))
    grid = np.arange(places[-1] + 1)
    values = signal.values[np.searchsorted(places, grid, side="right") - 1]
    window = max(min(len(grid) // 10, MAX_WINDOW), min(len(grid), 256))
    frequency, power = _welch(values, 1e9 / period_ns, window)
    return frequency[1:], dict(zip(signal.names, np.sqrt(power[1:]).T, strict=True))


def _welch(values: FloatArray, rate: float, window: int) -> tuple[FloatArray, FloatArray]:
    """Return frequencies, Hz, and one-sided power spectral density of the columns, (F, m).

    The result is that of `scipy.signal.welch`, but scipy.signal takes half a second to load, a
    tenth of a whole flight in one process.
    """
    hann = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(window) / window)
    # (parts, m, window)
    parts = sliding_window_view(values, window, axis=0)[:: window - window // 2]
    spectra = np.fft.rfft((parts - parts.mean(axis=-1, keepdims=True)) * hann)
    power: FloatArray = np.mean(np.abs(spectra) ** 2, axis=0).T / (rate * np.sum(hann**2))
    # Each frequency stands for its negative too, except 0 and the highest of an even window.
    power[1 : (window + 1) // 2] *= 2.0
    return np.fft.rfftfreq(window, 1.0 / rate).astype(np.float64), power
