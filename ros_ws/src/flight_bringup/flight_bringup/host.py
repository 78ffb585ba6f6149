# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure whether this host is fast enough to fly in real time.

For half a second, as many processes compute as the flight will have, and each process reports the
fraction of a core that it got. Two other measures are of no use: the load of the host, and the
delay with which a sleeping process wakes. Both look alike on a host that can fly and on one that
cannot.
"""

import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.display_units import unlike_numbers
from flight_bringup.graph import FIRST_STAGE, LEARNER, second_stage
from flight_core.outcome import Refusal
from flight_core.parameters import require

LOOK = 0.5  # s for which the processes compute, about a hundred time slices of the scheduler

CORES_A_NODE = 0.35
"""Cores that a node needs in a process of its own. The four nodes of osprey_servo take 1.3 on two
idle cores."""

CORES_A_PROCESS = 0.6
"""Cores that all nodes of an aircraft need in one process. They take 0.35, but if a host has no
more to spare, one process gets a single share and the flight loses most of its samples."""

SPINNER = """\
import sys, time
sys.stdout.write(".")
sys.stdout.flush()
sys.stdin.read(1)
begin, used = time.monotonic(), time.process_time()
while time.monotonic() < begin + float(sys.argv[1]):
    pass
print((time.process_time() - used) / (time.monotonic() - begin))
"""
"""Program that says it has started, waits for a byte, spins, and prints its share of a core."""

CoresGiven = Callable[[int], float]
"""Returns how many cores the host gives to a number of processes together."""


def processes_of(scenario: Scenario, *, composed: bool) -> int:
    """Return the number of processes of a flight that compute all the time.

    The learner is not included, because it searches only now and then, and a late model harms no
    flight.
    """
    if composed:
        return 1
    nodes = (*FIRST_STAGE, *second_stage(scenario))
    return sum(node is not LEARNER for node in nodes)


def shortage(
    scenarios: Sequence[Scenario], cores_given: CoresGiven, *, composed: bool = False
) -> Refusal | None:
    """Say how many cores are missing to fly scenarios together in real time, or return None.

    The text continues a sentence that begins with "this host", as in "gives 0.5 of the 1.4 cores
    that a flight in real time needs". `cores_given` measures what the host gives.
    """
    processes = sum(processes_of(scenario, composed=composed) for scenario in scenarios)
    needed = processes * (CORES_A_PROCESS if composed else CORES_A_NODE)
    given = cores_given(processes)
    if given >= needed:
        return None
    shown = unlike_numbers(given, needed)
    return Refusal(f"gives {shown[0]} of the {shown[1]} cores that a flight in real time needs")


def cores_given(processes: int) -> float:
    """Measure how many cores the host gives to processes that compute together for LOOK.

    Raises ParameterError if they cannot be started.
    """
    command = [sys.executable, "-I", "-S", "-c", SPINNER, str(LOOK)]
    shares = []
    with ExitStack() as stack:
        spinners = [
            stack.enter_context(
                subprocess.Popen(  # noqa: S603 - our own interpreter
                    command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
                )
            )
            for _ in range(processes)
        ]
        for spinner in spinners:
            if spinner.stdout is not None:
                spinner.stdout.read(1)
        # All processes have started, so they spin over the same time.
        for spinner in spinners:
            if spinner.stdin is not None:
                spinner.stdin.write(".")
                spinner.stdin.flush()
        for spinner in spinners:
            line = "" if spinner.stdout is None else spinner.stdout.read()
            require(bool(line.strip()), "this host", "no answer of a process", "a share of a core")
            shares.append(float(line))
    return sum(shares)
