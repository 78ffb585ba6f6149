# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Child processes of the benchmarks, their output, their processor time and their host delays."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import psutil
from benchmarks.host_delays import Intervals

RISE_DI = str(Path(sys.executable).parent / "rise-di")
ENDS_WITHIN = 30.0  # s
PRIORITY = 50  # SCHED_FIFO, as that of ros2_control


class Child:
    """A role of benchmarks/speed_nodes.py, or a module (with a dot in its name), as a process.

    It is a context manager.
    """

    def __init__(self, role: str, *arguments: str, within: Sequence[str] = ()) -> None:
        module = (role,) if "." in role else ("benchmarks.speed_nodes", role)
        command = [*within, sys.executable, "-m", *module, *arguments]
        self.popen = psutil.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )

    def __enter__(self) -> "Child":
        return self

    def __exit__(self, *_: object) -> None:
        if self.popen.poll() is None:
            self.popen.terminate()  # a killed peer remains in the graph for two more seconds
        try:
            self.popen.communicate(timeout=ENDS_WITHIN)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.communicate()

    def cpu_ns(self) -> int:
        """Return the processor time of its running threads, ns."""
        return threads_ns(self.popen.pid)

    def figures(self, timeout: float = 20.0) -> dict[str, Any]:
        """Wait for its end and return its JSON output. Raises RuntimeError without any."""
        output, _ = self.popen.communicate(timeout=timeout)
        lines = [line for line in output.splitlines() if line.startswith("{")]
        if not lines:
            raise RuntimeError(
                f"{' '.join(self.popen.args)} ended with status {self.popen.returncode} and "
                "without output"
            )
        figures: dict[str, Any] = json.loads(lines[-1])
        return figures

    def stop(self) -> dict[str, Any]:
        """Send SIGTERM and return its JSON output."""
        self.popen.terminate()
        return self.figures()


def threads_ns(pid: int) -> int:
    """Return the processor time of the threads of a process, ns.

    It comes from the kernel's schedstat, because psutil only resolves 10 ms.
    """
    total = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError):
            total += int((task / "schedstat").read_text(encoding="ascii").split()[0])
    return total


def real_time() -> tuple[str, ...]:
    """Return what runs a command at real-time priority; it is empty if that is not permitted."""
    prefix = (shutil.which("chrt") or "", "-f", str(PRIORITY))
    permitted = prefix[0] and not subprocess.run([*prefix, "true"], check=False).returncode  # noqa: S603
    return prefix if permitted else ()


@contextlib.contextmanager
def delay_monitors(allowed: bool) -> Iterator[Callable[[], Intervals] | None]:
    """Measure host delays with a process of the highest priority on each core, monotonic ns.

    Yields None if that is not allowed.
    """
    if not allowed:
        yield None
        return
    with contextlib.ExitStack() as stack:
        cores = sorted(os.sched_getaffinity(0))
        monitors = [
            stack.enter_context(Child("delay_monitor", "--core", str(core))) for core in cores
        ]
        yield lambda: [tuple(delay) for child in monitors for delay in child.stop()["delays"]]
