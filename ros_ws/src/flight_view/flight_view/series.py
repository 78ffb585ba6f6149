# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Keep the samples of a topic in limited memory. Long flights become coarser but keep peaks."""

import numpy as np
from numpy.typing import NDArray

from flight_core.vectors import FloatArray

MAX_ROWS = 100_000
"""Largest number of rows of a topic. With it, 30 channels need 12 MB. The samples become coarser
after 17 min at 100 Hz, and after 33 min at 50 Hz."""

DISORDER_NS = 1_000_000_000
"""Largest disorder of stamps, ns. When a controller recovers from an overrun, a tick can be a few
ms older than the tick before."""

FIRST_ROWS = 4096
BLOCK = 4096  # number of rows that are thinned together, a multiple of four


class Series:
    """Rows of k channels in the order of their stamps, float32."""

    def __init__(self, names: tuple[str, ...], max_rows: int = MAX_ROWS) -> None:
        self.names = names
        self.count = 0
        self.thinned = 0  # how often the number of rows was halved
        self.refused = 0  # number of rows that were refused because they are too old
        self._max_rows = max_rows
        self._stamp_ns = np.zeros(FIRST_ROWS, dtype=np.int64)
        self._values = np.zeros((FIRST_ROWS, len(names)), dtype=np.float32)

    @property
    def stamp_ns(self) -> NDArray[np.int64]:
        """Stamps, shape (N,)."""
        return self._stamp_ns[: self.count]

    @property
    def values(self) -> NDArray[np.float32]:
        """Values, shape (N, k)."""
        return self._values[: self.count]

    def append(self, stamp_ns: NDArray[np.int64], values: FloatArray) -> None:
        """Append rows.

        A row that is up to DISORDER_NS older than an earlier row gets the stamp of the earlier row.
        A row that is even older is refused.
        """
        earliest = (
            self._stamp_ns[self.count - 1] if self.count else np.iinfo(np.int64).min + DISORDER_NS
        )
        ordered = np.maximum.accumulate(np.concatenate([[earliest], stamp_ns]))[1:]
        in_order = stamp_ns >= ordered - DISORDER_NS
        self.refused += int(np.count_nonzero(~in_order))
        ordered = ordered[in_order]
        values = values[in_order]
        for start in range(0, len(ordered), self._max_rows // 2):
            part = slice(start, start + self._max_rows // 2)
            self._append_part(ordered[part], values[part])

    def _append_part(self, stamp_ns: NDArray[np.int64], values: FloatArray) -> None:
        if self.count + len(stamp_ns) > self._max_rows:
            self._thin()
        end = self.count + len(stamp_ns)
        if end > len(self._stamp_ns):
            size = min(max(end, len(self._stamp_ns) * 3 // 2), max(end, self._max_rows))
            self._stamp_ns = np.concatenate(
                [self.stamp_ns, np.zeros(size - self.count, dtype=np.int64)]
            )
            self._values = np.concatenate(
                [self.values, np.zeros((size - self.count, len(self.names)), dtype=np.float32)]
            )
        self._stamp_ns[self.count : end] = stamp_ns
        # A value beyond the range of float32 is drawn as infinite.
        with np.errstate(over="ignore"):
            self._values[self.count : end] = values
        self.count = end

    def _thin(self) -> None:
        """Replace each group of four rows by two, the minima and the maxima of each channel.

        In this way a plot keeps its peaks.
        """
        grouped = self.count - self.count % 4
        k = len(self.names)
        # Rows are thinned in place, because temporary arrays of all rows would stay in the heap of
        # the process.
        for start in range(0, grouped, BLOCK):
            groups = self._values[start : min(start + BLOCK, grouped)].reshape(-1, 4, k)
            thin = np.stack(
                [np.fmin.reduce(groups, axis=1), np.fmax.reduce(groups, axis=1)], axis=1
            ).reshape(-1, k)
            self._values[start // 2 : start // 2 + len(thin)] = thin
        half = grouped // 2
        self._stamp_ns[:half] = self._stamp_ns[:grouped:2].copy()
        self.count = half
        self.thinned = self.thinned + 1
