# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a deadline ends a process with its exit status, whatever holds the interpreter."""

import subprocess
import sys

import pytest

HOLDS_THE_INTERPRETER = "ctypes.PyDLL(None).sleep(60)"  # PyDLL does not release the GIL
BEGIN = "import ctypes, threading, time\nfrom flight_core.deadline import Deadline\n"
LIMIT = 30.0  # s, half of the sleep: the host may be busy


def end_of(code: str) -> tuple[int, str, str]:
    """Return the exit status and the output of a program."""
    process = subprocess.run(
        [sys.executable, "-c", BEGIN + code],
        check=False,
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )
    return process.returncode, process.stdout, process.stderr


@pytest.mark.parametrize("status", [0, 2, 3])
def test_process_ends_with_the_status_and_its_output_while_a_call_holds_the_interpreter(
    status: int,
) -> None:
    # 2 s: what holds the interpreter is told at nine tenths of it, and a busy host may be late
    code = f"print('last line')\nDeadline(2.0, {status})\n{HOLDS_THE_INTERPRETER}\n"
    found, output, stacks = end_of(code)
    assert (found, output) == (status, "last line\n")
    assert "Timeout" in stacks, "what held it is told"


def test_process_without_the_need_of_a_deadline_ends_as_without_it() -> None:
    assert end_of("Deadline(20.0, 3)\n") == (0, "", "")


def test_cancelled_deadline_ends_nothing() -> None:
    code = "with Deadline(0.2, 3):\n    pass\ntime.sleep(0.6)\nprint('goes on')\n"
    assert end_of(code) == (0, "goes on\n", "")


def test_deadline_holds_beside_threads_of_python() -> None:
    """A thread that waits for the interpreter does not delay the deadline."""
    code = "threading.Thread(target=time.sleep, args=(60,)).start()\nDeadline(0.3, 3)\n"
    assert end_of(f"{code}{HOLDS_THE_INTERPRETER}\n")[0] == 3
