# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure what the modes of a flight cost, compared with a flight in one process without ROS.

The figures are the processor time, user and system, of each process and of all together, and the
wall time of the command. A busy host takes wall time from all modes, so they are flown in turn in
the same run, and only the ratios count.

    .venv/bin/python -m benchmarks.modes --duration 20 --repeat 3
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
import psutil
from benchmarks.processes import RISE_DI

from flight_core.outcome import STATUS_HOST

SCENARIO = "osprey_servo"
LOOK = 0.05  # s, between two looks at the processor times: an ended process has none
BASE = "in one process, without ROS"
MODES = {
    BASE: ["--in-process"],
    "four processes, real time": ["--real-time"],
    "lockstep, four processes": ["--lockstep"],
    "lockstep, composed": ["--lockstep", "--composed"],
}


class Cost(NamedTuple):
    """What a flight took, s."""

    processor: float
    wall: float
    by_process: dict[str, float]  # processor time, by module


def fly(options: Sequence[str], duration: float) -> Cost:
    """Fly once and return what it took."""
    times: dict[tuple[int, str], float] = {}
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as runs:
        words = [RISE_DI, "fly", SCENARIO, "--duration", f"{duration:g}", "--runs", runs, *options]
        command = psutil.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while command.poll() is None:
            with suppress(psutil.Error):
                for process in (command, *command.children(recursive=True)):
                    used = process.cpu_times()
                    times[process.pid, _module(process, command.pid)] = used.user + used.system
            time.sleep(LOOK)
    if command.returncode not in {0, STATUS_HOST}:
        sys.exit(f"error: {' '.join(words)} ended with status {command.returncode}")
    by_process: dict[str, float] = {}
    for (_, module), total in times.items():
        by_process[module] = by_process.get(module, 0.0) + total
    return Cost(sum(times.values()), time.monotonic() - begin, by_process)


def _module(process: psutil.Process, command: int) -> str:
    """Return the module that a process runs: the one after -m, or the command."""
    words = process.cmdline()
    has_module = process.pid != command and "-m" in words[:-1]
    return words[words.index("-m") + 1] if has_module else "rise-di fly"


def main() -> None:
    """Fly each mode in turn, several times, and print medians and ratios."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--duration", type=float, default=20.0, help="of a flight, s")
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    costs: dict[str, list[Cost]] = {mode: [] for mode in MODES}
    for _ in range(arguments.repeat):
        for mode, options in MODES.items():
            costs[mode].append(fly(options, arguments.duration))
    base_processor, base_wall = (
        float(np.median([cost[column] for cost in costs[BASE]])) for column in (0, 1)
    )
    print(f"{SCENARIO}, {arguments.duration:g} s, median of {arguments.repeat}")
    for mode, flown in costs.items():
        processor, wall = (float(np.median([cost[column] for cost in flown])) for column in (0, 1))
        print(
            f"{mode:30} processor {processor:6.1f} s, {processor / base_processor:4.1f} times; "
            f"wall {wall:6.1f} s, {wall / base_wall:4.1f} times"
        )
        shares = sorted(flown[-1].by_process.items(), key=lambda each: -each[1])
        print("    " + ", ".join(f"{module} {used:.1f}" for module, used in shares))


if __name__ == "__main__":
    main()
