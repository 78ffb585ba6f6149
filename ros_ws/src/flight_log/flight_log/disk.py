# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Files on a disk that may run full: how much is free, a file with room held for its end, a text replaced as a whole."""

import errno
import fcntl
import os
import tempfile
from pathlib import Path
from typing import IO

NO_SPACE = (errno.ENOSPC, errno.EDQUOT)
STEP = 64 * 1024  # bytes by which the room held grows at least


def free_bytes(folder: Path) -> int:
    """Bytes that an ordinary user may still write to the disk of a folder."""
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize


def replace_text(path: Path, text: str) -> None:
    """Write a text file so that it is there as a whole or, after a crash, as it was."""
    fresh = path.with_name(f"{path.name}.new")
    with fresh.open("w", encoding="utf-8") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    fresh.replace(path)


def lock(stream: IO[bytes] | int) -> bool:
    """Take the lock that a file being written has, until the stream is closed; whether it was free.

    On a file system without locks it always is.
    """
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


class ReservedFile:
    """A new file, unbuffered, with room held for its end, so that it can still be finished on a disk that has run full.

    The room is that of a second file without a name. It is given up for the first write that finds no space, which then
    succeeds, and goes with the process if that is killed.
    """

    def __init__(self, path: Path) -> None:
        self._reserve = tempfile.TemporaryFile(dir=path.parent, buffering=0)  # noqa: SIM115 - held as long as this one
        try:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        except OSError:
            self._reserve.close()
            raise
        lock(self._descriptor)
        self._held = 0
        self._place = 0
        self._closed = False
        self.full = False  # the room was needed

    def hold(self, size: int) -> None:
        """Hold room for so many bytes; where there is none the disk counts as full, and what was held stays so."""
        if self.full or size <= self._held:
            return
        self._held = size + STEP
        try:
            os.posix_fallocate(self._reserve.fileno(), 0, self._held)
        except OSError as error:  # a file system that can hold no room does without
            self.full = error.errno in NO_SPACE

    def release(self) -> None:
        """Give up the room held."""
        self._reserve.close()

    def write(self, data: bytes | memoryview) -> int:
        """Write all of it. Raises OSError where the room held did not suffice, or for any other reason."""
        rest = memoryview(data)
        size = rest.nbytes
        while rest:
            try:
                written = os.write(self._descriptor, rest)
            except OSError as error:
                if error.errno not in NO_SPACE or self._reserve.closed:
                    raise
                self.full = True
                self.release()
                continue
            self._place += written
            rest = rest[written:]
        return size

    def tell(self) -> int:
        """How much was written."""
        return self._place

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        """Close it, and give up the room held."""
        if not self._closed:
            self._closed = True
            self.release()
            os.close(self._descriptor)
