# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the free space of a disk, and write files with reserved space."""

import errno
import fcntl
import os
import tempfile
from pathlib import Path
from typing import IO

NO_SPACE = (errno.ENOSPC, errno.EDQUOT)
RESERVE_STEP = 64 * 1024  # least growth of the reserve, bytes


def free_bytes(folder: Path) -> int:
    """Return how many bytes an unprivileged user can still write to the disk of a folder."""
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize


def try_lock(stream: IO[bytes] | int, kind: int = fcntl.LOCK_EX) -> bool:
    """Lock a file until the stream is closed.

    Returns False if another process, such as a recorder, holds the lock. On a file system without
    locks, the result is always True.
    """
    try:
        fcntl.flock(stream, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def is_locked(path: Path) -> bool:
    """Return whether another process, such as a recorder, holds the lock of a file.

    Raises OSError if the file cannot be opened.
    """
    with path.open("rb") as stream:
        return not try_lock(stream, fcntl.LOCK_SH)


class ReservedFile:
    """A new unbuffered file that reserves disk space, so that it can be finished on a full disk.

    A second, unnamed file occupies the reserved space, and stores the data of `keep`, which belong
    to the end of the first file. If a write finds no space, these data move into memory, the second
    file is closed, and the write succeeds. The reserve also ends with the process.
    """

    def __init__(self, path: Path) -> None:
        self._reserve = tempfile.TemporaryFile(dir=path.parent, buffering=0)  # noqa: SIM115 - open as long as this file
        try:
            self._descriptor = os.open(
                path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666
            )
        except OSError:
            self._reserve.close()
            raise
        try_lock(self._descriptor)
        self._reserved_bytes = 0
        # Number of bytes of kept data in the reserve; `release` moves these data to `_end_data`.
        self._kept_bytes = 0
        self._end_data = bytearray()
        self._position = 0
        self._closed = False
        self.is_full = False  # whether a write has needed the reserve

    def reserve(self, size: int) -> None:
        """Reserve `size` bytes in total.

        If there is not enough space, `full` is set and the earlier reserve stays. A call after
        `release` has no effect, because the last chunk is being written then.
        """
        if self.is_full or self._reserve.closed or size <= self._reserved_bytes:
            return
        self._reserved_bytes = size + RESERVE_STEP
        try:
            os.posix_fallocate(self._reserve.fileno(), 0, self._reserved_bytes)
        except OSError as error:
            # On a file system without fallocate there is no reserve.
            self.is_full = error.errno in NO_SPACE

    def keep(self, data: bytes) -> None:
        """Keep data that will be written to the end of the file.

        They are kept in the space that is reserved on the disk, or in memory if none is reserved.
        """
        if not self._reserve.closed:
            try:
                if os.pwrite(self._reserve.fileno(), data, self._kept_bytes) == len(data):
                    self._kept_bytes += len(data)
                    return
            except OSError as error:
                # On a file system without fallocate the reserve occupies no space.
                if error.errno not in NO_SPACE:
                    raise
            self.is_full = True
            self.release()
        self._end_data += data

    def kept_data(self) -> bytes:
        """Return the kept data. Call `release` first."""
        return bytes(self._end_data)

    def release(self) -> None:
        """Free the reserve, and move the kept data into memory."""
        if not self._reserve.closed:
            self._end_data += os.pread(self._reserve.fileno(), self._kept_bytes, 0)
            self._reserve.close()

    def write(self, data: bytes | memoryview) -> int:
        """Write the data.

        Raises OSError if the reserve does not suffice, or if the write fails for another reason.
        """
        unwritten = memoryview(data)
        size = unwritten.nbytes
        while unwritten:
            try:
                written = os.write(self._descriptor, unwritten)
            except OSError as error:
                if error.errno not in NO_SPACE or self._reserve.closed:
                    raise
                self.is_full = True
                self.release()
                continue
            self._position += written
            unwritten = unwritten[written:]
        return size

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self._position

    def flush(self) -> None:
        """Do nothing, because the file is unbuffered."""

    def close(self) -> None:
        """Close the file and free the reserve."""
        if not self._closed:
            self._closed = True
            self.release()
            os.close(self._descriptor)
