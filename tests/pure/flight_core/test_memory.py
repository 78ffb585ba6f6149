# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the limit of a node's memory.

Each test has a process of its own, because a limit cannot be undone.
"""

import subprocess
import sys

ALLOCATE = (
    "from flight_core.memory import limit_memory; limit_memory(); print(len(bytearray({size})))"
)


def output(size: int, within: str = "true") -> str:
    command = f'{within}; exec "$0" -c "$1"'
    return subprocess.run(
        ["/bin/sh", "-c", command, sys.executable, ALLOCATE.format(size=size)],
        capture_output=True,
        text=True,
        check=False,
    ).stderr


def test_allocation_within_limit_succeeds() -> None:
    assert output(1 << 28) == ""


def test_allocation_beyond_limit_fails_in_this_process_alone() -> None:
    assert output(1 << 32).strip().endswith("MemoryError")


def test_lower_limit_of_user_is_kept() -> None:
    assert output(1 << 28, within="ulimit -d 200000").strip().endswith("MemoryError")  # kB
