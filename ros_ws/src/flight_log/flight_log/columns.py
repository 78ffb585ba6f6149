# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Store the samples of a topic as columns, a short topic in memory, a long one in a temporary file.

Metrics and figures use whole channels, one after another. An hour of `truth` takes 400 MB, but each
of its channels only 14 MB.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from tempfile import TemporaryFile
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

from flight_core.parameters import ParameterError
from flight_core.tape import Signal
from flight_core.vectors import FloatArray

IN_MEMORY = 32_000_000
"""Largest size of a topic that stays in memory, bytes. 28 channels of `truth` at 500 Hz need more
after 5 min."""


class Columns:
    """Samples in the order of arrival, with stamps and rows of equal length.

    The rows are read as columns, which are contiguous in memory. At first there is space for
    `expected` samples, and the space grows with further samples. Raises ParameterError if no
    temporary file can hold a long topic.
    """

    def __init__(self, width: int, expected: int) -> None:
        self.count = 0
        self._width = width
        self._number_of_sender: dict[str, int] = {}  # number of each publisher by its name
        # number of the publisher of each sample, by appended part
        self._sender_of_rows: list[NDArray[np.int16]] = []
        self._stamp_ns, self._store = self._new(expected)

    @property
    def senders(self) -> list[str]:
        """Names of the publishers, in the order of their numbers."""
        return [*self._number_of_sender]

    def _new(self, capacity: int) -> tuple[NDArray[np.int64], "_MemoryColumns | _FileColumns"]:
        kind = _FileColumns if 8 * self._width * capacity > IN_MEMORY else _MemoryColumns
        return np.empty(capacity, np.int64), kind(self._width, capacity)

    def append(self, stamp_ns: NDArray[np.int64], rows: FloatArray, sender: str = "") -> None:
        """Append samples of a publisher: stamps (N,) and rows (N, k)."""
        end = self.count + len(rows)
        number = self._number_of_sender.setdefault(sender, len(self._number_of_sender))
        self._sender_of_rows.append(np.full(len(rows), number, np.int16))
        if end > len(self._stamp_ns):
            stamps = self._stamp_ns
            store = self._store
            self._stamp_ns, self._store = self._new(end + end // 2)
            self._stamp_ns[: self.count] = stamps[: self.count]
            for index in range(self._width):
                self._store.write(index, 0, store.read(index, index + 1, self.count)[:, 0])
        self._stamp_ns[self.count : end] = stamp_ns
        for index, column in enumerate(rows.T):
            self._store.write(index, self.count, column)
        self.count = end

    def signal(self, names: tuple[str, ...]) -> Signal:
        """Return the samples as a signal, in the order of arrival."""
        stamp_ns = self._stamp_ns[: self.count]
        sender = np.concatenate(self._sender_of_rows) if len(self._number_of_sender) > 1 else None
        if isinstance(self._store, _FileColumns):
            return _StoredSignal(
                stamp_ns=stamp_ns, names=names, sender=sender, store=self._store, first=0
            )
        return Signal(stamp_ns, names, self._store.read(0, self._width, self.count), sender)


class _MemoryColumns:
    def __init__(self, width: int, capacity: int) -> None:
        self._array = np.empty((width, capacity))

    def write(self, index: int, start: int, values: FloatArray) -> None:
        self._array[index, start : start + len(values)] = values

    def read(self, first: int, end: int, count: int) -> FloatArray:
        return self._array[first:end, :count].T


class _FileColumns:
    """Columns in a temporary file without a name.

    The columns are written to the file immediately. They are mapped into memory only while an array
    of the columns is in use.
    """

    def __init__(self, width: int, capacity: int) -> None:
        self._capacity = capacity
        self._shape = (width, capacity)
        with _on_disk():
            self._file = TemporaryFile()  # noqa: SIM115 - open as long as a signal uses it
            finalize(self, self._file.close)
            self._file.truncate(8 * width * capacity)

    def write(self, index: int, start: int, values: FloatArray) -> None:
        with _on_disk():
            self._file.seek(8 * (index * self._capacity + start))
            self._file.write(np.ascontiguousarray(values).data)

    def read(self, first: int, end: int, count: int) -> FloatArray:
        """Read columns `first` to `end`, shape (count, end - first)."""
        with _on_disk():
            self._file.flush()
        if not self._capacity or first == end:
            return np.empty((count, end - first))
        return np.asarray(np.memmap(self._file, np.float64, "r", shape=self._shape))[
            first:end, :count
        ].T


@contextmanager
def _on_disk() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        expected = "space for the samples of a long log: set TMPDIR to a folder with it"
        raise ParameterError(
            f"a temporary file: cannot be written ({error.strerror}), expected {expected}"
        ) from None


class _StoredSignal(Signal):
    """A signal whose values are in a file.

    The channels are the columns of the file from `first` on. Each access to `values` maps the file
    into memory. The memory is freed when you drop the array, so in a loop, keep the array.
    """

    def __init__(
        self,
        stamp_ns: NDArray[np.int64],
        names: tuple[str, ...],
        sender: NDArray[np.int16] | None,
        store: _FileColumns,
        first: int,
    ) -> None:
        for name, value in (
            ("stamp_ns", stamp_ns),
            ("names", names),
            ("sender", sender),
            ("_store", store),
            ("_first", first),
        ):
            object.__setattr__(self, name, value)

    _store: _FileColumns
    _first: int

    @property
    def values(self) -> FloatArray:
        return self._store.read(self._first, self._first + len(self.names), len(self.stamp_ns))

    def until(self, end_ns: int) -> Signal:
        count = int(np.searchsorted(self.stamp_ns, end_ns, side="right"))
        sender = None if self.sender is None else self.sender[:count]
        return _StoredSignal(
            stamp_ns=self.stamp_ns[:count],
            names=self.names,
            sender=sender,
            store=self._store,
            first=self._first,
        )

    def group(self, prefix: str) -> Signal:
        names = [name for name in self.names if name.startswith(f"{prefix}.")]
        first = self.names.index(names[0]) if names else 0
        if tuple(names) != self.names[first : first + len(names)]:
            return super().group(prefix)
        return _StoredSignal(
            stamp_ns=self.stamp_ns,
            names=tuple(name.removeprefix(f"{prefix}.") for name in names),
            sender=self.sender,
            store=self._store,
            first=self._first + first,
        )
