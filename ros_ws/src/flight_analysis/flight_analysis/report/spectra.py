# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute power spectral densities of signals by Welch's method."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from flight_analysis.metrics.time_spans import LONGEST_INTERVAL
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal
from flight_core.vectors import FloatArray

# Largest number of samples of a window, which is 82 s at 100 Hz. A longer flight than 14 min
# therefore has no lower frequencies in its spectrum.
MAX_WINDOW = 8192


def spectra(signal: Signal, period_ns: int) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return the frequencies, Hz, and each channel's amplitude spectral density, unit / sqrt(Hz).

    The method is Welch's (1967). The Hann windows overlap by half, and each has its mean removed. A
    window spans a tenth of the flight, but at most MAX_WINDOW. If a sample is missing, the last one
    is repeated, but for at most LONGEST_INTERVAL, because a gap of the log can have any length. The
    integral of the squared density over the frequencies is the variance.
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
    """Return the frequencies, Hz, and the one-sided power spectral density of each column, (F, m).

    The result equals the result of `scipy.signal.welch`. SciPy's function is not used, because
    loading it takes half a second, a tenth of the time of a whole flight in one process.
    """
    hann = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(window) / window)
    # (parts, m, window)
    parts = sliding_window_view(values, window, axis=0)[:: window - window // 2]
    spectra = np.fft.rfft((parts - parts.mean(axis=-1, keepdims=True)) * hann)
    power: FloatArray = np.mean(np.abs(spectra) ** 2, axis=0).T / (rate * np.sum(hann**2))
    # Each frequency counts for its negative as well, except 0 and the highest one of an even
    # window.
    power[1 : (window + 1) // 2] *= 2.0
    return np.fft.rfftfreq(window, 1.0 / rate).astype(np.float64), power
