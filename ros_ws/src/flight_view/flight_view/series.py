# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The samples of one topic in bounded memory: a long flight becomes coarser, and keeps its peaks."""

import numpy as np
from numpy.typing import NDArray

from flight_core.vectors import FloatArray

MAX_ROWS = 250_000
"""Rows of a topic. 40 channels then need 40 MB; 100 Hz last 42 min before the samples become coarser."""

FIRST_ROWS = 4096


class Series:
    """Rows of k channels in the order of their stamps, float32."""

    def __init__(self, names: tuple[str, ...], max_rows: int = MAX_ROWS) -> None:
        self.names = names
        self.count = 0
        self.thinned = 0  # how often the rows were halved
        self.refused = 0  # rows older than the row before them
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
        """Append rows. A row that is older than one before it is refused."""
        earliest = self._stamp_ns[self.count - 1] if self.count else np.iinfo(np.int64).min
        ordered = stamp_ns >= np.maximum.accumulate(np.concatenate([[earliest], stamp_ns]))[:-1]
        self.refused += int(np.count_nonzero(~ordered))
        stamp_ns, values = stamp_ns[ordered], values[ordered]
        for start in range(0, len(stamp_ns), self._max_rows // 2):
            part = slice(start, start + self._max_rows // 2)
            self._append_part(stamp_ns[part], values[part])

    def _append_part(self, stamp_ns: NDArray[np.int64], values: FloatArray) -> None:
        if self.count + len(stamp_ns) > self._max_rows:
            self._thin()
        end = self.count + len(stamp_ns)
        if end > len(self._stamp_ns):
            size = min(max(end, len(self._stamp_ns) * 3 // 2), max(end, self._max_rows))
            self._stamp_ns = np.resize(self._stamp_ns, size)
            self._values = np.resize(self._values, (size, len(self.names)))
        self._stamp_ns[self.count : end] = stamp_ns
        with np.errstate(over="ignore"):  # beyond float32 a value is drawn as infinite
            self._values[self.count : end] = values
        self.count = end

    def _thin(self) -> None:
        """Replace each four rows by two, the minima and the maxima of each channel: a plot keeps its peaks."""
        whole = self.count - self.count % 4
        groups = self._values[:whole].reshape(-1, 4, len(self.names))
        thin = np.stack([np.fmin.reduce(groups, axis=1), np.fmax.reduce(groups, axis=1)], axis=1)
        half = whole // 2
        self._stamp_ns[:half] = self._stamp_ns[:whole:2].copy()
        self._values[:half] = thin.reshape(half, len(self.names))
        self.count, self.thinned = half, self.thinned + 1
