# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the spans of a flight in which something holds, and the time that a sample stands for."""

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from flight_core.vectors import FloatArray

Windows = Mapping[str, tuple[float, float]]

LONGEST_INTERVAL = 1.0
"""Longest time for which a sample stands, s. A longer interval is a gap in the log, and the rest of
the interval does not count."""


def mask_spans(
    t: FloatArray, mask: NDArray[np.bool_], min_length: float = 0.0
) -> list[tuple[float, float]]:
    """Return the start and the stop, s, of each run of True in a mask of shape (N,).

    A run stops at the next False sample. If two spans are less than `min_length` apart, they are
    merged. If a span is shorter than `min_length`, it is lengthened to this length.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    spans: list[tuple[float, float]] = []
    for first, after in zip(edges[::2], edges[1::2], strict=True):
        start = float(t[first])
        stop = max(float(t[min(after, len(t) - 1)]), start + min_length)
        if spans and start - spans[-1][1] < min_length:
            start, _ = spans.pop()
        spans.append((start, stop))
    return spans


def is_in_spans(
    t: FloatArray, spans: Iterable[tuple[float, float]], settle: float = 0.0
) -> NDArray[np.bool_]:
    """Return a mask, (N,), of the instants that are in a span or up to `settle` s after it.

    The instants t, (N,), must ascend.
    """
    inside = np.zeros(len(t), dtype=bool)
    for start, stop in spans:
        inside[np.searchsorted(t, start) : np.searchsorted(t, stop + settle, side="right")] = True
    return inside


def sample_times(stamp_ns: NDArray[np.int64]) -> FloatArray:
    """Return the length of time that each sample represents, (N,), s.

    It is half the sum of the intervals to both neighbours. An interval longer than LONGEST_INTERVAL
    is replaced by LONGEST_INTERVAL. The first and the last sample represent a whole interval, so
    that equal intervals give equal times.
    """
    if len(stamp_ns) < 2:
        return np.ones(len(stamp_ns))
    intervals = np.minimum(np.diff(stamp_ns) / 1e9, LONGEST_INTERVAL)
    times: FloatArray = (
        np.concatenate([intervals[:1], intervals]) + np.concatenate([intervals, intervals[-1:]])
    ) / 2.0
    return times
