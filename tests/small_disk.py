# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A small disk to fill, where mounting one is allowed."""

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
    """A file system of so many bytes, mounted on a new folder."""
    mount, unmount = (shutil.which(command) for command in ("mount", "umount"))
    folder.mkdir()
    command = [str(mount), "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)]
    if not (mount and unmount) or subprocess.run(command, check=False, capture_output=True).returncode != 0:
        pytest.skip("a small file system may not be mounted here")
    try:
        yield folder
    finally:
        subprocess.run([unmount, str(folder)], check=True)


def fill(path: Path) -> None:
    """Take all the space that is left, in one piece: what somebody else gives up afterwards stays free."""
    with path.open("ab", buffering=0) as stream:
        taken = 0
        while free := free_bytes(path.parent):
            try:
                os.posix_fallocate(stream.fileno(), taken, free)
                taken += free
            except OSError as error:  # somebody else has taken some of it meanwhile
                if error.errno != errno.ENOSPC:
                    raise
