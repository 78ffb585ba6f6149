# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Real processes over real DDS: each test in a domain of its own, and nothing left running after it."""

import itertools
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import psutil
import pytest

_numbers = itertools.count(os.getpid())

Start = Callable[..., "Process"]


class Process:
    """A process under test, its output collected line by line."""

    def __init__(self, *arguments: str, cwd: Path, within: Sequence[str] = (), stdin: int | None = None) -> None:
        self.popen = subprocess.Popen(
            [*within, sys.executable, "-m", *arguments],
            cwd=cwd,
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.lines: list[str] = []
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.popen.stdout is not None
        for line in self.popen.stdout:
            with self._changed:
                self.lines.append(line.rstrip())
                self._changed.notify_all()

    @property
    def output(self) -> str:
        """All that was said so far."""
        return "\n".join(self.lines)

    def wait_for(self, text: str, timeout: float = 30.0) -> None:
        """Until a line holds the text."""
        with self._changed:
            said = self._changed.wait_for(lambda: any(text in line for line in self.lines), timeout)
        assert said, f"{text!r} not said within {timeout} s; said:\n{self.output}"

    def children(self) -> list[psutil.Process]:
        """Its processes."""
        return psutil.Process(self.popen.pid).children(recursive=True)

    def interrupt(self) -> None:
        """As Ctrl-C does."""
        self.popen.send_signal(signal.SIGINT)

    def end(self, timeout: float = 30.0) -> int:
        """Wait for the end; the exit status."""
        try:
            status = self.popen.wait(timeout)
        except subprocess.TimeoutExpired:
            pytest.fail(f"still running after {timeout} s; said:\n{self.output}")
        self._reader.join()
        assert self.popen.stdout is not None
        self.popen.stdout.close()
        return status


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """A ROS domain that no other test is in; 1 to 100 keep clear of the ports that Linux gives away."""
    number = 1 + next(_numbers) % 100
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    return number


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start `python -m MODULE ...` in the test's folder, `within` another command.

    Whatever still runs at the test's end is killed, with its children.
    """
    started: list[Process] = []

    def begin(*arguments: str, within: Sequence[str] = ()) -> Process:
        started.append(Process(*arguments, cwd=tmp_path, within=within))
        return started[-1]

    yield begin
    for process in started:
        if process.popen.poll() is None:
            for child in process.children():
                child.kill()
            process.popen.kill()
        process.end()
