# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Mount a small file system for tests of a full disk. They are skipped without the permission."""

import errno
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from flight_log.disk import free_bytes


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    """Mount a file system of `size` bytes on a new folder."""
    mount, unmount = (shutil.which(command) for command in ("mount", "umount"))
    folder.mkdir()
    command = [str(mount), "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)]
    if (
        not (mount and unmount)
        or subprocess.run(command, check=False, capture_output=True).returncode != 0
    ):
        pytest.skip("no permission to mount a small file system")
    try:
        yield folder
    finally:
        subprocess.run([unmount, str(folder)], check=True)


def fill(path: Path) -> None:
    """Allocate all free space once. Space that another process frees later stays free."""
    with path.open("ab", buffering=0) as stream:
        taken_bytes = 0
        while free := free_bytes(path.parent):
            try:
                os.posix_fallocate(stream.fileno(), taken_bytes, free)
                taken_bytes += free
            except OSError as error:  # another process has allocated a part of it
                if error.errno != errno.ENOSPC:
                    raise
